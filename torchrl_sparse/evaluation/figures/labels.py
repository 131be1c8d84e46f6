"""Placement of scatter-plot labels without overlap of labels, points or intervals.

adjustText, tried on the committed results, leaves labels on markers and on each other where a dozen methods crowd.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backend_bases import RendererBase
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation
    from matplotlib.transforms import Bbox

__all__ = ["place_labels", "text_box"]

_DISTANCES = (9, 16, 26, 38, 52, 68, 90, 115)
_ANGLES = (0, 180, 45, 135, -45, -135, 20, 160, -20, -160, 90, -90)


def place_labels(
    figure: Figure,
    axes: Axes,
    points: Mapping[str, tuple[float, float]],
    intervals: Mapping[str, tuple[float, float]],
    colors: Mapping[str, str],
    fontsize: float = 10.5,
) -> None:
    """Write each name at the nearest free position around its point; distant labels get a line.

    Args:
        figure: drawn once, since only a drawn figure knows where things are.
        axes: already holding the points and with its final limits.
        points: name -> (x, y), data units.
        intervals: name -> (low, high) of the vertical bar through its point, data units.
        colors: name -> colour of the text.
        fontsize: points.
    """
    figure.canvas.draw()
    figure.set_layout_engine("none")  # a later layout pass would move the points away from their labels
    renderer = figure.canvas.get_renderer()
    frame = axes.get_window_extent(renderer)
    taken = _occupied(axes, points, intervals, renderer)
    for name in sorted(points, key=lambda name: points[name]):
        label = _best_label(
            (
                _annotate(axes, name, points[name], distance, angle, colors[name], fontsize)
                for distance, angle in _positions()
            ),
            taken,
            frame,
            renderer,
        )
        taken.append(text_box(label, renderer).padded(1))


def _occupied(
    axes: Axes,
    points: Mapping[str, tuple[float, float]],
    intervals: Mapping[str, tuple[float, float]],
    renderer: RendererBase,
) -> list[Bbox]:
    """Return the boxes of points, intervals and what is written already, pixels."""
    markers = [_around(axes.transData.transform(point), 7) for point in points.values()]
    ends = [
        axes.transData.transform([(x, limit) for limit in intervals[name]]) for name, (x, _) in points.items()
    ]
    bars = [_around(low, 2, high) for low, high in ends]
    return markers + bars + [text_box(text, renderer) for text in axes.texts]


def _best_label(
    candidates: Iterator[Annotation], taken: list[Bbox], frame: Bbox, renderer: RendererBase
) -> Annotation:
    """Keep the first candidate that is free, or else the one that covers least; remove the others."""
    label, best = None, math.inf
    for candidate in candidates:
        box = text_box(candidate, renderer)
        cost = sum(_overlap(box, other) for other in taken) + 10 * _outside(box, frame)
        if cost >= best - 1:
            candidate.remove()
            continue
        if label is not None:
            label.remove()
        label, best = candidate, cost
        if best == 0:
            break
    return label


def text_box(annotation: Annotation, renderer: RendererBase) -> Bbox:
    """Return the bounding box of an annotation's text, pixels; ``get_window_extent`` would include the line to its point."""
    from matplotlib.text import Text

    annotation.update_positions(renderer)
    return Text.get_window_extent(annotation, renderer)


def _positions() -> Iterator[tuple[float, float]]:
    return ((distance, angle) for distance in _DISTANCES for angle in _ANGLES)


def _annotate(
    axes: Axes,
    name: str,
    point: tuple[float, float],
    distance: float,
    angle: float,
    color: str,
    fontsize: float,
) -> Annotation:
    from matplotlib.patheffects import withStroke

    dx, dy = distance * math.cos(math.radians(angle)), distance * math.sin(math.radians(angle))
    line = {"arrowstyle": "-", "color": color, "alpha": 0.6, "shrinkA": 0, "shrinkB": 5}
    return axes.annotate(
        name,
        point,
        xytext=(dx, dy),
        textcoords="offset points",
        ha="center" if abs(dx) < 1 else "left" if dx > 0 else "right",
        va="center" if abs(dy) < 6 else "bottom" if dy > 0 else "top",
        color=color,
        fontsize=fontsize,
        fontweight="bold",
        path_effects=[withStroke(linewidth=3, foreground="white")],
        arrowprops=line if distance > 20 else None,
    )


def _around(start: tuple[float, float], radius: float, end: tuple[float, float] | None = None) -> Bbox:
    """Return the box ``radius`` pixels around a point, or around the vertical line from ``start`` up to ``end``."""
    from matplotlib.transforms import Bbox

    end = start if end is None else end
    return Bbox.from_extents(start[0] - radius, start[1] - radius, end[0] + radius, end[1] + radius)


def _overlap(one: Bbox, other: Bbox) -> float:
    """Return the shared area, square pixels."""
    width = min(one.x1, other.x1) - max(one.x0, other.x0)
    height = min(one.y1, other.y1) - max(one.y0, other.y0)
    return max(width, 0.0) * max(height, 0.0)


def _outside(box: Bbox, frame: Bbox) -> float:
    """Return the area of ``box`` that lies outside ``frame``, square pixels."""
    return box.width * box.height - _overlap(box, frame)
