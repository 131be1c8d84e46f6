import imageio.v3 as iio
import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.training.curves import plot_pruner_curves, read_scalars


@pytest.fixture
def folder(tmp_path):
    steps = np.arange(5, 105, 5)
    values = {"train/fidelity": 1 / steps, "held_out/error": 2 / steps}
    values |= {f"train/rate_{name}": steps / 110 for name in ("cost", "SA", "CA", "FFN")}
    for name, curve in values.items():
        path = tmp_path / "scalars" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{step},{value}\n" for step, value in zip(steps, curve, strict=True)))
    return tmp_path


def test_curves_are_read_and_drawn(folder):
    curves = read_scalars(folder)
    assert curves["train/fidelity"][1].tolist() == [10, 0.1]
    image = iio.imread(plot_pruner_curves(curves, folder / "curves.png", rate=0.91))
    assert image.shape[1] == 900
    assert image.std() > 5


def test_what_a_resumed_training_logged_twice_counts_once(folder):
    path = folder / "scalars" / "train" / "fidelity.csv"
    path.write_text(path.read_text() + "95,7.0\n100,8.0\n")
    curve = read_scalars(folder)["train/fidelity"]
    assert curve[-2:].tolist() == [[95, 7], [100, 8]]
    assert (np.diff(curve[:, 0]) > 0).all()


def test_missing_curves_and_folders_are_named(folder, tmp_path):
    (folder / "scalars" / "train" / "rate_SA.csv").unlink()
    with refused("curves"):
        plot_pruner_curves(read_scalars(folder), folder / "curves.png", rate=0.9)
    with refused("scalars", FileNotFoundError):
        read_scalars(tmp_path / "nowhere")
