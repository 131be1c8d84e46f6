"""An environment that counts, and executors of every kind on it: what is played tells when the policy was asked."""

import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.data import Bounded, Unbounded
from torchrl.envs import Compose, InitTracker, TransformedEnv

from torchrl_sparse import (
    ActionAwareController,
    ChunkExecutor,
    DiffusionPolicy,
    Normalizer,
    RealtimeExecutor,
    Sampler,
    TransformerForDiffusion,
    WarmStart,
    keys,
)
from torchrl_sparse.control.roll_forward import RollForward, StateModel
from torchrl_sparse.control.selectors import CoherentChunk
from torchrl_sparse.control.temporal_ensemble import TemporalEnsemble
from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.envs.transforms import state_history
from torchrl_sparse.networks.diffusion.noise import NOISE_STREAM
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.diffusion.realtime_chunking import RealtimeChunking
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.frame_difference import FrameDifferencePruner
from torchrl_sparse.tokens.specprune import SpecPrune
from torchrl_sparse.tokens.vla_cache import VLACachePruner

SIZE = 28  # pixels
SEEDS = ((0, 2), (1, 3))  # of two environments


def episode_length(seed):
    return (7, 5, 10, 8)[seed]


class CountEnv(SeededEnv):
    """Its state is (seed, steps since the reset); the hand is slow now and then; two cameras show noise that seldom moves."""

    def __init__(self, seeds):
        super().__init__(horizon=100, seeds=seeds)
        self._make_specs(state_dim=2, action=Bounded(-1e6, 1e6, (1,)))
        spec = self.observation_spec.clone()
        spec[keys.EEF_VEL] = Unbounded((6,))
        for camera in (keys.IMAGE, keys.WRIST_IMAGE):
            spec[camera] = Unbounded((3, SIZE, SIZE), dtype=torch.uint8)
        self.observation_spec = spec

    def _start(self, seed):
        self.seed, self.steps = seed, 0

    def _advance(self, action):
        self.steps += 1
        return 0.0

    def _observe_state(self):
        return np.array([self.seed, self.steps], float)

    def _is_solved(self):
        return self.steps >= episode_length(self.seed)

    def _observe(self):
        out = super()._observe()
        out[keys.EEF_VEL] = torch.full((6,), 0.0 if self.steps % 5 == 3 else 1.0)
        for index, camera in enumerate((keys.IMAGE, keys.WRIST_IMAGE)):
            random = np.random.default_rng([self.seed, index, self.steps // 3])
            out[camera] = torch.from_numpy(random.integers(0, 256, (3, SIZE, SIZE), dtype=np.uint8))
        return out


def make_count_env(seeds):
    return TransformedEnv(CountEnv(seeds), Compose(InitTracker(), *state_history(2)))


class Told(TensorDictModuleBase):
    """A policy that always has one instruction: words cannot lie in shared memory."""

    def __init__(self, policy):
        super().__init__()
        self.policy, self.chunk_shape = policy, policy.chunk_shape
        self.in_keys = [key for key in policy.in_keys if key != keys.INSTRUCTION]
        self.out_keys = policy.out_keys

    def forward(self, td):
        answer = self.policy(td.copy().set(keys.INSTRUCTION, ["count"] * len(td)))
        return td.update(answer.select(*self.out_keys))


def counting_policy(length):
    """Entry i of a chunk is 10 * step + i."""

    def chunk(history):
        return (10 * history[..., -1, 1:] + torch.arange(float(length)))[..., None]

    return TensorDictModule(chunk, in_keys=[keys.HISTORY_STATE], out_keys=[keys.CHUNK])


def sampling_policy():
    """Samples of one policy call lie apart, in a way that the last chunk decides about."""

    def chunk(history, seed):
        step, sample = history[..., -1, 1:], seed // NOISE_STREAM
        return (step + sample * (step % 3 - 1) + torch.arange(6.0))[..., None]

    return TensorDictModule(chunk, in_keys=[keys.HISTORY_STATE, keys.EPISODE_SEED], out_keys=[keys.CHUNK])


def diffusion_policy(**parts):
    torch.manual_seed(0)
    network = TransformerForDiffusion(
        input_dim=1, output_dim=1, horizon=8, n_obs_steps=2, cond_dim=2, n_layer=1, n_emb=16
    )
    normalizer = Normalizer(torch.full((2,), 0.1), torch.zeros(2), torch.ones(1), torch.zeros(1))
    policy = DiffusionPolicy(network, normalizer, sampler=Sampler("ddpm", 3), engine="reference")
    for name, part in parts.items():
        setattr(policy, name, part)
    return policy


def vision_policy(pruner=None):
    torch.manual_seed(0)
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(image_size=SIZE, state_dim=2, action_dim=1, chunk_size=4)))
    policy.pruner = pruner or SpecPrune(budget=1, dynamic=False, look_back=2)
    return Told(policy)


