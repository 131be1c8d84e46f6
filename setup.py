"""Builds the native engine and the compiled substeps of robosuite. Everything else about the package is in pyproject.toml.

The extensions are optional: without a C++ compiler the package installs all the same, runs on its PyTorch engine and steps
robosuite in Python. They are plain shared libraries without Python's or PyTorch's headers. Instruction sets are chosen at run
time, so there is no -march.
"""

from pathlib import Path

from setuptools import Extension, find_packages, setup

FOLDER = Path("torchrl_sparse/blocks/engine/native")

NATIVE = Extension(
    "torchrl_sparse.blocks.engine.native._native",
    sources=[str(FOLDER / "native.cpp")],
    depends=[str(header) for header in sorted(FOLDER.glob("*.h"))],
    # A product may be fused with a sum; nothing else that changes results is allowed.
    extra_compile_args=[
        "-g0",
        "-std=c++17",
        "-O3",
        "-ffp-contract=fast",
        "-fno-math-errno",
        "-fvisibility=default",
        "-pthread",
    ],
    extra_link_args=["-pthread"],
    optional=True,
)

# To the same bits as robosuite's Python: no product may be fused with a sum.
PERIOD = Extension(
    "torchrl_sparse.envs.period._period",
    sources=["torchrl_sparse/envs/period/period.cpp"],
    extra_compile_args=["-g0", "-std=c++17", "-O2", "-ffp-contract=off", "-fvisibility=hidden"],
    optional=True,
)

# Recipes, and a policy to begin with, lie beside the package here and within it where a wheel brings them.
BESIDE = {
    "torchrl_sparse.recipes": "recipes",
    "torchrl_sparse.recipes.examples": "recipes/examples",
    "torchrl_sparse.recipes.sweeps": "recipes/sweeps",
    "torchrl_sparse.assets.lift": "assets/lift",
}

setup(
    ext_modules=[NATIVE, PERIOD],
    packages=[*find_packages(include=["torchrl_sparse*"]), *BESIDE],
    package_dir=BESIDE,
    package_data={
        "torchrl_sparse": [
            "py.typed",
            "evaluation/figures/*.jinja",
            "blocks/engine/native/*.[ch]*",
            "blocks/engine/native/CMakeLists.txt",
            "envs/period/period.cpp",
        ],
        "torchrl_sparse.recipes": ["*.yaml"],
        "torchrl_sparse.recipes.sweeps": ["*.yaml"],
        "torchrl_sparse.assets.lift": ["config.json", "model.safetensors", "bac*.json"],
    },
)
