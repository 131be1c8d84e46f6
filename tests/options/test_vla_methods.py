"""Options of the calibration and the benchmark of visual tokens: what arrives where calls are recorded and episodes played,
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

BENCHMARK, VLA = (f"torchrl_sparse.evaluation.benchmarks.{name}" for name in ("benchmark", "vla_benchmark"))
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
    Row("device", "'cpu:0'", device("torchrl_sparse.policies.vla.policy.VLAPolicy.to")),
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
    watched = (
        "load_vla",
        "torchrl_sparse.policies.vla.policy.VLAPolicy.to",
        "executor",
        "ActionAwareController.from_options",
    )
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
    return run.call(f"{VLA}.record_methods")["settings"]


def played(name, method="dense"):
    return lambda run: next(
        call[name] for call in run.calls[f"{BENCHMARK}.evaluate"] if call["name"] == method
    )


class TestBenchmark(OptionTests):
    recipe = "benchmark_vla"
    base = ("methods=[fastv@0.5]", "pairs=[]", "videos=[]", "logger=wandb")
    watched = (
        "load_vla",
        "torchrl_sparse.policies.vla.policy.VLAPolicy.to",
        f"{BENCHMARK}.make_design",
        f"{BENCHMARK}.describe_policy",
    )
    replaced = {
        LOAD: load,
        "instructed_env": returning(None),
        f"{BENCHMARK}.episode_horizon": returning(9),
        f"{VLA}.record_methods": lambda texts, *_, **__: dict.fromkeys(texts),
        f"{VLA}.skipped_layers": returning([2]),
        f"{VLA}.matched_number": returning(None),
        f"{BENCHMARK}.play_rounds": lambda names, play, terms: {name: play(name, terms.design.max_episodes) for name in names},
        "log_benchmark": lambda results, folder, config: wandb_arguments(config, folder, "default"),
        "print_results": returning(None),
        f"{BENCHMARK}.backend_runtime": lambda *_: nullcontext(),
        **dict.fromkeys((f"{BENCHMARK}.{name}" for name in ("evaluate", "build_results", "write_json")), returning(None)),
        **dict.fromkeys((f"{VLA}.{name}" for name in ("measure_methods", "draw_methods", "film_tokens")), returning(None)),
    }  # fmt: skip
    groups = (
        [
            *LOADED,
            Row("engine", "torch", said("engine")),
            Row("calibrated", "false", lambda run: "alpha" in settings(run)["specprune"]),
            Row("specprune.keep_share", "0.95", lambda run: settings(run)["specprune"].get("keep_share")),
            *controller_rows(lambda run: settings(run)["controller"]),
            Row("pairs", "[[dense,fastv@0.5]]", argument(f"{BENCHMARK}.build_results", "pairs")),
            Row("episodes", "3", lambda run: len(played("seeds")(run))),
            Row("seed", "7", first(f"{BENCHMARK}.evaluate", "seeds", 100_000)),
            Row("dense_log", "logs/one.jsonl", lambda run: str(played("log")(run)), "logs/one.jsonl"),
            Row("n_action_steps", "2", argument(f"{BENCHMARK}.describe_policy", "n_action_steps")),
            Row("num_envs", "2", argument(f"{BENCHMARK}.evaluate", "num_envs")),
            Row("workers", "2", argument(f"{BENCHMARK}.evaluate", "workers")),
            Row("backend", "ray", argument(f"{BENCHMARK}.evaluate", "backend")),
            Row("margin", "0.2", lambda run: run.call(f"{BENCHMARK}.build_results")["terms"].margin),
            Row("time_margin", "0.3", lambda run: run.call(f"{BENCHMARK}.build_results")["terms"].time_margin),
            Row("threads", "2", argument(f"{VLA}.measure_methods", "threads")),
            Row("latency_repeats", "2", argument(f"{VLA}.measure_methods", "repeats")),
            Row("probe_episodes", "2", size(f"{VLA}.record_methods", "seeds")),
            Row("videos", "[fastv@0.5]", lambda run: [call["name"] for call in run.calls[f"{VLA}.film_tokens"]]),
            *wandb_rows(lambda run: run.call("log_benchmark").result),
        ],
        [
            Row("policy", "other", lambda run: run.call("load_vla").result.chunk_size, 5),
            Row("methods", "[efficientvla_layers]", lambda run: argument(f"{VLA}.record_methods", "texts")(run)[1:]),
            Row("skipped_layers", "1", lambda run: [call["count"] for call in run.calls[f"{VLA}.skipped_layers"]], [1]),
            Row("split", "test", first(f"{BENCHMARK}.evaluate", "seeds"), 210_000),
            Row("out", "elsewhere", lambda run: str(run.call(f"{VLA}.draw_methods")["out"])),
            Row("logger", "null", lambda run: "wandb" if run.calls["log_benchmark"] else None),
            Row("table", "full", argument("print_results", "style")),
        ],
        [
            Row("task", "lift_crowded", argument(f"{BENCHMARK}.build_results", "task")),
            Row("until", "conclusive", argument(f"{BENCHMARK}.make_design", "until")),
            Row("max_episodes", "20", lambda run: run.call(f"{BENCHMARK}.build_results")["terms"].design.max_episodes, 20),
        ],
    )  # fmt: skip
    prepare = staticmethod(write_inputs)
