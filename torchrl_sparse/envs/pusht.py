"""Push-T as in Diffusion Policy's low-dimensional task (arXiv:2303.04137), in gym-pusht's simulator; extra ``pusht``.

A round agent pushes a T-shaped block onto a T on the floor. One difference from the published simulation is known: a newer
pymunk, whose contacts may differ in their last digits.
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

__all__ = ["KEYPOINTS", "PushTEnv", "block_keypoints", "published_start"]

WINDOW = 512.0  # pixels, both sides of the world
GOAL = np.array([256.0, 256.0, np.pi / 4])  # x, y in pixels and angle in rad, where the block should be
HORIZON = 300

KEYPOINTS = np.array(
    [
        [9.26978671, 90.04097352],
        [-60.98347236, -1.18672976],
        [60.91275558, -1.39336422],
        [-0.27050344, 25.54362499],
        [-14.06492758, 122.81585355],
        [39.0027385, 32.85740428],
        [-39.96641442, 32.72965545],
        [-16.82434438, 62.86317892],
        [23.54146122, -1.70028811],
    ]
)
"""The block's keypoints in its own frame, f64 [9, 2]. The bar spans -60 to 60 by 0 to 30, the stem -15 to 15 by 30 to 120.

The published code samples them when it starts: of the pixels of a drawn T one by ``numpy.random.default_rng(0)``, then eight
times the pixel furthest from those chosen, then a shift below one pixel by the same generator. These were derived that way,
with pygame 2.6.1, whose edges of a drawn T may differ from those of the published version by a pixel.
"""


class PushTEnv(SeededEnv):
    """Push-T at 10 Hz: push the T onto its goal. Episodes begin and end as in every `SeededEnv`.

    The state is the published one, f32 [20] in pixels: the nine `KEYPOINTS` of the block, x and y each, then the agent's x and
    y. The action is the agent's target position, f32 [2], pixels in 0 to 512. Success is a coverage of the goal above 0.95.
    The reward is coverage / 0.95, at most 1; the published score is its maximum over an episode. The episode of seed s starts
    where the published one does.

    Args:
        horizon: steps until truncation; 300 by default, as published.
        seeds: see `SeededEnv`.

    Raises:
        ImportError: without gym-pusht, with the command that installs it.

    Examples:
        >>> env = PushTEnv(seeds=[100000])  # doctest: +SKIP
        >>> env.reset()["observation", "state"].shape  # doctest: +SKIP
        torch.Size([20])
    """

    def __init__(
        self,
        *,
        horizon: int | None = None,
        seeds: Sequence[int] | None = None,
        device: torch.device | str = "cpu",
    ):
        simulator = import_extra("gym_pusht.envs.pusht", "pusht")
        super().__init__(horizon=HORIZON if horizon is None else horizon, seeds=seeds, device=device)
        self.sim_env = simulator.PushTEnv(obs_type="state")
        self._coverage = 0.0
        self._make_specs(2 * len(KEYPOINTS) + 2, Bounded(0.0, WINDOW, (2,)))

    def _start(self, seed: int) -> None:
        self.sim_env.reset(options={"reset_to_state": published_start(seed)})
        self._coverage = self.sim_env._get_coverage()

    def _advance(self, action: np.ndarray) -> float:
        _, reward, _, _, info = self.sim_env.step(action)
        self._coverage = info["coverage"]
        return float(reward)

    def _observe_state(self) -> np.ndarray:
        block, agent = self.sim_env.block, self.sim_env.agent
        return np.concatenate([block_keypoints(block.position, block.angle).ravel(), agent.position])

    def _is_solved(self) -> bool:
        return bool(self._coverage > self.sim_env.success_threshold)

    def render(self, camera: str = "", height: int = 256, width: int = 256) -> np.ndarray:
        """Return a u8 [height, width, 3] picture of the world from above; the only view, whatever the ``camera``.

        Raises:
            RunFailed: if OpenCV cannot be imported, for want of a GL library.
        """
        self.sim_env.visualization_height, self.sim_env.visualization_width = height, width
        try:
            return self.sim_env.render()
        except AttributeError as error:  # of the stand-in for cv2
            raise RunFailed(GL_HINT) from error


def block_keypoints(position: Sequence[float], angle: float) -> np.ndarray:
    """Return the `KEYPOINTS` of a block at ``position`` (pixels), rotated by ``angle`` (rad), f64 [9, 2].

    >>> block_keypoints((100.0, 200.0), np.pi / 2)[1].round(2).tolist()
    [101.19, 139.02]
    """
    sine, cosine = np.sin(angle), np.cos(angle)
    return KEYPOINTS @ np.array([[cosine, sine], [-sine, cosine]]) + np.asarray(position)


def published_start(seed: int) -> np.ndarray:
    """Return the published initial state of a seed's episode, f64 [5]: agent x, y; block x, y (pixels); block angle (rad).

    >>> published_start(100000).round(1).tolist()
    [235.0, 124.0, 335.0, 128.0, -0.9]
    """
    rng = np.random.RandomState(seed)  # the published stream of random numbers
    positions = [rng.randint(50, 450), rng.randint(50, 450), rng.randint(100, 400), rng.randint(100, 400)]
    return np.array([*positions, rng.randn() * 2 * np.pi - np.pi])
