"""Options of the benchmark of a diffusion policy."""

from contextlib import nullcontext

import torch

from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import write_reach
from tests.options.training import wandb_rows
from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.evaluation.rollouts.evaluate import evaluate
from torchrl_sparse.runtime.wandb_run import wandb_arguments

ANALYSES = {"max_episodes": 20, "analyses": 2}
BENCHMARK = "torchrl_sparse.evaluation.benchmarks.benchmark"
DIFFUSION = "torchrl_sparse.evaluation.benchmarks.diffusion"
CALIBRATED = "torchrl_sparse.training.diffusion.calibration.calibrate_policy"
EVALUATED, TIMED = f"{BENCHMARK}.evaluate", f"{DIFFUSION}.time_queries"
RECORDED, ROUNDS, FILMED = (
    f"{DIFFUSION}.record_queries",
    f"{BENCHMARK}.play_rounds",
    f"{DIFFUSION}.film_masks",
)


def results(*names):
    """What ``results.json`` has under nested names."""

    def read(run):
        found = run.json("results.json")
        for name in names:
            found = found[name]
        return found

    return read


def played(argument, name="dense"):
    """An argument of the call that plays a method's episodes."""

    def read(run):
        return next(call[argument] for call in run.calls[EVALUATED] if call["name"] == name)

    return read


def calls_of(name, argument):
    return lambda run: [call[argument] for call in run.calls[name]]


def uniform(*names):
    return results("methods", "uniform", *names)


def updates(run):
    """How many of 20 steps compute a block under ``uniform``."""
    return round(20 * (1 - uniform("prune_rate")(run)))


def wandb(run):
    """Arguments of ``wandb.init``."""
    return run.call("log_benchmark").result


def pairs(run):
    return [[pair["method"], pair["against"]] for pair in run.json("results.json").get("pairs", ())]


def evaluated(name, actor, make_env, seeds, *, workers, backend, **options):
    """Episodes as they are on one worker of this process, which those of all others equal."""
    return evaluate(name, actor, make_env, seeds, **options)


class TestOptions(OptionTests):
    recipe = "benchmark"
    base = (
        "task=reach",
        *("methods=[uniform,saved]", "episodes=1", "horizon=9", "latency_repeats=1", "probe_episodes=1"),
        *("videos=[]", "logger=wandb"),
    )
    watched = ("DiffusionPolicy.to", CALIBRATED, RECORDED, ROUNDS, TIMED)
    replaced = {
        EVALUATED: evaluated,
        f"{BENCHMARK}.backend_runtime": lambda *_: nullcontext(),
        f"{DIFFUSION}.draw_methods": returning(None),
        FILMED: returning(None),
        "log_benchmark": lambda results, folder, config: wandb_arguments(config, folder, "default"),
    }
    groups = (
        [
            Row("device", "'cpu:0'", lambda run: str(run.call("DiffusionPolicy.to")["args"][0])),
            Row("planners", "plans", results("methods", "saved", "prune_rate"), 0.5),
            Row("pairs", "[[saved,uniform]]", pairs),
            Row("episodes", "2", uniform("success", "n")),
            Row("seed", "7", lambda run: played("seeds")(run)[0] - 100_000),
            Row("dense_log", "logs/one.jsonl", lambda run: (run.folder / "logs/one.jsonl").is_file(), True),
            Row("horizon", "8", results("episode_horizon")),
            Row("num_updates", "5", updates),
            Row("calibration_samples", "2", lambda run: len(run.call(CALIBRATED)["seeds"])),
            Row("n_action_steps", "5", lambda run: played("actor")(run).n_action_steps, 5),
            Row("num_envs", "2", played("num_envs")),
            Row("workers", "2", played("workers")),
            Row("backend", "ray", played("backend")),
            Row("margin", "0.2", uniform("paired_vs_dense", "margin")),
            Row("time_margin", "0.3", uniform("time_vs_dense", "margin")),
            Row("threads", "2", lambda run: run.call(TIMED)["threads"]),
            Row("latency_repeats", "2", lambda run: run.call(TIMED)["repeats"]),
            Row("probe_episodes", "2", lambda run: len(run.call(RECORDED)["seeds"])),
            Row("videos", "[dense,saved]", calls_of(FILMED, "name")),
            *wandb_rows(wandb),
        ],
        [
            Row("methods", "[ddim2]", lambda run: [*results("methods")(run)], ["dense", "ddim2"]),
            Row("engine", "reference", lambda run: played("actor")(run).policy.engine),
            Row("policy", "other", results("policy", "horizon"), 12),
            Row("split", "test", lambda run: played("seeds")(run)[0], 210_000),
            Row("out", "elsewhere", lambda run: (run.folder / "elsewhere/results.json").is_file(), True),
            Row("logger", "null", lambda run: "wandb" if run.calls["log_benchmark"] else None),
            Row("table", "full", lambda run: "McNemar's p" in run.printed, True),
            "n_action_steps=8",
        ],
        [
            Row("task", "touch", results("task"), "Touch"),
            Row(
                "until", "conclusive", lambda run: run.json("results.json").get("until_conclusive"), ANALYSES
            ),
            Row("max_episodes", "20", lambda run: run.call(ROUNDS)["terms"].design.max_episodes, 20),
            "methods=[uniform]",
        ],
    )

    @staticmethod
    def prepare(folder):
        torch.manual_seed(0)
        write_reach(folder / "assets/touch", "Touch")
        write_reach(folder / "other", horizon=12)
        policy = write_reach(folder / "assets/reach")
        for plans, steps in (("assets/reach", range(20)), ("plans", range(0, 20, 2))):
            blocks = (tuple(steps),) * policy.plan.spec.num_blocks
            saved = CacheSchedule("saved", policy.fingerprint, 20, 2, blocks)
            saved.save_pretrained(folder / plans / "saved.json")
