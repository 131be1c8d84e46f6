"""Trains TTS's pruner as released, plays it, and puts it beside ours.

    PYTHONPATH=Test-time-Sparsity python -m tests.released.compare lift_moving data/lift_moving_100.h5 runs/released

Both have one policy, chain, calibration set and target rate, and as many updates and queries. Network, choices, loss, optimiser
and learning rates are the release's own; there, too, the noise of an answer is not that of its target. What is in the last
folder already is not made again.
"""

import sys
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm
from TTSInfer.pruner.train.losses import compose_total_loss

from torchrl_sparse import DiffusionPolicy, Sampler, keys
from torchrl_sparse.blocks.mask import NetworkSizes, mask_flops
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.evaluation.rollouts.episodes import read_episodes, totals
from torchrl_sparse.evaluation.rollouts.evaluate import evaluate
from torchrl_sparse.evaluation.rollouts.pairs import pair_episodes
from torchrl_sparse.storage.json import write_json
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.loss import varying_share
from torchrl_sparse.training.pruner.recalls import RecallTrainer

from . import tts

STEPS, RATE, TURNS, BATCH, ROUNDS = 10, 0.7, 4, 16, 250
EPISODES, MARGIN = 50, 0.05
# The release's learning rates, whose schedule is planned for more epochs than there are.
PEAK, LOWEST, EPOCHS, WARM, PLANNED = 1e-4, 1e-6, 20, 4, 45


def main(task, demos, out):
    torch.set_num_threads(1)
    out = Path(out)
    policy = DiffusionPolicy.from_pretrained(f"assets/{task}")
    policy.sampler = Sampler("ddpm", STEPS)
    ours = load_planner(f"assets/{task}/tts", policy.plan.spec)
    targets = make_targets(policy, policy_demos(demos, task, policy), turns=TURNS)
    trainer = RecallTrainer(ours.network, policy, targets, PrunerConfig(rate=RATE, reuse=ours.reuse))
    pruner = tts.make_pruner(policy)
    out.mkdir(parents=True, exist_ok=True)
    with tts.ask_on_cpu():
        if not (out / "pruner.safetensors").exists():
            train(policy, pruner, trainer.train_set)
            save_file(pruner.state_dict(), out / "pruner.safetensors")
        pruner.load_state_dict(load_file(out / "pruner.safetensors"))
        held_out = {"released": validate(policy, pruner, trainer.held_out), "ours": trainer.validate()}
        played = {"released": play("released", ReleasedQuery(policy, pruner), policy, task, out)}
        forbid(pruner.head, tts.RECALL)
        played["released_no_recall"] = play(
            "released_no_recall", ReleasedQuery(policy, pruner), policy, task, out
        )
    forbid(ours.network.mlp[-1], 2)
    policy.plan = ours.eval()
    played["ours_no_recall"] = play("ours_no_recall", policy, policy, task, out)
    write_json(out / "report.json", {"held_out": held_out, "played": played})


def turns_of(policy, rows):
    """The queries of a row in turn, and the dense answers to them."""
    for turn in rows.unbind(1):
        noise = policy.sample_noise(turn[keys.SEED].squeeze(-1))
        yield {"cond": turn[keys.COND], "noise": noise}, turn["target"]


def train(policy, pruner, rows):
    """One update a query, the first of an episode included; the noise is not that of the target."""
    made, scale = tts.released(policy, pruner, training=True), policy.normalizer.unnormalize_action
    optimizer = torch.optim.AdamW(pruner.parameters(), PEAK, betas=(0.9, 0.999), weight_decay=1e-4)
    torch.manual_seed(0)
    for number in tqdm(range(ROUNDS), "rounds", file=sys.stderr):
        epoch = number * EPOCHS // ROUNDS
        for group in optimizer.param_groups:
            group["lr"] = PEAK * rate_factor(epoch)
        made.reset()
        for query, target in turns_of(policy, rows[torch.randint(len(rows), (BATCH,))]):
            query["noise"] = torch.randn_like(query["noise"])
            actions = made.predict_action(query)["action_pred"]
            errors = scale(target), scale(actions), made._cache["gate"]
            loss, *_ = compose_total_loss(True, "l1", "l1", *errors, lamb_sparse=1, target_pruning_ratio=RATE)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def rate_factor(epoch):
    if epoch < WARM:
        return LOWEST / PEAK + epoch / WARM
    return 1 - (epoch - WARM) / (PLANNED - WARM) * (1 - LOWEST / PEAK)


