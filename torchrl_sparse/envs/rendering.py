"""Off-screen camera images of a simulator, made only when asked for. Needs EGL or OSMesa from the system."""

from __future__ import annotations

import atexit
import os
from typing import Any

import numpy as np

GL_HINT = (
    "rendering needs a GL library: install Debian's libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 libopengl0 libgles2, or "
    "libosmesa6 with MUJOCO_GL=osmesa"
)


class CameraRenderer:
    """Renders the cameras of one MuJoCo model; a hard reset makes a new model and needs a new renderer.

    Args:
        sim: robosuite's ``MjSim``.
        height, width: pixels.
        fast: no multisampling, shadows or reflections. Software rendering is about four times faster so; it changes how images
            look, so train and evaluate with the same setting.

    Raises:
        RuntimeError: if no GL library is installed; the message says which package brings one.
    """

    def __init__(self, sim: Any, height: int, width: int, *, fast: bool = True):
        import mujoco

        self._mujoco = mujoco
        self._model, self._data = sim.model._model, sim.data._data
        self._model.vis.global_.offheight, self._model.vis.global_.offwidth = height, width
        if fast:
            self._model.vis.quality.offsamples = 0
            self._model.vis.quality.shadowsize = 0
        self._gl = _make_gl_context(height, width)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(self._model, maxgeom=10000)
        if fast:
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                self._scene.flags[flag] = 0
        self._options = mujoco.MjvOption()
        self._options.geomgroup[0] = 0  # collision shapes
        atexit.register(self.close)  # a context that outlives EGL itself complains at exit

    def image(self, camera: str) -> np.ndarray:
        """u8 [height, width, 3], top row first.

        Raises:
            ValueError: if the model has no camera of that name.
        """
        mujoco = self._mujoco
        camera_id = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if camera_id < 0:
            names = [self._model.camera(i).name for i in range(self._model.ncam)]
            raise ValueError(f"camera: expected one of {', '.join(names)}, got {camera!r}")
        view = mujoco.MjvCamera()
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera_id
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._options, None, view, everything, self._scene)
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return np.ascontiguousarray(pixels[::-1])  # OpenGL's first row is the lowest

    def close(self) -> None:
        """Frees the GL context. Call once."""
        atexit.unregister(self.close)
        self._gl.make_current()
        self._context.free()
        self._gl.free()


def _make_gl_context(height: int, width: int) -> Any:
    # mujoco chooses its own backend when it is first imported, by whomever; here MUJOCO_GL is read when it is needed.
    try:
        if os.environ.get("MUJOCO_GL") == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.egl import GLContext
        return GLContext(width, height)
    except Exception as error:  # every backend fails with an exception type of its own
        raise RuntimeError(f"{GL_HINT} ({type(error).__name__}: {error})") from error
