# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw a small graph with networkx and matplotlib; lines and texts show on any background."""

import argparse
from collections import defaultdict
from collections.abc import Sequence
import json
from pathlib import Path
import sys
import textwrap
from typing import Any, NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
import networkx as nx
import numpy as np

from pose_graph_ros.cli.graph_input import read, rows_of
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.io.g2o import GraphFile
from pose_graph_ros.offline import graph_views as views
from pose_graph_ros.offline.graph_views import Role, Sort
from pose_graph_ros.offline.pattern import elimination_order, Pattern, pattern

N_MOST = 300  # hidden nodes in a picture; with more of them names can't be read
INK, GREY = '#111111', '#7a828c'
COLOURS = {     # after Okabe and Ito, but for grey; without a sort, arcs of several terms
    None: GREY, Sort.ODOMETRY: GREY, Sort.LOOP_CLOSURE: '#2F8FD0', Sort.TURN: '#B9A51C',
    Sort.LANDMARK: '#009E73', Sort.OBSERVED: '#E69F00', Sort.BIAS: '#B583A4',
    Sort.PRIOR: '#D55E00'}
FILLS = {Role.POSE: '#ffffff', Role.LANDMARK: '#D9F2E6', Role.BIAS: '#F0E2EC',
         Role.CONTROL: '#C2CAD4', Role.MEASUREMENT: '#C2CAD4', Role.JOINT: '#D55E00'}
"""Of vertices whose colour is not that of their term."""
SIZES = {Role.FACTOR: 0.5, Role.JOINT: 0.25}
"""Diameters of vertices as parts of that of a hidden node."""
BLOCK, FILL = '#4C78A8', '#E69F00'  # of the pattern of H, of the fill of its factor
UNIT, LARGEST = 0.8, 14.0  # distance of neighbours, and most of the width and height [inch]
DIAMETER = 0.32  # of a hidden node [inch]; less where neighbours are nearer
SETTINGS: dict[Any, Any] = {
    'svg.fonttype': 'none', 'svg.hashsalt': 'pose_graph_ros', 'text.color': GREY, 'font.size': 8.0,
    'axes.edgecolor': GREY, 'legend.title_fontsize': 8.0,
    'font.family': ['DejaVu Sans', 'sans-serif']}


class Panel(NamedTuple):
    """A view of a graph with the places of its vertices, and the pattern of H if it is drawn."""

    title: str
    view: Any
    at: dict[int, FloatArray]
    pattern: Pattern | None


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if (options.graph is None) != options.example:
        raise ConfigError('expected a graph or --example, and not both')
    graphs = ([(title, GraphFile(rows, rows.node_ids)) for title, rows in views.five_states()]
              if options.example else [('', read(options.graph, options.edge2))])
    notes, panels = list[str](), list[Panel]()
    for title, file in graphs:
        whole = views.factor_graph(file.rows, file.ids)
        shown, n_cut = views.part(whole, _chosen(options, file.ids, whole))
        view = views.VIEWS[options.view](shown)
        at, n_near = ((views.time_slices(view), 0) if options.view == 'dbn'
                      else views.map_places(view, spring=options.spring))
        order = elimination_order(shown) if options.ordering == 'elimination' else None
        blocks = (pattern(shown, order) if options.pattern or options.example or order is not None
                  else None)
        panels.append(Panel(title, view, at, blocks))
        notes += view.graph['notes']
        n_shown, n_whole = len(views.hidden(shown)), len(views.hidden(whole))
        if n_shown < n_whole:
            notes.append(f'{n_shown} of {n_whole} hidden nodes; '
                         f'{n_cut} constraints lead to others.')
        if options.spring and options.view != 'dbn':
            notes.append('Not to scale: hidden nodes stand apart, as by springs.')
        elif n_near > 0:
            notes.append(f'{n_near} hidden nodes lie on others; --spring moves them apart.')
        fixed = [data['name'] for _, data in shown.nodes(data=True) if data.get('fixed', False)]
        if blocks is not None and len(fixed) > 0:
            notes.append(f'H has no row for what is fixed: {", ".join(fixed[:5])}'
                         f'{", ..." if len(fixed) > 5 else ""}.')
    notes = list(dict.fromkeys(notes))
    if options.example and options.view == 'mrf':
        notes = ['Terms of a single node are not in the picture: a Markov random field has lines '
                 'for pairs of nodes only.']
    print(*notes, sep='\n', end='\n' if notes else '', file=sys.stderr)
    _draw(panels, options.out, notes, headings=options.headings)
    print(json.dumps(_facts(options.view, panels, notes, options.out), indent=2) if options.json
          else f'written: {options.out}')
    return 0


