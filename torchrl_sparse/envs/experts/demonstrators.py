"""One scripted demonstration, step by step: intended actions, executed actions, and the recording.

`torchrl_sparse.data.demos` runs the same loop over both kinds; a task says which is its own (`Task.demonstrator`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.envs.experts.disturbance import Disturbance, next_noise
from torchrl_sparse.envs.experts.operators import OPERATORS, draw_operator
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.simulator import CONTROL_FREQ, controller_config, import_robosuite
from torchrl_sparse.envs.tasks import RobosuiteTask, StateTask
from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import absolute_to_pose, pose_to_absolute

__all__ = ["Demonstrator", "RobosuiteDemonstrator", "StateDemonstrator", "StateExpert"]


class Demonstrator(Protocol):
    """Driver of one episode of an environment that was just reset.

    Attributes:
        qualities: those that it knows; of the class.
        operator: name of who demonstrates.
        instruction: what the episode asks for; None where there is no choice.
        model_file: the simulator's model, to restore the episode's start; empty where the state is enough.
    """

    qualities: ClassVar[tuple[str, ...]]
    operator: str
    instruction: str | None
    model_file: str

    def record(self, present: TensorDictBase) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        """Return the simulator's state, f64 [S], and the named observations, each f64 [n], before an action."""

    def label(self, present: TensorDictBase) -> np.ndarray:
        """Return the expert's intended action in this state, as recorded, whoever led there."""

    def disturb(self, clean: np.ndarray) -> np.ndarray:
        """Return the executed action, as recorded, when the expert intends ``clean`` and acts itself."""

    def command(self, executed: np.ndarray) -> np.ndarray:
        """Convert a recorded action to an environment action."""

    def recorded(self, command: np.ndarray) -> np.ndarray:
        """Convert an environment action to its recorded form."""


class RobosuiteDemonstrator:
    """`Demonstrator` of a robosuite task, with an operator drawn for a quality level.

    Args:
        task: what is demonstrated.
        env: its environment, of absolute actions.
        rng: draws the operator, their style and every disturbance.
        quality: see `torchrl_sparse.envs.experts.operators`.

    Raises:
        InputError: if the task has no expert or the quality is unknown.
    """

    qualities = tuple(OPERATORS)

    def __init__(self, task: RobosuiteTask, env: RobosuiteEnv, rng: np.random.Generator, quality: str):
        operator = draw_operator(quality, rng)
        start = env.get_initial_state()
        self.operator, self.instruction, self.model_file = operator.name, start.instruction, start.model_xml
        self._env, self._arms = env, range(task.arms)
        self._expert = task.load_expert()(env.sim_env, operator.draw(rng))
        self._disturb = Disturbance(operator, task.arms, rng)

    def record(self, present: TensorDictBase) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        """See `Demonstrator.record`."""
        observed = self._env.raw_observation(self._env.recorded_keys)
        return self._env.sim_env.sim.get_state().flatten(), observed

    def label(self, present: TensorDictBase) -> np.ndarray:
        """See `Demonstrator.label`; f64 [7 * arms]."""
        return self._expert.command()

    def disturb(self, clean: np.ndarray) -> np.ndarray:
        """See `Demonstrator.disturb`; f64 [7 * arms]."""
        return self._disturb(clean, np.stack([self._expert.hand(arm).position for arm in self._arms]))

    def command(self, executed: np.ndarray) -> np.ndarray:
        """See `Demonstrator.command`."""
        return pose_to_absolute(executed)

    def recorded(self, command: np.ndarray) -> np.ndarray:
        """See `Demonstrator.recorded`."""
        return absolute_to_pose(command)

    @staticmethod
    def env_args(task: RobosuiteTask) -> dict[str, Any]:
        """Describe the environment of the demonstrations, in robomimic's format."""
        return {
            "env_name": task.name,
            "env_version": import_robosuite().__version__,
            "type": 1,  # robomimic's EnvType.ROBOSUITE_TYPE
            "env_kwargs": {
                "robots": ["Panda"] * task.arms,
                "controller_configs": controller_config(absolute=True),
                "control_freq": CONTROL_FREQ,
                "has_renderer": False,
                "has_offscreen_renderer": False,
                "use_camera_obs": False,
                "reward_shaping": False,
            },
        }


class StateExpert(Protocol):
    """Scripted expert that observes what a policy observes; its random choices and plans are hidden from the policy.

    Made for one episode from a random generator.

    Attributes:
        noise: standard deviation of what is added to its actions while demonstrating, in their units.
    """

    noise: float

    def command(self, state: np.ndarray) -> np.ndarray:
        """Return the action, f64 [A], for a state [Ds]."""


class StateDemonstrator:
    """`Demonstrator` of a task outside robosuite, with noisy execution and clean labels, as in DART (arXiv:1703.09327).

    Args:
        task: what is demonstrated.
        env: its environment.
        rng: draws the expert's preferences and the noise.
        quality: "proficient"; these experts have no other.

    Raises:
        InputError: if the task has no expert, or not of that quality.
    """

    instruction, model_file = None, ""

    qualities = ("proficient",)

    def __init__(self, task: StateTask, env: EnvBase, rng: np.random.Generator, quality: str):
        if quality not in self.qualities:
            known = ", ".join(self.qualities)
            raise InputError(f"quality: expected one of {known} for {task.name}, got {quality!r}")
        self.operator = quality
        self._expert: StateExpert = task.load_expert()(rng)
        self._rng, self._noise = rng, np.zeros(task.action_dim)

    def record(self, present: TensorDictBase) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        """See `Demonstrator.record`."""
        state = _state(present)
        return state, {"state": state}

    def label(self, present: TensorDictBase) -> np.ndarray:
        """See `Demonstrator.label`; f64 [A]."""
        return self._expert.command(_state(present))

    def disturb(self, clean: np.ndarray) -> np.ndarray:
        """See `Demonstrator.disturb`; f64 [A]."""
        self._noise = next_noise(self._noise, self._rng)
        return clean + self._expert.noise * self._noise

    def command(self, executed: np.ndarray) -> np.ndarray:
        """See `Demonstrator.command`."""
        return executed

    def recorded(self, command: np.ndarray) -> np.ndarray:
        """See `Demonstrator.recorded`."""
        return command

    @staticmethod
    def env_args(task: StateTask) -> dict[str, Any]:
        """Describe the environment of the demonstrations, in robomimic's format."""
        return {"env_name": task.name, "env_kwargs": {}, "type": 2}  # robomimic's EnvType.GYM_TYPE


def _state(present: TensorDictBase) -> np.ndarray:
    return present[keys.STATE].double().numpy()
