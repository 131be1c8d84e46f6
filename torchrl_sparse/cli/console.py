"""The command ``torchrl-sparse``: runs every recipe from any folder, and describes the installation for bug reports.

::

    torchrl-sparse                                  # the recipes, a line each, in the order in which they are used
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

from torchrl_sparse.runtime.names import did_you_mean

__all__ = ["RECIPES", "main"]

RECIPES = {
    "Data": ("collect_demos", "convert_demos"),
    "Training": ("train_policy", "train_vla", "evaluate_policy"),
    "Acceleration": (
        *("accelerate", "calibrate_bac", "calibrate_timesteps", "calibrate_tokens"),
        "train_pruner",
    ),
    "Evaluation": (
        *("plan", "benchmark", "benchmark_vla", "realtime", "profile", "sweep"),
        *("compare", "report"),
    ),
    "Robots": ("serve",),
}
"""What one wants -> the recipes for it, all in the order in which they are used."""

# scripts of these names would hide libraries: one that diffusers imports, and the standard one that PyTorch does
_SCRIPTS = {"accelerate": "accelerate_policy", "profile": "profile_policy"}
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0, or 2 for an unknown recipe.

    >>> main(["nope"])
    2
    """
    name, *options = [*(sys.argv[1:] if arguments is None else arguments)] or ["--help"]
    names = [recipe for group in RECIPES.values() for recipe in group]
    if name in ("--help", "-h"):
        print("\n".join(_listing()))
    elif name == "env":
        print("\n".join(_environment()))
    elif name in (*names, *_SCRIPTS.values()):
        script = str(_script(name))
        sys.argv = [script, *options]
        runpy.run_path(script, run_name="__main__")
    else:
        guess = did_you_mean(name, ["env", *names])
        print(f"expected a recipe, got {name!r}{guess}; torchrl-sparse alone lists them", file=sys.stderr)
        return 2
    return 0


def _listing() -> list[str]:
    """Return the lines of all recipes, grouped, none of 80 columns."""
    lines = ["torchrl-sparse RECIPE [OPTION=VALUE ...]", "torchrl-sparse RECIPE --help    shows its options"]
    for title, names in RECIPES.items():
        lines += ["", title, *(f"  {name:<19}  {_purpose(_script(name))}" for name in names)]
    return [*lines, "", "Installation", f"  {'env':<19}  Show versions, engine and machine, for a report"]


def _script(name: str) -> Path:
    """Return a recipe's program: within the package where a wheel brought it, beside it in a repository."""
    package = Path(__file__).parents[1]
    installed = package / "recipes"
    folder = installed if installed.is_dir() else package.parent / "recipes"
    return folder / f"{_SCRIPTS.get(name, name)}.py"


def _purpose(path: Path) -> str:
    """Return the first line of a recipe's docstring without its full stop, without importing it."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0].removesuffix(".")


def _environment() -> list[str]:
    from torchrl_sparse.blocks.engine import native_available
    from torchrl_sparse.evaluation.latency.measure import describe_machine

    machine, (built, told) = describe_machine(), native_available()
    return [
        f"python {platform.python_version()}, {platform.platform()}",
        *(f"{name} {_version(name)}" for name in _REPORTED),
        f"native engine: {told if built else f'not available, {told}'}",
        f"{machine.cpu}, {machine.threads} threads, {machine.device}",
    ]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
