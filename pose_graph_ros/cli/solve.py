# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Optimise a g2o, TORO or iSAM file, and print the constraints with the largest energies.

With `--robust` wrong loop closures are found first. A file that is written then has them as
comments, `# not used EDGE_SE2 ...`, so that other programs read the graph without them. Unless
`--no-certificate` is given, it is proved whether the minimum is the global one, for an objective
that is nearly chi2; if it is not, a lower one is searched for.
"""

import argparse
from collections.abc import Sequence
import json
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np

from pose_graph_ros.cli.solve_starts import hold_parts, Solution, solve, STARTS
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import CLOSURE_FLOORS
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.error_functions import energies as energies_of
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.io.edge2_order import Guess, read_guessed
from pose_graph_ros.core.io.g2o import EDGE2_ORDERS, GraphFile, read_g2o
from pose_graph_ros.core.io.g2o_writing import write_g2o

N_LARGEST = 5  # number of edges, of observed nodes, and of names, that are printed
N_TAGS = 10  # number of warnings of tags
EXAMPLES = """\
examples:
  pose-graph solve graph.g2o -o optimised.g2o
  pose-graph solve graph.graph --edge2 toro --start best
  pose-graph solve graph.g2o --marginals newest
  pose-graph solve graph.g2o --marginals all -o covariances.csv --json
  pose-graph solve graph.g2o --robust --no-certificate -o optimised.g2o

exit code: 0 converged, 1 not converged, 2 wrong input
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.epilog = EXAMPLES
    parser.add_argument('graph', type=Path, help='g2o file')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path, action='append', default=[],
                        help='optimised g2o file, or marginals if the name ends in .csv; may be '
                             'repeated')
    parser.add_argument('--start', choices=STARTS, default='chordal',
                        help='start from the constraints, from the poses in the file, from '
                             'composed odometry, or from each, and take the lowest minimum '
                             '(default: %(default)s)')
    parser.add_argument('--certificate', action=argparse.BooleanOptionalAction, default=True,
                        help='prove whether the minimum is the global one (default: yes)')
    parser.add_argument('--marginals', metavar='{all,newest,ID[,ID...]}',
                        help='covariances of these nodes as CSV: the last output, or -o FILE.csv '
                             '(default, with such a file: all)')
    parser.add_argument('--json', action='store_true', help='print JSON (docs/tools.md)')
    parser.add_argument('--robust', action='store_true',
                        help='decide which loop closures to believe, and leave the others out; '
                             'an edge is odometry if no id of a vertex lies between its two')
    parser.add_argument('--closure-sigma', nargs=2, type=_sigma, metavar=('M', 'RAD'),
                        default=(CLOSURE_FLOORS[0], CLOSURE_FLOORS[2]),
                        help='least standard deviations of loop closures for this decision '
                             f'(default: {CLOSURE_FLOORS[0]} {CLOSURE_FLOORS[2]}); the result '
                             'has those of the file, times what the residuals show')
    parser.add_argument('--edge2', choices=EDGE2_ORDERS,
                        help='format of the tag EDGE2 in this file; by default both are tried')


def _sigma(text: str) -> float:
    """Return a standard deviation, 0 included."""
    value = float(text)
    if not 0.0 <= value < np.inf:
        raise argparse.ArgumentTypeError(f'expected a finite number of at least 0, got {text}')
    return value


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    file, order = _read(options.graph, options.edge2)
    graph = file.graph
    tables = [path for path in options.out if path.suffix == '.csv']
    which = options.marginals or ('all' if len(tables) > 0 else None)
    rows = None if which is None else _chosen_rows(file, which)
    text = _Text(options.json)
    held = hold_parts(graph)
    before = graph.energies().chi2
    text.add(f'{graph.n_nodes} hidden nodes, {len(graph.edges)} edges, '
             f'{len(graph.observed)} observed nodes; chi2 {before:.9g} as read')
    if not file.has_start:
        text.add('nodes without a pose in the file start at poses composed from the edges')
    if len(held) > 0:
        text.add(f'nothing held {len(held)} more parts of the graph; now their first nodes are '
                 f'fixed: {_listed(file.ids[held])}')
    begin = time.monotonic()
    doubted = (_doubt(file, options.closure_sigma, text) if options.robust
               else np.empty(0, np.int64))
    solution = solve(file, 'present' if options.robust else options.start)
    seconds = time.monotonic() - begin
    certificate = None
    if options.certificate:
        # loads SciPy
        from pose_graph_ros.cli.solve_certificate import with_certificate  # noqa: PLC0415

        begin = time.monotonic()
        solution, certificate = with_certificate(file, solution)
    _tell(file, solution, seconds, doubted, text)
    if certificate is not None:
        for line in certificate.lines():
            text.add(line)
    lines = [] if rows is None else _csv_lines(file, solution, rows)
    for path in options.out:
        if path in tables:
            path.write_text('\n'.join(lines) + '\n', encoding='ascii')
        else:
            write_g2o(graph, path, file.ids)
    if options.json:
        values = _values(file, solution, doubted, file.ids[held])
        values |= {'chi2_start': before, 'seconds': seconds, 'edge2': order,
                   'certificate': None if certificate is None else certificate.values()}
        if rows is not None and len(tables) == 0:
            values['marginals'] = lines
        print(json.dumps(values, indent=2))
    elif rows is not None and len(tables) == 0:
        print('\n'.join(lines))
    return 0 if solution.result.status is Status.CONVERGED else 1


