"""Placing the labels of a scatter plot so that they do not cover each other, the points or their
intervals."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

__all__ = ["place_labels"]

_DISTANCES = (9, 16, 26, 38, 52, 68, 90, 115)
_ANGLES = (0, 180, 45, 135, -45, -135, 20, 160, -20, -160, 90, -90)


def place_labels(
    figure: "Figure",
    axes: "Axes",
    points: Mapping[str, tuple[float, float]],
    intervals: Mapping[str, tuple[float, float]],
    colors: Mapping[str, str],
    fontsize: float = 10.5,
) -> None:
    """Write each name beside its point, at the nearest of a fan of positions that is free; far ones get a
    line.

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
    taken = [_around(axes.transData.transform(point), 7) for point in points.values()]
    for name, (x, _) in points.items():
        ends = axes.transData.transform([(x, limit) for limit in intervals[name]])
        taken.append(_around(ends[0], 2, ends[1]))
    taken += [text_box(text, renderer) for text in axes.texts]
    frame = axes.get_window_extent(renderer)
    for name in sorted(points, key=lambda name: points[name]):
        label = None
        best = None
        for offset, angle in _positions():
            candidate = _annotate(axes, name, points[name], offset, angle, colors[name], fontsize)
            box = text_box(candidate, renderer)
            cost = sum(_overlap(box, other) for other in taken) + 10 * _outside(box, frame)
            if best is None or cost < best - 1:
                if label is not None:
                    label.remove()
                label, best = candidate, cost
            else:
                candidate.remove()
            if best == 0:
                break
        taken.append(text_box(label, renderer).padded(1))


def text_box(annotation, renderer) -> "Bbox":
    """Where the words of an annotation are, pixels; its own ``get_window_extent`` includes the line to its
    point."""
    from matplotlib.text import Text

    annotation.update_positions(renderer)
    return Text.get_window_extent(annotation, renderer)


def _positions():
    return ((distance, angle) for distance in _DISTANCES for angle in _ANGLES)


def _annotate(axes, name, point, distance, angle, color, fontsize):
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


def _around(start, radius: float, end=None) -> "Bbox":
    """The box ``radius`` pixels around a point, or around the vertical line from ``start`` up to ``end``."""
    from matplotlib.transforms import Bbox

    end = start if end is None else end
    return Bbox.from_extents(start[0] - radius, start[1] - radius, end[0] + radius, end[1] + radius)


def _overlap(one: "Bbox", other: "Bbox") -> float:
    """Shared area, square pixels."""
    width = min(one.x1, other.x1) - max(one.x0, other.x0)
    height = min(one.y1, other.y1) - max(one.y0, other.y0)
    return max(width, 0.0) * max(height, 0.0)


def _outside(box: "Bbox", frame: "Bbox") -> float:
    """Area of ``box`` that lies outside ``frame``, square pixels."""
    return box.width * box.height - _overlap(box, frame)
