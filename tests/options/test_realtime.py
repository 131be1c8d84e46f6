"""Options of success against latency: what arrives where policy calls are timed and episodes played, whose own tests do so."""

from contextlib import nullcontext
from types import SimpleNamespace

import torch

from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import write_demos, write_policy
from tests.options.seen import argument, device, first, size
from torchrl_sparse.evaluation.latency.measure import summarize_latency


def timed(methods, queries, **_):
    return {name: summarize_latency([0.01]) for name in methods}


BENCHMARK, LATE = (
    "torchrl_sparse.evaluation.benchmarks.benchmark",
    "torchrl_sparse.evaluation.benchmarks.delayed",
)
CALIBRATED = "torchrl_sparse.training.diffusion.calibration.calibrate_policy"
EVALUATED, TIMED, BUILT = f"{BENCHMARK}.evaluate", f"{LATE}.time_methods", f"{LATE}.build_realtime"


def delays(run):
    return sorted({int(call["name"].rpartition("+")[2]) for call in run.calls[EVALUATED]})


class TestOptions(OptionTests):
    recipe = "realtime"
    base = ("methods=[uniform]",)
    watched = (CALIBRATED, "fit_state_model", "make_methods", "diffusion_env", "DiffusionPolicy.to")
    replaced = {
        TIMED: timed,
        "fit_state_model": returning((SimpleNamespace(weight=torch.zeros(1)), 0.5)),
        f"{LATE}.make_realtime_executor": returning(SimpleNamespace(n_action_steps=8)),
        "format_realtime": returning("table"),
        f"{BENCHMARK}.episode_horizon": returning(9),
        **dict.fromkeys(
            (f"{LATE}.record_queries", EVALUATED, BUILT, f"{BENCHMARK}.write_json", f"{LATE}.plot_realtime"),
            returning(None),
        ),
        f"{BENCHMARK}.backend_runtime": lambda *_: nullcontext(),
    }
    groups = (
        [
            Row("engine", "reference", lambda run: run.call("make_methods")["policy"].engine),
            Row("device", "'cpu:0'", device()),
            Row("planners", "plans", lambda run: str(argument("make_methods", "planners")(run))),
            Row("latencies", "[0.2]", delays, [1, 4]),
            Row("episodes", "3", size(EVALUATED, "seeds")),
            Row("seed", "7", first(EVALUATED, "seeds", 100_000)),
            Row("out", "elsewhere", lambda run: str(argument(EVALUATED, "log")(run).parents[1])),
            Row("n_action_steps", "5", argument(BUILT, "n_action_steps")),
            Row("horizon", "9", argument("diffusion_env", "horizon")),
            Row("num_updates", "5", argument("make_methods", "num_updates")),
            Row("margin", "0.2", lambda run: run.call(BUILT)["terms"].margin),
            Row("time_margin", "0.3", lambda run: run.call(BUILT)["terms"].time_margin),
            Row("num_envs", "2", argument(EVALUATED, "num_envs")),
            Row("workers", "2", argument(EVALUATED, "workers")),
            Row("backend", "ray", argument(EVALUATED, "backend")),
            Row("threads", "2", argument(TIMED, "threads")),
            Row("latency_repeats", "2", argument(TIMED, "repeats")),
        ],
        [
            Row("policy", "other", lambda run: run.call("make_methods")["policy"].horizon, 12),
            Row("methods", "[ddim2_ahead]", lambda run: [*run.call("make_methods").result], ["dense", "ddim2_ahead"]),
            Row("demos", "data/more.h5", lambda run: [len(call["demos"]) for call in run.calls["fit_state_model"]], [3]),
            Row("split", "test", first(EVALUATED, "seeds"), 210_000),
        ],
        [
            Row("task", "lift_moving", argument(BUILT, "task"), "LiftMoving"),
            Row("calibration_samples", "2", lambda run: [len(call["seeds"]) for call in run.calls[CALIBRATED]], [2]),
            "methods=[bac]",
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        demos = write_demos(folder / "data/more.h5", 3)
        write_policy(folder / "other", demos, horizon=12)
        for name in ("lift", "lift_moving"):
            write_policy(folder / "assets" / name, demos)
