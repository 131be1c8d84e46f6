"""A control step of a robosuite simulator whose substeps but the first are compiled, bit-equal to its own."""

from __future__ import annotations

import ctypes
import logging
import weakref
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from torchrl_sparse.envs.period.exact import why_not, why_not_arms
from torchrl_sparse.envs.period.library import Arm, World, functions, library

__all__ = ["ControlPeriod"]

_log = logging.getLogger(__name__)


@cache
def _tell(reason: str) -> None:
    """Log, once in a process, why a simulator steps as robosuite has it."""
    _log.warning("robosuite steps in Python, slower and to the same bits: %s", reason)


class ControlPeriod:
    """Take the control steps of one simulator: goal and gripper by robosuite's Python, the rest of the substeps compiled.

    In the first step after each reset robosuite's torques and the compiled ones are compared; where a bit differs, or a
    controller, a robot or a version is not the one that the compiled substeps are of, everything is robosuite's own, and one
    line of the log says why.

    Args:
        sim_env: robosuite's environment; `step` is to stand in for its own.
    """

    def __init__(self, sim_env: Any):
        self._sim_env = sim_env
        self._reason = why_not(sim_env)
        self._bound: list[weakref.ref] = []
        self._arms: list[_BoundArm] = []
        self._world = World()
        self._checked = self._looked = False
        self._keep: list[Any] = []
        if self._reason is not None:
            _tell(self._reason)

    @property
    def exact(self) -> bool:
        """Whether the compiled substeps may be robosuite's own, as far as that is known."""
        return self._reason is None

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, dict]:
        """Do what robosuite's ``step`` does."""
        env = self._sim_env
        self.advance(action)
        reward, done, info = env._post_action(action)
        return env._get_observations(), reward, done, info

    def advance(self, action: np.ndarray) -> None:
        """Do what robosuite's ``step`` does until it asks for the reward."""
        env = self._sim_env
        if env.done:
            raise ValueError("executing action in terminated episode")
        env.timestep += 1
        sim, left = env.sim, int(env.control_timestep / env.model_timestep) - 1
        sim.step1()
        self._look()
        env._pre_action(action, True)
        self._looked = False
        ready = self._is_ready()
        sim.step2()
        if ready and not self._checked:
            # Not in the first substep: after a reset the controller has a mass matrix of before the gripper was put right.
            sim.step1()
            env._pre_action(action, False)
            self._check()
            sim.step2()
            left -= 1
        if ready and self._checked and self._whole(env):
            taken = self._run(left)
            if taken < left:  # what stopped it is robosuite's own to raise
                env._pre_action(action, False)
                sim.step2()
                taken += 1
            left -= taken
        for _ in range(left):
            sim.step1()
            env._pre_action(action, False)
            sim.step2()
        # robosuite adds it at once too
        env.cur_time += env.control_timestep

    def control(self, robot: Any) -> bool:
        """Command one robot's arms as robosuite does between actions; False if it is left to robosuite."""
        return self._checked and self._is_bound() and self._command_arms(robot.composite_controller)

    # -- the compiled part ---------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Spare controllers their look at the present state, where they would take one."""
        self._looked = False
        if not (self._checked and self._is_bound()):
            return
        if not all(arm.controller().new_update for arm in self._arms):
            return
        library().period_look(ctypes.byref(functions()), ctypes.byref(self._world))
        for arm in self._arms:
            arm.hand_over()
            arm.controller().new_update = False
        self._looked = True

    def _run_controller(self, find: Callable[[], Any], enabled: dict[str, bool]) -> dict[str, np.ndarray]:
        """Do what the ``run_controller`` of a composite controller does, in the first substep."""
        composite = find()
        if self._looked and all(enabled.values()):
            for arm in self._arms:
                arm.take_goal()
            if self._command_arms(composite):
                parts, arms = composite.part_controllers, composite.arms
                for arm in arms:
                    parts[arm].new_update = True
                return {
                    name: part.torques if name in arms else part.run_controller()
                    for name, part in parts.items()
                }
        return type(composite).run_controller(composite, enabled)

    def _command_arms(self, composite: Any) -> bool:
        numbers = [number for number, arm in enumerate(self._arms) if arm.composite() is composite]
        done = all(self._command(number) for number in numbers)
        for number in numbers:
            self._arms[number].hand_over()
        return done

    @staticmethod
    def _whole(env: Any) -> bool:
        """Tell whether nothing but the robots acts between substeps."""
        from robosuite.environments.robot_env import RobotEnv

        return type(env)._pre_action is RobotEnv._pre_action

    def _run(self, substeps: int) -> int:
        taken = library().period_advance(ctypes.byref(functions()), ctypes.byref(self._world), substeps)
        if taken < 0:
            import mujoco

            raise mujoco.FatalError(library().period_error().decode())
        for arm in self._arms:
            arm.hand_over()
        return taken

    def _command(self, number: int) -> bool:
        call = library().period_control
        return bool(call(ctypes.byref(functions()), ctypes.byref(self._world), number))

    def _is_ready(self) -> bool:
        """Take over what the action asks for; False where everything is left to robosuite."""
        if self._reason is None and not self._is_bound():
            self._bind()
        if self._reason is not None:
            return False
        for arm in self._arms:
            arm.take_goal()
        return True

    def _check(self) -> None:
        """Compare the torques of robosuite with the compiled ones in the present state, where both have been asked."""
        ctrl = self._sim_env.sim.data.ctrl
        own = ctrl.copy()
        torques = [arm.controller().torques for arm in self._arms]
        done = all(self._command(number) for number in range(len(self._arms)))
        same = all(np.array_equal(arm.torques, own) for arm, own in zip(self._arms, torques, strict=True))
        self._checked = done and same and np.array_equal(ctrl, own)
        ctrl[:] = own
        if not self._checked:
            self._reason = "its torques are others here, by the BLAS of numpy and scipy"
            _tell(self._reason)

    def _is_bound(self) -> bool:
        now = self._followed()
        return len(now) == len(self._bound) and all(
            ref() is each for ref, each in zip(self._bound, now, strict=True)
        )

    def _followed(self) -> list[Any]:
        """Return what a reset, or a user, may have replaced."""
        composites = [robot.composite_controller for robot in self._sim_env.robots]
        arms = [composite.part_controllers.get(arm) for composite in composites for arm in composite.arms]
        return [self._sim_env.sim, *composites, *arms]

    def _bind(self) -> None:
        env, self._checked = self._sim_env, False
        self._reason = why_not_arms(env)
        if self._reason is not None:
            return _tell(self._reason)
        self._bound = [weakref.ref(each) for each in self._followed()]
        model, data = env.sim.model._model, env.sim.data._data
        self._arms = [_BoundArm(robot, arm) for robot in env.robots for arm in robot.arms]
        structures = (Arm * len(self._arms))(*(arm.structure() for arm in self._arms))
        work = np.empty((model.nv, model.nv)), np.empty((6, model.nv))
        read = (data.site_xpos, data.site_xmat, data.qpos, data.qvel, data.qM, data.qfrc_bias)
        self._keep = [structures, *work]
        for robot in env.robots:
            composite = robot.composite_controller
            composite.run_controller = partial(self._run_controller, weakref.ref(composite))
        self._world = World(
            *(model._address, data._address, model.nv, len(self._arms)),
            *(each.ctypes.data for each in (*read, model.actuator_ctrlrange, data.ctrl, *work)),
            ctypes.addressof(structures),
        )


