"""Summaries of a policy and of its actions: shape, distance to dense, and FLOPs."""

from __future__ import annotations

from tensordict import TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.costs import executed_flops
from torchrl_sparse.evaluation.results.parts import PolicyShape
from torchrl_sparse.evaluation.statistics.fidelity import action_error
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["describe_policy", "error_to_dense", "flops_executed"]


def describe_policy(policy: DiffusionPolicy | VLAPolicy, n_action_steps: int) -> PolicyShape:
    """Return the description of a policy for ``results.json``.

    Args:
        policy: the dense policy.
        n_action_steps: actions of a chunk that are executed.

    Examples:
        >>> describe_policy(DiffusionPolicy.from_pretrained("assets/lift"), 8).num_inference_steps
        100
        >>> describe_policy(DiffusionPolicy.from_pretrained("assets/lift_image"), 8).cameras
        ('image', 'wrist_image')
    """
    vision = policy.vision if isinstance(policy, DiffusionPolicy) else None
    return PolicyShape(
        params=sum(parameter.numel() for parameter in policy.network.parameters()),
        num_inference_steps=policy.num_inference_steps,
        horizon=policy.horizon,
        n_obs_steps=policy.n_obs_steps,
        n_action_steps=n_action_steps,
        cameras=() if vision is None else vision.cameras,
    )


def error_to_dense(
    policy: DiffusionPolicy | VLAPolicy, answers: TensorDictBase, dense_answers: TensorDictBase
) -> tuple[float, float]:
    """Return the mean and maximum absolute difference of normalised actions to dense's.

    Args:
        policy: whose normaliser applies.
        answers: of a method, with ``("vla_action", "chunk")``, [Q].
        dense_answers: of the dense policy to the same policy calls, [Q].
    """
    normalize = policy.normalizer.normalize_action
    return action_error(normalize(answers[keys.CHUNK]), normalize(dense_answers[keys.CHUNK]))


def flops_executed(policy: DiffusionPolicy, answers: TensorDictBase) -> float:
    """Return the FLOPs that planner and engine executed per policy call, mean over ``answers`` [Q].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift", engine="torch")
        >>> answers = policy(TensorDict({"history": {"state": torch.zeros(1, 2, 19)}}, [1]))
        >>> round(answers["cost", "flops"].item() / 1e9, 2), round(flops_executed(policy, answers) / 1e9, 2)
        (15.74, 12.78)
    """
    engine = policy.module["denoise"].current_engine()
    done = executed_flops(engine, answers[keys.PRUNE_MASK], answers.get(keys.NUM_STEPS, None))
    return policy.plan.flops + done.mean().item()
