"""Training of gates that also say what is recalled of earlier queries, as TTS (arXiv:2605.13316) does.

A sample is not a query but several in a row, as an episode asks them: the first computes everything, each of the others is
answered under its gates with the memory that those before it left, and the loss is the mean of theirs. No gradient runs through
a memory.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.reference import denoise_recalling, first_memory
from torchrl_sparse.blocks.sag.relaxed import Recalled, straight_through_gate
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import ANSWER_BATCH
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.gates import Gates
from torchrl_sparse.training.pruner.loss import rate_metrics, varying_share
from torchrl_sparse.training.pruner.trainer import PrunerTrainer

__all__ = ["RecallTrainer", "check_turns", "pruner_trainer"]


class RecallTrainer(PrunerTrainer):
    """Trains gates that recall through a frozen policy; see `PrunerTrainer`.

    Args:
        gates: :class:`~torchrl_sparse.blocks.sag.network.PrunerNetwork` with ``recalls``.
        policy: the policy, with the sampler that will be pruned; its weights get no gradient.
        targets: [N, turns], see `make_targets`.
        config: how to train: through the whole chain, to one rate.

    Raises:
        ValueError: if calibration set, configuration and gates do not fit each other.
    """

    batch_dims = 2

    def __init__(
        self, gates: Gates, policy: DiffusionPolicy, targets: TensorDict, config: PrunerConfig
    ) -> None:
        for name, only in (("objective", "actions"), ("gradient", "chain"), ("rate_range", None)):
            if (got := getattr(config, name)) != only:
                raise ValueError(f"{name}: expected {only!r} for gates that recall, got {got!r}")
        super().__init__(gates, policy, targets, config)

    def batch_losses(self, index: Tensor) -> dict[str, Tensor]:
        """Return what `PrunerTrainer.batch_losses` does, means over the turns, and ``"recalled"``, the share of the cells."""
        first, *queries = self.train_set[index].unbind(1)
        memory, turns = self._first_memory(first), []
        for query in queries:
            logits, recall = self._both_logits(query)
            gate, recalls = self._gate(logits), straight_through_gate(recall)
            errors = self._chain_errors(query, gate, Recalled(recalls, memory))
            rate = self._draw_rates(len(query))
            share = (gate * recalls).detach().mean()
            turns.append(self._losses(self._norm(errors), logits, gate, rate) | {"recalled": share})
            memory = self._answer(query, gate.bool(), recalls.bool(), memory)[1]
        return {name: torch.stack([losses[name] for losses in turns]).mean() for name in turns[0]}

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Return what `PrunerTrainer.validate` does, of all turns but the first, and the share of the cells that recall."""
        self.gates.eval()
        errors, masks, recalled = [], [], []
        for part in self.held_out.split(ANSWER_BATCH):
            first, *queries = part.unbind(1)
            memory = self._first_memory(first)
            for query in queries:
                mask, recalls = self._choice(query)
                actions, memory = self._answer(query, mask, recalls, memory)
                errors.append((actions - query["target"]).abs().mean(dim=(1, 2)))
                masks.append(mask)
                recalled.append(recalls)
        mask, recalls = torch.cat(masks), torch.cat(recalled)
        metrics = {
            "error": torch.cat(errors).mean(),
            "variance": mask.float().var(dim=0, unbiased=False).mean(),
            "varying": varying_share(mask),
            "recalled": recalls.float().mean(),
            **rate_metrics(mask.float(), self.weight),
        }
        return {name: value.item() for name, value in metrics.items()}

    @torch.no_grad()
    def fixed_recalls(self, mask: Tensor) -> Tensor:
        """Return the cells of ``mask`` that are recalled in the mean, bool [K, 3L]: by half of those that prune them."""
        self.gates.eval()
        choices = [
            self._choice(query) for part in self.train_set.split(ANSWER_BATCH) for query in part.unbind(1)
        ]
        pruned, recalled = (sum(cells.sum(dim=0) for cells in part) for part in zip(*choices, strict=True))
        return mask & (recalled * 2 >= pruned) & (recalled > 0)

    def _choice(self, query: TensorDict) -> tuple[Tensor, Tensor]:
        """Return the pruned and the recalled cells as they will be used, bool [B, K, 3L] each."""
        logits, recall = self._both_logits(query)
        mask = (logits > 0) & self._may_prune
        return mask, mask & (recall > 0)

    def _both_logits(self, query: TensorDict) -> tuple[Tensor, Tensor]:
        keep, prune, recall = self.gates(query[keys.COND]).unbind(-1)
        return prune - keep, recall

    @torch.no_grad()
    def _first_memory(self, query: TensorDict) -> Tensor:
        """Return what the first queries of episodes leave to the next, f32 [B, K, 3L, H, d]."""
        noise = self.policy.sample_noise(query[keys.SEED].squeeze(-1))
        return first_memory(self.policy.network, self.policy.sampler, noise, query[keys.COND])

    @torch.no_grad()
    def _answer(
        self, query: TensorDict, mask: Tensor, recalls: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return actions [B, H, A] and the memory that they leave."""
        return denoise_recalling(*self._query(query, mask), mask & recalls, memory, reuse=self.config.reuse)


def pruner_trainer(
    gates: Gates, policy: DiffusionPolicy, targets: TensorDict, config: PrunerConfig
) -> PrunerTrainer:
    """Return the trainer of such gates; arguments and errors are those of `PrunerTrainer` and `RecallTrainer`."""
    kind = RecallTrainer if gates.recalls else PrunerTrainer
    return kind(gates, policy, targets, config)


def check_turns(gates: Gates, turns: int) -> None:
    """Raise ValueError unless gates can be taught by ``turns`` queries in a row: several if they recall, else one."""
    if gates.recalls != (turns > 1):
        expected = "2 or more" if gates.recalls else "1"
        raise ValueError(f"targets.turns: expected {expected} for such gates, got {turns}")
