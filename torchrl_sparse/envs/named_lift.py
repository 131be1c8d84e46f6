"""Lift with three cubes, one of which the instruction names: "lift the green cube".

The scene does not say which cube counts, so a policy that ignores the instruction can be right in one episode of three.

Importing this module registers ``"LiftNamed"`` with robosuite; `make_simulator` does so.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np

from torchrl_sparse.envs.simulator import import_robosuite
from torchrl_sparse.envs.tasks import find_robosuite_task

import_robosuite()  # quietly, before anything else imports it
from robosuite.environments.manipulation.lift import Lift  # noqa: E402
from robosuite.models.objects import BoxObject  # noqa: E402
from robosuite.utils.mjcf_utils import CustomMaterial  # noqa: E402
from robosuite.utils.placement_samplers import UniformRandomSampler  # noqa: E402

COLOURS = ("red", "green", "blue")
X_RANGE, Y_RANGE = (-0.08, 0.08), (-0.13, 0.13)  # m, of the cubes' centres about the table's
SPACING = 0.10  # m between centres: open fingers fit around a cube without touching another
_RGBA = {
    "green": (0.0, 1.0, 0.0, 1.0),
    "blue": (0.0, 0.0, 1.0, 1.0),
    "yellow": (1.0, 0.9, 0.0, 1.0),
    "purple": (0.5, 0.0, 0.8, 1.0),
}
_WOODEN = ("green", "blue")  # those of which robosuite has a texture


class LiftNamed(Lift):
    """Lift with a red, a green and a blue cube, of which only the named one counts.

    Everything that `Lift` says of "the cube" (success, reward, object state) is true of the named one. The named cube is drawn
    last at a reset, so a seed gives the same scene whatever the instruction.
    """

    colours: tuple[str, ...] = COLOURS
    x_range, y_range = X_RANGE, Y_RANGE
    placement_initializer: Any

    def _load_model(self) -> None:
        if self.placement_initializer is None:
            self.placement_initializer = SpacedSampler(
                name="ObjectSampler",
                x_range=self.x_range,
                y_range=self.y_range,
                ensure_object_boundary_in_range=False,
                reference_pos=self.table_offset,
                z_offset=0.01,
                rng=self.rng,
            )
        super()._load_model()  # with the red cube
        others = [_cube(colour, self.rng) for colour in self.colours[1:]]
        self.cubes: Mapping[str, BoxObject] = dict(zip(self.colours, [self.cube, *others], strict=True))
        self.model.mujoco_objects = [*self.cubes.values()]
        self.model.merge_objects(others)
        self.placement_initializer.add_objects(others)

    def _reset_internal(self) -> None:
        super()._reset_internal()
        choices = find_robosuite_task(type(self).__name__).instructions
        self.instruction = choices[self.rng.integers(len(choices))]

    @property
    def instruction(self) -> str:
        """Instruction of the current episode; may be set at any time."""
        return self._instruction

    @instruction.setter
    def instruction(self, words: str) -> None:
        self._instruction = words
        self.cube = next(cube for colour, cube in self.cubes.items() if colour in words.split())
        self.cube_body_id = self.sim.model.body_name2id(self.cube.root_body)


class SpacedSampler(UniformRandomSampler):
    """Placement sampler that redraws all places until centres are at least `SPACING` apart."""

    def sample(self, *args: Any, **kwargs: Any) -> dict:
        while True:
            placed = super().sample(*args, **kwargs)
            centres = [np.array(position[:2]) for position, _, _ in placed.values()]
            if all(np.linalg.norm(one - other) >= SPACING for one, other in combinations(centres, 2)):
                return placed


def _cube(colour: str, rng: np.random.Generator) -> BoxObject:
    """Make a cube like Lift's red one, of another colour."""
    material = _wood(colour) if colour in _WOODEN else None
    size = {"size_min": [0.020] * 3, "size_max": [0.022] * 3}
    return BoxObject(name=f"{colour}_cube", **size, rgba=_RGBA[colour], material=material, rng=rng)


def _wood(colour: str) -> CustomMaterial:
    return CustomMaterial(
        texture=f"Wood{colour.capitalize()}",
        tex_name=f"{colour}wood",
        mat_name=f"{colour}wood_mat",
        tex_attrib={"type": "cube"},
        mat_attrib={"texrepeat": "1 1", "specular": "0.4", "shininess": "0.1"},
    )
