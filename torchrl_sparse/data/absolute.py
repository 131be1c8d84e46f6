"""Published demonstrations as this library's policies need them: absolute actions and present-day observations.

Published files of robomimic (arXiv:2108.03298) record normalised deltas. As Diffusion Policy (arXiv:2303.04137) does it, each
becomes the pose that robosuite's OSC controller makes its goal when the recorded simulator state is set and the recorded
delta given to it; the gripper's command stays. Played by an absolute controller in the robosuite that recorded it, the motion
is the same: whole scripted episodes of Lift are repeated within 1e-4 rad, m, rad/s and m/s.

Observations are made anew from the recorded states, since those of robosuite up to 1.4 mean something else (Lift's vector
between hand and cube has the other sign, Transport's parts another order) and published files lack the grip site's quaternion
(robosuite issue 672). They are those of the state itself; in a running simulator they are one physics step, 2 ms, older.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from torchrl_sparse.data.hdf5_files import new_hdf5
from torchrl_sparse.data.hdf5_reader import (
    ArrayReader,
    demo_group,
    demo_names,
    naming,
    open_demo,
    open_demos,
)
from torchrl_sparse.data.hdf5_writer import copy_attributes, lay_out
from torchrl_sparse.data.parts import check_same, claim_parts, parts_of
from torchrl_sparse.data.recorded_control import RecordedControl, read_control
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.rotations import POSE_DIM

__all__ = ["AbsoluteActions", "convert_demos"]

# m between a recorded hand and the same state's hand here; another robot or table is far off
_TOLERANCE = 1e-3


def convert_demos(path: str | Path, out: str | Path) -> int:
    """Copy a robomimic file with absolute actions and with the observations that policies of the task read.

    Images, simulator states, rewards, attributes and filter keys are copied; one demonstration at a time is in memory. A
    killed conversion goes on where it stopped, from ``<out>.parts``; ``out`` appears when it is complete. Calling again
    after that only reports.

    Args:
        path: a published file, low-dimensional, with images, or raw; its ``env_args`` have the form of robosuite 1.4 or 1.5.
        out: the file to write.

    Returns:
        The number of demonstrations.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: naming file and demonstration, if the file is damaged or not of a known task with Pandas under
            OSC_POSE, or its recorded hand is not where its states put it; or if ``out`` was made of another file.

    Examples:
        >>> convert_demos("low_dim_v15.hdf5", "data/lift_human.h5")  # doctest: +SKIP
        200
    """
    path, out = Path(path), Path(out)
    with open_demos(path) as source:
        names, control = demo_names(path, source), read_control(path, source)
        settings = {"source": path.name, "source_bytes": path.stat().st_size, "demonstrations": len(names)}
        if out.exists():
            shutil.rmtree(parts_of(out), ignore_errors=True)  # a kill between the two last steps leaves them
            with open_demos(out) as file:
                check_same(out, {key: file["data"].attrs.get(key) for key in settings}, settings)
            return len(names)
        if control is None:
            raise ValueError(f"{path}: expected an attribute env_args of 'data', got none")
        parts = claim_parts(out, settings)
        missing = [name for name in names if not _part(parts, name).exists()]
        if missing:
            _make_parts(path, demo_group(path, source), missing, control, parts)
        _merge(path, source, out, names, parts, settings | {"env_args": _env_args(control)})
    shutil.rmtree(parts)
    return len(names)


class AbsoluteActions:
    """Turns recorded states and actions into absolute actions and observations, by robosuite itself.

    Args:
        control: how the actions were meant.

    Raises:
        ValueError: if the task is unknown or its robots are not Pandas.

    Examples:
        >>> settings = {"type": "OSC_POSE", "input_type": "delta", "input_ref_frame": "world"}
        >>> absolute = AbsoluteActions(RecordedControl("Lift", ("Panda",), settings, keeps_orientation=False))
        >>> state = absolute.env.sim_env.sim.get_state().flatten()
        >>> made = absolute.convert(state[None], np.array([[0, 0, 1.0, 0, 0, 0, -1]]))
        >>> (made["actions"][0, :3] - made["obs/robot0_eef_pos"][0]).round(6).tolist()
        [0.0, 0.0, 0.05]
    """

    def __init__(self, control: RecordedControl):
        self.control = control
        task = find_robosuite_task(control.env_name)
        if control.robots != ("Panda",) * task.arms:
            raise ValueError(f"robots: expected {task.arms} times Panda, got {', '.join(control.robots)}")
        self.env = RobosuiteEnv(task.name)
        self.env.reset()
        self._controllers = [_recorded_osc(robot, control.arm) for robot in self.env.sim_env.robots]

    def convert(self, states: np.ndarray, actions: np.ndarray) -> dict[str, np.ndarray]:
        """Convert one demonstration.

        Args:
            states: [T, S] simulator states before each action.
            actions: [T, 7 * arms] normalised deltas, or absolute poses, which stay.

        Returns:
            ``"actions"`` f64 [T, 7 * arms] (position in m, rotation vector in rad, both in the world frame; gripper), and
            ``"obs/<key>"`` f64 [T, n] for each of the environment's ``recorded_keys``.

        Raises:
            ValueError: if the sizes are not those of the task.
        """
        sim = self.env.sim_env.sim
        self._check(states, actions)
        deltas = self.control.are_deltas(actions)
        goals = actions.copy()
        observed: dict[str, list[np.ndarray]] = {f"obs/{key}": [] for key in self.env.recorded_keys}
        rotations: list[np.ndarray | None] = [None] * len(self._controllers)
        for state, goal in zip(states, goals.reshape(len(goals), -1, POSE_DIM), strict=True):
            sim.set_state_from_flattened(state)
            sim.forward()
            for key, value in self.env.raw_observation(self.env.recorded_keys).items():
                observed[f"obs/{key}"].append(value)
            for arm, osc in enumerate(self._controllers if deltas else ()):
                position, rotations[arm] = self._goal(osc, goal[arm, :6], rotations[arm])
                goal[arm, :6] = *position, *Rotation.from_matrix(rotations[arm]).as_rotvec()
        return {"actions": goals} | {key: np.stack(values) for key, values in observed.items()}

    def _goal(self, osc: Any, delta: np.ndarray, last: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the world-frame position [3] and rotation matrix [3, 3] that the controller aims at."""
        osc.update(force=True)
        osc.set_goal(delta)
        position, rotation = osc.goal_pos, osc.goal_ori
        if osc.input_ref_frame == "base":
            position, rotation = osc.origin_pos + osc.origin_ori @ position, osc.origin_ori @ rotation
        if self.control.keeps_orientation and last is not None and not delta[3:].any():
            rotation = last
        return position, rotation

    def _check(self, states: np.ndarray, actions: np.ndarray) -> None:
        task, size = self.env.task, len(self.env.sim_env.sim.get_state().flatten())
        if states.shape[1] != size or actions.shape[1] != POSE_DIM * task.arms:
            raise ValueError(
                f"expected {size} numbers of a state and {POSE_DIM * task.arms} of an action of {task.name}, "
                f"got {states.shape[1]} and {actions.shape[1]}"
            )

    def close(self) -> None:
        """Free the simulator."""
        self.env.close()


