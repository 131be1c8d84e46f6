"""Options of the calibration and the benchmark of visual tokens: what arrives where queries are recorded and episodes played,
whose own tests do so; they need a GL library."""

from contextlib import nullcontext

from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import write_vla
from tests.options.seen import argument, content, device, first, size, written
from tests.options.training import wandb_rows
from tests.training.vla.rendered import write_demos
from torchrl_sparse.methods.token_budget import BudgetPoint, TokenBudget
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.runtime.wandb_run import wandb_arguments

LOAD = "torchrl_sparse.cli.vla.VLAPolicy.from_pretrained"
THRESHOLDS = {
    "translation": 0.1,
    "rotation": 0.2,
    "leave_translation": 0.3,
    "leave_rotation": 0.4,
    "leave_rise": 0.5,
}
_from_pretrained = VLAPolicy.from_pretrained


def load(path, **_):
    """A policy, whatever else is said of a published one."""
    return _from_pretrained(path)


def said(name):
    """What is said of a policy beside its folder."""
    return lambda run: run.call(LOAD).arguments.get(name)


LOADED = (
    Row("base", "base.gguf", said("base")),
    Row("heads", "[2,2,4]", said("heads")),
    Row("published.chunk_size", "3", said("chunk_size")),
    Row("device", "'cpu:0'", device("VLAPolicy.to")),
    Row("cameras.image", "frontview_image", lambda run: run.call("instructed_env")["cameras"]["image"]),
    Row("cameras.wrist_image", "side_image", lambda run: run.call("instructed_env")["cameras"]["wrist_image"]),
    Row("horizon", "9", argument("instructed_env", "horizon")),
)  # fmt: skip


def controller_rows(find):
    """Rows of a controller, whose options ``find`` finds."""
    thresholds = "{" + ", ".join(f"{name}: {value}" for name, value in THRESHOLDS.items()) + "}"
    values = {"motion": "commanded", "coarse": "2.0", "fine": "3.0", "warmup_steps": "4"}
    rows = [
        Row(f"controller.{name}", value, lambda run, name=name: find(run)[name])
        for name, value in values.items()
    ]
    return [*rows, Row("controller.thresholds", thresholds, lambda run: find(run)["thresholds"])]


def write_inputs(folder):
    (folder / "data").mkdir()
    demos = write_demos(folder / "data/images.h5")
    write_vla(folder / "assets/vla", demos)
    write_vla(folder / "other", demos, chunk_size=5)
    TokenBudget("specprune", 0.5, "success", 0.1, (BudgetPoint(0.5, 4, 0.0),)).save_pretrained(
        folder / "assets/vla/specprune.json"
    )


def points(policy, episodes, tried, *_):
    """Fewer tokens, more loss."""
    return [BudgetPoint(number, 10 * number, 0.02 / number) for number in tried]


class TestCalibrateTokens(OptionTests):
    recipe = "calibrate_tokens"
    base = ("numbers=[0.5,0.9]", "tolerance=0.03")
    watched = ("load_vla", "VLAPolicy.to", "executor", "ActionAwareController.from_options")
    replaced = {
        LOAD: load,
        "instructed_env": returning(None),
        "recorded_queries": lambda *_: iter(range(100)),
        "demonstrated_queries": lambda *_: iter(range(100)),
        "measure_errors": points,
        "measure_success": lambda policy, make, env, seeds, tried, *_: points(policy, seeds, tried),
        "plot_token_budgets": returning(None),
    }
    groups = (
        [
            *LOADED,
            Row("options.keep_share", "0.95", lambda run: content("", "settings")(run).get("keep_share")),
            Row(
                "numbers", "[0.4,0.8]", lambda run: [point["number"] for point in content("", "points")(run)]
            ),
            Row("tolerance", "0.05", content("", "tolerance")),
            Row("episodes", "3", size("measure_errors", "episodes")),
            Row("seed", "175000", first("recorded_queries", "seeds")),
            Row("n_action_steps", "2", lambda run: run.call("executor").result.n_action_steps),
            *controller_rows(lambda run: run.call("ActionAwareController.from_options").arguments),
        ],
        [
            Row("policy", "other", lambda run: run.call("load_vla").result.chunk_size, 5),
            Row("measure", "success", content("", "measure")),
            Row("out", "elsewhere.json", written("elsewhere.json"), True),
        ],
        [
            Row("task", "lift_crowded", argument("load_vla", "data_set")),
            Row("method", "fastv", content("", "method")),
        ],
        [Row("demos", "data/images.h5", lambda run: len(run.calls["demonstrated_queries"]), 1)],
    )
    prepare = staticmethod(write_inputs)


