"""Options of the policy server."""

import pytest

from tests.options.harness import OptionTests, Row
from tests.options.inputs import write_reach
from tests.options.seen import argument, device
from torchrl_sparse import DiffusionPolicy, Uniform

pytest.importorskip("websockets")
pytest.importorskip("msgpack")

SERVER, RUN = "PolicyServer", "torchrl_sparse.serving.server.PolicyServer.run"


def served(run):
    return run.call(SERVER)["executor"]


def task(run):
    contract = run.call(SERVER)["contract"]
    return contract and contract.task


def asked_for(name):
    """What a method is made with, the default where none is."""
    return lambda run: str(run.call("make_method")[name]) if run.calls["make_method"] else "10"


class TestOptions(OptionTests):
    recipe = "serve"
    base = ("policy=policy", "threads=1")
    watched = (SERVER, "DiffusionPolicy.to", "make_method")
    replaced = {RUN: lambda *_, **__: None}
    groups = (
        [
            Row("policy", "other", lambda run: served(run).policy.horizon, 12),
            Row("task", "touch", task, "Touch"),
            Row("n_action_steps", "5", lambda run: served(run).n_action_steps),
            Row("seed", "7", argument(SERVER, "seed")),
            Row("max_clients", "3", argument(SERVER, "max_clients")),
            Row("max_message_bytes", "1000", argument(SERVER, "max_message_bytes")),
            Row("host", "0.0.0.0", argument(RUN, "host")),
            Row("port", "0", argument(RUN, "port")),
            Row("report_every", "9", lambda run: run.call(RUN)["report_every"]),
            Row("engine", "torch", lambda run: served(run).policy.engine),
            Row("device", "'cpu:0'", device()),
            Row("threads", "2", argument(SERVER, "threads")),
        ],
        [Row("answers", "chunk", argument(SERVER, "answers"))],
        [
            Row("method", "ddim2", lambda run: served(run).policy.num_inference_steps, 2),
            Row("planners", "planned", asked_for("planners"), "planned"),
            Row("num_updates", "4", asked_for("num_updates"), "4"),
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        write_reach(folder / "policy")
        write_reach(folder / "other", horizon=12)
        policy = DiffusionPolicy.from_pretrained(folder / "policy")
        policy.plan = Uniform(2)
        policy.save_pretrained(folder / "planned")
