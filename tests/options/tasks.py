"""Two tasks that cost nothing: a point on a line, which is to come to zero, and the same of another name."""

import numpy as np
from torchrl.data import Bounded

from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.envs.tasks import StateTask


class ReachEnv(SeededEnv):
    def __init__(self, *, horizon=50, seeds=None):
        super().__init__(horizon=horizon, seeds=seeds)
        self._make_specs(state_dim=1, action=Bounded(-1.0, 1.0, (1,)))

    def _start(self, seed):
        self.x = np.random.default_rng(seed).uniform(-1, 1, size=1)

    def _advance(self, action):
        self.x = self.x + 0.1 * action
        return -float(abs(self.x[0]))

    def _observe_state(self):
        return self.x

    def _is_solved(self):
        return bool(abs(self.x[0]) < 0.05)


def way_of(states):
    return int(states[0, 0] > 0)


EASY = tuple(
    StateTask(name, name.lower(), 1, 1, f"{__name__}:ReachEnv", way_of=f"{__name__}:way_of")
    for name in ("Reach", "Touch")
)
