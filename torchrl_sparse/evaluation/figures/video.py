"""Videos of rollouts: camera frames above a status bar of the policy."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["Caption", "add_caption", "write_video"]

_BAR = (24, 24, 28)
_TEXT = (236, 236, 240)
_DIM = (150, 150, 158)
_QUERY = (242, 153, 74)
_SUCCESS = (76, 187, 122)


@dataclass(frozen=True)
class Caption:
    """Text of the status bar under a frame.

    Attributes:
        method: name of the method.
        step: environment step of the episode.
        queried: whether this step called the policy; lights the lamp.
        latency: seconds of the latest policy call, None before the first.
        success: whether the task is solved.
    """

    method: str
    step: int
    queried: bool = False
    latency: float | None = None
    success: bool = False


def write_video(
    frames: Sequence[np.ndarray],
    path: str | os.PathLike,
    *,
    captions: Sequence[Caption] | None = None,
    fps: float = 20.0,
    hold: float = 1.0,
) -> Path:
    """Write an H.264 mp4 file atomically.

    Args:
        frames: u8 [h, w, 3] images of one size, at least one.
        path: of the mp4.
        captions: one per frame, drawn by :func:`add_caption`; none for bare frames.
        fps: frames a second; 20 is the control rate of the tasks.
        hold: seconds for which the last frame stays.

    Raises:
        InputError: if there is no frame, a frame has another shape or type, or captions do not match.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "rollout.mp4"
    >>> frames = [np.full((64, 96, 3), 20 * step, np.uint8) for step in range(5)]
    >>> write_video(frames, path, captions=[Caption("dense", step) for step in range(5)]).stat().st_size > 0
    True
    """
    import imageio.v3 as iio

    if not len(frames):
        raise InputError("frames: expected at least one, got none")
    if captions is not None and len(captions) != len(frames):
        raise InputError(f"captions: expected one per frame, {len(frames)}, got {len(captions)}")
    shape = np.shape(frames[0])
    for index, frame in enumerate(frames):
        _check_frame(frame, shape, index)
    if captions is not None:
        frames = [add_caption(frame, caption) for frame, caption in zip(frames, captions, strict=True)]
    frames = [*frames, *[frames[-1]] * round(hold * fps)]
    with atomic_path(path) as temporary, iio.imopen(temporary, "w", plugin="pyav") as file:
        file.init_video_stream("libx264", fps=fps, pixel_format="yuv420p")
        for frame in frames:
            file.write_frame(_even(frame))
    return Path(path)


def add_caption(frame: np.ndarray, caption: Caption) -> np.ndarray:
    """Add a two-line bar under the frame: method and step; the latest policy call, with a lamp lit at calls.

    Args:
        frame: u8 [h, w, 3].
        caption: what to write.

    Returns:
        u8 [h + bar, w, 3].
    """
    from PIL import Image, ImageDraw

    height, width = frame.shape[:2]
    size = max(10, round(width / 20))
    margin, line = 0.7 * size, 1.5 * size
    image = Image.new("RGB", (width, height + round(2 * line + 0.6 * size)), _BAR)
    image.paste(Image.fromarray(frame), (0, 0))
    draw = ImageDraw.Draw(image)
    upper, lower = height + 0.3 * size + line / 2, height + 0.3 * size + 1.5 * line
    left, right, regular = margin, width - margin, _font(size)
    draw.text((left, upper), caption.method, _TEXT, _font(size, bold=True), anchor="lm")
    draw.text((right, upper), f"step {caption.step}", _TEXT, regular, anchor="rm")
    radius = 0.32 * size
    draw.ellipse(
        (left, lower - radius, left + 2 * radius, lower + radius),
        fill=_QUERY if caption.queried else None,
        outline=_QUERY if caption.queried else _DIM,
    )
    if caption.latency is not None:
        color = _TEXT if caption.queried else _DIM
        text = f"policy call {1e3 * caption.latency:.0f} ms"
        draw.text((left + 3.5 * radius, lower), text, color, regular, anchor="lm")
    if caption.success:
        draw.text((right, lower), "solved", _SUCCESS, _font(size, bold=True), anchor="rm")
    return np.asarray(image)


def _check_frame(frame: np.ndarray, shape: tuple[int, ...], index: int) -> None:
    fits = isinstance(frame, np.ndarray) and frame.dtype == np.uint8 and frame.shape == shape
    if not fits or len(shape) != 3 or shape[2] != 3:
        got = f"{getattr(frame, 'dtype', type(frame).__name__)} {list(np.shape(frame))}"
        raise InputError(f"frames[{index}]: expected uint8 [h, w, 3], all of one size, got {got}")


def _even(frame: np.ndarray) -> np.ndarray:
    """Pad to even sides: the usual chroma subsampling of H.264 takes no odd ones."""
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


@lru_cache(maxsize=8)
def _font(size: int, bold: bool = False):
    """Load DejaVu Sans, which matplotlib brings along, so that videos look the same on every machine."""
    import matplotlib
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(os.path.join(matplotlib.get_data_path(), "fonts", "ttf", name), size)
