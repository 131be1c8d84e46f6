"""Options of the study that steps LIBERO's suites, in scenes in which nothing happens."""

import pytest

pytest.importorskip("transformers")

from torchrl.envs import InitTracker, TransformedEnv

from tests.envs.test_libero import StillScene
from tests.options.harness import OptionTests, Row, returning
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy

LOADED = "torchrl_sparse.cli.vla.VLAPolicy.from_pretrained"


def still(suite, task_id, *, image_size, as_released):
    return TransformedEnv(StillScene(image_size), InitTracker())


def told(name, argument):
    """An argument of the first call of a function, None where it was not called or not given it."""
    return lambda run: run.calls[name][0].arguments.get(argument) if run.calls[name] else None


class TestOptions(OptionTests):
    recipe = "studies.libero_smoke"
    base = ("steps=2", "suites=[libero_spatial]", "alpha=0.1", "n_action_steps=2")
    watched = ("SpecPrune", "ChunkExecutor", "VLAPolicy.to")
    replaced = {
        "make_libero_env": still,
        "draw": returning("strip.png"),
        LOADED: lambda *_, **__: VLAPolicy(VLANetwork(VLAConfig.tiny())),
        "VLANetwork": lambda config: VLANetwork(VLAConfig.tiny()),
    }
    groups = (
        [
            Row(
                "suites",
                "[libero_goal]",
                lambda run: [call["suite"] for call in run.calls["make_libero_env"]],
            ),
            Row("task_id", "3", told("make_libero_env", "task_id")),
            Row("steps", "3", lambda run: int(run.printed.split(" steps, ")[0].split()[-1])),
            Row("n_action_steps", "1", lambda run: run.calls["ChunkExecutor"][0]["n_action_steps"]),
            Row("preset", "release", told("SpecPrune", "preset")),
            Row("alpha", "0.05", told("SpecPrune", "alpha")),
            Row("device", "'cpu:0'", lambda run: str(run.call("VLAPolicy.to")["args"][0])),
            Row("out", "elsewhere", lambda run: run.calls["draw"][0]["path"].parent.name, "elsewhere"),
        ],
        [
            Row("policy", "published", lambda run: told(LOADED, "path")(run)),
            Row("heads", "[4,2,4]", told(LOADED, "heads")),
            Row("published.chunk_size", "5", told(LOADED, "chunk_size")),
        ],
    )
