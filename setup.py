"""Builds the native engine. Everything else about the package is in pyproject.toml.

The extension is optional: without a C++ compiler the package installs all the same and runs on its PyTorch engine. It is a
plain shared library without Python's or PyTorch's headers. Instruction sets are chosen at run time, so there is no -march.
"""

from pathlib import Path

from setuptools import Extension, setup

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

setup(ext_modules=[NATIVE])
