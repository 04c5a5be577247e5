# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw a small graph."""

import argparse
from collections.abc import Sequence
import json
from pathlib import Path
import sys
from typing import Any

import numpy as np

from pose_graph_ros.cli.graph_input import NamedRows, read, rows_of
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.offline.drawing.diagram import Diagram, diagram, View
from pose_graph_ros.offline.drawing.example import five_states
from pose_graph_ros.offline.drawing.layout import Layout, place
from pose_graph_ros.offline.drawing.pattern import elimination_order, Pattern, pattern
from pose_graph_ros.offline.drawing.structure import part, Structure, structure, within

N_MOST = 200  # hidden nodes in a picture; with more of them names can't be read


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if (options.graph is None) != options.example:
        raise ConfigError('expected a graph or --example, and not both')
    view = View(options.view)
    graphs: Sequence[tuple[str, NamedRows]]
    if options.example:
        graphs = [(title, NamedRows(rows, rows.node_ids)) for title, rows in five_states()]
    else:
        graphs = [('', read(options.graph, options.edge2))]
    notes: list[str] = []
    panels: list[tuple[str, Diagram, Layout]] = []
    patterns: list[Pattern | None] = []
    for title, graph in graphs:
        whole = structure(graph.rows, graph.ids)
        chosen = _chosen(options, graph.ids, whole)
        shown, n_cut = part(whole, np.isin(np.arange(whole.n_nodes), chosen))
        drawing = diagram(shown, view)
        layout = place(drawing, shown)
        panels.append((title, drawing, layout))
        has_pattern = options.pattern or options.example or options.ordering == 'elimination'
        order = elimination_order(shown) if options.ordering == 'elimination' else None
        patterns.append(pattern(shown, order) if has_pattern else None)
        notes += [*drawing.notes, *_notes(shown, whole, n_cut, layout, patterns[-1])]
    notes = list(dict.fromkeys(notes))
    if options.example and view is View.MRF:
        notes = ['Terms of a single node are not in the picture: a Markov random field has lines '
                 'for pairs of nodes only.']
    for note in notes:
        print(note, file=sys.stderr)
    _write(options, panels, patterns, notes)
    if options.json:
        print(json.dumps(_facts(view, panels, notes, options.out), indent=2))
    else:
        print(f'written: {options.out}')
    return 0


def _chosen(options: argparse.Namespace, ids: IntArray, whole: Structure) -> IntArray:
    """Return the rows that are drawn; raise ConfigError if they are too many."""
    if options.nodes is not None:
        rows = rows_of(ids, options.nodes, '--nodes')
    elif options.around is not None:
        start = int(rows_of(ids, str(options.around), '--around')[0])
        rows = np.flatnonzero(within(whole, start, options.hops))
    else:
        rows = np.arange(whole.n_nodes)
    if len(rows) > N_MOST:
        raise ConfigError(
            f'{options.graph}: {len(rows)} hidden nodes are too many for a picture, which has '
            f'room for {N_MOST}; draw a part with --around ID --hops K or --nodes A:B')
    return rows


def _notes(
    shown: Structure, whole: Structure, n_cut: int, layout: Layout, blocks: Pattern | None,
) -> list[str]:
    """Return what a reader has to know of a picture."""
    notes = []
    if shown.n_nodes < whole.n_nodes:
        notes.append(f'{shown.n_nodes} of {whole.n_nodes} hidden nodes; '
                     f'{n_cut} constraints lead to others.')
    if layout.n_moved > 0:
        notes.append(f'Not to scale: {layout.n_moved} hidden nodes were moved apart.')
    if blocks is not None and any(shown.fixed):
        names = [name for name, fixed in zip(shown.names, shown.fixed, strict=True) if fixed]
        notes.append(f'H has no row for what is fixed: {", ".join(names[:5])}'
                     f'{", ..." if len(names) > 5 else ""}.')
    return notes


def _write(
    options: argparse.Namespace, panels: list[tuple[str, Diagram, Layout]],
    patterns: list[Pattern | None], notes: list[str],
) -> None:
    if options.out.suffix.lower() == '.dot':
        from pose_graph_ros.cli.graph_dot import dot_text  # noqa: PLC0415

        options.out.write_text(dot_text(panels, notes), encoding='utf-8')
        return
    # matplotlib takes longer to load than all else here
    from pose_graph_ros.cli.graph_picture import draw, Panel  # noqa: PLC0415

    draw([Panel(*panel, blocks) for panel, blocks in zip(panels, patterns, strict=True)],
         options.out, notes, headings=options.headings)


def _facts(
    view: View, panels: list[tuple[str, Diagram, Layout]], notes: list[str], out: Path,
) -> dict[str, Any]:
    """Return what is drawn, for machines."""
    return {'view': view.value, 'file': str(out), 'notes': notes, 'diagrams': [{
        'title': title,
        'vertices': [{'name': vertex.name, 'role': vertex.role.name.lower(),
                      'sort': None if vertex.sort is None else vertex.sort.name.lower(),
                      'fixed': vertex.fixed, 'used': vertex.used,
                      'nodes': [drawing.vertices[node].name for node in vertex.nodes],
                      'at': np.round(at, 3).tolist()}
                     for vertex, at in zip(drawing.vertices, layout.at, strict=True)],
        'arcs': [{'start': arc.start, 'end': arc.end, 'directed': arc.directed,
                  'sort': None if arc.sort is None else arc.sort.name.lower(), 'used': arc.used}
                 for arc in drawing.arcs]} for title, drawing, layout in panels]}
