"""Options of the training of a diffusion policy."""

import re

import torch
from safetensors.torch import load_file

from tests.options.harness import OptionTests, Row
from tests.options.inputs import STEPS, write_demos, write_policy, write_state_demos
from tests.options.training import (
    AVERAGE,
    LOGGER,
    WATCHED,
    average,
    batch,
    clipped,
    csv_logger,
    first_step,
    logger_kind,
    peak_lr,
    precision,
    threads,
    total,
    wandb_rows,
    warmup_steps,
    weight_decay,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult

EVALUATE = "torchrl_sparse.evaluation.rollouts.evaluate.evaluate"
AGENT, WRIST = "agentview_image", "robot0_eye_in_hand_image"
WINDOWS = STEPS - 10 + 8 + 1
"""Of a demonstration: horizon 10, 8 executed actions, two observations."""
MOVED = "torchrl_sparse.policies.diffusion.policy.DiffusionPolicy.to"


def exported(*names):
    """What the exported policy's configuration has under nested names, None if nothing."""

    def read(run):
        found = run.json("policy/config.json")
        for name in names:
            found = (found or {}).get(name)
        return found

    return read


def network(name):
    return exported("network", name)


def demonstrations(run):
    return int(re.search(r"(\d+) demonstrations", run.printed)[1])


def windows(run):
    return int(re.search(r"(\d+) training windows", run.printed)[1])


def windows_and_noted(run):
    """And what the policy says, for whoever plays it."""
    return windows(run), exported("source", "n_action_steps")(run)


def scales_of_the_state(run):
    return len(load_file(run.out / "policy/model.safetensors")["normalizer.state_scale"].unique()) > 1


def evaluated(read):
    return lambda run: read(run.call(EVALUATE))


class TestOptions(OptionTests):
    recipe = "train_policy"
    base = (
        *("max_steps=3", "batch_size=4", "lr_warmup_steps=1", "train.val_ratio=0.25"),
        *("network.n_layer=1", "network.n_emb=16", "network.n_head=2"),
        *("log_every=1", "checkpoint_every=2", "eval_every=1", "logger=wandb"),
    )
    watched = (*WATCHED, AVERAGE, "untrained_policy", MOVED)
    replaced = {
        LOGGER: csv_logger,
        EVALUATE: lambda *_, **__: [EpisodeResult(0, True, 8, 1, 10.0, 0.5)],
    }
    groups = (
        [
            Row("network.horizon", "12", network("horizon")),
            Row("network.n_obs_steps", "3", network("n_obs_steps")),
            Row("network.n_layer", "2", network("n_layer")),
            Row("network.n_head", "4", network("n_head")),
            Row("network.n_emb", "32", network("n_emb")),
            Row("network.p_drop_emb", "0.1", network("p_drop_emb")),
            Row("network.p_drop_attn", "0.2", network("p_drop_attn")),
            Row("network.causal_attn", "false", network("causal_attn")),
            Row("network.n_cond_layers", "1", network("n_cond_layers")),
            Row("demos", "[data/lift_proficient.h5,data/more.h5]", demonstrations, 7),
            Row("train.max_steps", "4", total),
            Row("train.batch_size", "3", batch("batch_size")),
            Row("train.lr", "0.02", peak_lr),
            Row("train.lr_warmup_steps", "2", warmup_steps),
            Row("train.weight_decay", "0.5", weight_decay),
            Row("train.max_grad_norm", "0.25", clipped),
            Row("train.ema_power", "0.5", average("power")),
            Row("train.ema_max_decay", "0.5", average("decay")),
            Row("train.precision", "bf16", precision),
            Row("train.seed", "5", batch("seed")),
            Row("device", "'cpu:0'", lambda run: str(run.call(MOVED)["args"][0])),
            Row("threads", "2", threads),
            Row("checkpoint_every", "3", first_step("held_out/loss")),
            Row("eval_every", "2", first_step("eval/success")),
            Row("eval_episodes", "4", evaluated(lambda call: len(call["seeds"]))),
            Row("eval_ddim_steps", "7", evaluated(lambda call: call["actor"].policy.num_inference_steps)),
            *wandb_rows(lambda run: run.call(LOGGER)["wandb_kwargs"]),
        ],
        [
            Row("max_steps", "4", total),
            Row("batch_size", "3", batch("batch_size")),
            Row("lr", "0.02", peak_lr),
            Row("lr_warmup_steps", "2", warmup_steps),
            Row("precision", "bf16", precision),
            Row("seed", "5", lambda run: run.call("untrained_policy")["seed"]),
            Row("filter_key", "few", demonstrations, 2),
            Row("state_normalization", "range", scales_of_the_state, True),
            Row("train.n_action_steps", "4", windows_and_noted, (WINDOWS - 4, 4)),
            Row("out", "elsewhere", lambda run: (run.folder / "elsewhere/policy").is_dir(), True),
            Row("logger", "csv", logger_kind),
            "train.val_ratio=0.5",
        ],
        [
            Row("init", "other", network("n_emb"), 8),
            Row("train.val_ratio", "0.5", windows, 2 * WINDOWS),
            Row("log_every", "2", first_step("train/loss")),
            *(f"network.{size}=null" for size in ("n_layer", "n_emb", "n_head")),  # its own
        ],
        [
            Row("task", "block_push", network("input_dim"), 2),
        ],
        [
            Row("cameras.image", AGENT, exported("source", "cameras", "image")),
            Row("cameras.wrist_image", WRIST, exported("source", "cameras", "wrist_image")),
            Row("vision.crop", "0.85", exported("vision", "crop_size"), [34, 34]),
            Row("vision.width", "16", exported("vision", "width"), 16),
            "max_steps=1",
        ],
    )

    @staticmethod
    def prepare(folder):
        demos = write_demos(folder / "data/lift_proficient.h5", 4, cameras=(AGENT, WRIST))
        write_demos(folder / "data/more.h5", 3)
        write_state_demos(folder / "data/block_push_proficient.h5", "BlockPush", (16, 2))
        torch.manual_seed(0)
        write_policy(folder / "other", demos, n_emb=8)