def _chosen(options: argparse.Namespace, ids: IntArray, whole: Any) -> set[int]:
    """Return the rows that are drawn; raise ConfigError if they are too many."""
    chosen = set(views.hidden(whole))
    if options.nodes is not None:
        chosen = set(rows_of(ids, options.nodes, '--nodes').tolist())
    elif options.around is not None:
        start = int(rows_of(ids, str(options.around), '--around')[0])
        field = nx.Graph(views.markov_random_field(whole))
        chosen = set(nx.ego_graph(field, start, radius=options.hops))
    if len(chosen) > N_MOST:
        raise ConfigError(
            f'{options.graph}: {len(chosen)} hidden nodes are too many for a picture, which has '
            f'room for {N_MOST}; draw a part with --around ID --hops K or --nodes A:B')
    return chosen


def _facts(view: str, panels: Sequence[Panel], notes: list[str], out: Path) -> dict[str, Any]:
    """Return what is drawn, for machines."""
    diagrams = []
    for panel in panels:
        place, vertices = {node: n for n, node in enumerate(panel.view)}, []
        for node, data in panel.view.nodes(data=True):
            term = data.get('term')
            vertices.append({
                'name': data['name'], 'role': data['role'].name.lower(),
                'sort': None if term is None else term.sort.name.lower(),
                'fixed': data.get('fixed', False), 'used': term is None or term.used,
                'nodes': [panel.view.nodes[each]['name'] for each in (
                    [node] if term is None else term.nodes)],
                'at': np.round(panel.at[node], 3).tolist()})
        diagrams.append({'title': panel.title, 'vertices': vertices, 'arcs': [
            {'start': place[start], 'end': place[end], 'directed': arc['directed'],
             'sort': None if arc['sort'] is None else arc['sort'].name.lower(),
             'used': arc['used']} for start, end, arc in panel.view.edges(data=True)]})
    return {'view': view, 'file': str(out), 'notes': notes, 'diagrams': diagrams}


def _draw(panels: Sequence[Panel], path: Path, notes: Sequence[str], *, headings: bool) -> None:
    """Draw views below each other into a file, each beside its pattern."""
    sizes = np.array([np.ptp(list(panel.at.values()), axis=0) + 1.0 for panel in panels])
    unit = min(UNIT, LARGEST / float(np.max(sizes)))
    heights = np.maximum(unit * sizes[:, 1], 1.2)
    patterns = [panel.pattern for panel in panels if panel.pattern is not None]
    widths = [max(unit * float(np.max(sizes[:, 0])), 4.0), *(
        [min(max(0.06 * sum(patterns[-1].sizes), 1.2), 4.5)] if len(patterns) > 0 else [])]
    if len(panels) == 1:
        heights = np.maximum(heights, widths[1:] or 0.0)
    width = sum(widths)
    text = [line for note in notes for line in textwrap.wrap(note, int(width / 0.065))]
    with rc_context(SETTINGS):
        figure = Figure(figsize=(width, float(np.sum(heights)) + 1.0 + 0.15 * len(text)), dpi=200,
                        layout='constrained')
        grid = figure.subplots(len(panels), len(widths), squeeze=False, width_ratios=widths,
                               height_ratios=heights.tolist())
        for panel, (axes, *beside) in zip(panels, grid, strict=True):
            axes.set_title(panel.title, loc='left', size=9)
            _draw_view(axes, panel, unit, headings=headings)
            for other in beside:
                _draw_pattern(other, panel.pattern)
        entries = {label: handle for axes in figure.axes for handle, label in zip(
            *axes.get_legend_handles_labels(), strict=True)}
        figure.legend(entries.values(), entries.keys(), loc='outside lower left', frameon=False,
                      ncols=max(int(width / 2.2), 1), title='\n'.join(text), alignment='left')
        options = {'metadata': {'Date': None}} if path.suffix.lower() == '.svg' else {}
        figure.savefig(path, transparent=True, **options)


