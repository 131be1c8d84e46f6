"""Options of the training of a pruner."""

from tests.options.harness import OptionTests, Row, returning
from tests.options.inputs import write_reach, write_state_demos
from tests.options.seen import argument, device, printed, written
from tests.options.training import (
    LOGGER,
    WATCHED,
    csv_logger,
    first_step,
    logger_kind,
    threads,
    wandb_rows,
)
from torchrl_sparse.blocks.schedule import CacheSchedule


def config(name):
    """A field of the `PrunerConfig` that is trained under."""

    def read(run):
        value = getattr(run.call("PrunerTrainer")["config"], name)
        return [*value] if isinstance(value, tuple) else value

    return read


def width(run):
    return run.call("make_gates").arguments.get("width")


def trained(run):
    return run.call("PrunerTrainer")["policy"]


def spread(run):
    return [call["spread"] for call in run.calls["spread_logits"]]


class TestOptions(OptionTests):
    recipe = "train_pruner"
    base = (
        *("task=reach", "sampler={kind: ddim, num_inference_steps: 4}", "targets.share=1", "rate=0.5"),
        *("train.max_updates=2", "train.batch_size=4", "train.lr=0.001"),
        *("log_every=1", "checkpoint_every=1", "logger=wandb"),
    )
    watched = (
        *(WATCHED[0], "PrunerTrainer", "make_gates", "make_targets", "policy_demos", "spread_logits"),
        *("closed_loop_queries", "DiffusionPolicy.to"),
    )
    replaced = {LOGGER: csv_logger, "plot_pruner_curves": returning(None)}
    groups = (
        [
            Row("demos", "data/more.h5", lambda run: len(run.call("policy_demos").result), 3),
            Row("device", "'cpu:0'", device()),
            Row("spread", "1.5", spread, [1.5]),
            Row("sampler", "{kind: ddpm, num_inference_steps: 5}", lambda run: trained(run).num_inference_steps, 5),
            Row("targets.share", "0.5", argument("make_targets", "share")),
            Row("targets.seed", "3", argument("make_targets", "seed")),
            Row("network.width", "8", width, 8),
            Row("train.rate", "0.4", config("rate")),
            Row("train.epochs", "1", config("epochs")),
            Row("train.max_updates", "1", config("max_updates")),
            Row("train.batch_size", "3", config("batch_size")),
            Row("train.lr", "0.002", config("lr")),
            Row("train.beta", "0.5", config("beta")),
            Row("train.norm", "l2", config("norm")),
            Row("train.estimator", "gumbel", config("estimator")),
            Row("train.temperature", "2.0", config("temperature")),
            Row("train.final_temperature", "0.5", config("final_temperature")),
            Row("train.variety", "0.05", config("variety")),
            Row("train.information", "0.5", config("information")),
            Row("train.sparsity", "block", config("sparsity")),
            Row("train.cost", "flops", config("cost")),
            Row("train.reuse", "type", config("reuse")),
            Row("train.gradient", "step", config("gradient")),
            Row("train.detached", "true", config("detached")),
            Row("train.explore", "0.5", config("explore")),
            Row("train.checkpointed", "false", config("checkpointed")),
            Row("train.max_grad_norm", "0.5", config("max_grad_norm")),
            Row("train.seed", "3", config("seed")),
            Row("threads", "2", threads),
            *wandb_rows(lambda run: run.call(LOGGER)["wandb_kwargs"]),
        ],
        [
            Row("policy", "other", lambda run: trained(run).horizon, 12),
            Row("objective", "noise", config("objective")),
            Row("rate", "0.3", config("rate")),
            Row("targets.source", "data", argument("make_targets", "source")),
            Row("log_every", "2", first_step("train/loss")),
            Row("checkpoint_every", "2", first_step("held_out/error")),
            Row("logger", "csv", logger_kind),
            Row("out", "elsewhere", written("elsewhere/pruner"), True),
        ],
        [
            Row("method", "l2c", lambda run: "l2c.json" in run.names(), True),
            Row("reuse", "type", config("reuse")),
            Row("init", "plan.json", printed(r"(\S+): fitted"), "plan.json"),
            Row("rollouts", "1", lambda run: [call["episodes"] for call in run.calls["closed_loop_queries"]], [1]),
        ],
        [
            Row("train.objective", "noise", config("objective")),
            Row("train.rate_range", "[0.3,0.4]", config("rate_range")),
            Row("task", "touch", argument("policy_demos", "task"), "touch"),
            "rate=0.3",
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        write_reach(folder / "other", horizon=12)
        policy = write_reach(folder / "assets/reach")
        write_reach(folder / "assets/touch", "Touch")
        write_state_demos(folder / "data/more.h5", "Reach", (1, 1), 3)
        blocks = ((0, 2),) * policy.plan.spec.num_blocks
        CacheSchedule("bac", policy.fingerprint, 4, 2, blocks, "ddim").save_pretrained(folder / "plan.json")
