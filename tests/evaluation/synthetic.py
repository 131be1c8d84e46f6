"""Realistic made-up measurements, for tables and figures without a trained policy."""

import numpy as np

from torchrl_sparse.evaluation.latency.measure import Machine, summarize_latency
from torchrl_sparse.evaluation.results.build import MethodRun, Terms, build_results
from torchrl_sparse.evaluation.results.parts import PolicyShape
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.sequential import Design

# name: success rate, prune rate, FLOPs ratio, latency (s), mean action error, episode length
METHODS = {
    "dense": (0.99, 0.0, 1.0, 1.02, 0.0, 41),
    "ddim10": (0.985, 0.0, 0.1, 0.105, 0.021, 42),
    "uniform": (0.93, 0.9, 0.122, 0.151, 0.034, 47),
    "bac_unified": (0.96, 0.89, 0.131, 0.158, 0.018, 44),
    "bac_blockwise": (0.62, 0.89, 0.134, 0.162, 0.21, 190),
    "bac": (0.98, 0.85, 0.169, 0.191, 0.009, 42),
}
MACHINE = Machine("Imaginary CPU @ 2.5 GHz", 1, "cpu", "2.13.0", "2026-01-31T12:00:00+00:00")
POLICY = PolicyShape(params=8967434, num_inference_steps=100, horizon=10, n_obs_steps=2, n_action_steps=8)
DENSE_FLOPS = 15.74e9
HORIZON = 400


def make_runs(episodes=100, names=tuple(METHODS), seed=0):
    """One `MethodRun` per method."""
    generator = np.random.default_rng(seed)
    difficulty = generator.random(episodes)
    runs = {}
    for name in names:
        success, prune_rate, ratio, latency, error, length = METHODS[name]
        runs[name] = MethodRun(
            [
                EpisodeResult(
                    index,
                    bool(difficulty[index] < success),
                    length + index % 7 if difficulty[index] < success else HORIZON,
                    *(5, 5 * ratio * DENSE_FLOPS, prune_rate),
                )
                for index in range(episodes)
            ],
            summarize_latency(latency * generator.gamma(400, 1 / 400, 40)),
            (error, 6 * error),
        )
    return runs


def make_results(episodes=100, **kwargs):
    """The content of a `results.json`."""
    terms = Terms(Design(episodes), HORIZON, early_cut=44)
    about = {"task": "lift", "split": "development", "seed": 0, "machine": MACHINE, "policy": POLICY}
    return build_results(make_runs(episodes, **kwargs), terms=terms, **about)


def make_similarity(layers=8, steps=100):
    """[3 * layers, steps, steps] cosine similarities that fall off late, and faster in deep blocks."""
    time = np.linspace(0, 1, steps)
    blocks = []
    for block in range(3 * layers):
        speed = 0.6 + 2.5 * (block % 3 == 2) + 0.25 * (block // 3)
        position = speed * (0.25 * time + time ** (3 + block % 5))
        blocks.append(np.exp(-(((position[:, None] - position[None, :]) / 1.1) ** 2)))
    return np.stack(blocks)


def make_masks(layers=8, steps=100, updates=10, seed=0):
    """Schedules [steps, 3 * layers], True = pruned: uniform, block-wise, and one with unions upstream."""
    generator = np.random.default_rng(seed)
    uniform = np.ones((steps, 3 * layers), dtype=bool)
    uniform[:: steps // updates] = False
    blockwise = np.ones((steps, 3 * layers), dtype=bool)
    weights = np.linspace(0.2, 1.5, steps - 2)
    weights /= weights.sum()
    for block in range(3 * layers):
        chosen = generator.choice(np.arange(1, steps - 1), updates - 1, replace=False, p=weights)
        blockwise[[0, *chosen, steps - 1], block] = False
    union = blockwise.copy()
    for block in (2, 5, 9, 15, 18):
        downstream = [c for c in range(2, 3 * layers, 3) if c >= block]
        union[:, block] &= blockwise[:, downstream].all(axis=1)
    return {"uniform": uniform, "bac_blockwise": blockwise, "bac": union}


def make_errors(layers=8, steps=100, seed=0):
    """Relative errors [steps, 3 * layers] per schedule: growing while reused, surging at block-wise
    updates."""
    generator = np.random.default_rng(seed)
    scale = {"uniform": 0.05, "bac_blockwise": 0.06, "bac": 0.035}
    errors = {}
    for name, mask in make_masks(layers, steps, seed=seed).items():
        age = np.zeros(mask.shape)
        for step in range(1, steps):
            age[step] = np.where(mask[step], age[step - 1] + 1, 0)
        growth = 1 + np.linspace(0, 4, steps)[:, None] ** 1.5
        error = scale[name] * np.sqrt(age / 10) * growth * generator.uniform(0.8, 1.2, mask.shape)
        if name == "bac_blockwise":
            error[:, 2::3] += 0.07 * ~mask[:, 2::3] * growth * np.linspace(0.3, 1, layers)
        errors[name] = error
    return errors