@torch.no_grad()
def validate(policy, pruner, rows):
    """What `RecallTrainer.validate` says of ours, and what is reused."""
    made = tts.released(policy, pruner, training=True)
    made._cache["training"] = False
    errors, chosen = [], []
    for part in rows.split(BATCH):
        made.reset()
        for number, (query, target) in enumerate(turns_of(policy, part)):
            actions = made.predict_action(query)["action_pred"]
            if number:
                errors.append((actions - target).abs().mean(dim=(1, 2)))
                chosen.append(made._cache["gate"].argmax(-1))
    chosen = torch.cat(chosen)
    names = ("compute", "type", "block", "recall")
    shares = {name: (chosen == one).float().mean().item() for one, name in enumerate(names)}
    return {"error": torch.cat(errors).mean().item(), "varying": varying_share(chosen > 0).item(), **shares}


@torch.no_grad()
def forbid(head, choice):
    """Have a pruner take what is second to a choice."""
    head.weight[choice], head.bias[choice] = 0, -1e3


class ReleasedQuery(TensorDictModuleBase):
    """Answers one environment's queries as the release does, between our encoder and our executor."""

    def __init__(self, policy, pruner):
        super().__init__()
        self._policy, self._encode = policy, policy.module["encode"]
        self._made = tts.released(policy, pruner)
        self.in_keys = [*self._encode.in_keys, keys.ELAPSED]
        self.out_keys = [keys.CHUNK, keys.FLOPS, keys.PRUNE_MASK]

    def forward(self, td):
        td, policy = self._encode(td), self._policy
        first = not keys.recall(td, keys.ELAPSED, (1,), 0).any()
        if first:
            self._made.reset()
        query = {"cond": td[keys.COND], "noise": policy.sample_noise(td[keys.SEED].reshape(-1))}
        actions = self._made.predict_action(query)["action_pred"]
        pruned = tts.choices(self._made, (1, STEPS, policy.num_blocks)) > tts.COMPUTE
        if first:  # the release asks, and computes everything
            pruned.zero_()
        td[keys.PRUNE_MASK] = pruned
        td[keys.FLOPS] = mask_flops(NetworkSizes.of(policy.network), pruned)[:, None]
        return td.set(keys.CHUNK, policy.normalizer.unnormalize_action(actions[:, policy.n_obs_steps - 1 :]))


def play(name, module, policy, task, out):
    """Plays test episodes and counts them beside those of our planner that are committed."""
    log = out / "episodes" / f"{name}.jsonl"
    log.parent.mkdir(exist_ok=True)
    options = {"log": log, "identity": {"task": task}, "num_envs": 1, "workers": 1, "policy_device": "cpu"}
    make_env, seeds = diffusion_env(task, policy, None), evaluation_seeds("test", 0, EPISODES)
    episodes = evaluate(name, ChunkExecutor(module, 8), make_env, seeds, backend="process", **options)
    stored = read_episodes(f"assets/{task}/test_split/episodes/tts.jsonl")
    pairs = pair_episodes(name, episodes, "tts", [episode for episode in stored if episode.seed in seeds])
    solved, by_tts = map(sum, pairs.solved)
    counts = {"solved": solved, "tts": by_tts, "prune_rate": totals(episodes).prune_rate}
    return counts | asdict(pairs.success_difference(MARGIN))


if __name__ == "__main__":
    main(*sys.argv[1:])
