"""Files in the layout in which robomimic publishes demonstrations, made by scripted or random deltas."""

import json

import h5py
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchrl_sparse import keys
from torchrl_sparse.envs.experts.operators import draw_operator

OSC = {
    "type": "OSC_POSE",
    "input_max": 1,
    "input_min": -1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "kp": 150,
    "damping": 1,
    "impedance_mode": "fixed",
    "kp_limits": [0, 300],
    "damping_limits": [0, 10],
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "control_delta": True,
    "interpolation": None,
    "ramp_ratio": 0.2,
}


def env_args_14(task, **changes):
    """The controller is one flat dictionary, and there is no version."""
    return _env_args(task, OSC | changes)


def env_args_15(task, frame="world", **changes):
    """A composite controller; ``control_delta`` is still there and means nothing."""
    arm = OSC | {"input_ref_frame": frame, "gripper": {"type": "GRIP"}} | changes
    return _env_args(task, {"type": "BASIC", "body_parts": {"right": arm}}) | {"env_version": "1.5.0"}


def _env_args(task, controller):
    robots = ["Panda"] * task.arms
    kwargs = {"robots": robots, "controller_configs": controller, "control_freq": 20, "lite_physics": False}
    return {"env_name": task.name, "type": 1, "env_kwargs": kwargs}


def scripted_delta(env, expert):
    """The expert's absolute command as a delta from where the hand is."""
    command, hand = expert.command(), expert.hand(0)
    turn = Rotation.from_rotvec(command[3:6]) * Rotation.from_matrix(hand.rotation).inv()
    delta = np.concatenate([(command[:3] - hand.position) / 0.05, turn.as_rotvec() / 0.5])
    return np.append(np.clip(delta, -1, 1), command[6])


def record(env, seed, steps=None):
    """One episode of an environment of deltas: a scripted one, or ``steps`` random ones.

    Returns what a published file holds, and, as ``"seen"``, what the environment observed.
    """
    rng = np.random.default_rng(seed)
    env.set_seed(seed)
    present = env.reset()
    if steps is None:
        expert = env.task.load_expert()(env.sim_env, draw_operator("proficient", rng).draw(rng))
    demo = {"states": [], "actions": [], "obs": [], "seen": [], "model": env.get_initial_state().model_xml}
    while not present["done"] and len(demo["states"]) != steps:
        action = rng.uniform(-0.9, 0.9, 7 * env.task.arms) if steps else scripted_delta(env, expert)
        demo["states"].append(env.sim_env.sim.get_state().flatten())
        demo["actions"].append(action)
        env.sim_env.sim.forward()  # poses of a running simulator are one physics step old
        demo["seen"].append(env.raw_observation())
        observed = env.sim_env._get_observations(force_update=True)
        names = [
            f"robot{i}_{n}" for i in range(env.task.arms) for n in ("eef_pos", "eef_quat", "gripper_qpos")
        ]
        demo["obs"].append({name: observed[name] for name in names})
        present[keys.ACTION] = torch.as_tensor(action, dtype=torch.float32)
        present = env.step(present)["next"]
    return demo


def write(path, demos, env_args, *, image_size=4, masks=None):
    """A file with images, ``next_obs``, and an ``object`` that means what it meant in robosuite 1.4: something else."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index, demo in enumerate(demos):
            group = file.create_group(f"data/demo_{index}")
            length = len(demo["actions"])
            group["actions"], group["states"] = np.float32(demo["actions"]), demo["states"]
            group["rewards"], group["dones"] = np.zeros(length), np.zeros(length, int)
            for name in demo["obs"][0]:
                group[f"obs/{name}"] = np.stack([step[name] for step in demo["obs"]])
            group["obs/object"] = -np.stack([step["object"] for step in demo["seen"]])
            images = rng.integers(0, 256, (length, image_size, image_size, 3), dtype=np.uint8)
            group.create_dataset("obs/agentview_image", data=images, compression="gzip")
            file.copy(group["obs"], group, name="next_obs")
            group.attrs["model_file"], group.attrs["num_samples"] = demo["model"], length
        for name, listed in (masks or {}).items():
            file[f"mask/{name}"] = np.array(listed, dtype="S8")
        file["data"].attrs["total"] = sum(len(demo["actions"]) for demo in demos)
        file["data"].attrs["env_args"] = json.dumps(env_args, indent=4)
    return path
