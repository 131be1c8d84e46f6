"""Conversion of published demonstrations to absolute actions and current observations, as this library's policies need them.

Published files of robomimic (arXiv:2108.03298) record normalised deltas. As Diffusion Policy (arXiv:2303.04137) does it, each
becomes the pose that robosuite's OSC controller makes its goal when the recorded simulator state is set and the recorded
delta given to it; the gripper's command stays. Played by an absolute controller in the robosuite that recorded it, the motion
is the same: whole scripted episodes of Lift are repeated within 1e-4 rad, m, rad/s and m/s.

Observations are made again from the recorded states, since those of robosuite up to 1.4 mean something else (Lift's vector
between hand and cube has the other sign, Transport's parts another order) and published files lack the grip site's quaternion
(robosuite issue 672). They are those of the state itself; in a running simulator they are one physics step, 2 ms, older.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from torchrl_sparse.data.hdf5_files import new_hdf5
from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.hdf5_reader import (
    ArrayReader,
    demo_group,
    demo_names,
    open_demo,
    open_demos,
)
from torchrl_sparse.data.hdf5_writer import lay_out
from torchrl_sparse.data.parts import check_same, claim_parts, parts_of
from torchrl_sparse.data.recorded_control import RecordedControl, read_control
from torchrl_sparse.data.recorded_poses import (
    REACH,
    TURN,
    check_hands,
    check_poses,
    check_rate,
    steps_out_of_reach,
)
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import POSE_DIM

__all__ = ["AbsoluteActions", "convert_demos"]


def convert_demos(path: str | Path, out: str | Path, *, poses: bool = False) -> int:
    """Copy a robomimic file with absolute actions and the observations that policies of the task read.

    Images, simulator states, rewards, attributes and filter keys are copied; one demonstration at a time is in memory. A
    killed conversion goes on where it stopped, from ``<out>.parts``; ``out`` appears when it is complete. Calling again
    after that only reports.

    Whether actions are deltas or poses is decided for the whole file, by the controller that it names or by ``poses``. Then the
    data have to agree. Deltas beyond the controller's input are clipped, as the simulator does; a warning says how many.

    Args:
        path: a published file, low-dimensional, with images, or raw; its ``env_args`` have the form of robosuite 1.2 to 1.5.
        out: the file to write.
        poses: its actions are absolute poses whatever controller it names, as in Diffusion Policy's ``*_abs.hdf5``.

    Returns:
        The number of demonstrations.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: naming file and demonstration, if the file is damaged or not of a known task with Pandas under
            OSC_POSE at 20 actions a second, its recorded hand is not where its states put it, or its actions are not what its
            controller or ``poses`` says; or if ``out`` was made of another file.

    Examples:
        >>> convert_demos("low_dim_v15.hdf5", "data/lift_human.h5")  # doctest: +SKIP
        200
    """
    path, out = Path(path), Path(out)
    with open_demos(path) as source:
        names, control = demo_names(source), read_control(source, poses=poses)
        settings = {"source": path.name, "source_bytes": path.stat().st_size, "demonstrations": len(names)}
        if out.exists():
            shutil.rmtree(parts_of(out), ignore_errors=True)  # a kill between the two last steps leaves them
            with open_demos(out) as file:
                check_same(out, {"poses": False} | demo_group(file).told(), settings | {"poses": poses})
            return len(names)
        parts = claim_parts(out, settings | {"poses": poses})
        missing = [name for name in names if not _part(parts, name).exists()]
        if missing:
            _make_parts(source, missing, control, parts)
        settings |= {"env_args": _env_args(control)} | ({"poses": True} if poses else {})
        clipped = _merge(source, out, names, parts, settings)
    shutil.rmtree(parts)
    if clipped:
        warnings.warn(
            f"{path}: {clipped} numbers of its actions lie beyond the controller's input and were clipped, as robosuite does",
            stacklevel=2,
        )
    return len(names)


class AbsoluteActions:
    """Converter of recorded states and actions to absolute actions and observations, using robosuite itself.

    Args:
        control: how the actions were meant.

    Raises:
        InputError: if the task is unknown.

    Examples:
        >>> absolute = AbsoluteActions(RecordedControl("Lift"))
        >>> state = absolute.env.sim_env.sim.get_state().flatten()
        >>> made, _ = absolute.convert(state[None], np.array([[0, 0, 1.0, 0, 0, 0, -1]]))
        >>> (made["actions"][0, :3] - made["obs/robot0_eef_pos"][0]).round(6).tolist()
        [0.0, 0.0, 0.05]
    """

    def __init__(self, control: RecordedControl):
        self.control = control
        self.env = RobosuiteEnv(find_robosuite_task(control.env_name).name)
        self.env.reset()
        self._controllers = [_recorded_osc(robot, control) for robot in self.env.sim_env.robots]

    def convert(self, states: np.ndarray, actions: np.ndarray) -> tuple[dict[str, np.ndarray], int]:
        """Convert one demonstration.

        Args:
            states: [T, S] simulator states before each action.
            actions: [T, 7 * arms] normalised deltas, or absolute poses, which stay.

        Returns:
            ``"actions"`` f64 [T, 7 * arms] (position in m, rotation vector in rad, both in the world frame; gripper), and
            ``"obs/<key>"`` f64 [T, n] for each of the environment's ``recorded_keys``. And how many numbers of the deltas lay
            beyond the controller's input and were clipped.

        Raises:
            InputError: if the sizes are not those of the task, or the actions are not what the controller says: poses that no
                hand could follow, or deltas that are poses.
        """
        sim = self.env.sim_env.sim
        self._check(states, actions)
        deltas = self.control.are_deltas
        goals, clipped = self.control.clip(actions) if deltas else (actions.copy(), 0)
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
        arrays = {key: np.stack(values) for key, values in observed.items()}
        self._check_kind(actions, arrays)
        return {"actions": goals} | arrays, clipped

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
            raise InputError(
                f"expected {size} numbers of a state and {POSE_DIM * task.arms} of an action of {task.name}, "
                f"got {states.shape[1]} and {actions.shape[1]}"
            )

    def _check_kind(self, actions: np.ndarray, observed: Mapping[str, np.ndarray]) -> None:
        """Refuse actions that are not of the kind which the controller says."""
        arms = range(self.env.task.arms)
        positions = [observed[f"obs/robot{arm}_eef_pos"] for arm in arms]
        quaternions = [observed[f"obs/robot{arm}_eef_quat_site"] for arm in arms]
        if not self.control.are_deltas:
            check_poses("actions", actions, positions, quaternions)
            return
        far, turn = steps_out_of_reach(actions, positions, quaternions)
        if (far <= REACH).all() and (turn <= TURN).all():
            raise InputError(
                "actions: expected deltas, as the file's controller takes them, got absolute poses; poses=true says so"
            )

    def close(self) -> None:
        """Free the simulator."""
        self.env.close()


def _recorded_osc(robot: Any, control: RecordedControl) -> Any:
    """Make robosuite's OSC controller with recorded settings, for the goals that it sets."""
    from robosuite.controllers.parts.arm.osc import OperationalSpaceController

    own = robot.part_controllers["right"]
    joints = {"joints": own.joint_index, "qpos": own.qpos_index, "qvel": own.qvel_index}
    place = {"part_name": own.part_name, "naming_prefix": own.naming_prefix}
    osc = OperationalSpaceController(
        sim=own.sim,
        ref_name=own.ref_name,
        joint_indexes=joints,
        actuator_range=(own.actuator_min, own.actuator_max),
        **place,
        input_min=control.input_min,
        input_max=control.input_max,
        output_min=control.output_min,
        output_max=control.output_max,
        input_type="delta" if control.are_deltas else "absolute",
        input_ref_frame=control.frame,
    )
    osc.update_origin(*robot.composite_controller.get_controller_base_pose("right"))
    osc.reset_goal()
    return osc


