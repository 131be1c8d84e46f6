"""Franka Kitchen as in Diffusion Policy's low-dimensional task (arXiv:2303.04137), in gymnasium-robotics' kitchen (extra).

gymnasium-robotics' own environment differs from the published relay-kitchen, so only its robot, kitchen and tasks are used. It
commands joint velocities between -1 and 1 (times 2 rad/s) where the published policies command positions; it observes 59
numbers, with velocities and without goals, with a tenth of the published noise on joints and less on objects; and it detects
completed tasks from poses without noise. What remains different is MuJoCo 3 instead of 2.1, and the details of the model that
gymnasium-robotics changed. People's demonstrations come with the published data; there are none here, and no scripted expert.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torchrl.data import Bounded

from torchrl_sparse.envs.extras import import_extra
from torchrl_sparse.envs.rendering import GL_HINT
from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.runtime.failure import RunFailed

__all__ = ["NUM_TASKS", "KitchenEnv"]

HORIZON = 280
NUM_TASKS = 4
"""Tasks that make an episode a success: as many as each demonstration completes, out of seven."""

_JOINTS = 9
_NOISE_RATIO = 0.1
_NOISE = np.repeat([0.1, 0.005, 0.0005, 0.005, 0.1, 0.005, 0.1, 0.005], [9, 2, 6, 3, 3, 3, 3, 1])
"""Amplitudes of the published observation noise, joints then objects, f64 [30]; rad and m."""


class KitchenEnv(SeededEnv):
    """Four of seven kitchen tasks in any order, at 12.5 Hz. Episodes begin and end as in every `SeededEnv`.

    The state is the published one, f32 [60]: the robot's 9 joint positions (7 in rad, 2 fingers in m), the 21 positions of
    knobs, lights, doors and kettle, both with uniform noise, then 30 numbers for a goal, which published policies see as zeros.
    The action, f32 [9], is the target of each joint. Bounded velocities and positions are commanded towards it, as published.

    The seven tasks are turning on the bottom burner, the top burner and the light, opening the slide cabinet, the hinge cabinet
    and the microwave, and moving the kettle. The reward is the number of tasks completed in a step;
    ``("episode", "completed")`` counts them, so p1 to p4 are the shares of episodes in which it reaches 1 to 4. Success is 4,
    and ends the episode; the published episodes go on until all seven are done.

    Every episode starts in the published pose of test episodes, its noise is what the seed fixes.

    Args:
        horizon: steps until truncation; 280 by default, as published.
        seeds: see `SeededEnv`.

    Raises:
        ImportError: without gymnasium-robotics, with the command that installs it.

    Examples:
        >>> env = KitchenEnv(seeds=[100000])  # doctest: +SKIP
        >>> env.reset()["observation", "state"].shape  # doctest: +SKIP
        torch.Size([60])
    """

    def __init__(
        self,
        *,
        horizon: int | None = None,
        seeds: Sequence[int] | None = None,
        device: torch.device | str = "cpu",
    ):
        self._kitchen = import_extra("gymnasium_robotics.envs.franka_kitchen.kitchen_env", "kitchen")
        horizon = HORIZON if horizon is None else horizon
        super().__init__(horizon=horizon, seeds=seeds, counts_parts=True, device=device)
        self.sim_env = self._kitchen.KitchenEnv(render_mode="rgb_array").robot_env
        self._make_specs(60, Bounded(-8.0, 8.0, (_JOINTS,)))

    def _start(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.completed: list[str] = []
        self.sim_env.reset()
        self._sense()

    def _advance(self, action: np.ndarray) -> float:
        self.sim_env.do_simulation(self._feasible(action), self.sim_env.frame_skip)
        self._sense()
        done = [
            task
            for task in self._kitchen.OBS_ELEMENT_GOALS
            if task not in self.completed and self._is_done(task)
        ]
        self.completed += done
        return float(len(done))

    def _feasible(self, target: np.ndarray) -> np.ndarray:
        """Return the joint positions to command, f64 [9]: within reach of the observed ones in one step, and in bounds."""
        robot, present = self.sim_env, self._observed[:_JOINTS]
        reach = robot.robot_vel_bound[:_JOINTS].T * robot.dt
        bounds = robot.robot_pos_bound[:_JOINTS].T
        return np.clip(present + np.clip(target - present, *reach), *bounds)

    def _sense(self) -> None:
        """Observe all positions, f64 [30], noise included."""
        noise = _NOISE_RATIO * _NOISE * self._rng.uniform(-1.0, 1.0, len(_NOISE))
        self._observed = self.sim_env.data.qpos + noise

    def _is_done(self, task: str) -> bool:
        where = self._kitchen.OBS_ELEMENT_INDICES[task]
        gap = self._observed[where] - self._kitchen.OBS_ELEMENT_GOALS[task]
        return bool(np.linalg.norm(gap) < self._kitchen.BONUS_THRESH)

    def _observe_state(self) -> np.ndarray:
        return np.concatenate([self._observed, np.zeros(30)])

    def _is_solved(self) -> bool:
        return len(self.completed) >= NUM_TASKS

    def _parts_done(self) -> int:
        return len(self.completed)

    def render(self, camera: str = "", height: int = 256, width: int = 256) -> np.ndarray:
        """Return a u8 [height, width, 3] picture from behind the robot; the only view, whatever the ``camera``.

        The first call decides on the size.

        Raises:
            RunFailed: if no GL library is installed; the message says which package brings one.
        """
        renderer = self.sim_env.mujoco_renderer
        renderer.height, renderer.width = height, width
        try:
            return self.sim_env.render()
        except Exception as error:  # every backend fails with an exception type of its own
            raise RunFailed(f"{GL_HINT} ({type(error).__name__}: {error})") from error

    def close(self, *, raise_if_closed: bool = True) -> None:
        self.sim_env.close()
        super().close(raise_if_closed=raise_if_closed)
