"""Options of the profile of a policy call: of a diffusion policy, of its engines, and of a VLA."""

import json
from contextlib import nullcontext

import pytest
import torch

pytest.importorskip("transformers")

from tests.options.harness import OptionTests, Row, returning
from torchrl_sparse import DiffusionPolicy, Sampler
from torchrl_sparse.evaluation.latency.vla_cases import make_policy
from torchrl_sparse.evaluation.results.world_report import WorldTimes
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer

CALL = "torchrl_sparse.evaluation.benchmarks.policy_call"
ENGINES = "torchrl_sparse.evaluation.benchmarks.engine_times"
VLA = "torchrl_sparse.evaluation.benchmarks.vla_latency"
TIMED = "torchrl_sparse.evaluation.latency.profile.measure_latency"
LOADED = "torchrl_sparse.cli.vla.VLAPolicy.from_pretrained"
CASE = "torchrl_sparse.evaluation.latency.vla_cases.VLACase"
AS_SHIPPED = ("thread_counts=[1,2,4]", "queries=300")
"""What a VLA does not read."""


def told(name, argument):
    """An argument of the first call of a function, None where it was not called or not given it."""
    return lambda run: run.calls[name][0].arguments.get(argument) if run.calls[name] else None


def found(file, *names):
    """What a file of results has under nested names, None if there is none."""

    def read(run):
        content = run.json(file) if (run.out / file).is_file() else {}
        for name in names:
            content = (content or {}).get(name)
        return content

    return read


def variants(run):
    """Names of the variants at the first batch."""
    shapes = found("engine.json", "shapes")(run) or {"none": {"rows": ()}}
    return {*next(iter(shapes.values()))["rows"]}


def methods(run):
    return {name for name in found("vla_latency.json", "methods")(run) or {} if name != "dense"}


class TestOptions(OptionTests):
    recipe = "profile_policy"
    base = ("policy=small", "repeats=1", "warmup=0", "queries=3", "thread_counts=[1]")
    watched = ("measure_call", TIMED, "DiffusionPolicy.to", CASE)
    replaced = {
        f"{CALL}.usable_cores": returning(8),
        f"{CALL}.busy_cores": returning(nullcontext()),
        f"{CALL}.exported_call": returning(nullcontext(lambda: None)),
        "torch.compile": lambda function, *_, **__: function,
        "torchrl_sparse.evaluation.results.engine_report.measure_multiply_adds": returning(1e9),
        f"{VLA}.product_calls": returning({}),
        "torchrl_sparse.evaluation.benchmarks.world._measure": returning(WorldTimes(*[1.0] * 5)),
        LOADED: lambda *_, **__: make_policy("toy"),
        **dict.fromkeys(
            (f"{ENGINES}.plot_engine_times", "plot_thread_scaling", "plot_vla_times"), returning(None)
        ),
    }
    groups = (
        [
            Row("policy", "deep", lambda run: run.call("measure_call")["policy"].network.n_layer, 2),
            Row("threads", "2", found("query.json", "machine", "threads")),
            Row("repeats", "2", told(TIMED, "repeats")),
            Row("warmup", "1", told(TIMED, "warmup")),
            Row("sampler", "ddim2", found("query.json", "sampler")),
            Row("engine", "native_bf16", lambda run: run.call("measure_call")["policy"].engine),
            Row("thread_counts", "[2]", lambda run: [*found("query.json", "threads_s", "dense")(run)], ["1", "2"]),
            Row("queries", "4", found("query.json", "queries")),
            Row("hz", "500", found("query.json", "hz")),
            Row("library", "libtsp.so", lambda run: [*found("query.json", "tails_s")(run)], ["Python", "C"]),
            Row("busy", "2", found("query.json", "busy")),
            Row("out", "elsewhere", lambda run: (run.folder / "elsewhere/query.json").is_file(), True),
        ],
        [
            Row("tables", "[engines]", lambda run: run.names("*.json"), ["engine.json"]),
            Row("device", "'cpu:0'", lambda run: [str(call["args"][0]) for call in run.calls["DiffusionPolicy.to"]], ["cpu:0"]),
            Row("batches", "[1,2]", lambda run: [*(found("engine.json", "shapes")(run) or {})], ["small_b1", "small_b2"]),
            Row("compile", "true", lambda run: "eager-compiled dense" in variants(run), True),
            Row("instruction_sets", "true", lambda run: "native-portable dense" in variants(run), True),
            *AS_SHIPPED,
        ],
        [
            Row("shape", "toy", found("vla_latency.json", "shape", "name")),
            Row("dtype", "bfloat16", found("vla_latency.json", "shape", "dtype")),
            Row("alphas", "[0.7]", lambda run: {name for name in methods(run) if "alpha" in name}, {"specprune, alpha 0.7"}),
            Row("shares", "[0.4]", lambda run: {name for name in methods(run) if "40%" in name}, {"fastv, 40%", "random, 40%"}),
            Row("equal_to", "'fastv, 40%'", lambda run: "random, as many" in methods(run), True),
            Row("instruction", "'lift the cube'", told(CASE, "instruction")),
            *AS_SHIPPED, "policy=${shipped:assets/lift}",
        ],
        [
            Row("base", "model.gguf", told(LOADED, "base")),
            Row("heads", "[4,2,4]", told(LOADED, "heads")),
            Row("published.chunk_size", "5", told(LOADED, "chunk_size")),
            Row("task", "libero_goal", told(LOADED, "unnorm_key")),
            Row("engine", "torch", told(LOADED, "engine"), "torch"),
            *AS_SHIPPED, "policy=openvla", "alphas=[1]", "shares=[]",
        ],
        [
            Row("world", "true", lambda run: len(found("world.json", "tasks")(run) or {}), 4),
            *AS_SHIPPED, "policy=${shipped:assets/lift}",
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        for name, layers in (("small", 1), ("deep", 2)):
            torch.manual_seed(0)
            sizes = {"input_dim": 4, "output_dim": 4, "horizon": 6, "n_obs_steps": 2, "cond_dim": 5}
            network = TransformerForDiffusion(**sizes, n_layer=layers, n_emb=32)
            normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
            DiffusionPolicy(network, normalizer, sampler=Sampler("ddpm", 4, 4)).save_pretrained(folder / name)
        (folder / "openvla").mkdir()
        (folder / "openvla/config.json").write_text(json.dumps({"model_type": "openvla"}))
