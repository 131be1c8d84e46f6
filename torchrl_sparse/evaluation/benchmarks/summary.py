"""The same for every benchmark: which policy it was of, how far a method is from dense, and what is printed at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tensordict import TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.evaluation.results.parts import PolicyShape
from torchrl_sparse.evaluation.results.report import format_pairs, format_table
from torchrl_sparse.evaluation.results.schema import Results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.fidelity import action_error
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["describe_policy", "error_to_dense", "format_benchmark"]


def describe_policy(policy: DiffusionPolicy | VLAPolicy, n_action_steps: int) -> PolicyShape:
    """Return what ``results.json`` says of the policy.

    Args:
        policy: the dense policy.
        n_action_steps: actions of a chunk that are executed.

    Examples:
        >>> describe_policy(DiffusionPolicy.from_pretrained("assets/lift"), 8).num_inference_steps
        100
    """
    return PolicyShape(
        params=sum(parameter.numel() for parameter in policy.network.parameters()),
        num_inference_steps=policy.num_inference_steps,
        horizon=policy.horizon,
        n_obs_steps=policy.n_obs_steps,
        n_action_steps=n_action_steps,
    )


def error_to_dense(
    policy: DiffusionPolicy | VLAPolicy, answers: TensorDictBase, dense_answers: TensorDictBase
) -> tuple[float, float]:
    """Return mean and maximum absolute difference of normalised actions.

    Args:
        policy: whose normaliser applies.
        answers: of a method, with ``("vla_action", "chunk")``, [Q].
        dense_answers: of the dense policy to the same queries, [Q].
    """
    normalize = policy.normalizer.normalize_action
    return action_error(normalize(answers[keys.CHUNK]), normalize(dense_answers[keys.CHUNK]))


def format_benchmark(
    results: Results,
    episodes: Mapping[str, Sequence[EpisodeResult]],
    pairs: Sequence[Sequence[str]],
    margin: float,
) -> str:
    """Return the table of all methods against dense and, if ``pairs`` are named, of one against another, in Markdown.

    Args:
        results: content of a ``results.json``.
        episodes: method -> its episodes.
        pairs, margin: see `format_pairs`.
    """
    table = format_table(results)
    if not pairs:
        return table
    if results.until_decided is not None:  # methods may have stopped after different numbers of episodes
        shared = set.intersection(*({episode.seed for episode in played} for played in episodes.values()))
        episodes = {n: [e for e in played if e.seed in shared] for n, played in episodes.items()}
    return f"{table}\n\n{format_pairs(episodes, pairs, margin)}"
