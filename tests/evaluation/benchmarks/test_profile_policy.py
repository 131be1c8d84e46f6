"""One recipe tells where a call's time goes: of states, with cameras, under an observation-conditioned planner, or a VLA."""

import sys
from functools import partial

import imageio.v3 as iio
import pytest
import torch

from recipes.studies.pages.page_rows import read_table
from tests.recipe_modules import load_recipe, run
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Sampler, keys
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.evaluation.benchmarks import policy_call
from torchrl_sparse.evaluation.latency.engine_cases import make_network
from torchrl_sparse.evaluation.latency.measure import usable_cores
from torchrl_sparse.evaluation.latency.profile import call_parts
from torchrl_sparse.evaluation.latency.stages import example_query, image_policy
from torchrl_sparse.evaluation.results.engine_report import load_engine_results
from torchrl_sparse.evaluation.results.query_report import load_query_profile
from torchrl_sparse.evaluation.results.vla_report import load_vla_results
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.networks.vla.flops import decoder_flops
from torchrl_sparse.policies.diffusion.warm_start import WarmStart

needs_native = pytest.mark.skipif(not native_available()[0], reason=native_available()[1])
SMALL, STEPS = {"n_layer": 2, "n_emb": 32}, Sampler("ddpm", 20, 20)
FEW = ("queries=20", "repeats=2", "warmup=0", "thread_counts=[2]")


def make_policy(seed=0, **options):
    torch.manual_seed(seed)
    network = TransformerForDiffusion(
        input_dim=4, output_dim=4, horizon=6, n_obs_steps=2, cond_dim=5, n_layer=2, n_emb=32
    )
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    return DiffusionPolicy(network, normalizer, sampler=STEPS, **options)


def add_schedule(folder, policy):
    mask = torch.zeros(20, policy.num_blocks, dtype=torch.bool)
    mask[1::2] = True
    CacheSchedule.from_mask(mask, method="bac", policy=policy.fingerprint).save_pretrained(
        folder / "bac.json"
    )


@pytest.fixture
def saved(tmp_path):
    policy = make_policy()
    policy.save_pretrained(tmp_path / "small")
    return tmp_path / "small"


@pytest.fixture(scope="module")
def seeing(tmp_path_factory):
    """A policy with two cameras."""
    folder = tmp_path_factory.mktemp("seeing") / "seeing"
    torch.manual_seed(0)
    image_policy(make_network("image", **SMALL), width=16, sampler=STEPS).save_pretrained(folder)
    return folder


@needs_native
def test_a_call_is_told_by_parts_threads_and_tail(saved, tmp_path):
    output = run("profile_policy", f"policy={saved}", "sampler=ddim2", *FEW, f"out={tmp_path}/out")
    assert "20 policy calls, one after the other." in output
    found = load_query_profile(tmp_path / "out" / "query.json")
    assert list(found.parts_s) == ["query", "noise", "weights", "blocks", "compiled rest", "tensors"]
    assert found.sampler == "ddim2"
    assert set(found.threads_s) == {"dense", "ddim2"}
    assert set(found.threads_s["dense"]) == {"1", "2"} if usable_cores() > 1 else {"1"}
    late = found.tails_s["Python"]
    assert late["p50"] <= late["p99.9"] <= late["max"]
    (row,) = read_table(tmp_path / "out" / "query.json", "tails").rows
    assert (row["beside"], row["queries"]) == ("0 busy processes", "20, one after the other")
    assert (tmp_path / "out" / "query_threads.png").stat().st_size > 0


@needs_native
def test_the_call_of_a_policy_with_cameras_is_told_by_stages(seeing, tmp_path):
    output = run("profile_policy", f"policy={seeing}", "sampler=ddim2", *FEW, f"out={tmp_path}")
    assert "A policy call, ddim2: " in output
    parts = load_query_profile(tmp_path / "query.json").parts_s
    assert parts["encode"] > parts["camera image"] > 0
    assert parts["query"] == pytest.approx(parts["encode"] + parts["denoise"] + parts["rest"])


