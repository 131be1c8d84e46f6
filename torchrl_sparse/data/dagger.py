"""DAgger for chunked policies: the policy drives, then the expert takes over from the reached state and finishes.

DAgger (arXiv:1011.0686) visits states under the mixture ``beta * expert + (1 - beta) * policy``, drawn at every step, asks the
expert for one action in each of them, and trains on all. A policy that acts in chunks needs more than that: its target in a
state are the H actions that the expert would take from there on. Labels along a path that the policy drives are not those.
Each is right where it is given, but none follows from the one before, and an absolute pose, which aims a step ahead of the
hand, would follow the policy's hand. So the mixture is drawn once a policy call, and who takes over stays: before each call
after the first the expert takes over with probability ``mixing``, and at the latest half-way to the horizon, which leaves it an
episode's time. From there on an episode is a demonstration, disturbed like any other, that begins at a call of the policy's.
HG-DAgger (arXiv:1810.02890) hands over like that, where a person finds it necessary; here chance does, so that the states are
those that the policy visits, its failures among them. With rounds, each driven by the policy of the round before, ``mixing``
falls, which lets the policy drive longer.

Steps that the policy drove stay in the file: they are the history of the first calls, and an episode can be replayed from its
start. Their label is the expert's action in that state. No window has its present among them (`Demonstrations.window_rows`).
Episodes that the policy solves before the expert takes over teach nothing, and those that the expert does not solve teach what
fails: both are dropped and counted. An expert that plans ahead, as Push-T's does, first ends the plan that it last made.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.envs.contract import Contract, policy_contract, task_contract
from torchrl_sparse.errors import InputError
from torchrl_sparse.methods.diffusion import make_method
from torchrl_sparse.networks.fingerprint import is_same_policy
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["Driver", "Driving", "load_driver"]

# Keeps the moment of taking over apart from the operator's random numbers and the initial state's, of the same seed.
_TAKE_OVER_STREAM = 2


@dataclass(frozen=True)
class Driving:
    """Settings of the policy that drives before the expert, and for how long.

    Attributes:
        policy: folder of a `DiffusionPolicy` that observes states of the task, in whatever convention.
        fingerprint: of its weights, so that a collection is not continued with others.
        method: how it is sampled, see `torchrl_sparse.methods.diffusion`; none that needs a calibration.
        n_action_steps: actions executed of a chunk.
        mixing: probability that the expert takes over before a policy call that is not the episode's first.

    Raises:
        InputError: if a value is out of its range.
    """

    policy: str
    fingerprint: str
    method: str = "dense"
    n_action_steps: int = 8
    mixing: float = 0.1

    def __post_init__(self) -> None:
        if self.n_action_steps < 1:
            raise InputError(f"n_action_steps: expected at least 1, got {self.n_action_steps}")
        if not 0 <= self.mixing <= 1:
            raise InputError(f"mixing: expected a probability, got {self.mixing}")

    def draw_steps(self, seed: int, longest: int) -> int:
        """Draw the number of steps, at most ``longest``, that the policy drives in the episode of a seed.

        >>> driving = Driving("assets/lift", "", mixing=0.5)
        >>> [driving.draw_steps(seed, 100) for seed in range(4)]
        [8, 8, 24, 8]
        """
        if not self.mixing:
            return longest
        queries = int(np.random.default_rng([seed, _TAKE_OVER_STREAM]).geometric(self.mixing))
        return min(queries * self.n_action_steps, longest)


class Driver:
    """Policy that drives the first steps of an episode.

    Args:
        driving: decides how many.
        actor: the policy's executor.
        contract: what it observes; None for the task's state as the environment shows it.

    Examples:
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> driver = load_driver("lift", Driving("assets/lift", policy.fingerprint, "ddim2", mixing=1.0))
        >>> env = find_task("lift").make(seeds=[0])  # doctest: +SKIP
        >>> driver.begin(0, env), driver.act(env.reset()).shape  # doctest: +SKIP
        (8, (10,))
    """

    def __init__(self, driving: Driving, actor: ChunkExecutor, contract: Contract | None = None):
        self._driving, self._actor, self._contract = driving, actor, contract
        self._env: Any = None

    def begin(self, seed: int, env: Any) -> int:
        """Begin the episode of a seed and return how many steps the policy drives, at most half of the environment's."""
        self._actor.reset(seed)
        self._env = env
        return self._driving.draw_steps(seed, env.horizon // 2)

    def act(self, present: TensorDictBase) -> np.ndarray:
        """Return the environment's action, f64 [A], for this step."""
        state = present[keys.STATE].numpy()
        if (seen := self._contract) is not None:
            parts = self._env.raw_observation(seen.state_keys, seen.convention)
            state = np.concatenate([*parts.values()]).astype(np.float32)
        return self._actor.act({"state": state}).astype(np.float64)


@cache
def load_driver(task: str, driving: Driving) -> Driver:
    """Load the driving policy, once per process.

    Raises:
        FileNotFoundError, InputError: if it cannot be read, is of other weights than ``driving`` says or of another task,
            has cameras, or the method is unknown or needs a calibration.
    """
    path = Path(driving.policy)
    policy = DiffusionPolicy.from_pretrained(path)
    _check_policy(policy, driving)
    method = make_method(
        driving.method,
        policy,
        num_updates=1,
        planners=path.with_suffix("") if path.suffix == ".ckpt" else path,
        calibration=_refuse_calibration,
    )
    contract = policy_contract(task, policy)
    own = contract == task_contract(task)
    return Driver(driving, ChunkExecutor(method, driving.n_action_steps), None if own else contract)


def _check_policy(policy: DiffusionPolicy, driving: Driving) -> None:
    if not is_same_policy(driving.fingerprint, policy.fingerprint):
        raise InputError(
            f"policy: expected the weights {driving.fingerprint} in {driving.policy}, got {policy.fingerprint}"
        )
    if policy.vision is not None:
        raise InputError(f"policy: expected one that observes states, got one with cameras, {driving.policy}")


def _refuse_calibration() -> Any:
    raise InputError("method: expected one that needs no calibration while demonstrations are collected")
