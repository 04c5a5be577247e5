# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write diagrams in the language of Graphviz, with the places that pictures have."""

from collections.abc import Sequence

from pose_graph_ros.cli import diagram_style as style
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.offline.drawing.diagram import Arc, Diagram, Vertex
from pose_graph_ros.offline.drawing.layout import Layout

UNIT = 0.2      # radius of a node [inch]
_SHAPES = {'circle': ('circle', 2.0), 'square': ('square', 1.0), 'dot': ('point', 0.5)}


def dot_text(panels: Sequence[tuple[str, Diagram, Layout]], notes: Sequence[str]) -> str:
    """
    Return the text of a graph for Graphviz, with one cluster for each diagram.

    Parameters
    ----------
    panels : sequence of (title, diagram, layout), from top to bottom
    notes : sequence of str, become the label

    """
    lines = ['digraph pose_graph {', '  layout=neato; overlap=true; splines=true; bgcolor=none;',
             f'  label={_quoted(" ".join(notes))}; fontcolor="{style.TEXT}"; fontsize=10;',
             f'  node [fixedsize=true, style=filled, color="{style.BORDER}", '
             f'fontcolor="{style.INK}", fontsize=9];']
    bottom = 0.0
    for n, (title, drawing, layout) in enumerate(panels):
        at = layout.at.copy()
        at[:, 1] += bottom - at[:, 1].max()
        bottom = float(at[:, 1].min()) - 6.0
        indent = '  '
        if len(panels) > 1:
            lines.append(f'  subgraph cluster_{n} {{ label={_quoted(title)};')
            indent = '    '
        for k, vertex in enumerate(drawing.vertices):
            lines.append(f'{indent}{_vertex(f"n{n}_{k}", vertex, at[k])}')
        lines += [f'{indent}{_arc(n, arc)}' for arc in drawing.arcs]
        if len(panels) > 1:
            lines.append('  }')
    return '\n'.join([*lines, '}']) + '\n'


def _vertex(name: str, vertex: Vertex, at: FloatArray) -> str:
    shape, size = _SHAPES[style.SHAPES[vertex.role]]
    if vertex.fixed:
        shape = 'doublecircle'
    fill = style.FILLS.get(vertex.role)
    if fill is None:
        fill = '#ffffff' if vertex.sort is None else style.SORT_COLOURS[vertex.sort]
    label = vertex.name if style.SHAPES[vertex.role] == 'circle' else ''
    x, y = (UNIT * at).tolist()
    return (f'{name} [label={_quoted(label)}, shape={shape}, width={size * UNIT:.3g}, '
            f'fillcolor="{fill}", pos="{x:.4f},{y:.4f}!"];')


def _arc(n: int, arc: Arc) -> str:
    colour = style.LINE if arc.sort is None else style.SORT_COLOURS[arc.sort]
    options = [f'color="{colour}"']
    if not arc.directed:
        options.append('dir=none')
    if not arc.used:
        options.append('style=dashed')
    return f'n{n}_{arc.start} -> n{n}_{arc.end} [{", ".join(options)}];'


def _quoted(text: str) -> str:
    escaped = text.replace('\\', '\\\\').replace('"', '\\"')
    return f'"{escaped}"'