@needs_native
def test_every_engine_is_timed_on_a_policys_network_under_its_schedule(saved, tmp_path):
    add_schedule(saved, make_policy())
    options = ("tables=[engines]", "batches=[1,2]", "repeats=2", "warmup=0", "threads=null")
    printed = run("profile_policy", f"policy={saved}", *options, f"out={tmp_path}/out")
    results = load_engine_results(tmp_path / "out" / "engine.json")
    assert list(results.shapes) == ["small_b1", "small_b2"]
    rows = results.shapes["small_b1"].rows
    assert "eager-ifs random91" in rows
    assert rows["native bac10"].limit_s == pytest.approx(rows["native dense"].limit_s / 2)  # as bac.json says
    for name, shape in results.shapes.items():
        assert shape.threads == torch.get_num_threads()
        assert iio.imread(tmp_path / "out" / f"engine_{name}.png").std() > 5
        assert f"{name}: batch" in printed
    add_schedule(saved, make_policy(seed=1))
    refused = run("profile_policy", f"policy={saved}", *options, f"out={tmp_path}/no", expect=2)
    assert "made for policy fingerprint" in refused
    assert not (tmp_path / "no").exists()


def test_engines_of_a_policy_with_cameras_time_whole_calls_too(seeing, tmp_path):
    options = ("tables=[engines]", "batches=[2]", "repeats=1", "warmup=0")
    printed = run("profile_policy", f"policy={seeing}", *options, f"out={tmp_path}")
    assert "Whole policy calls, cameras included." in printed
    table = read_table(tmp_path / "engine.json", "seeing_b2_parts")
    rows = {table.name(row): row for row in table.rows}
    assert list(rows)[:2] == ["query", "encode"]
    assert rows["query"]["ddim2, share"] == "100%"
    assert float(rows["camera image"]["dense, ms"]) > 0


class PruneLater(Planner):
    """Prunes all but the first step, of whatever it sees."""

    def masks(self, cond):
        step = torch.arange(self.spec.num_inference_steps) > 0
        return step[None, :, None].expand(len(cond), -1, self.spec.num_blocks)


def test_a_planner_that_looks_is_a_stage_of_its_own():
    policy = make_policy(plan=PruneLater())
    parts = call_parts(policy, repeats=2, warmup=0)
    assert list(parts) == ["query", "encode", "plan", "denoise", "rest"]
    assert parts["query"] == pytest.approx(sum(parts[name] for name in list(parts)[1:]))


def test_a_warm_call_begins_from_the_last_chunk():
    """A call without one would take all 20 steps, which no call in mid-episode does (`WarmStart`)."""
    policy = make_policy()
    policy.start = WarmStart(3)
    assert policy(example_query(policy))[keys.NUM_STEPS].item() == 3
    assert list(call_parts(policy, repeats=1, warmup=0)) == ["query", "encode", "denoise", "rest"]


@needs_native
def test_threads_and_exported_weights_are_those_of_an_engine_that_rounds(tmp_path, monkeypatch):
    """A policy that was saved to round is measured as it runs (`DiffusionPolicy.from_pretrained`)."""
    make_policy(engine="native_int8").save_pretrained(tmp_path / "rounded")
    policy, asked = DiffusionPolicy.from_pretrained(tmp_path / "rounded"), []
    monkeypatch.setattr(
        policy_call, "thread_seconds", lambda *args, engine: asked.append(engine) or {"dense": {1: 1.0}}
    )
    measure = partial(policy_call.measure_call, policy, threads=1, thread_counts=[1], repeats=1, warmup=0)
    found = measure(queries=2)
    assert (asked, found.sampler) == (["native_int8"], "dense")
    (tmp_path / "libtsp.so").write_bytes(b"no library")
    with refused("library"):
        measure(queries=2, library=tmp_path / "libtsp.so")


