# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Symbols of diagrams, and the legend that explains those that a picture has."""

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle
import numpy as np

from pose_graph_ros.cli.diagram_style import (
    BLOCK,
    BORDER,
    FILL,
    FILLS,
    LINE,
    SHAPES,
    SORT_COLOURS,
    TEXT,
)
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.offline.drawing.diagram import Diagram, Role, View
from pose_graph_ros.offline.drawing.pattern import Pattern

SMALL = 8.0     # size of text [pt]
CHARACTER = 0.07  # mean width of one of its letters [inch]
SYMBOL, BORDERED = 0.08, 0.15
"""Radius of a symbol of the legend, and of one whose border has its full width [inch]."""


class Entry(NamedTuple):
    """A line of a legend."""

    what: str
    """`circle`, `square`, `dot`, `fixed`, `line` or `cell`."""
    colour: str
    words: str


def draw_symbol(
    axes: Axes, shape: str, fill: str, at: FloatArray, radius: float, *, fixed: bool = False,
    opaque: float = 1.0,
) -> None:
    """
    Draw a circle, a square or a dot.

    Parameters
    ----------
    axes : Axes
    shape, fill : str
    at : ndarray, shape (2,) [inch]
    radius : float, of a circle [inch]
    fixed : bool, whether with a second border
    opaque : float, 0 to 1

    """
    x, y = at.tolist()
    line = 1.3 * min(radius / BORDERED, 1.0)
    if shape == 'square':
        axes.add_patch(Rectangle(
            (x - 0.5 * radius, y - 0.5 * radius), radius, radius, facecolor=fill,
            edgecolor=BORDER, linewidth=0.7 * line, zorder=5))
    elif shape == 'dot':
        axes.add_patch(Circle((x, y), 0.25 * radius, facecolor=fill, edgecolor='none', zorder=5))
    else:
        # a light rim, so that the black border shows on a dark background
        axes.add_patch(Circle((x, y), 1.1 * radius, facecolor='#ffffff', edgecolor='none',
                              zorder=4))
        axes.add_patch(Circle((x, y), radius, facecolor=fill, edgecolor=BORDER, linewidth=line,
                              zorder=5, alpha=opaque))
        if fixed:
            axes.add_patch(Circle((x, y), 0.78 * radius, facecolor='none', edgecolor=BORDER,
                                  linewidth=0.7 * line, zorder=5))


def legend(
    drawings: Sequence[Diagram], patterns: Sequence[Pattern | None],
) -> list[Entry]:
    """Return what the legend of diagrams of the same view and patterns explains, in order."""
    vertices = [vertex for drawing in drawings for vertex in drawing.vertices]
    roles, view = {vertex.role for vertex in vertices}, drawings[0].view
    sorts = {vertex.sort for vertex in vertices if vertex.role not in FILLS}
    entries = []
    for role in Role:
        if role in roles and role in FILLS:
            entries.append(Entry(SHAPES[role], FILLS[role], role.value))
        elif role in roles:
            entries += [Entry(SHAPES[role], SORT_COLOURS[sort], f'{role.value}: {sort.value}')
                        for sort in SORT_COLOURS if sort in sorts]
    if any(vertex.fixed for vertex in vertices):
        entries.append(Entry('fixed', '#ffffff', 'fixed (known)'))
    if view is View.MRF:
        entries.append(Entry('line', LINE, 'in a term together'))
    elif view is not View.FACTOR_GRAPH:
        lines = {arc.sort for drawing in drawings for arc in drawing.arcs} - sorts
        entries += [Entry('line', SORT_COLOURS[sort], sort.value) for sort in SORT_COLOURS
                    if sort in lines]
    if any(pattern is not None for pattern in patterns):
        entries.append(Entry('cell', BLOCK, 'block of H that is not zero'))
    if any(pattern is not None and np.any(pattern.fill) for pattern in patterns):
        entries.append(Entry('cell', FILL, 'fill of its factor R'))
    return entries


def legend_rows(entries: Sequence[Entry], width: float) -> list[list[tuple[float, Entry]]]:
    """
    Return the lines of a legend, each entry with where it begins [inch].

    Parameters
    ----------
    entries : sequence of Entry
    width : float [inch]

    """
    rows: list[list[tuple[float, Entry]]] = []
    x = np.inf
    for entry in entries:
        wide = 0.45 + CHARACTER * len(entry.words)
        if x + wide > width:
            rows.append([])
            x = 0.0
        rows[-1].append((x, entry))
        x += wide
    return rows


def draw_legend_row(
    axes: Axes, row: Sequence[tuple[float, Entry]], left: float, y: float,
) -> None:
    """
    Draw a line of a legend.

    Parameters
    ----------
    axes : Axes
    row : sequence of (where it begins [inch], Entry)
    left, y : float [inch]

    """
    for begin, (what, colour, words) in row:
        x = left + begin
        at = np.array((x + 0.11, y))
        if what == 'line':
            axes.plot((x, x + 0.22), (y, y), color=colour, linewidth=1.6, solid_capstyle='butt')
        elif what == 'cell':
            axes.add_patch(Rectangle((x + 0.05, y - 0.06), 0.12, 0.12, facecolor=colour,
                                     edgecolor='none'))
        else:
            draw_symbol(axes, what, colour, at, 0.12 if what in {'square', 'dot'} else SYMBOL,
                        fixed=what == 'fixed')
        axes.text(x + 0.29, y, words, size=SMALL, color=TEXT, va='center')
