"""What is installed: a command that runs every recipe from any folder, and distributions that install."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.cli.console import main

ROOT = Path(__file__).parents[1]


def test_the_command_lists_every_recipe_with_its_purpose_in_the_order_of_use(capsys):
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) < 80
    names = [line.split()[0] for line in lines if line.startswith("  ")]
    scripts = {path.stem.removesuffix("_policy") for path in (ROOT / "recipes").glob("*.py")}
    assert {name.removesuffix("_policy") for name in names} == scripts | {"env"}
    order = ["collect_demos", "train_policy", "accelerate", "benchmark", "profile"]
    assert [name for name in names if name in order] == order
    assert all(len(line.split()) > 4 for line in lines if line.startswith("  "))


@pytest.mark.parametrize(
    ("name", "guess"),
    [
        ("benchmrak", ", did you mean benchmark?"),
        ("profile_query", ", did you mean profile?"),
        ("convert_robomimic", ", did you mean convert_demos?"),
        ("nonsense", ""),
    ],
)
def test_an_unknown_recipe_is_one_line(capsys, name, guess):
    assert main([name]) == 2
    expected = f"expected a recipe, got {name!r}{guess}; torchrl-sparse alone lists them\n"
    assert capsys.readouterr().err == expected


def test_short_and_long_names_lead_to_one_recipe(capsys):
    told = []
    for name in ("profile", "profile_policy"):
        assert main([name, "--help"]) == 0
        told.append(capsys.readouterr().out)
    assert told[0] == told[1]
    assert told[0].startswith("Find out where the time of one policy call goes.\n")


def test_a_fault_can_be_reported_with_the_installation(capsys):
    assert main(["env"]) == 0
    told = capsys.readouterr().out
    assert "torchrl 0." in told
    built, which = native_available()
    assert f"native engine: {which if built else f'not available, {which}'}\n" in told


def test_an_engine_that_cannot_run_is_told_with_the_reason(capsys, monkeypatch):
    monkeypatch.setattr("torchrl_sparse.blocks.engine.native_available", lambda: (False, "it was not built"))
    assert main(["env"]) == 0
    assert "native engine: not available, it was not built\n" in capsys.readouterr().out


def test_a_recipe_runs_from_any_folder_with_overrides(tmp_path):
    command = [sys.executable, "-c", "from torchrl_sparse.cli.console import main; main()"]
    options = ["calibrate_bac", f"policy={ROOT}/assets/lift", "methods=[bac_unified]", f"out={tmp_path}/made"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([*command, *options], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["bac_unified.json"]


def test_the_citation_names_this_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert f'version = "{cited["version"]}"' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("compiler", [None, "/bin/false"], ids=["compiler", "no_compiler"])
def test_distributions_install_with_and_without_a_compiler(tmp_path, compiler):
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns(
        ".git", ".venv", "build", "dist", "*.so", "*.egg-info", "episodes", "figures"
    )
    shutil.copytree(ROOT, source, ignore=ignored)
    environment = os.environ if compiler is None else os.environ | {"CC": compiler, "CXX": compiler}

    def pip(*arguments):
        command = [sys.executable, "-m", "pip", "-q", *arguments]
        subprocess.run(command, check=True, cwd=tmp_path, env=environment)

    pip("install", "--target", str(tmp_path / "tools"), "build")
    environment = environment | {"PYTHONPATH": str(tmp_path / "tools")}
    subprocess.run([sys.executable, "-m", "build", str(source)], check=True, cwd=tmp_path, env=environment)
    (wheel,), (sdist,) = source.glob("dist/*.whl"), source.glob("dist/*.tar.gz")
    names = zipfile.ZipFile(wheel).namelist()
    for packed in (
        "recipes/benchmark.yaml",
        "recipes/examples/robot_loop.py",
        "assets/lift/model.safetensors",
        "py.typed",
        "policies/__init__.pyi",
    ):
        assert f"torchrl_sparse/{packed}" in names
    assert any(name.endswith(".so") for name in names) == (compiler is None)
    with tarfile.open(sdist) as archive:
        for packed in ("native.cpp", "torchrl_sparse/py.typed"):
            assert any(name.endswith(packed) for name in archive.getnames())
    pip("install", "--no-deps", "--target", str(tmp_path / "installed"), str(wheel))
    code = "import torchrl_sparse, sys; from torchrl_sparse.cli.console import main; print(torchrl_sparse.__file__); main([])"
    outside = {name: value for name, value in environment.items() if name != "PYTHONPATH"}
    outside["PYTHONPATH"] = str(tmp_path / "installed")
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=outside, capture_output=True, text=True, check=True
    )
    assert str(tmp_path / "installed") in done.stdout
    assert "benchmark" in done.stdout
