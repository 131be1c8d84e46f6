"""Options of the acceleration of a policy: what arrives in `accelerate`, whose own tests run it."""

from types import SimpleNamespace

from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import write_reach, write_state_demos
from tests.options.seen import argument, device


def request(name):
    return lambda run: getattr(run.call("accelerate")["request"], name)


def grid(name):
    return lambda run: [*getattr(run.call("accelerate")["grid"], name)]


def pruner(name):
    return lambda run: getattr(run.call("accelerate")["pruner"], name, None)


class TestOptions(OptionTests):
    recipe = "accelerate_policy"
    base = ("task=reach",)
    watched = ("DiffusionPolicy.to",)
    replaced = {
        "accelerate": lambda *_, **__: (SimpleNamespace(chosen="dense"), {"dense": None}),
        "write_acceleration_report": lambda found, out: out / "report.html",
        "acceleration_rows": returning([{"method": "dense"}]),
        **dict.fromkeys(("save_policy", "film_chosen", "acceleration_note"), returning(None)),
    }
    groups = (
        [
            Row("policy", "other", lambda run: argument("accelerate", "policy")(run).horizon, 12),
            Row("engine", "reference", lambda run: argument("accelerate", "policy")(run).engine),
            Row("device", "'cpu:0'", device()),
            Row("demos", "data/more.h5", lambda run: len(argument("accelerate", "demos")(run)), 3),
            Row("out", "elsewhere", lambda run: str(argument("accelerate", "out")(run))),
            Row("budget_ms", "5.5", request("budget_ms")),
            Row("episodes", "0", lambda run: (request("episodes")(run), len(run.calls["film_chosen"])), (0, 0)),
            Row("finalists", "2", request("finalists")),
            Row("margin", "0.1", request("margin")),
            Row("time_margin", "0.2", request("time_margin")),
            Row("candidates.samplers", "[ddim7]", grid("samplers")),
            Row("candidates.searched", "[ddim4]", grid("searched")),
            Row("candidates.cached", "[]", grid("cached")),
            Row("candidates.updates", "[6]", grid("updates")),
            Row("candidates.intervals", "[3]", grid("intervals")),
            Row("candidates.rounded", "[bf16]", grid("rounded")),
            Row("candidates.strides", "[40]", grid("strides")),
            Row("n_action_steps", "5", request("n_action_steps")),
            Row("windows", "100", request("windows")),
            Row("seed", "3", request("seed")),
            Row("workers", "2", request("workers")),
            Row("threads", "2", request("threads")),
            Row("latency_repeats", "7", request("repeats")),
            Row("horizon", "9", lambda run: argument("accelerate", "make_env")(run).keywords.get("horizon")),
        ],
        [
            Row("task", "touch", request("task"), "Touch"),
            Row("train", "true", lambda run: argument("accelerate", "pruner")(run) is not None),
            Row("pruner.rate", "0.5", pruner("rate"), 0.5),
            Row("pruner.max_updates", "3", pruner("max_updates"), 3),
            Row("pruner.batch_size", "4", pruner("batch_size"), 4),
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        write_reach(folder / "other", horizon=12)
        for task in ("Reach", "Touch"):
            write_reach(folder / f"assets/{task.lower()}", task)
        write_state_demos(folder / "data/more.h5", "Reach", (1, 1), 3)