def state_model():
    steps = torch.arange(12.0)
    return StateModel.fit(
        [(torch.stack([torch.full((12,), float(seed)), steps], -1), steps[:, None]) for seed in range(4)]
    )


def hold():
    return TensorDictModule(lambda state: -1 - state[..., :1], in_keys=[keys.STATE], out_keys=[keys.HOLD])


EXECUTORS = {
    "chunks": lambda: ChunkExecutor(counting_policy(4), 4),
    "controller": lambda: ChunkExecutor(counting_policy(4), 4, ActionAwareController(warmup_steps=2)),
    "realtime": lambda: RealtimeExecutor(counting_policy(8), hold(), 4, latency=0.1),
    "ensemble": lambda: ChunkExecutor(TemporalEnsemble(counting_policy(4), coeff=0.0), 2),
    "selector": lambda: ChunkExecutor(sampling_policy(), 3, num_samples=3, selector=CoherentChunk()),
    "warm start": lambda: ChunkExecutor(diffusion_policy(start=WarmStart(1)), 3),
    "guided": lambda: RealtimeExecutor(diffusion_policy(start=RealtimeChunking()), hold(), 3, latency=0.1),
    "ahead": lambda: RealtimeExecutor(RollForward(diffusion_policy(), state_model()), hold(), 3, latency=0.1),
    "tokens": lambda: ChunkExecutor(
        vision_policy(), 3, ActionAwareController(warmup_steps=2, coarse=1, fine=2)
    ),
    "frame difference": lambda: ChunkExecutor(vision_policy(FrameDifferencePruner()), 3),
    "vla cache": lambda: ChunkExecutor(vision_policy(VLACachePruner(threshold=-1.0)), 3),
}


def by_hand(actor, seed):
    """Play the episode of a seed in one environment alone, without a collector: (action, asked) of each step."""
    env, steps = make_count_env([seed]), []
    td = env.reset()
    while True:
        td = env.step(actor(td))
        steps.append((td[keys.ACTION].item(), td[keys.QUERIED].item()))
        if td["next", "done"].item():
            return steps
        td = td.exclude("next").update(td["next"])


def expected_chunks(seed):
    return [(10.0 * (t - t % 4) + t % 4, t % 4 == 0) for t in range(episode_length(seed))]


def expected_realtime(seed):
    steps = []
    for t in range(episode_length(seed)):
        asked = t - t % 4
        if t - asked < 2:  # the answer is not there yet
            played = -1.0 - seed if asked == 0 else 10.0 * (asked - 4) + t - (asked - 4)
        else:
            played = 10.0 * asked + t - asked
        steps.append((played, t == asked))
    return steps


def expected_ensemble(seed):
    steps = []
    for t in range(episode_length(seed)):
        told = [10.0 * asked + t - asked for asked in range(0, t + 1, 2) if t - asked < 4]
        steps.append((sum(told) / len(told), t % 2 == 0))
    return steps
