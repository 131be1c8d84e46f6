import os

import imageio.v3 as iio
import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.figures.video import Caption, add_caption, write_video


def frames(count=12, height=120, width=160):
    return [np.full((height, width, 3), 15 * index, dtype=np.uint8) for index in range(count)]


def test_video_decodes_to_the_frames(tmp_path):
    path = write_video(frames(), tmp_path / "videos" / "rollout.mp4", fps=10, hold=0.5)
    decoded = iio.imread(path, plugin="pyav")
    assert decoded.shape == (12 + 5, 120, 160, 3)
    assert abs(float(decoded[6].mean()) - 15 * 6) < 5
    assert abs(float(decoded[-1].mean()) - 15 * 11) < 5
    assert iio.immeta(path, plugin="pyav")["fps"] == pytest.approx(10)
    assert os.listdir(path.parent) == ["rollout.mp4"]


def test_odd_sizes_are_padded(tmp_path):
    path = write_video(frames(3, 61, 83), tmp_path / "odd.mp4", hold=0)
    assert iio.imread(path, plugin="pyav").shape == (3, 62, 84, 3)


def test_caption_is_a_bar_below_an_untouched_frame():
    frame = frames(8)[7]
    captioned = add_caption(frame, Caption("bac", 12, queried=True, latency=0.19))
    assert captioned.shape[0] > frame.shape[0]
    assert captioned.shape[1:] == frame.shape[1:]
    np.testing.assert_array_equal(captioned[: frame.shape[0]], frame)
    assert captioned[frame.shape[0] :].std() > 10


def test_caption_tells_states_apart():
    frame = frames(1)[0]
    captions = [
        Caption("bac", 12),
        Caption("dense", 12),
        Caption("bac", 13),
        Caption("bac", 12, queried=True),
        Caption("bac", 12, latency=0.19),
        Caption("bac", 12, success=True),
    ]
    bars = [add_caption(frame, caption).tobytes() for caption in captions]
    assert len(set(bars)) == len(captions)


def test_captioned_video(tmp_path):
    captions = [Caption("bac_blockwise", step, step % 8 == 0, 0.2) for step in range(12)]
    path = write_video(frames(), tmp_path / "rollout.mp4", captions=captions, hold=0)
    assert iio.imread(path, plugin="pyav").shape[1] > 120


@pytest.mark.parametrize(
    ("images", "captions", "entry"),
    [
        ([], None, "frames"),
        (frames(2), [Caption("bac", 0)], "captions"),
        ([np.zeros((4, 4, 3))], None, "frames[0]"),
        ([*frames(2), *frames(1, 64, 64)], None, "frames[2]"),
        ([np.zeros((4, 4), np.uint8)], None, "frames[0]"),
    ],
)
def test_faults_leave_no_file(tmp_path, images, captions, entry):
    with refused(entry):
        write_video(images, tmp_path / "rollout.mp4", captions=captions)
    assert os.listdir(tmp_path) == []
