"""Off-screen camera images of a simulator, rendered on demand. Needs EGL or OSMesa from the system."""

from __future__ import annotations

import atexit
import math
import os
from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.failure import RunFailed

GL_HINT = (
    "rendering needs a GL library: install Debian's libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 libopengl0 libgles2, or "
    "libosmesa6 with MUJOCO_GL=osmesa"
)


_HIDDEN_GROUP = 5  # of geoms; MuJoCo draws groups 0 to 2 unless told otherwise
_CORNERS = np.array([*product((-1.0, 1.0), repeat=3)])
# Beginnings of the names of what a GL context copies from a model.
_UPLOADED = ("mesh_", "tex_", "hfield_", "skin_", "mat_")


class CameraRenderer:
    """Renderer of one MuJoCo model's cameras; after a hard reset, `follow` moves it to the new model.

    Args:
        sim: robosuite's ``MjSim``.
        height, width: pixels.
        fast: no multisampling, shadows or reflections. Software rendering is about four times faster so; it changes how images
            look, so train and evaluate with the same setting. Geometry outside the view is then not drawn, which saves about
            half of the time and changes nothing.

    Raises:
        RunFailed: if no GL library is installed; the message says which package brings one.
    """

    def __init__(self, sim: Any, height: int, width: int, *, fast: bool = True):
        import mujoco

        self._mujoco = mujoco
        self._watch(sim)
        self._cull = fast  # shadows and reflections fall into the picture from outside
        self._model.vis.global_.offheight, self._model.vis.global_.offwidth = height, width
        if fast:
            self._model.vis.quality.offsamples = 0
            self._model.vis.quality.shadowsize = 0
        self._gl = _make_gl_context(height, width)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        # Only its size matters, whichever model comes next.
        self._scene = mujoco.MjvScene(self._model, maxgeom=10000)
        if fast:
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                self._scene.flags[flag] = 0
        self._options = mujoco.MjvOption()
        self._options.geomgroup[0] = 0  # collision shapes
        atexit.register(self.close)  # a context that outlives EGL itself complains at exit

    def follow(self, sim: Any) -> bool:
        """Switch to another simulator; return False and change nothing if its meshes or textures differ.

        To make a renderer takes as long as dozens of images: everything is copied into a new GL context.
        """
        if sim.model._model is not self._model and not _same_uploads(self._model, sim.model._model):
            return False
        self._watch(sim)
        return True

    def _watch(self, sim: Any) -> None:
        self._model, self._data = sim.model._model, sim.data._data

    def image(self, camera: str) -> np.ndarray:
        """Return the image u8 [height, width, 3], top row first.

        Raises:
            InputError: if the model has no camera of that name.
        """
        mujoco = self._mujoco
        camera_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if camera_id < 0:
            names = [self._model.camera(i).name for i in range(self._model.ncam)]
            raise InputError(f"camera: expected one of {', '.join(names)}, got {camera!r}")
        view = mujoco.MjvCamera()
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera_id
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        groups = self._model.geom_group.copy()
        if self._cull:
            self._model.geom_group[self._out_of_view(camera_id)] = _HIDDEN_GROUP
        mujoco.mjv_updateScene(self._model, self._data, self._options, None, view, everything, self._scene)
        self._model.geom_group[:] = groups
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return np.ascontiguousarray(pixels[::-1])  # OpenGL's first row is the lowest

    def _out_of_view(self, camera: int) -> np.ndarray:
        """Return bool [geoms], those whose bounding box lies beyond one side of what the camera sees, or behind it."""
        model, data = self._model, self._data
        centre, half = model.geom_aabb[:, None, :3], model.geom_aabb[:, None, 3:]
        axes = data.geom_xmat.reshape(-1, 3, 3)
        corners = (centre + half * _CORNERS) @ axes.transpose(0, 2, 1) + data.geom_xpos[:, None]
        x, y, z = np.moveaxis((corners - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3), -1, 0)
        tall = math.tan(math.radians(model.cam_fovy[camera]) / 2)
        wide = tall * self._viewport.width / self._viewport.height
        ahead = -z  # a camera looks along its negative z axis
        beyond = (x > wide * ahead, x < -wide * ahead, y > tall * ahead, y < -tall * ahead, ahead < 0)
        bounded = model.geom_rbound > 0  # planes are not
        return bounded & np.any([side.all(1) for side in beyond], axis=0)

    def close(self) -> None:
        """Free the GL context. Call once."""
        atexit.unregister(self.close)
        self._gl.make_current()
        self._context.free()
        self._gl.free()


class Cameras:
    """Observation cameras of an environment, and any others on request; one renderer per image size.

    Args:
        names: the cameras, by the key of each one's images.
        size: height and width of these images, pixels.
        fast: see `CameraRenderer`, whose errors are those of `images` and `render`.
    """

    def __init__(self, names: Mapping[NestedKey, str], size: int, *, fast: bool = True):
        self.names = dict(names)
        self.size = size
        self._fast = fast
        self._renderers: dict[tuple[int, int], CameraRenderer] = {}
        self._last: dict[NestedKey, Tensor] = {}

    def images(self, sim: Any, *, again: bool = False) -> Mapping[NestedKey, Tensor]:
        """Return u8 [3, size, size] of each camera; ``again`` returns the previous call's images without rendering."""
        if not again:
            shown = {key: self.render(sim, name, self.size, self.size) for key, name in self.names.items()}
            self._last = {
                key: torch.from_numpy(image).permute(2, 0, 1).contiguous() for key, image in shown.items()
            }
        return self._last

    def render(self, sim: Any, camera: str, height: int, width: int) -> np.ndarray:
        """Return u8 [height, width, 3] of the current state, top row first."""
        size = (height, width)
        renderer = self._renderers.get(size)
        if renderer is not None and not renderer.follow(sim):
            self._renderers.pop(size).close()
            renderer = None
        if renderer is None:
            renderer = self._renderers[size] = CameraRenderer(sim, height, width, fast=self._fast)
        return renderer.image(camera)

    def close(self) -> None:
        """Free all GL contexts; later requests create new ones."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers = {}


def _same_uploads(one: Any, other: Any) -> bool:
    """Tell whether a GL context made for one model shows the other as well."""
    names = [name for name in dir(one) if name.startswith(_UPLOADED)]
    if not all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names):
        return False
    return np.array_equal(_plane_sizes(one), _plane_sizes(other))  # planes are tessellated at their size


def _plane_sizes(model: Any) -> np.ndarray:
    return model.geom_size[model.geom_type == 0]


def _make_gl_context(height: int, width: int) -> Any:
    # mujoco chooses its own backend when it is first imported, by whomever; here MUJOCO_GL is read when it is needed.
    try:
        if os.environ.get("MUJOCO_GL") == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.egl import GLContext
        return GLContext(width, height)
    except Exception as error:  # every backend fails with an exception type of its own
        raise RunFailed(f"{GL_HINT} ({type(error).__name__}: {error})") from error