def _recorded_osc(robot: Any, settings: Mapping[str, Any]) -> Any:
    """Make robosuite's OSC controller with recorded settings, for the goals that it sets."""
    from robosuite.controllers.parts.arm.osc import OperationalSpaceController

    own = robot.part_controllers["right"]
    joints = {"joints": own.joint_index, "qpos": own.qpos_index, "qvel": own.qvel_index}
    place = {"part_name": own.part_name, "naming_prefix": own.naming_prefix}
    settings = {key: value for key, value in settings.items() if key not in ("type", "gripper", *place)}
    osc = OperationalSpaceController(
        sim=own.sim,
        ref_name=own.ref_name,
        joint_indexes=joints,
        actuator_range=(own.actuator_min, own.actuator_max),
        **place,
        **settings,
    )
    osc.update_origin(*robot.composite_controller.get_controller_base_pose("right"))
    osc.reset_goal()
    return osc


def _part(parts: Path, name: str) -> Path:
    return parts / f"{name}.h5"


def _make_parts(
    path: Path, data: h5py.Group, names: Sequence[str], control: RecordedControl, parts: Path
) -> None:
    with _saying(path):
        absolute = AbsoluteActions(control)
    for name in tqdm(names, unit="demo"):
        where = f"{path}, {name}"
        demo, length = open_demo(where, data, name)
        reader = ArrayReader(data.file)  # one demonstration is in memory at a time
        states, actions = (reader.numbers(where, demo, key, length) for key in ("states", "actions"))
        with _saying(where):
            arrays = absolute.convert(states, actions)
        _check_hands(where, demo, arrays, length)
        with new_hdf5(_part(parts, name)) as file:
            for key, value in arrays.items():
                file[key] = value
    absolute.close()


@contextmanager
def _saying(where: str | Path) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _check_hands(where: str, demo: h5py.Group, arrays: Mapping[str, np.ndarray], length: int) -> None:
    """Refuse states of another robot, table or version of the task, which put the hand elsewhere."""
    for key, value in arrays.items():
        if key.endswith("eef_pos") and key in demo:
            far = np.linalg.norm(
                ArrayReader(demo.file).numbers(where, demo, key, length) - value, axis=1
            ).max()
            if far > _TOLERANCE:
                raise ValueError(
                    f"{where}, {key}: expected the hand where the states put it, got {far:.4f} m off"
                )


def _merge(
    path: Path, source: h5py.File, out: Path, names: Sequence[str], parts: Path, attributes: Mapping[str, Any]
) -> None:
    total = sum(open_demo(f"{path}, {name}", source["data"], name)[1] for name in names)
    with new_hdf5(out) as file:
        data = lay_out(file, names, attributes | {"total": total})
        if "mask" in source:
            source.copy("mask", file)
        for name in names:
            with naming(f"{path}, {name}"), h5py.File(_part(parts, name), "r") as part:
                _fill(data[name], source["data"][name], part)


def _fill(target: h5py.Group, demo: h5py.Group, part: h5py.File) -> None:
    """Merge what was converted with those recordings that do not depend on the controller."""
    copy_attributes(demo, target)
    part.copy("actions", target)
    part.copy("obs", target)
    for name in ("states", "rewards", "dones"):
        if name in demo:
            demo.copy(name, target)
    for name, item in demo.get("obs", {}).items():
        if item.dtype == np.uint8 and item.ndim == 4:
            demo.copy(item, target["obs"], name=name)


def _env_args(control: RecordedControl) -> dict[str, Any]:
    task = find_robosuite_task(control.env_name)
    return task.demonstrator.env_args(task)
