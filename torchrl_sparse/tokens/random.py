"""Random pruning of visual tokens: the control that every other method has to beat."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.networks.diffusion.noise import query_seed
from torchrl_sparse.networks.vla.hooks import VisualSpec
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.selection import best, check_share


def random_set(seed: Tensor, num_tokens: int, count: int) -> Tensor:
    """Draw ``count`` of the tokens, bool [B, num_tokens], row i from ``seed[i]`` alone.

    Args:
        seed: i64 [B].

    Examples:
        >>> chosen = random_set(torch.tensor([3, 4, 3]), 8, 2)
        >>> chosen.sum(-1).tolist(), torch.equal(chosen[0], chosen[2])
        ([2, 2, 2], True)
    """
    draws = [
        torch.rand(num_tokens, generator=torch.Generator().manual_seed(value)) for value in seed.tolist()
    ]
    draws = torch.stack(draws).to(seed.device)
    return best(draws, count, torch.ones_like(draws, dtype=torch.bool))


class RandomPruner(TokenPruner):
    """Pruner that keeps a random ``share`` of all visual tokens, redrawn at each policy call, before the decoder.

    The draw follows from ``("episode", "seed")`` and ``("episode", "step")`` where the environment writes them, else from
    torch's global generator.

    Args:
        share: of the visual tokens that stay, in (0, 1].
    """

    in_keys = [keys.EPISODE_SEED, keys.EPISODE_STEP]
    out_keys = [keys.KEEP_MASK]

    def __init__(self, share: float = 0.5):
        check_share("share", share)
        self.share = share

    def bind(self, spec: VisualSpec) -> None:
        self.spec = spec

    def begin(self, td: TensorDictBase) -> None:
        count = round(self.share * self.spec.num_visual)
        td.set(keys.KEEP_MASK, random_set(self._seed(td), self.spec.num_visual, count))

    @staticmethod
    def _seed(td: TensorDictBase) -> Tensor:
        seed, step = td.get(keys.EPISODE_SEED, None), td.get(keys.EPISODE_STEP, None)
        if seed is None or step is None:
            return torch.randint(2**62, td.batch_size, device=td.device)
        return query_seed(seed, step).reshape(-1)
