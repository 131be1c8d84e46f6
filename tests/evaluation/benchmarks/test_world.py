"""What steps of a simulated task take, in both ways and without anything but the physics."""

from torchrl_sparse.evaluation.benchmarks.world import measure_world
from torchrl_sparse.evaluation.results.result_files import read_tables
from torchrl_sparse.evaluation.results.world_report import format_world_profile, load_world_profile
from torchrl_sparse.storage.json import write_json


def test_a_task_is_measured_and_told(tmp_path):
    found = measure_world(["lift"], threads=1, repeats=1, warmup=0)
    times = found.tasks["lift"]
    assert 0 < times.physics_s < min(times.compiled_step_s, times.python_step_s)
    assert min(times.compiled_reset_s, times.python_reset_s) > 0
    write_json(tmp_path / "world.json", found)
    assert load_world_profile(tmp_path / "world.json") == found
    (row,) = read_tables(tmp_path / "world.json")["world"].rows
    assert row["simulated task"] == "lift"
    told = format_world_profile(found)
    assert " lift |" in told
    assert found.machine.cpu in told
