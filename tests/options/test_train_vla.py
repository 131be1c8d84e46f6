"""Options of the training of a vision-language-action policy."""

import h5py

from tests.fixtures.demonstrations import describe
from tests.fixtures.gguf import write_llama
from tests.options.harness import OptionTests, Row
from tests.options.inputs import write_vla
from tests.options.seen import device, printed, written
from tests.options.training import LOGGER, WATCHED, csv_logger, first_step, logger_kind, threads, wandb_rows
from tests.training.vla.rendered import write_demos
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.networks.vla.config import VLAConfig

EVALUATE = "torchrl_sparse.evaluation.rollouts.evaluate.evaluate"


def config(name):
    """A field of the `TrainConfig` that is trained under."""
    return lambda run: getattr(run.call("VLATrainer")["config"], name)


def stage(name):
    return lambda run: getattr(run.call("VLATrainer")["grounding"], name)


def network(name):
    return lambda run: getattr(run.call("VLATrainer")["policy"].network.config, name)


def made(name):
    return lambda run: [call[name] for call in run.calls["untrained_policy"]]


def source(run):
    return run.call("VLATrainer")["policy"].source


class TestOptions(OptionTests):
    recipe = "train_vla"
    base = (
        *("size=tiny", "max_steps=2", "batch_size=2", "lr_warmup_steps=1", "train.val_ratio=0.4"),
        *("grounding.locate_steps=1", "grounding.refer_steps=1", "log_every=1", "checkpoint_every=1"),
        *("eval_every=1", "logger=wandb"),
    )
    watched = (WATCHED[0], "untrained_policy", "VLATrainer", "VLAPolicy.to")
    replaced = {
        LOGGER: csv_logger,
        EVALUATE: lambda *_, **__: [EpisodeResult(0, True, 8, 1, 10.0, 0.5)],
    }
    groups = (
        [
            Row("demos", "[data/more.h5,data/more.h5]", printed(r"(\d+) demonstrations", int), 6),
            Row("network.chunk_size", "3", network("chunk_size")),
            Row("grounding.locate_steps", "0", stage("locate_steps")),
            Row("grounding.refer_steps", "2", stage("refer_steps")),
            Row("train.max_steps", "3", config("max_steps")),
            Row("train.batch_size", "1", config("batch_size")),
            Row("train.lr", "0.01", config("lr")),
            Row("train.lr_warmup_steps", "2", config("lr_warmup_steps")),
            Row("train.weight_decay", "0.5", config("weight_decay")),
            Row("train.max_grad_norm", "0.5", config("max_grad_norm")),
            Row("train.ema_power", "0.5", config("ema_power")),
            Row("train.ema_max_decay", "0.5", config("ema_max_decay")),
            Row("train.precision", "bf16", config("precision")),
            Row("train.val_ratio", "0.2", config("val_ratio")),
            Row("train.seed", "3", config("seed")),
            Row("device", "'cpu:0'", device("VLAPolicy.to")),
            Row("threads", "2", threads),
            Row("log_every", "2", first_step("train/loss")),
            Row("checkpoint_every", "2", first_step("held_out/loss")),
            Row("eval_every", "2", first_step("eval/success")),
            Row("eval_episodes", "3", lambda run: len(run.call(EVALUATE)["seeds"])),
            Row("n_action_steps", "2", lambda run: run.call(EVALUATE)["actor"].n_action_steps),
            *wandb_rows(lambda run: run.call(LOGGER)["wandb_kwargs"]),
        ],
        [
            Row("max_steps", "1", config("max_steps")),
            Row("batch_size", "1", config("batch_size")),
            Row("lr", "0.01", config("lr")),
            Row("lr_warmup_steps", "2", config("lr_warmup_steps")),
            Row("precision", "bf16", config("precision")),
            Row("seed", "5", lambda run: made("seed")(run)[0]),
            Row("base", "base.gguf", made("base"), ["base.gguf"]),
            Row("rank", "2", lambda run: made("rank")(run)[0]),
            Row("cameras.image", "null", lambda run: "image" in source(run).cameras, False),
            Row("logger", "csv", logger_kind),
            Row("out", "elsewhere", written("elsewhere/policy"), True),
            "+network.patch_size=7",
            "checkpoint_every=9",  # a validation takes longer than the steps
        ],
        [
            Row("size", "small", network("llm"), VLAConfig.small().llm),
            Row("cameras.wrist_image", "null", lambda run: "wrist_image" in source(run).cameras, False),
            "max_steps=1",
            "checkpoint_every=9",
        ],
        [Row("init", "vla", made("size"), []), "size=null", "max_steps=1", "checkpoint_every=9"],
        [
            Row("task", "lift_crowded", lambda run: source(run).task, "LiftCrowded"),
            "grounding.locate_steps=0",
            "grounding.refer_steps=0",
        ],
    )  # fmt: skip

    @staticmethod
    def prepare(folder):
        (folder / "data").mkdir()
        for name in ("lift_named_images", "more", "lift_crowded_images"):
            demos = write_demos(folder / f"data/{name}.h5")
        with h5py.File(demos, "a") as file:
            describe(file, "LiftCrowded")
        write_vla(folder / "vla", folder / "data/more.h5")
        write_llama(folder / "base.gguf")
