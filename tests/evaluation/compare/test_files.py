"""Anybody's files are read, by kind, and refused where they do not tell what they should."""

import json

import pytest

from tests.evaluation.synthetic import make_results, make_runs
from tests.refusals import refused
from torchrl_sparse.evaluation.compare.files import read_methods
from torchrl_sparse.evaluation.compare.outcomes import Start
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog
from torchrl_sparse.storage.json import write_json

# as vla-eval 0.8.0's ResultCollector writes it
VLA_EVAL = {
    "benchmark": "pusht", "mode": "sync", "harness_version": "0.8.0", "created_at": "2026-11-29", "num_errors": 1, "seed": 7,
    "tasks": [{"task": "push", "num_episodes": 2, "avg_steps": 15.0, "episodes": [
        {"episode_id": 0, "metrics": {"success": True}, "steps": 30},
        {"episode_id": 1, "metrics": {"success": False}, "failure_reason": "timeout", "failure_detail": "x"},
    ]}], "config": {},
}  # fmt: skip
VERBOSE = """
rollout: env=Lift, horizon=400, use_goals=False, num_episodes=2
Episode 1, horizon=400, num_success=1.0
{
    "Horizon": 41,
    "Success_Rate": 1.0
}
Episode 2, horizon=400, num_success=1.0
{
    "Horizon": 400,
    "Success_Rate": 0.0
}

Epoch 20 Rollouts took 3.1s (avg) with results:
Env: Lift
{
    "Success_Rate": 0.5
}
"""
MEANS = """
rollout: env=Lift, horizon=400, use_goals=False, num_episodes=50

Epoch {epoch} Rollouts took 3.1s (avg) with results:
Env: Lift
{{
    "Success_Rate": {rate}
}}
"""


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return path


def lerobot(successes, group="libero", task=0):
    metrics = {"sum_rewards": [1.0] * len(successes), "max_rewards": [1.0] * len(successes)}
    metrics |= {"successes": successes, "video_paths": []}
    return {"task_group": group, "task_id": task, "metrics": metrics}


def told(method):
    return [(o.start and o.start.number, o.success, o.steps) for o in method.outcomes]


def test_our_results_with_their_logs(tmp_path):
    results = make_results(8, names=("dense", "bac"))
    save_results(results, tmp_path / "results.json")
    for name, run in make_runs(8, names=("dense", "bac")).items():
        log = EpisodeLog(tmp_path / "episodes" / f"{name}.jsonl", {"task": "lift"})
        for index, episode in enumerate(run.episodes):
            log.append(type(episode)(**{**vars(episode), "seed": results.first_seed + index}))
    dense, bac = read_methods([tmp_path])
    assert (dense.name, bac.name, dense.horizon) == ("dense", "bac", results.episode_horizon)
    assert dense.solved == results.dense.success.k
    alone = read_methods([tmp_path / "episodes"])
    assert [told(method) for method in alone] == [told(dense), told(bac)]
    assert [method.name for method in read_methods([tmp_path / "episodes" / "bac.jsonl"])] == ["bac"]
    (tmp_path / "episodes" / "bac.jsonl").unlink()
    with refused("bac.jsonl", FileNotFoundError):
        read_methods([tmp_path])


def test_lerobots_tasks_and_its_episodes_with_seeds(tmp_path):
    current = {"per_task": [lerobot([True, False]), lerobot([True], task=1)], "per_group": {}, "overall": {}}
    earlier = {"per_episode": [{"episode_ix": 0, "success": True, "seed": 1000, "max_reward": 0.7}]}
    paths = [
        write(tmp_path / f"{name}/eval_info.json", data) for name, data in (("a", current), ("b", earlier))
    ]
    a, b = read_methods(paths)
    assert (a.name, b.name, a.tasks) == ("a", "b", {"libero/0", "libero/1"})
    assert told(a) == [(0, True, None), (1, False, None), (0, True, None)]
    assert (b.outcomes[0].start, b.outcomes[0].score) == (Start("", "seed", 1000), 0.7)


def test_vla_evals_errors_are_counted_as_chosen(tmp_path):
    path = write(tmp_path / "pusht_aggregate.json", VLA_EVAL)
    with refused("pusht_aggregate.json"):
        read_methods([path])
    assert told(*read_methods([path], "failure")) == [(0, True, 30), (1, False, None)]
    (left,) = read_methods([path], "exclude")
    assert (told(left), left.outcomes[0].start.run) == ([(0, True, 30)], "7")


