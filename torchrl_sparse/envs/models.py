"""Compiled models that a simulator keeps between resets, so that unchanged meshes are not compiled again."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from copy import copy
from functools import cache, cached_property
from typing import Any

import numpy as np

__all__ = ["compile_what_changes"]

# What is large, and which no reset changes.
_LARGE = ("mesh_", "tex_", "hfield_", "skin_", "flex", "oct_", "bvh_")
# A mesh or a material is an asset; these refer to one.
_REFERENCES = ("mesh", "material", "texture", "hfield", "skin")
_SETTINGS = ("option", "visual", "compiler", "size", "statistic", "extension", "custom")


def compile_what_changes(sim_env: Any) -> None:
    """Let a robosuite environment compile at a reset only what differs from the model before, to the same bits.

    A model whose XML is the same is used again, with all numbers as they were compiled but those of meshes and textures, which
    are taken to be untouched. Where sizes of objects differ, they alone are compiled, without meshes and textures, and
    MuJoCo computes what follows from them. Where anything else differs the whole model is compiled, as robosuite does.
    """
    from robosuite.environments.base import MujocoEnv
    from robosuite.utils.binding_utils import MjSim

    if type(sim_env)._initialize_sim is not MujocoEnv._initialize_sim:
        return
    models = _Models()

    def initialize_sim(xml_string: str | None = None) -> None:
        xml = xml_string or sim_env.model.get_xml()
        for processor in sim_env._xml_processors:
            xml = processor(xml)
        sim_env.sim = MjSim(models.compiled(xml))
        _say_its_xml(sim_env.sim.model, xml)
        sim_env.sim.forward()
        sim_env.initialize_time(sim_env.control_freq)

    sim_env._initialize_sim = initialize_sim


def _say_its_xml(model: Any, xml: str) -> None:
    """Let ``sim.model.get_xml()`` be of this model: MuJoCo writes the one that it compiled last."""
    import mujoco

    write = type(model).get_xml

    def get_xml() -> str:
        mujoco.MjModel.from_xml_string(xml)
        return write(model)

    model.get_xml = get_xml


class _Models:
    """One model at a time, and its numbers as they were compiled."""

    def __init__(self) -> None:
        self._xml: str | None = None
        self._model: Any = None
        self._scene: _Scene | None = None
        self._kept: list[tuple[np.ndarray, np.ndarray]] = []
        self._options: list[tuple[Any, str, Any]] = []

    def compiled(self, xml: str) -> Any:
        """Return the model of an XML; the one that was returned before is not to be used any more."""
        import mujoco

        if xml == self._xml:
            self._restore()
            return self._model
        scene = _Scene(xml)
        if not self._becomes(scene):
            self._kept, self._options = [], []
            self._model = None  # two of them need not be in memory
            self._model = mujoco.MjModel.from_xml_string(xml)
        self._xml, self._scene = xml, scene
        self._kept = [(numbers, numbers.copy()) for numbers in _numbers(self._model).values()]
        self._options = [
            (of, name, copy(getattr(of, name)))
            for of in (self._model.opt, self._model.stat)
            for name in dir(of)
            if not name.startswith("_") and not callable(getattr(of, name))
        ]
        return self._model

    def _restore(self) -> None:
        for numbers, compiled in self._kept:
            np.copyto(numbers, compiled)
        for of, name, compiled in self._options:
            setattr(of, name, compiled)

    def _becomes(self, scene: _Scene) -> bool:
        """Give the model the sizes of another scene; False, with nothing changed, where more than sizes differ."""
        import mujoco

        if self._scene is None or not self._scene.differs_in_numbers(scene):
            return False
        self._restore()
        changes = _changes(self._model, self._scene.model, scene.model)
        if changes is None:
            return False
        for numbers, where, values in changes:
            numbers[where] = values
        mujoco.mj_setConst(self._model, mujoco.MjData(self._model))
        return True


class _Scene:
    """A model without its assets: each mesh a ball, nothing textured. It is compiled when it is first asked for."""

    def __init__(self, xml: str):
        root = ET.fromstring(xml)
        self._of_assets, self._references = [], []
        for part in [*root]:
            if part.tag in ("asset", *_SETTINGS):
                self._of_assets.append(ET.tostring(part))
            if part.tag == "asset":
                root.remove(part)
        for element in root.iter():
            named = [(key, element.attrib.pop(key)) for key in _REFERENCES if key in element.attrib]
            self._references += named
            if element.tag == "geom" and "mesh" in dict(named):
                element.attrib.update(type="sphere", size="0.01")
        self._xml = ET.tostring(root, encoding="unicode")

    @cached_property
    def model(self) -> Any:
        """Its model, whose numbers are those of the whole model but for meshes."""
        import mujoco

        # Not MjModel.from_xml_string: MuJoCo would take it for the model whose XML is asked for.
        return mujoco.MjSpec.from_string(self._xml).compile()

    def differs_in_numbers(self, other: _Scene) -> bool:
        """Tell whether assets, what refers to them, settings and names are the same."""
        return (
            self._of_assets == other._of_assets
            and self._references == other._references
            and self.model.names == other.model.names
        )


_Change = tuple[np.ndarray, Any, np.ndarray]


def _changes(model: Any, before: Any, after: Any) -> list[_Change] | None:
    """Return which numbers of a whole model change with its scene, and to what; None if the scene does not tell.

    It tells where the numbers that change were those of the whole model before.
    """
    whole, old, new = _numbers(model), _numbers(before), _numbers(after)
    changes = []
    for name, values in new.items():
        if name.startswith("bvh_"):
            continue
        if values.shape != old[name].shape:
            return None
        changed = values != old[name]
        if not changed.any():
            continue
        if values.shape != whole[name].shape or not np.array_equal(whole[name][changed], old[name][changed]):
            return None
        changes.append((whole[name], changed, values[changed]))
    for body in range(model.nbody):
        places = [_tree(each, body) for each in (model, before, after)]
        for name in _TREE:
            there, was, now = (
                getattr(each, name)[place] for each, place in zip((model, before, after), places, strict=True)
            )
            if np.array_equal(was, now):
                continue
            if not np.array_equal(there, was):
                return None
            changes.append((there, slice(None), now))
    return changes


_TREE = ("bvh_aabb", "bvh_child", "bvh_depth", "bvh_nodeid")


def _tree(model: Any, body: int) -> slice:
    """Return where the volumes that bound a body's geoms are."""
    begin = model.body_bvhadr[body]
    return slice(begin, begin + model.body_bvhnum[body])


def _numbers(model: Any) -> dict[str, np.ndarray]:
    """Return views of a model's numbers by name, of the large ones those of bodies' trees alone."""
    small = {name: getattr(model, name) for name in _small()}
    of_bodies = int(model.body_bvhnum.sum())
    found = {name: value for name, value in small.items() if isinstance(value, np.ndarray)}
    return found | {name: getattr(model, name)[:of_bodies] for name in _TREE}


@cache
def _small() -> tuple[str, ...]:
    import mujoco

    return tuple(name for name in dir(mujoco.MjModel) if not name.startswith(("_", *_LARGE)))