def _read(path: Path, order: str | None) -> tuple[GraphFile, str | None]:
    """Return the graph in a file with the order of its EDGE2; print warnings."""
    file, order, reason = (
        read_guessed(path) if order is None else Guess(read_g2o(path, order), order, ''))
    for line in _skipped(path, file):
        print(line, file=sys.stderr)
    if reason:
        print(f'warning: {path}: EDGE2 is read in the order of {order}, as {reason}; '
              f'say which it is with --edge2', file=sys.stderr)
    return file, order


class _Text:
    """Prints lines for people; with JSON there are none."""

    def __init__(self, silent: bool) -> None:
        self._silent = silent

    def add(self, line: str) -> None:
        if not self._silent:
            print(line)


def _tell(
    file: GraphFile, solution: Solution, seconds: float, doubted: IntArray, text: _Text,
) -> None:
    """Print chi2 with how it was reached, and the largest energies."""
    graph, result = file.graph, solution.result
    for name, each in solution.tried:
        text.add(f'  from the {name}: chi2 {each.chi2:.9g}, {each.status.value} after '
                 f'{each.iterations} iterations')
    text.add(f'chi2 {result.chi2:.9g}, {result.status.value} after {result.iterations} iterations '
             f'from the {solution.start}, {seconds:.3f} s'
             f'{": " if result.reason else ""}{result.reason}')
    energies = graph.energies()
    for k in _largest(energies.edges, doubted):
        text.add(f'  edge {file.ids[graph.edges.i[k]]} -> {file.ids[graph.edges.j[k]]}: '
                 f'energy {energies.edges[k]:.4g}')
    for k in np.argsort(energies.observed)[::-1][:N_LARGEST]:
        text.add(f'  observed node on {file.ids[graph.observed.node[k]]}: '
                 f'energy {energies.observed[k]:.4g}')


def _values(
    file: GraphFile, solution: Solution, doubted: IntArray, held: IntArray,
) -> dict[str, Any]:
    """Return most of the JSON output."""
    graph, result = file.graph, solution.result
    edges = graph.edges_at(doubted)
    return {
        'hidden_nodes': graph.n_nodes, 'edges': len(graph.edges),
        'observed_nodes': len(graph.observed), 'chi2': result.chi2,
        'iterations': result.iterations, 'status': result.status.value, 'reason': result.reason,
        'start': solution.start, 'starts': [
            {'start': name, 'chi2': each.chi2, 'iterations': each.iterations,
             'status': each.status.value} for name, each in solution.tried],
        'held': held.tolist(),
        'doubted': np.stack((file.ids[edges.i], file.ids[edges.j]), axis=1).tolist()}


def _chosen_rows(file: GraphFile, which: str) -> IntArray:
    """Return the rows of nodes; what knows of covariances is loaded only if asked for."""
    from pose_graph_ros.cli.marginals import chosen_rows  # noqa: PLC0415

    return chosen_rows(file, which)


def _csv_lines(file: GraphFile, solution: Solution, rows: IntArray) -> list[str]:
    from pose_graph_ros.cli.marginals import csv_lines  # noqa: PLC0415

    if solution.result.status is Status.FAILED or not solution.determined:
        raise PoseGraphError(f'--marginals: {solution.result.reason}')
    return csv_lines(file, rows)


def _doubt(file: GraphFile, sigma: Sequence[float], text: _Text) -> IntArray:
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
        text.add(f'odometry, edges between neighbouring ids, leaves {beliefs.n_parts} parts; loop '
                 f'closures that join them are believed')
    doubted = beliefs.closures[~beliefs.believed]
    text.add(f'{len(beliefs.closures)} loop closures: {int(np.sum(beliefs.believed))} believed, '
             f'{len(doubted)} doubted')
    graph.set_poses(beliefs.poses)
    graph.apply(GraphUpdate(remove_edges=doubted.tolist()))
    if beliefs.scale > 1.0:
        text.add(f'by their residuals, sigmas of loop closures are {beliefs.scale:.2g} times '
                 f'those of the file, and count so')
        graph.apply(GraphUpdate(weigh_edges=dict.fromkeys(
            beliefs.closures[beliefs.believed].tolist(), beliefs.scale**-2.0)))
    edges = graph.edges_at(doubted)
    errors = graph.edge_errors(edges)
    squares = energies_of(errors, edges.information)
    for k in np.argsort(-squares, kind='stable')[:N_LARGEST]:
        x, y, theta = errors[k]
        text.add(f'  doubted edge {file.ids[edges.i[k]]} -> {file.ids[edges.j[k]]}: '
                 f'{np.hypot(x, y):.3g} m and {abs(theta):.3g} rad off, {np.sqrt(squares[k]):.3g} '
                 f'sigma')
    if len(doubted) > N_LARGEST:
        text.add(f'  and {len(doubted) - N_LARGEST} more; a file written with --out has them all '
                 f'as comments')
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


def _listed(names: IntArray) -> str:
    """Return names separated by commas, at most five."""
    return ', '.join(map(str, names[:N_LARGEST].tolist())) + (
        ', ...' if len(names) > N_LARGEST else '')
