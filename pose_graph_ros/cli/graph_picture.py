# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw diagrams of small graphs, each with the pattern of H, as SVG or PNG."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
import textwrap
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
import numpy as np

from pose_graph_ros.cli.diagram_legend import (
    CHARACTER,
    draw_legend_row,
    draw_symbol,
    legend,
    legend_rows,
    SMALL,
)
from pose_graph_ros.cli.diagram_style import (
    BLOCK,
    BORDER,
    FILL,
    FILLS,
    INK,
    LINE,
    SHAPES,
    SORT_COLOURS,
    TEXT,
)
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.offline.drawing.diagram import Diagram, Role, Vertex
from pose_graph_ros.offline.drawing.layout import Layout
from pose_graph_ros.offline.drawing.pattern import Pattern
from pose_graph_ros.offline.drawing.structure import Sort

DPI = 200
UNIT = 0.15     # radius of a node [inch]; less in a large diagram
LARGEST = 13.0  # width and height of a diagram [inch]
MARGIN, GAP = 0.12, 0.35  # around the picture, between diagram and pattern [inch]
TITLE, ROW, LINE_HEIGHT = 0.3, 0.22, 0.16  # of a title, the legend, and notes [inch]
COORDINATE, WIDEST = 0.06, 4.5  # of the pattern: a row, all of it [inch]
LEAST_WIDTH = 4.4
MEDIUM = 9.0  # size of titles [pt]
SETTINGS: dict[Any, Any] = {'svg.fonttype': 'none', 'svg.hashsalt': 'pose_graph_ros',
                            'font.family': ['DejaVu Sans', 'sans-serif']}


@dataclass(frozen=True, slots=True)
class Panel:
    """A diagram with its title and the pattern of H, if that is drawn."""

    title: str
    drawing: Diagram
    layout: Layout
    pattern: Pattern | None = None


def draw(panels: Sequence[Panel], path: Path, notes: Sequence[str], *, headings: bool) -> None:
    """
    Draw diagrams below each other into a file, on a transparent background.

    Parameters
    ----------
    panels : sequence of Panel
    path : Path, a `.svg` or `.png`
    notes : sequence of str, below the legend
    headings : bool, whether poses show where they head

    """
    boxes = [_box(panel) for panel in panels]
    sizes = np.array([high - low for low, high in boxes])
    unit = min(UNIT, LARGEST / float(np.max(sizes)))
    sides = [_side(panel.pattern) for panel in panels]
    column = float(np.max(sizes[:, 0])) * unit + GAP
    beside = column + max(sides) <= 1.3 * LARGEST
    column_of_patterns = max(sides) if beside else 0.0
    width = max(column + column_of_patterns - (GAP if max(sides) == 0.0 else 0.0),
                *sides, LEAST_WIDTH) + 2 * MARGIN
    rows = legend_rows(legend(
        [panel.drawing for panel in panels], [panel.pattern for panel in panels]),
        width - 2 * MARGIN)
    lines = [line for note in notes
             for line in textwrap.wrap(note, int((width - 2 * MARGIN) / CHARACTER))]
    heights = [(TITLE if panel.title else 0.0) + (
        max(size[1] * unit, side) if beside else size[1] * unit + side + GAP) + 0.1
        for panel, size, side in zip(panels, sizes, sides, strict=True)]
    height = sum(heights) + ROW * len(rows) + LINE_HEIGHT * len(lines) + 2 * MARGIN + 0.1
    with rc_context(SETTINGS):
        figure = Figure(figsize=(width, height), dpi=DPI)
        FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set_xlim(0.0, width)
        axes.set_ylim(0.0, height)
        top = height - MARGIN
        for panel, box, size, side, tall in zip(panels, boxes, sizes, sides, heights, strict=True):
            _draw_panel(axes, panel, unit, headings, (
                MARGIN, top, box, size[1] * unit, side, column if beside else 0.0))
            top -= tall
        top -= 0.1
        for row in rows:
            draw_legend_row(axes, row, MARGIN, top - 0.5 * ROW)
            top -= ROW
        for line in lines:
            axes.text(MARGIN, top - 0.5 * LINE_HEIGHT, line, size=SMALL, color=TEXT, va='center')
            top -= LINE_HEIGHT
        options = {'metadata': {'Date': None}} if path.suffix.lower() == '.svg' else {}
        figure.savefig(path, transparent=True, **options)


