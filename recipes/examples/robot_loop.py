"""Run a policy in a plain fixed-rate loop that reports missed deadlines; your robot goes in `observe` and `command`.

python recipes/examples/robot_loop.py
"""

import time

import numpy as np

from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler

policy = DiffusionPolicy.from_pretrained("assets/lift").freeze()
policy.sampler = Sampler("ddpm", 3, spacing="logsnr")
print(policy.describe())


def observe() -> dict[str, np.ndarray]:
    return {"state": np.zeros(19)}  # your robot's, in the layout that was just printed


def command(action: np.ndarray) -> None:
    """Send the target pose to your robot."""


period, steps, missed = 1 / 20, 20, 0
actor = ChunkExecutor(policy, n_action_steps=8)
actor.reset()
actor.act(observe())  # the first policy call also builds what the engine runs
actor.reset()
deadline = time.perf_counter() + period
for _ in range(steps):
    command(actor.act(observe()))
    missed += time.perf_counter() > deadline
    time.sleep(max(0.0, deadline - time.perf_counter()))
    deadline += period
print(f"{missed} of {steps} deadlines of {1000 * period:.0f} ms missed")
