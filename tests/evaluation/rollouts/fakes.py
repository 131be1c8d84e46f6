"""A tiny environment and actor with the keys that paired rollouts read."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_sparse import keys

HORIZON = 12
FLOPS_PER_QUERY = 1.0e9
CHUNK_LENGTH = 4


def expected_length(seed: int) -> int:
    """Episodes of a seed that is a multiple of 5 fail at the horizon, others succeed after 3 to 6 steps."""
    return HORIZON if seed % 5 == 0 else 3 + seed % 4


class FakeEnv(EnvBase):
    """Counts steps; succeeds where `expected_length` says so. Keeps a list of the seeds that it started."""

    def __init__(self, seeds):
        super().__init__(device="cpu", batch_size=[])
        self._seeds = list(seeds)
        self.started = []
        flag = Categorical(2, (1,), dtype=torch.bool)
        count = Unbounded((1,), dtype=torch.int64)
        self.observation_spec = Composite(
            observation=Composite(state=Unbounded((2,))),
            episode=Composite(seed=count, step=count.clone()),
            success=flag,
        )
        self.action_spec = Unbounded((2,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone())

    def _observe(self):
        out = TensorDict({}, batch_size=[])
        out[keys.STATE] = torch.tensor([self.seed, self.elapsed], dtype=torch.float32)
        out[keys.EPISODE_SEED] = torch.tensor([self.seed])
        out[keys.EPISODE_STEP] = torch.tensor([self.elapsed])
        solved = self.seed % 5 != 0 and self.elapsed >= expected_length(self.seed)
        out[keys.SUCCESS] = torch.tensor([solved])
        return out

    def _reset(self, tensordict=None, **kwargs):
        self.seed = self._seeds[len(self.started) % len(self._seeds)]
        self.started.append(self.seed)
        self.elapsed = 0
        return self._observe()

    def _step(self, tensordict):
        self.elapsed += 1
        out = self._observe()
        out["terminated"] = out[keys.SUCCESS].clone()
        out["truncated"] = torch.tensor([self.elapsed >= HORIZON]) & ~out["terminated"]
        out["done"] = out["terminated"] | out["truncated"]
        out["reward"] = torch.zeros(1)
        return out

    def _set_seed(self, seed):
        return seed


class TellingEnv(FakeEnv):
    """Rewards its second step most, does a part of its task every two steps and shows its way after the first."""

    def __init__(self, seeds):
        super().__init__(seeds)
        count = Unbounded((1,), dtype=torch.int64)
        self.observation_spec["episode"].update({"completed": count, "way": count.clone()})

    def _observe(self):
        out = super()._observe()
        out[keys.EPISODE_COMPLETED] = torch.tensor([self.elapsed // 2])
        out[keys.EPISODE_WAY] = torch.tensor([self.seed % 4 if self.elapsed else -1])
        return out

    def _step(self, tensordict):
        out = super()._step(tensordict)
        return out.set("reward", torch.tensor([{1: 0.1, 2: 0.5}.get(self.elapsed, 0.2)]))


class FakeActor(TensorDictModuleBase):
    """Policy calls every `CHUNK_LENGTH` steps; its cost keys hold nonsense on served steps, where nobody may look.

    Args:
        crash_at: raise on this call, as a machine that dies would.
        prune_rate: share of the mask that is pruned; None writes no mask.
    """

    def __init__(self, crash_at=None, prune_rate=0.5):
        super().__init__()
        self.in_keys = [keys.STATE, keys.EPISODE_STEP]
        self.out_keys = [keys.ACTION, keys.QUERIED, keys.FLOPS, keys.LATENCY]
        if prune_rate is not None:
            self.out_keys.append(keys.PRUNE_MASK)
        self.crash_at, self.prune_rate, self.calls = crash_at, prune_rate, 0

    def forward(self, tensordict):
        self.calls += 1
        if self.calls == self.crash_at:
            raise RuntimeError("injected crash")
        step = tensordict[keys.EPISODE_STEP]
        queried = step % CHUNK_LENGTH == 0
        tensordict[keys.ACTION] = torch.zeros(*step.shape[:-1], 2)
        tensordict[keys.QUERIED] = queried
        tensordict[keys.FLOPS] = torch.where(queried, FLOPS_PER_QUERY, -1.0e30)
        tensordict[keys.LATENCY] = torch.where(queried, 0.01, -1.0)
        if self.prune_rate is not None:
            mask = torch.zeros(*step.shape[:-1], 10, 6, dtype=torch.bool)
            mask[..., : int(10 * self.prune_rate), :] = True
            tensordict[keys.PRUNE_MASK] = torch.where(queried[..., None], mask, True)
        return tensordict
