# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Optimise a g2o file, and print the constraints with the largest energies.

With `--robust` wrong loop closures are found first. A file that is written then has them as
comments, `# not used EDGE_SE2 ...`, so that other programs read the graph without them.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
import re
import sys
import time

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import BatchResult, Status
from pose_graph_ros.core.config import CLOSURE_FLOORS, SolverConfig
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.error_functions import energies as energies_of
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import EDGE2_ORDERS, GraphFile, read_g2o
from pose_graph_ros.core.io.g2o_writing import write_g2o

N_LARGEST = 5  # number of edges, of observed nodes, and of names, that are printed
N_TAGS = 10  # number of warnings of tags
WEAK = 1e-7  # information of a weak prior, as a fraction of that of the median constraint
CONFIG = SolverConfig(max_iterations=200)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.add_argument('graph', type=Path, help='g2o file')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path, help='optimised g2o file')
    parser.add_argument('--start', choices=('chordal', 'file'), default='chordal',
                        help='start from the constraints or from the poses in the file '
                             '(default: %(default)s)')
    parser.add_argument('--robust', action='store_true',
                        help='decide which loop closures to believe, and leave the others out; '
                             'an edge is odometry if no id of a vertex lies between its two')
    parser.add_argument('--closure-sigma', nargs=2, type=_sigma, metavar=('M', 'RAD'),
                        default=(CLOSURE_FLOORS[0], CLOSURE_FLOORS[2]),
                        help='least standard deviations of loop closures for this decision '
                             f'(default: {CLOSURE_FLOORS[0]} {CLOSURE_FLOORS[2]}); the result '
                             'has those of the file, times what the residuals show')
    parser.add_argument('--edge2', choices=EDGE2_ORDERS,
                        help='format of the tag EDGE2 in this file')


def _sigma(text: str) -> float:
    """Return a standard deviation, 0 included."""
    value = float(text)
    if not 0.0 <= value < np.inf:
        raise argparse.ArgumentTypeError(f'expected a finite number of at least 0, got {text}')
    return value


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    file = read_g2o(options.graph, options.edge2)
    graph = file.graph
    for line in _skipped(options.graph, file):
        print(line, file=sys.stderr)
    held = _hold_parts(graph)
    print(f'{graph.n_nodes} hidden nodes, {len(graph.edges)} edges, '
          f'{len(graph.observed)} observed nodes; chi2 {graph.energies().chi2:.9g} as read')
    if not file.has_start:
        print('nodes without a pose in the file start at poses composed from the edges')
    if len(held) > 0:
        print(f'nothing held {len(held)} more parts of the graph; now their first nodes are '
              f'fixed: {_listed(file.ids[held])}')
    start = time.monotonic()
    doubted = _doubt(file, options.closure_sigma) if options.robust else np.empty(0, np.int64)
    result = _solve(graph, optimizer.optimize if options.start == 'file' or options.robust
                    else optimizer.optimize_from_linear_start)
    reason = re.sub(r'hidden node (\d+)', lambda node: f'hidden node {file.ids[int(node[1])]}',
                    result.reason)
    print(f'chi2 {result.chi2:.9g}, {result.status.value} after {result.iterations} iterations '
          f'from the {result.start.value}, {time.monotonic() - start:.3f} s'
          f'{": " if reason else ""}{reason}')
    energies = graph.energies()
    for k in _largest(energies.edges, doubted):
        print(f'  edge {file.ids[graph.edges.i[k]]} -> {file.ids[graph.edges.j[k]]}: '
              f'energy {energies.edges[k]:.4g}')
    for k in np.argsort(energies.observed)[::-1][:N_LARGEST]:
        print(f'  observed node on {file.ids[graph.observed.node[k]]}: '
              f'energy {energies.observed[k]:.4g}')
    if options.out is not None:
        write_g2o(graph, options.out, file.ids)
    return 0 if result.status is Status.CONVERGED else 1