def _part(parts: Path, name: str) -> Path:
    return parts / f"{name}.h5"


def _make_parts(source: Node, names: Sequence[str], control: RecordedControl, parts: Path) -> None:
    with _saying(source.where):
        absolute = AbsoluteActions(control)
    for name in tqdm(names, unit="demo"):
        demo, length = open_demo(demo_group(source), name)
        reader = ArrayReader(source)  # one demonstration is in memory at a time
        states, actions = (reader.numbers(demo, key, length) for key in ("states", "actions"))
        check_rate(demo, states[:, 0])
        with _saying(demo.where):
            arrays, clipped = absolute.convert(states, actions)
        check_hands(demo, arrays, length)
        with new_hdf5(_part(parts, name)) as file:
            file.attrs["clipped"] = clipped
            for key, value in arrays.items():
                file[key] = value
    absolute.close()


@contextmanager
def _saying(where: str | Path) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error


def _merge(source: Node, out: Path, names: Sequence[str], parts: Path, attributes: Mapping[str, Any]) -> int:
    """Write the file, and return how many numbers of its actions were clipped."""
    demos, total, clipped = demo_group(source), 0, 0
    for name in names:
        total += open_demo(demos, name)[1]
        with open_demos(_part(parts, name)) as part:
            clipped += part.count("clipped", default=0)
    told: dict[str, Any] = {"total": total} | ({"clipped": clipped} if clipped else {})
    with new_hdf5(out) as file:
        data = lay_out(file, names, {**attributes, **told})
        source.copy(file, "mask")
        for name in names:
            with open_demos(_part(parts, name)) as part:
                _fill(data[name], demos.group(name), part)
    return clipped


def _fill(target: h5py.Group, demo: Node, part: Node) -> None:
    """Merge what was converted with those recordings that do not depend on the controller."""
    demo.copy_attributes(target)
    part.copy(target, "actions")
    part.copy(target, "obs")
    for name in ("states", "rewards", "dones"):
        demo.copy(target, name)
    observed = demo.find("obs")
    if observed is None or not observed.is_group:
        return
    for name in observed.names():
        item = observed.find(name)
        if (
            item is not None
            and item.is_array
            and item.layout().dtype == np.uint8
            and len(item.layout().shape or ()) == 4
        ):
            item.copy_to(target["obs"], name)


def _env_args(control: RecordedControl) -> dict[str, Any]:
    task = find_robosuite_task(control.env_name)
    return task.demonstrator.env_args(task)
