"""The command ``torchrl-sparse``: every recipe from any folder, and what a report of a fault should tell of an installation.

::

    torchrl-sparse                                  # the recipes, a line each
    torchrl-sparse accelerate policy=latest.ckpt task=lift demos=lift.hdf5 budget_ms=5
    torchrl-sparse benchmark task=lift episodes=10  # as python recipes/benchmark.py, with the same options
    torchrl-sparse env                              # versions, engine and machine
"""

from __future__ import annotations

import ast
import platform
import runpy
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

__all__ = ["main"]

_REPORTED = (
    "torchrl-sparse",
    "torch",
    "torchrl",
    "tensordict",
    "robosuite",
    "mujoco",
    "numpy",
    "transformers",
)
_SHORT = {
    "accelerate": "accelerate_policy"
}  # a script of that name would hide the library that diffusers imports


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0, or 2 for a name that is no recipe.

    >>> main(["nope"])
    2
    """
    name, *options = [*(sys.argv[1:] if arguments is None else arguments)] or ["--help"]
    command = _SHORT.get(name, name)
    recipes = {path.stem: path for path in sorted(_recipes().glob("*.py"))}
    if command in ("--help", "-h"):
        print("torchrl-sparse env, or a recipe; torchrl-sparse RECIPE --help shows its options\n")
        print("\n".join(f"{name:<20} {_purpose(path)}" for name, path in recipes.items()))
    elif command == "env":
        print("\n".join(_environment()))
    elif command in recipes:
        sys.argv = [str(recipes[command]), *options]
        runpy.run_path(str(recipes[command]), run_name="__main__")
    else:
        print(f"recipe: expected env or one of {', '.join(recipes)}, got {command!r}", file=sys.stderr)
        return 2
    return 0


def _recipes() -> Path:
    """Return the folder of the recipes: within the package where a wheel brought them, beside it in a repository."""
    package = Path(__file__).parents[1]
    installed = package / "recipes"
    return installed if installed.is_dir() else package.parent / "recipes"


def _purpose(path: Path) -> str:
    """Return the first line of a recipe's docstring, without importing it."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def _environment() -> list[str]:
    from torchrl_sparse.blocks.engine import native_available
    from torchrl_sparse.evaluation.latency.measure import describe_machine

    machine = describe_machine()
    return [
        f"python {platform.python_version()}, {platform.platform()}",
        *(f"{name} {_version(name)}" for name in _REPORTED),
        f"native engine: {'built' if native_available() else 'not built'}",
        f"{machine.cpu}, {machine.threads} threads, {machine.device}",
    ]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