def _box(panel: Panel) -> tuple[FloatArray, FloatArray]:
    """Return the lower left and the upper right corner of a diagram [radii]."""
    at = panel.layout.at
    points = np.concatenate([at, *(
        _path(at[arc.start], corners, at[arc.end]) for arc, corners in zip(
            panel.drawing.arcs, panel.layout.corners, strict=True))])
    return np.min(points, axis=0) - 1.5, np.max(points, axis=0) + 1.5


def _draw_panel(
    axes: Axes, panel: Panel, unit: float, headings: bool,
    place: tuple[float, float, tuple[FloatArray, FloatArray], float, float, float],
) -> None:
    """Draw a panel, given left, top, box, height, side and left of the pattern [inch]."""
    left, top, box, height, side, column = place
    if panel.title:
        axes.text(left, top - 0.4 * TITLE, panel.title, size=MEDIUM, color=TEXT, va='center')
        top -= TITLE
    tall = max(height, side) if column > 0.0 else height
    low = np.array((left, top - 0.5 * (tall + height))) - unit * box[0]
    _draw_diagram(axes, panel, low, unit, headings)
    if panel.pattern is not None and side > 0.0:
        corner = ((left + column, top - 0.5 * (tall - side)) if column > 0.0
                  else (left, top - height - GAP))
        _draw_pattern(axes, panel.pattern, corner, side)


def _draw_diagram(
    axes: Axes, panel: Panel, low: FloatArray, unit: float, headings: bool,
) -> None:
    vertices, at = panel.drawing.vertices, low + unit * panel.layout.at
    for arc, corners in zip(panel.drawing.arcs, panel.layout.corners, strict=True):
        points = _path(at[arc.start], low + unit * corners, at[arc.end])
        points = _trimmed(points, unit * _reach(vertices[arc.start]),
                          unit * (_reach(vertices[arc.end]) + 0.1))
        colour = LINE if arc.sort is None else SORT_COLOURS[arc.sort]
        thin = min(unit / UNIT, 1.0)
        style = '-' if arc.used else (0, (3, 2))
        if arc.directed and len(points) > 1:
            points = _draw_arrow(axes, points, unit, colour)
        axes.plot(*points.T, color=colour, linewidth=1.4 * thin, linestyle=style,
                  solid_capstyle='butt', zorder=2, alpha=1.0 if arc.used else 0.6)
    for n, vertex in enumerate(vertices):
        if headings and vertex.role is Role.POSE:
            _draw_heading(axes, at[n], unit, panel.layout.headings[n])
        _draw_vertex(axes, vertex, at[n], unit)


def _path(start: FloatArray, corners: FloatArray, end: FloatArray) -> FloatArray:
    """Return the points of an arc: a line, a quadratic Bezier curve, or lines with corners."""
    if len(corners) != 1:
        return np.vstack((start, corners, end))
    t = np.linspace(0.0, 1.0, 33)[:, None]
    return np.asarray((1.0 - t)**2 * start + 2.0 * t * (1.0 - t) * corners + t**2 * end)


def _trimmed(points: FloatArray, start: float, end: float) -> FloatArray:
    """Return a path without what lies within distances of its ends."""
    for distance in (start, end):
        away = np.hypot(*(points - points[0]).T)
        first = int(np.argmax(away > distance))     # the others are all on one side of it
        if away[first] > distance:
            share = (distance - away[first - 1]) / (away[first] - away[first - 1])
            border = points[first - 1] + share * (points[first] - points[first - 1])
            points = np.vstack((border, points[first:]))
        points = points[::-1]
    return points