def settings(run):
    return run.call("record_methods")["settings"]


def played(name, method="dense"):
    return lambda run: next(call[name] for call in run.calls["evaluate"] if call["name"] == method)


class TestBenchmark(OptionTests):
    recipe = "benchmark_vla"
    base = ("methods=[fastv@0.5]", "pairs=[]", "videos=[]", "logger=wandb")
    watched = ("load_vla", "VLAPolicy.to", "make_design", "describe_policy")
    replaced = {
        LOAD: load,
        "instructed_env": returning(None),
        "episode_horizon": returning(9),
        "record_methods": lambda texts, *_, **__: dict.fromkeys(texts),
        "skipped_layers": returning([2]),
        "matched_number": returning(None),
        "play_rounds": lambda names, play, terms: {name: play(name, terms.design.max_episodes) for name in names},
        "log_benchmark": lambda results, folder, config: wandb_arguments(config, folder, "default"),
        "format_table": returning("table"),
        "backend_runtime": lambda *_: nullcontext(),
        **dict.fromkeys(
            ("evaluate", "measure_methods", "build_results", "save_results", "draw_methods", "film_tokens"),
            returning(None),
        ),
    }  # fmt: skip
    groups = (
        [
            *LOADED,
            Row("calibrated", "false", lambda run: "alpha" in settings(run)["specprune"]),
            Row("specprune.keep_share", "0.95", lambda run: settings(run)["specprune"].get("keep_share")),
            *controller_rows(lambda run: settings(run)["controller"]),
            Row("pairs", "[[dense,fastv@0.5]]", argument("build_results", "pairs")),
            Row("episodes", "3", lambda run: len(played("seeds")(run))),
            Row("seed", "7", first("evaluate", "seeds", 100_000)),
            Row("dense_log", "logs/one.jsonl", lambda run: str(played("log")(run)), "logs/one.jsonl"),
            Row("n_action_steps", "2", argument("describe_policy", "n_action_steps")),
            Row("num_envs", "2", argument("evaluate", "num_envs")),
            Row("workers", "2", argument("evaluate", "workers")),
            Row("backend", "ray", argument("evaluate", "backend")),
            Row("margin", "0.2", lambda run: run.call("build_results")["terms"].margin),
            Row("time_margin", "0.3", lambda run: run.call("build_results")["terms"].time_margin),
            Row("threads", "2", argument("measure_methods", "threads")),
            Row("latency_repeats", "2", argument("measure_methods", "repeats")),
            Row("probe_episodes", "2", size("record_methods", "seeds")),
            Row("videos", "[fastv@0.5]", lambda run: [call["name"] for call in run.calls["film_tokens"]]),
            *wandb_rows(lambda run: run.call("log_benchmark").result),
        ],
        [
            Row("policy", "other", lambda run: run.call("load_vla").result.chunk_size, 5),
            Row("methods", "[efficientvla_layers]", lambda run: argument("record_methods", "texts")(run)[1:]),
            Row("skipped_layers", "1", lambda run: [call["count"] for call in run.calls["skipped_layers"]], [1]),
            Row("split", "test", first("evaluate", "seeds"), 210_000),
            Row("out", "elsewhere", lambda run: str(run.call("draw_methods")["out"])),
            Row("logger", "null", lambda run: "wandb" if run.calls["log_benchmark"] else None),
        ],
        [
            Row("task", "lift_crowded", argument("build_results", "task")),
            Row("until", "decided", argument("make_design", "until")),
            Row("max_episodes", "20", lambda run: run.call("build_results")["terms"].design.max_episodes, 20),
        ],
    )  # fmt: skip
    prepare = staticmethod(write_inputs)
