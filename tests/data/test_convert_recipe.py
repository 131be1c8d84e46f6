"""One recipe for every published file: its format is found, what needs no conversion is only rendered, a kill loses nothing."""

import sys

import h5py
import numpy as np
import pytest

from tests.data.published_demos import env_args_15, record, write
from tests.data.test_pusht_human import recording
from tests.recipe_modules import load_recipe
from torchrl_sparse.data.demos import Collection, collect
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task

LIFT = find_robosuite_task("Lift")
SEEN = ("cameras=[birdview]", "image_size=16")  # which robomimic's files have no images of


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Two demonstrations of three steps with deltas, as robomimic publishes them."""
    env = RobosuiteEnv(LIFT.name, action_mode="delta")
    demos = [record(env, seed, 3) for seed in (1, 2)]
    env.close()
    return write(tmp_path_factory.mktemp("published") / "low_dim_v15.hdf5", demos, env_args_15(LIFT))


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    path = tmp_path_factory.mktemp("collected") / "lift.h5"
    collect(path, Collection("Lift", episodes=1, seed=50))
    return path


@pytest.fixture
def pusht(tmp_path):
    np.savez(tmp_path / "human.npz", **recording())
    return tmp_path / "human.npz"


@pytest.fixture
def convert(monkeypatch, capsys, tmp_path):
    """Runs the recipe into ``tmp_path/out/made.h5``; returns what it says, and that path."""

    def convert(demos, *options, expect=0):
        out = tmp_path / "out" / "made.h5"
        monkeypatch.setattr(sys, "argv", ["convert_demos.py", f"demos={demos}", f"out={out}", *options])
        try:
            load_recipe("convert_demos").main()
        except RuntimeError as error:
            if "GL library" in str(error):
                pytest.skip(str(error))
            raise
        except SystemExit:
            printed = capsys.readouterr().err.strip()
            assert expect == 2, printed
            return printed, out
        assert expect == 0
        return capsys.readouterr().out.strip(), out

    return convert


def arrays(path):
    with h5py.File(path) as file:
        return {
            name: file["data"][name][()] for name in ("demo_0/actions", "demo_0/states", "demo_0/obs/object")
        }


def test_a_published_file_is_converted_and_rendered_at_once(convert, published):
    said, out = convert(published, *SEEN)
    assert said == f"{out}: 2 demonstrations with absolute actions, images of birdview"
    assert [path.name for path in out.parent.iterdir()] == ["made.h5"]
    plain = convert(
        published
    )  # whose actions and observations rendering leaves alone, so that the file is taken as made
    assert plain[0] == f"{out}: 2 demonstrations with absolute actions"
    with h5py.File(out) as file:
        assert file["data/demo_1/obs/birdview_image"].shape == (3, 16, 16, 3)
        assert file["data/demo_1/obs/birdview_image"][()].std() > 5
        assert np.abs(file["data/demo_0/actions"][:, 2]).min() > 0.5  # a height in the world, no delta


def test_what_was_converted_before_a_kill_is_rendered_only(convert, published, monkeypatch):
    with monkeypatch.context() as killed:
        killed.setattr("torchrl_sparse.data.rendering.RobosuiteEnv.render", _kill)
        with pytest.raises(KeyboardInterrupt):
            convert(published, *SEEN)
    monkeypatch.setattr("torchrl_sparse.data.absolute.AbsoluteActions", None)  # converting again would fail
    _, out = convert(published, *SEEN)
    assert [path.name for path in out.parent.iterdir()] == ["made.h5"]


def _kill(*args, **options):
    raise KeyboardInterrupt


def test_what_this_library_collected_is_rendered_as_it_is(convert, collected):
    """Recomputed observations are those of the recorded state, one physics step (2 ms) later than a running simulator's."""
    said, out = convert(collected, *SEEN)
    assert said == f"{out}: images of birdview"
    for name, values in arrays(collected).items():
        np.testing.assert_array_equal(arrays(out)[name], values)


def test_format_robomimic_makes_observations_anew(convert, collected):
    said, out = convert(collected, "format=robomimic", *SEEN)
    assert said == f"{out}: 1 demonstrations with absolute actions, images of birdview"
    before, after = arrays(collected), arrays(out)
    np.testing.assert_array_equal(after["demo_0/actions"], before["demo_0/actions"])
    difference = np.abs(after["demo_0/obs/object"] - before["demo_0/obs/object"]).max()
    assert 0 < difference < 2e-2


def test_pusht_is_found_by_its_content(convert, pusht):
    named_otherwise = pusht.rename(pusht.with_suffix(".bin"))
    said, out = convert(named_otherwise)
    assert said == f"{out}: 2 demonstrations"
    with h5py.File(out) as file:
        assert file["data/demo_1/obs/state"].shape == (4, 20)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["format=robomimic"], "human.npz: expected a complete HDF5 file"),
        (SEEN, "cameras: expected [] of Push-T, which is not rendered, got ['birdview']"),
        (["poses=true"], "poses: expected false of Push-T, whose actions are positions, got true"),
        (["format=zarr"], "format: expected 'robomimic' or 'pusht', got 'zarr'"),
    ],
)
def test_what_pusht_has_not_is_refused(convert, pusht, options, message):
    said, out = convert(pusht, *options, expect=2)
    assert message in said
    assert not out.parent.exists()


def test_a_camera_is_added_to_a_file_that_has_another_and_none_twice(convert, published):
    _, out = convert(published, *SEEN)
    once = out.rename(out.with_name("once.h5"))
    convert(once, "cameras=[frontview]", "image_size=16")
    with h5py.File(out) as file:
        assert {"birdview_image", "frontview_image", "object_positions"} < {*file["data/demo_0/obs"]}
    said, _ = convert(once, *SEEN, expect=2)
    expected = f"{once}, demo_0: cameras: expected ones that it has no images of, got birdview"
    assert said.splitlines()[-1] == expected


def test_the_other_format_is_named(convert, collected):
    said, out = convert(collected, "format=pusht", expect=2)
    assert said.endswith("lift.h5: expected a complete npz file, got another or a part of one")
    assert not out.parent.exists()


def test_pushts_demonstrations_are_not_rendered(convert, pusht):
    """A converted file has no camera either: its task is none of robosuite."""
    _, converted = convert(pusht)
    source = converted.rename(pusht.with_name("converted.h5"))
    said, out = convert(source, *SEEN, expect=2)
    assert "converted.h5, env_args" in said
    assert not out.exists()