def _draw_view(axes: Axes, panel: Panel, unit: float, *, headings: bool) -> None:
    diameter = 72.0 * min(DIAMETER, 0.4 * unit)  # [pt]
    vertices = dict(panel.view.nodes(data=True))
    area = {node: (diameter * SIZES.get(data['role'], 1.0))**2 for node, data in vertices.items()}
    looks: dict[Any, list[int]] = defaultdict(list)
    for node, data in sorted(vertices.items(), key=lambda each: list(Role).index(each[1]['role'])):
        opaque, role = 1.0 if 'term' not in data or data['term'].used else 0.5, data['role']
        meaning, colour = (role.value, FILLS[role]) if role in FILLS else (
            f'{role.value}: {data["term"].sort.value}', COLOURS[data['term'].sort])
        looks[meaning, colour, area[node], role, opaque].append(node)
        if data.get('fixed', False):
            looks['fixed (known): double border', colour, 0.6 * area[node], role,
                  opaque].append(node)
    for (meaning, colour, size, role, opaque), nodes in looks.items():
        nx.draw_networkx_nodes(panel.view, panel.at, nodelist=nodes, ax=axes, node_color=colour,
                               node_size=size, linewidths=0.05 * diameter, edgecolors=INK,
                               alpha=opaque, node_shape='s' if role is Role.FACTOR else 'o')
        axes.plot([], [], 's' if role is Role.FACTOR else 'o', color=colour, markeredgecolor=INK,
                  label=meaning)
    named = {data['term'].sort for data in vertices.values()
             if 'term' in data and data['role'] not in FILLS}
    groups: dict[Any, Any] = defaultdict(nx.DiGraph)  # arcs that look alike
    drawn = set[tuple[int, int]]()
    for start, end, arc in panel.view.edges(data=True):
        # of several between the same vertices, all but the first are bent
        bend = 0.25 * (not drawn.isdisjoint({(start, end), (end, start)}))
        drawn.add((start, end))
        groups[arc['sort'], bend, arc['used'], arc['directed']].add_edge(start, end)
    for (sort, bend, used, directed), alike in groups.items():
        nx.draw_networkx_edges(alike, panel.at, ax=axes, edge_color=COLOURS[sort],
                               width=0.05 * diameter, connectionstyle=f'arc3,rad={bend}',
                               style='solid' if used else 'dashed', arrows=True,
                               arrowsize=0.45 * diameter, arrowstyle='-|>' if directed else '-',
                               nodelist=list(alike), node_size=[area[node] for node in alike])
        if sort not in named:
            axes.plot([], [], color=COLOURS[sort],
                      label='in a term together' if sort is None else sort.value)
    longest = max((len(data['name']) for data in vertices.values()), default=1)
    names = {node: data['name'] for node, data in vertices.items() if data['role'] not in SIZES}
    nx.draw_networkx_labels(panel.view, panel.at, names, ax=axes, font_color=INK,
                            font_size=min(0.42, 1.2 / longest) * diameter)
    if headings:
        poses = [node for node, data in vertices.items() if data['role'] is Role.POSE]
        turns = np.array([vertices[node]['pose'][2] for node in poses])
        ways = 0.5 * diameter / 72.0 / unit * np.column_stack((np.cos(turns), np.sin(turns)))
        axes.quiver(*(np.array([panel.at[node] for node in poses]) + ways).T, *(0.6 * ways).T,
                    angles='xy', scale_units='xy', scale=1.0, color=INK, units='inches',
                    width=0.02, headlength=3, headaxislength=3, zorder=3)
    (left, low), (right, high) = (limit(list(panel.at.values()), axis=0)
                                  for limit in (np.min, np.max))
    axes.set(xlim=(left - 0.5, right + 0.5), ylim=(low - 0.5, high + 0.5))
    axes.set_aspect('equal', anchor='W')
    axes.set_axis_off()


def _draw_pattern(axes: Axes, blocks: Pattern | None) -> None:
    """Draw the pattern of H."""
    assert blocks is not None, 'all views have a pattern, or none'
    ends = np.concatenate(([0], np.cumsum(blocks.sizes)))
    for cells, colour, meaning in ((blocks.blocks, BLOCK, 'block of H that is not zero'),
                                   (blocks.fill, FILL, 'fill of its factor R')):
        if np.any(cells):
            axes.pcolormesh(ends, ends, np.ma.masked_equal(cells, 0), edgecolors='white',
                            cmap=ListedColormap([colour]), linewidth=0.5)
            axes.plot([], [], 's', color=colour, label=meaning)
    every = -(-len(blocks.names) // 40)
    middles, names = (0.5 * (ends[:-1] + ends[1:]))[::every], blocks.names[::every]
    axes.set(aspect='equal', xlim=(0, ends[-1]), ylim=(ends[-1], 0))
    axes.set_xticks(middles, names, rotation=90)
    axes.set_yticks(middles, names)
    axes.tick_params(length=0, pad=1, labelsize=6, labelcolor=GREY, top=True, labeltop=True,
                     bottom=False, labelbottom=False)
