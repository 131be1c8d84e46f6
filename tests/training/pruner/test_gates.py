"""What gates of a policy with cameras read."""

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.export import export_planner
from torchrl_sparse.training.pruner.fit import spread_logits
from torchrl_sparse.training.pruner.gates import make_gates
from torchrl_sparse.training.pruner.trainer import PrunerTrainer


@pytest.mark.parametrize(("reads", "unseen"), [("all", 0), ("state", 128)])
def test_a_pruner_is_trained_on_all_or_on_the_state_alone(
    make_image_policy, make_image_demos, tmp_path, reads, unseen
):
    policy = make_image_policy()
    targets = make_targets(policy, make_image_demos(policy), share=0.5, n_action_steps=4)
    gates = make_gates("sag", policy, reads=reads, width=8)
    spread_logits(gates, targets, 1.0)
    with torch.no_grad():
        assert gates.prune_logits(targets[keys.COND])[:, 1:].std(dim=0).mean() == pytest.approx(1, abs=1e-3)
    config = PrunerConfig(rate=0.3, batch_size=4, max_updates=2, checkpointed=False)
    trainer, before = PrunerTrainer(gates, policy, targets, config), gates.obs.weight.clone()
    trainer.train_step()
    assert not torch.equal(before, gates.obs.weight)
    assert gates.obs.in_features == 2 * (128 + 3 - unseen)

    planner = load_planner(export_planner(trainer, tmp_path, {}), policy.plan.spec)
    assert planner.network.unseen == unseen
    gates.eval()
    masks = planner.masks(targets[keys.COND])
    with torch.no_grad():
        assert torch.equal(masks, gates.prune_masks(targets[keys.COND]))


def test_something_else_to_read_is_refused(make_image_policy):
    with refused("reads"):
        make_gates("sag", make_image_policy(), reads="cameras")
    with refused("network"):
        make_gates("l2c", make_image_policy(), width=8)
