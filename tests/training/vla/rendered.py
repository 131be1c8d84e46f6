"""A demonstration file with pictures and instructions, of random numbers."""

import json

import h5py
import numpy as np

from tests.fixtures.demonstrations import describe, hands

STATE = {"object_positions": 9, "robot0_gripper_qpos": 2}
COLOURS = ("red", "green", "blue")


def write_demos(path, image_size=28, steps=9):
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(3):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = steps
            demo.attrs["ep_meta"] = json.dumps({"lang": f"lift the {COLOURS[index]} cube"})
            demo["actions"] = actions = random.uniform(-1, 1, (steps, 7))
            demo["obs/robot0_eef_pos"], demo["obs/robot0_eef_quat_site"] = hands(actions)
            for key, size in STATE.items():
                demo[f"obs/{key}"] = random.uniform(-1, 1, (steps, size))
            for camera in ("agentview", "robot0_eye_in_hand"):
                shape = (steps, image_size, image_size, 3)
                demo[f"obs/{camera}_image"] = random.integers(256, size=shape, dtype=np.uint8)
        describe(file, "LiftNamed")
    return path