def _draw_arrow(axes: Axes, points: FloatArray, unit: float, colour: str) -> FloatArray:
    """Draw the head of an arrow; return the path without it."""
    tip = points[-1]
    shaft = _trimmed(points, 0.0, 0.75 * unit)
    way = tip - shaft[-1]
    length = float(np.hypot(*way))
    across = np.array((-way[1], way[0])) * (0.32 * unit / max(length, 1e-9))
    axes.add_patch(Polygon((tip, shaft[-1] + across, shaft[-1] - across), closed=True,
                           facecolor=colour, edgecolor='none', zorder=3))
    return shaft


def _reach(vertex: Vertex) -> float:
    """Return how far a vertex extends [radii]."""
    return {'square': 0.55, 'dot': 0.1}.get(SHAPES[vertex.role], 1.0)


def _draw_vertex(axes: Axes, vertex: Vertex, at: FloatArray, unit: float) -> None:
    fill = FILLS.get(vertex.role)
    if fill is None:
        fill = SORT_COLOURS[vertex.sort or Sort.PRIOR]
    draw_symbol(axes, SHAPES[vertex.role], fill, at, unit, fixed=vertex.fixed,
                opaque=1.0 if vertex.used else 0.5)
    if SHAPES[vertex.role] == 'circle':
        size = min(SMALL * min(unit / UNIT, 1.0), 72.0 * unit * (1.25 if vertex.fixed else 1.6) / (
            0.62 * max(len(vertex.name), 2)))
        axes.text(at[0], at[1], vertex.name, size=size, color=INK, ha='center',
                  va='center_baseline', zorder=6)


def _draw_heading(axes: Axes, at: FloatArray, unit: float, heading: float) -> None:
    """Draw a small triangle inside the border of a node."""
    way = np.array((np.cos(heading), np.sin(heading))) * unit
    across = np.array((-way[1], way[0]))
    axes.add_patch(Polygon((at + way, at + 0.68 * way + 0.3 * across,
                            at + 0.68 * way - 0.3 * across), closed=True,
                           facecolor=BORDER, edgecolor='none', zorder=6))


def _side(pattern: Pattern | None) -> float:
    """Return how wide and high a pattern is, with its names [inch]."""
    if pattern is None or len(pattern.names) == 0:
        return 0.0
    return min(COORDINATE * sum(pattern.sizes), WIDEST) + 0.32


def _draw_pattern(
    axes: Axes, pattern: Pattern, corner: tuple[float, float], side: float,
) -> None:
    """Draw the pattern of H, given its upper left corner [inch]."""
    ends = np.concatenate(([0], np.cumsum(pattern.sizes))) * (
        (side - 0.32) / sum(pattern.sizes))
    x, y = corner[0] + 0.3, corner[1] - 0.3
    axes.add_patch(Rectangle((x, y - ends[-1]), ends[-1], ends[-1], facecolor='none',
                             edgecolor=LINE, linewidth=0.8, zorder=4))
    for shown, colour in ((pattern.blocks, BLOCK), (pattern.fill, FILL)):
        for row, col in np.argwhere(shown).tolist():
            wide, tall = ends[col + 1] - ends[col], ends[row + 1] - ends[row]
            axes.add_patch(Rectangle(
                (x + ends[col], y - ends[row + 1]), wide, tall, facecolor=colour,
                edgecolor='#ffffff', linewidth=min(0.5, 3.0 * wide), zorder=3))
    longest = max(map(len, pattern.names))
    cell = float(np.min(np.diff(ends)))
    every = int(np.ceil(0.11 / cell))
    size = min(7.0, 72.0 * 0.28 / (0.62 * longest))
    for n in range(0, len(pattern.names), every):
        middle = 0.5 * (ends[n] + ends[n + 1])
        axes.text(x - 0.04, y - middle, pattern.names[n], size=size, color=TEXT, ha='right',
                  va='center')
        axes.text(x + middle, y + 0.04, pattern.names[n], size=size, color=TEXT, ha='center',
                  va='bottom', rotation=0 if longest * 0.0086 * size + 0.05 < cell * every else 90)