def test_robomimics_lines_of_episodes_and_its_means(tmp_path):
    (lines,) = read_methods([write(tmp_path / "verbose.txt", VERBOSE)])
    assert (lines.name, told(lines)) == ("Lift epoch 20", [(1, True, 41), (2, False, 400)])
    log = "".join(MEANS.format(epoch=epoch, rate=rate) for epoch, rate in ((20, 0.3), (40, 0.82)))
    means = read_methods([write(tmp_path / "log.txt", log)])
    assert [(m.name, m.solved, len(m.outcomes)) for m in means] == [
        ("Lift epoch 20", 15, 50),
        ("Lift epoch 40", 41, 50),
    ]
    trained = 'Average Rollout Stats\n{\n    "Success_Rate": 0.9,\n    "Num_Success": 45.0\n}\n'
    (agent,) = read_methods([write(tmp_path / "agent.txt", trained)])
    assert (agent.name, agent.solved, len(agent.outcomes)) == ("agent", 45, 50)


def test_tables_with_seeds_methods_and_errors(tmp_path):
    text = "method,seed,success,steps,error\na,1,true,30,\na,2,0,400,\nb,1,,,crashed\nb,2,1,31,\n"
    a, b = read_methods([write(tmp_path / "both.csv", text)], "failure")
    assert (told(a), told(b)) == ([(1, True, 30), (2, False, 400)], [(1, False, None), (2, True, 31)])


@pytest.mark.parametrize(
    ("name", "text", "entry"),
    [
        ("a.csv", "seed,success\n1,yes\n", "success"),
        ("a.csv", "seed,success\n1,true\n1,false\n", "seed"),
        ("a.csv", "seed,success\n1.5,true\n", "seed"),
        ("a.csv", "seed,success\n1\n", "a.csv:2"),
        ("a.csv", "seed,index,success\n1,1,true\n", "a.csv:1"),
        ("a.csv", "episode,won\n1,true\n", "a.csv:1"),
        ("a.csv", "seed,success,steps\n1,true,-3\n", "steps"),
        ("a.csv", "seed,success\n", "a.csv"),
        ("a.json", {"per_task": [lerobot(["won"])]}, "successes.0"),
        ("a.json", {"per_task": [lerobot([True]), lerobot([True])]}, "index"),
        ("a.json", {"per_task": [3]}, "per_task.0"),
        ("a.json", {"per_task": 3}, "per_task"),
        ("a.json", {"benchmark": "x", "tasks": [{"episodes": [{"episode_id": 0}]}]}, "success"),
        ("a.json", {"benchmark": "x", "tasks": 4}, "tasks"),
        ("a.json", {"other": 1}, "a.json"),
        ("a.txt", "nothing of rollouts\n", "a.txt"),
        ("a.txt", MEANS.format(epoch=20, rate=0.333), "Success_Rate"),
        ("a.txt", VERBOSE.replace("num_success=1.0", "num_success=3.0"), "num_success"),
        ("a.txt", VERBOSE + VERBOSE, "a.txt:33"),
    ],
)  # fmt: skip
def test_what_a_file_does_not_tell_is_refused(tmp_path, name, text, entry):
    with refused(entry):
        read_methods([write(tmp_path / name, text)])


def test_the_same_names_are_told_apart_and_the_same_file_is_not(tmp_path):
    files = [write(tmp_path / f"{name}/log.txt", VERBOSE) for name in ("first", "second")]
    assert [m.name for m in read_methods(files)] == ["first/Lift epoch 20", "second/Lift epoch 20"]
    with refused("files"):
        read_methods([files[0], files[0]])
    with refused("files"):
        read_methods([])
    with refused("none.csv", FileNotFoundError):
        read_methods([tmp_path / "none.csv"])


def test_a_huge_or_binary_file_is_refused(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00seed")
    (tmp_path / "b.bin").write_bytes(bytes(range(256)))
    for name in ("a.csv", "b.bin"):
        with refused(name):
            read_methods([tmp_path / name])
    write_json(tmp_path / "c.json", {"schema": 1})
    with refused("schema"):
        read_methods([tmp_path / "c.json"])
