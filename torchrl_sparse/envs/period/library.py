"""The compiled library of ``period.cpp``, and the functions of MuJoCo, numpy and scipy that it calls by their addresses.

It knows nothing of Python and of no other library's headers: a product is bit-equal to numpy's only in the BLAS that numpy
itself calls, and to numba's only in scipy's.
"""

from __future__ import annotations

import ctypes
import importlib.machinery
from ctypes import c_char_p, c_int, c_int64, c_void_p
from functools import lru_cache
from pathlib import Path
from typing import Any

__all__ = ["Arm", "World", "functions", "library"]

_GEMV = (
    "cblas_dgemv64_",
    "cblas_dgemv",
)  # in numpy's wheels, and where numpy was built against a system's BLAS
_FUNCTIONS = ("step1", "step2", "full_m", "jac_site", "set_handler", "numpy_gemv")
_MUJOCO = ("mj_step1", "mj_step2", "mj_fullM", "mj_jacSite", "_mjPRIVATE__set_tls_error_fn")
_BLAS, _LAPACK = ("dgemm", "dgemv"), ("dgetrf", "dgetri", "dgesdd")


class Functions(ctypes.Structure):
    """``Functions`` of ``period.cpp``."""

    _fields_ = [(name, c_void_p) for name in (*_FUNCTIONS, *_BLAS, *_LAPACK)]


class Arm(ctypes.Structure):
    """``Arm`` of ``period.cpp``."""

    _LOOKED_AT = ("position", "rotation", "velocity", "turning", "j_pos", "j_ori", "j_full")
    _fields_ = [
        *((name, c_int64) for name in ("site", "n")),
        *((name, c_void_p) for name in ("qpos", "qvel", "actuators", "goal", *_LOOKED_AT)),
        *((name, c_void_p) for name in ("joints", "speeds", "mass", "torques")),
    ]


class World(ctypes.Structure):
    """``World`` of ``period.cpp``."""

    _READ = ("site_xpos", "site_xmat", "qpos", "qvel", "qm", "bias", "ctrlrange")
    _fields_ = [
        *((name, c_void_p) for name in ("model", "data")),
        *((name, c_int64) for name in ("nv", "arms")),
        *((name, c_void_p) for name in (*_READ, "ctrl", "inertia", "jacobians", "arm")),
    ]


@lru_cache(maxsize=1)
def library() -> Any:
    """Return the compiled library, or a str that says why there is none."""
    paths = [Path(__file__).parent / f"_period{suffix}" for suffix in importlib.machinery.EXTENSION_SUFFIXES]
    path = next((path for path in paths if path.exists()), None)
    if path is None:
        return f"{paths[0].name} was not built (install a C++17 compiler, then this package again)"
    try:
        found = ctypes.CDLL(str(path))
        found.period_look.restype, found.period_look.argtypes = None, [c_void_p, c_void_p]
        found.period_control.restype, found.period_control.argtypes = c_int, [c_void_p, c_void_p, c_int64]
        found.period_advance.restype, found.period_advance.argtypes = c_int64, [c_void_p, c_void_p, c_int64]
        found.period_error.restype = c_char_p
        if found.period_layout() != _layout():
            return f"{path.name} was built from other sources; build it again: pip install -e ."
    except (OSError, AttributeError) as error:
        return f"{path.name} cannot be used ({error}); install the package again"
    return found


@lru_cache(maxsize=1)
def functions() -> Any:
    """Return the addresses of what the library calls, or a str that says why they cannot be had."""
    import mujoco
    from scipy.linalg import cython_blas, cython_lapack

    try:
        numpy = ctypes.CDLL(_numpy_core())
        gemv = next(name for name in _GEMV if hasattr(numpy, name))
        simulator = ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
        return Functions(
            *(_address(simulator[name]) for name in _MUJOCO),
            _address(numpy[gemv]),
            *(_of_cython(cython_blas, name) for name in _BLAS),
            *(_of_cython(cython_lapack, name) for name in _LAPACK),
        )
    except (OSError, AttributeError, KeyError, StopIteration) as error:
        return f"a function of MuJoCo, numpy or scipy was not found ({error!r})"


def _layout() -> int:
    return sum(ctypes.sizeof(each) << 8 * place for place, each in enumerate((Functions, Arm, World)))


def _numpy_core() -> str:
    from numpy.core import _multiarray_umath

    return _multiarray_umath.__file__


def _address(function: Any) -> int | None:
    return ctypes.cast(function, c_void_p).value


def _of_cython(module: Any, name: str) -> int:
    capsule = module.__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = c_char_p, [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, c_char_p]
    return api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