def test_a_shape_of_a_vla_leaves_json_table_and_chart(tmp_path):
    pytest.importorskip("transformers")
    from torchrl_sparse.evaluation.latency.vla_cases import SHAPES

    options = ("repeats=1", "warmup=0", "alphas=[1]", "shares=[0.5]", "equal_to='specprune, alpha 1'")
    printed = run("profile_policy", "shape=toy", *options, f"out={tmp_path}")
    results = load_vla_results(tmp_path / "vla_latency.json")
    assert results.machine.threads == 1
    assert results.shape.name == "toy"
    assert list(results.methods) == [
        *("dense", "specprune, alpha 1", "fastv, 50%", "random, 50%"),
        *("fastv, as many", "frame difference, as many", "random, as many"),
    ]
    kept = [method.kept for name, method in results.methods.items() if "as many" in name]
    assert kept == pytest.approx([results.methods["specprune, alpha 1"].kept] * 3, abs=1)
    linear, attention, square = results.products.values()
    assert linear.flops + attention.flops == decoder_flops(
        SHAPES["toy"], torch.full((8,), results.shape.tokens)
    )
    assert square.flops == 2 * 2048**3
    assert all(f" {name} | " in printed for name in results.products)
    assert all(f"| {name} " in printed for name in [*results.methods, *results.parts])
    assert iio.imread(tmp_path / "vla_latency.png").std() > 5


@pytest.fixture
def fail(monkeypatch, capsys, tmp_path):
    """Runs the recipe, which has to fail before it writes anything, and returns the line that it leaves."""

    def fail(*options):
        monkeypatch.setattr(sys, "argv", ["profile_policy.py", *options, f"out={tmp_path}/out"])
        with pytest.raises(SystemExit) as ended:
            load_recipe("profile_policy").main()
        assert ended.value.code == 2
        assert not (tmp_path / "out").exists()
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return fail


VLA, SHAPE = "policy=assets/vla", "shape=low_dim"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([VLA, "sampler=ddim2"], "sampler: expected null of a VLA, got ddim2"),
        ([VLA, "tables=[engines]"], "tables: expected ['call'] of a VLA, got ['engines']"),
        ([VLA, "dtype=bfloat16"], "dtype: expected null of a trained policy, got bfloat16"),
        ([VLA, "heads=[4,2,4]"], "heads: expected none for assets/vla, whose own files tell"),
        ([VLA, "equal_to=magic"], "equal_to: expected one of dense, specprune, alpha 1, "),
        (["alphas=[2]"], "alphas: expected [1.0, 0.5] of a diffusion policy, got [2]"),
        (["batches=[4]"], "batches: expected [1] without the table engines, got [4]"),
        (["tables=[engines]", "hz=50"], "hz: expected null without the table call, got 50"),
        (["tables=[blocks]"], "tables: 0: expected 'call' or 'engines', got 'blocks'"),
        (["sampler=magic"], "sampler: expected KIND[STEPS]"),
        (["engine=torch"], "engine: expected native, got torch"),
        (["device=abacus"], "device: expected one that this machine and PyTorch have, got 'abacus'"),
        (["thread_counts=[2,0]"], "thread_counts: 1: expected greater than or equal to 1, got 0"),
        (["policy=nowhere"], "policy: expected a folder that holds config.json, or a .ckpt"),
        (
            ["shape=moon"],
            "shape: expected one of low_dim, image, kitchen, openvla_oft, reduced, smollm2, toy",
        ),
        ([SHAPE, "policy=assets/can"], "policy: expected "),
        ([SHAPE, "task=lift"], "task: expected null beside a shape, got lift"),
    ],
)
def test_what_nothing_would_read_and_what_nothing_is_are_one_line(fail, options, message):
    assert fail(*options).startswith(message)