def _doubt(file: GraphFile, sigma: Sequence[float]) -> IntArray:
    """Give the closures that are not believed the weight 0; print and return their rows."""
    # what judges takes longer to load than all else here
    from pose_graph_ros.cli.believe import believe  # noqa: PLC0415

    graph = file.graph
    beliefs = believe(graph, np.array([sigma[0], sigma[0], sigma[1]]))
    if beliefs is None:
        print('warning: there is no set of loop closures with a solution; all are believed',
              file=sys.stderr)
        return np.empty(0, np.int64)
    if beliefs.n_parts > 1:
        print(f'odometry, edges between neighbouring ids, leaves {beliefs.n_parts} parts; loop '
              f'closures that join them are believed')
    doubted = beliefs.closures[~beliefs.believed]
    print(f'{len(beliefs.closures)} loop closures: {int(np.sum(beliefs.believed))} believed, '
          f'{len(doubted)} doubted')
    graph.set_poses(beliefs.poses)
    graph.apply(GraphUpdate(remove_edges=doubted.tolist()))
    if beliefs.scale > 1.0:
        print(f'by their residuals, sigmas of loop closures are {beliefs.scale:.2g} times those '
              f'of the file, and count so')
        graph.apply(GraphUpdate(weigh_edges=dict.fromkeys(
            beliefs.closures[beliefs.believed].tolist(), beliefs.scale**-2.0)))
    edges = graph.edges_at(doubted)
    errors = graph.edge_errors(edges)
    squares = energies_of(errors, edges.information)
    for k in np.argsort(-squares, kind='stable')[:N_LARGEST]:
        x, y, theta = errors[k]
        print(f'  doubted edge {file.ids[edges.i[k]]} -> {file.ids[edges.j[k]]}: '
              f'{np.hypot(x, y):.3g} m and {abs(theta):.3g} rad off, {np.sqrt(squares[k]):.3g} '
              f'sigma')
    if len(doubted) > N_LARGEST:
        print(f'  and {len(doubted) - N_LARGEST} more; a file written with --out has them all as '
              f'comments')
    return doubted


def _largest(energies: FloatArray, left_out: IntArray) -> IntArray:
    """Return the rows with the largest energies, without some of them."""
    order = np.argsort(energies)[::-1]
    return np.asarray(order[~np.isin(order, left_out)][:N_LARGEST])


def _skipped(path: Path, file: GraphFile) -> list[str]:
    """Return a warning for each tag that is not known, the most frequent ones first."""
    tags = sorted(file.skipped, key=lambda tag: -file.skipped[tag])
    lines = [f'warning: {path}: {file.skipped[tag]} lines {tag!r} are skipped'
             + (': TORO may merge these nodes, which their edges connect anyway'
                if tag == 'EQUIV' else '') for tag in tags[:N_TAGS]]
    if len(tags) > N_TAGS:
        lines.append(f'warning: {path}: lines with {len(tags) - N_TAGS} other tags are skipped')
    return lines


def _hold_parts(graph: Graph) -> list[int]:
    """Fix the first node of each part that has no fixed and no observed one; return these."""
    held = []
    while (node := symbolic.loose_part(graph.memory.head)[0]) >= 0:
        graph.apply(GraphUpdate(fix=[int(node)]))
        held.append(int(node))
    return held


def _solve(graph: Graph, optimize: Callable[[Graph, SolverConfig], BatchResult]) -> BatchResult:
    """
    Optimise a graph; if poses are not determined, choose those near the present ones.

    The result has the reason then. It is the minimum of chi2 with a weak prior on each node, which
    is not added to the graph.
    """
    result = optimize(graph, CONFIG)
    if result.status is not Status.FAILED or not np.isfinite(result.chi2):
        return result
    copy, n = Graph(), graph.n_nodes
    copy.fill(graph.rows())
    typical = np.concatenate([np.einsum('mii->mi', table.weighted_information).ravel()
                              for table in (graph.edges, graph.observed)])
    weak = WEAK * np.median(typical[typical > 0.0]) * (
        np.eye(3) * (np.arange(3) < graph.dimension[:, None, None]))
    copy.apply(GraphUpdate(observed=ObservedNodes(
        np.arange(n), None, graph.poses.copy(), weak,
        [ObservedKind.GLOBAL_POSE] * n)))
    other = optimize(copy, CONFIG)
    if other.status is Status.FAILED:
        return result
    graph.set_poses(copy.poses)
    return replace(other, chi2=graph.energies().chi2,
                   reason=f'{result.reason}; it is held near its start')


def _listed(names: IntArray) -> str:
    """Return names separated by commas, at most five."""
    return ', '.join(map(str, names[:N_LARGEST].tolist())) + (
        ', ...' if len(names) > N_LARGEST else '')