class _BoundArm:
    """One arm's numbers where the compiled substeps read and write them; it keeps no simulator alive."""

    def __init__(self, robot: Any, arm: str):
        controller = robot.part_controllers[arm]
        self.composite: Callable[[], Any] = weakref.ref(robot.composite_controller)  # who calls them is there
        self.controller: Callable[[], Any] = weakref.ref(controller)
        n = len(controller.qvel_index)
        self._site = robot.sim.model.site_name2id(controller.ref_name)
        indexes = (controller.qpos_index, controller.qvel_index, robot._ref_actuators_indexes_dict[arm])
        self._indexes = [np.array(each, np.int64) for each in indexes]
        self._goal = np.empty(24 + n)
        self._looked_at = (
            *(controller.ref_pos, controller.ref_ori_mat, controller.ref_pos_vel, controller.ref_ori_vel),
            *(controller.J_pos, controller.J_ori, controller.J_full),
        )
        self._joints, self._speeds, self.torques = np.empty(n), np.empty(n), np.empty(n)
        self._mass = np.empty((n, n), order="F")

    def structure(self) -> Arm:
        arrays = (
            *(*self._indexes, self._goal, *self._looked_at),
            *(self._joints, self._speeds, self._mass, self.torques),
        )
        return Arm(self._site, len(self._joints), *(each.ctypes.data for each in arrays))

    def take_goal(self) -> None:
        """Read what the action asks for, in the world frame: it stays until the next one."""
        controller, goal = self.controller(), self._goal
        place, rotation = controller.goal_pos, controller.goal_ori
        if controller.input_ref_frame == "base":
            place = controller.origin_pos + np.dot(controller.origin_ori, place)
            rotation = np.dot(controller.origin_ori, rotation)
        goal[:3], goal[3:12] = place, rotation.reshape(-1)
        goal[12:18], goal[18:24], goal[24:] = controller.kp, controller.kd, controller.initial_joint

    def hand_over(self) -> None:
        """Leave the controller what it would have seen last."""
        controller = self.controller()
        controller.joint_pos, controller.joint_vel = self._joints, self._speeds
        controller.mass_matrix, controller.torques = self._mass, self.torques
