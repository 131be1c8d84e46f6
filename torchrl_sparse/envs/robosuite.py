"""robosuite 1.5 tasks as TorchRL environments with the library's keys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, NonTensor, Unbounded

from torchrl_sparse import keys
from torchrl_sparse.envs.conventions import check_convention, object_state
from torchrl_sparse.envs.observing import OBJECTS, Observed
from torchrl_sparse.envs.rendering import Cameras
from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.envs.simulator import make_simulator, site_twist
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import (
    ABSOLUTE_DIM,
    POSE_DIM,
    absolute_to_pose,
    downward_quaternion,
    fixes_rotation,
    matrix_to_rot6d,
)
from torchrl_sparse.storage.convention import Convention


@dataclass(frozen=True)
class InitialState:
    """Complete initial state of an episode.

    Attributes:
        model_xml: the MuJoCo model; robosuite randomises sizes, so it belongs to the state.
        sim_state: f64 [1 + nq + nv] time, positions, velocities.
        seed: the seed it came from.
        instruction: what the episode asked for, one of the task's instructions; None leaves it open.
    """

    model_xml: str
    sim_state: np.ndarray
    seed: int
    instruction: str | None = None


class RobosuiteEnv(SeededEnv):
    """One robosuite task with Panda arms at 20 Hz; episodes begin and end as in every `SeededEnv`.

    Args:
        task: one of `torchrl_sparse.envs.tasks.TASKS`.
        action_mode: "absolute", 10 numbers per arm (position in m, 6-D rotation of the grip site in the world frame, gripper
            -1 open to 1 closed; a rotation that is none leaves the hand as it is), or "delta", 7 numbers of OSC_POSE per arm.
        horizon: steps until truncation; the task's own by default.
        seeds: seeds of successive episodes, repeated when used up. For paired evaluations.
        camera: camera of ``("observation", "image")``, e.g. "agentview"; none by default.
        wrist_camera: camera of ``("observation", "wrist_image")``, e.g. "robot0_eye_in_hand".
        image_size: height and width of the images, pixels, 84 by default; only with a camera.
        object_state: False leaves the objects out of the state, as in image tasks: cameras show them.
        state_keys: robosuite's names of the observations that make up the state, in order; None for the task's.
        convention: the version of robosuite whose meaning the objects' state has, see `torchrl_sparse.envs.conventions`.
        fast_render: see `CameraRenderer`.
        seen_frames: render those frames alone that a policy of so many observation steps sees, as its executor tells under
            ``("control", "until_query")``, and repeat the last one in place of the others; None renders each.
        instruction: write ``"language_instruction"``; True for the episode's own words. Words of your own are written as
            they are; for a task with several instructions they have to be one of those, and that one counts in every episode.
        reward_shaping: robosuite's dense reward instead of 1 on success.
        compiled: False for robosuite's own substeps and models: the same bits, slower.

    Raises:
        InputError: for an unknown task, action mode or instruction, an ``image_size`` without a camera, ``seen_frames`` below
            1, or an action of a wrong size or that is not finite.

    Examples:
        >>> env = RobosuiteEnv("Lift", seeds=[7])
        >>> env.reset()["observation", "state"].shape
        torch.Size([19])
    """

    def __init__(
        self,
        task: str,
        *,
        action_mode: Literal["absolute", "delta"] = "absolute",
        horizon: int | None = None,
        seeds: Sequence[int] | None = None,
        camera: str | None = None,
        wrist_camera: str | None = None,
        image_size: int | None = None,
        object_state: bool = True,
        state_keys: Sequence[str] | None = None,
        convention: Convention = "1.5",
        fast_render: bool = True,
        seen_frames: int | None = None,
        instruction: bool | str = False,
        reward_shaping: bool = False,
        compiled: bool = True,
        device: torch.device | str = "cpu",
    ):
        if action_mode not in ("absolute", "delta"):
            raise InputError(f"action_mode: expected 'absolute' or 'delta', got {action_mode!r}")
        self.task = find_robosuite_task(task)
        horizon = self.task.horizon if horizon is None else horizon
        super().__init__(horizon=horizon, seeds=seeds, tells_way=self.task.way_of is not None, device=device)
        self.action_mode = action_mode
        asked = {keys.IMAGE: camera, keys.WRIST_IMAGE: wrist_camera}
        named = {key: name for key, name in asked.items() if name is not None}
        if image_size is not None and not named:
            raise InputError(f"image_size: expected a camera or wrist_camera with it, got {image_size} alone")
        if seen_frames is not None and seen_frames < 1:
            raise InputError(f"seen_frames: expected None or at least 1, got {seen_frames}")
        self._cameras = Cameras(named, 84 if image_size is None else image_size, fast=fast_render)
        self._seen_frames, self._unseen = seen_frames, False
        own_keys = self.task.state_keys if object_state else self.task.proprioception_keys
        self._state_keys = own_keys if state_keys is None else tuple(state_keys)
        self._state_size = self.task.state_size(self._state_keys)
        check_convention(convention, self.task.name)
        self._convention: Convention = convention
        self._instruction = instruction
        if isinstance(instruction, str) and self.task.has_choice:
            self.task.check_instruction(instruction)
        self._restored_xml: str | None = None
        options = {"absolute": action_mode == "absolute", "reward_shaping": reward_shaping}
        self.sim_env = make_simulator(self.task, compiled=compiled, **options)
        self._observed = Observed(self.sim_env)
        self._describe()

    # -- specs ---------------------------------------------------------------------------------------------------------

    def _describe(self) -> None:
        size = self._cameras.size
        if self.action_mode == "absolute":
            action = Unbounded((ABSOLUTE_DIM * self.task.arms,))
        else:
            action = Bounded(-1.0, 1.0, (POSE_DIM * self.task.arms,))
        self._make_specs(self._state_size, action)
        observation = self.observation_spec
        observation[keys.EEF_VEL] = Unbounded((6 * self.task.arms,), device=self.device)
        for key in self._cameras.names:
            observation[key] = Bounded(0, 255, (3, size, size), dtype=torch.uint8, device=self.device)
        if self._instruction:
            example = self.task.instructions[0]
            observation[keys.INSTRUCTION] = NonTensor((), example_data=example, device=self.device)
        self.observation_spec = observation

    # -- episodes ------------------------------------------------------------------------------------------------------

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        initial_state: InitialState | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        self._unseen = False
        if initial_state is None:
            return super()._reset(tensordict, **kwargs)
        self._start_from_state(initial_state)
        self._elapsed = 0
        return self._observe()

    def _start(self, seed: int) -> None:
        # robosuite hands its generator to samplers when it builds them, so it is reseeded in place, never replaced.
        self.sim_env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
        self._restored_xml = None
        self.sim_env.reset()
        self._ask_for(None)

    def _start_from_state(self, state: InitialState) -> None:
        sim_env = self.sim_env
        sim_env.reset_from_xml_string(sim_env.edit_model_xml(state.model_xml))
        sim_env.sim.set_state_from_flattened(state.sim_state)
        sim_env.sim.forward()
        for robot in sim_env.robots:  # the null-space posture is that of the episode's first configuration
            joints = sim_env.sim.data.qpos[robot._ref_joint_pos_indexes]
            robot.part_controllers["right"].update_initial_joints(joints)
        self._episode_seed, self._restored_xml = state.seed, state.model_xml
        self._ask_for(state.instruction)

    def get_initial_state(self) -> InitialState:
        """Return the current state, to start another episode with ``env.reset(initial_state=state)``."""
        # The simulator's own XML is rounded to six digits; the one it was compiled from is exact.
        model_xml = self._restored_xml or self.sim_env.model.get_xml()
        state = self.sim_env.sim.get_state().flatten()
        return InitialState(model_xml, state, self._episode_seed, self.instruction)

    # -- what is asked for ---------------------------------------------------------------------------------------------

    @property
    def instruction(self) -> str:
        """Instruction of the current episode."""
        if isinstance(self._instruction, str):
            return self._instruction
        return self.sim_env.instruction if self.task.has_choice else self.task.instructions[0]

    def _ask_for(self, recorded: str | None) -> None:
        """Tell the simulator what counts: the caller's words, else the recorded ones, else those that the seed drew."""
        if not self.task.has_choice:
            return
        words = self._instruction if isinstance(self._instruction, str) else recorded
        if words is not None:
            self.task.check_instruction(words)
            self.sim_env.instruction = words

    # -- steps ---------------------------------------------------------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._unseen = self._goes_unseen(tensordict)
        return super()._step(tensordict)

    def _goes_unseen(self, tensordict: TensorDictBase) -> bool:
        """Tell whether no policy call will see the frames after this step."""
        if self._seen_frames is None or (ahead := tensordict.get(keys.UNTIL_QUERY, None)) is None:
            return False
        return int(ahead) >= self._seen_frames

    def _advance(self, action: np.ndarray) -> float:
        command = self._pose(action) if self.action_mode == "absolute" else action
        return self.sim_env.step(command)[1]

    def _pose(self, action: np.ndarray) -> np.ndarray:
        """Return robosuite's command of an absolute action.

        A policy that is pruned too far may saturate to two equal rows. That is its failure, and not the end of an evaluation.
        """
        try:
            return absolute_to_pose(action)
        except ValueError:
            return absolute_to_pose(self._turned(action))

    def _turned(self, action: np.ndarray) -> np.ndarray:
        """Return the action with the hand's own rotation where it fixes none."""
        arms = action.reshape(self.task.arms, ABSOLUTE_DIM).copy()
        for arm, site in zip(arms, self._grip_sites(), strict=True):
            if not fixes_rotation(arm[3:9]):
                arm[3:9] = matrix_to_rot6d(self.sim_env.sim.data.get_site_xmat(site))
        return arms.reshape(-1)

    def _grip_sites(self) -> list[str]:
        return [robot.gripper["right"].important_sites["grip_site"] for robot in self.sim_env.robots]

    def _is_solved(self) -> bool:
        return bool(self.sim_env._check_success())

    def _way(self) -> int:
        return self.sim_env.way

    # -- observations --------------------------------------------------------------------------------------------------

    @property
    def recorded_keys(self) -> tuple[str, ...]:
        """Names of the observations that demonstrations record: the task's state, and published policies' hand rotation."""
        return (*self.task.state_keys, *(f"robot{arm}_eef_quat" for arm in range(self.task.arms)))

    def raw_observation(
        self, state_keys: Sequence[str] | None = None, convention: Convention | None = None
    ) -> Mapping[str, np.ndarray]:
        """Return the parts of the state, or ``state_keys``, f64, by robosuite's names, in a given or its own convention."""
        wanted = self.task.state_keys if state_keys is None else state_keys
        observed = self._observed.read([OBJECTS if name == "object" else name for name in wanted])
        if "object" in wanted:
            objects = object_state(self.task.name, observed, convention or self._convention)
            observed = {**observed, "object": objects}
        parts = {name: np.asarray(observed[name]) for name in wanted}
        return {k: downward_quaternion(v) if k.endswith("eef_quat_site") else v for k, v in parts.items()}

    def _observe_state(self) -> np.ndarray:
        return np.concatenate([*self.raw_observation(self._state_keys).values()])

    def _observe(self) -> TensorDict:
        out = super()._observe()
        out[keys.EEF_VEL] = torch.as_tensor(self._eef_velocity(), dtype=torch.float32)
        for key, image in self._cameras.images(self.sim_env.sim, again=self._unseen).items():
            out[key] = image
        if self._instruction:
            out[keys.INSTRUCTION] = self.instruction
        return out

    def object_positions(self) -> np.ndarray:
        """Return the world positions of the scene's n objects, f64 [3 n], m."""
        sim, objects = self.sim_env.sim, self.sim_env.model.mujoco_objects
        bodies = [sim.model.body_name2id(thing.root_body) for thing in objects]
        return sim.data.body_xpos[bodies].reshape(-1)

    def _eef_velocity(self) -> np.ndarray:
        """Return the velocity of each arm's grip site as the simulator has it: m/s, then rad/s, world frame."""
        return np.concatenate([site_twist(self.sim_env.sim, site) for site in self._grip_sites()])

    def render(self, camera: str = "frontview", height: int = 256, width: int = 256) -> np.ndarray:
        """Return a u8 [height, width, 3] image of the current state, top row first. See `CameraRenderer` for errors."""
        return self._cameras.render(self.sim_env.sim, camera, height, width)

    def close(self, *, raise_if_closed: bool = True) -> Any:
        self._cameras.close()
        self.sim_env.close()
        return super().close(raise_if_closed=raise_if_closed)
