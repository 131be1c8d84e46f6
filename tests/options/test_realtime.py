"""Options of success against latency: what arrives where queries are timed and episodes played, whose own tests do so."""

from contextlib import nullcontext

from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import write_demos, write_policy
from tests.options.seen import argument, device, first, size
from torchrl_sparse.evaluation.latency.measure import summarize_latency


def timed(methods, queries, **_):
    return {name: summarize_latency([0.01]) for name in methods}


def delays(run):
    return sorted({call["delay_steps"] for call in run.calls["evaluate_late"]})


class TestOptions(OptionTests):
    recipe = "realtime"
    base = ("methods=[uniform]",)
    watched = ("calibrate_policy", "fit_state_model", "make_methods", "diffusion_env", "DiffusionPolicy.to")
    replaced = {
        "time_methods": timed,
        "fit_state_model": returning((None, 0.5)),
        "format_realtime": returning("table"),
        "episode_horizon": returning(9),
        **dict.fromkeys(
            ("record_queries", "evaluate_late", "build_realtime", "write_json", "plot_realtime"),
            returning(None),
        ),
        "backend_runtime": lambda *_: nullcontext(),
    }
    groups = (
        [
            Row("engine", "reference", lambda run: run.call("make_methods")["policy"].engine),
            Row("device", "'cpu:0'", device()),
            Row("planners", "plans", lambda run: str(argument("make_methods", "planners")(run))),
            Row("latencies", "[0.2]", delays, [1, 4]),
            Row("episodes", "3", size("evaluate_late", "seeds")),
            Row("seed", "7", first("evaluate_late", "seeds", 100_000)),
            Row("out", "elsewhere", argument("evaluate_late", "out")),
            Row("n_action_steps", "5", argument("build_realtime", "n_action_steps")),
            Row("horizon", "9", argument("diffusion_env", "horizon")),
            Row("num_updates", "5", argument("make_methods", "num_updates")),
            Row("margin", "0.2", lambda run: run.call("build_realtime")["terms"].margin),
            Row("time_margin", "0.3", lambda run: run.call("build_realtime")["terms"].time_margin),
            Row("num_envs", "2", argument("evaluate_late", "num_envs")),
            Row("workers", "2", argument("evaluate_late", "workers")),
            Row("backend", "ray", argument("evaluate_late", "backend")),
            Row("threads", "2", argument("time_methods", "threads")),
            Row("latency_repeats", "2", argument("time_methods", "repeats")),
        ],
        [
            Row("policy", "other", lambda run: run.call("make_methods")["policy"].horizon, 12),
            Row("methods", "[ddim2_ahead]", lambda run: [*run.call("make_methods").result], ["dense", "ddim2_ahead"]),
            Row("demos", "data/more.h5", lambda run: [len(call["demos"]) for call in run.calls["fit_state_model"]], [3]),
            Row("split", "test", first("evaluate_late", "seeds"), 210_000),
        ],
        [
            Row("task", "lift_moving", argument("build_realtime", "task"), "LiftMoving"),
            Row("calibration_samples", "2", lambda run: [len(call["seeds"]) for call in run.calls["calibrate_policy"]], [2]),
            "methods=[bac]",
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        demos = write_demos(folder / "data/more.h5", 3)
        write_policy(folder / "other", demos, horizon=12)
        for name in ("lift", "lift_moving"):
            write_policy(folder / "assets" / name, demos)
