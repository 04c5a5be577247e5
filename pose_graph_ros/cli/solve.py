# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Optimise a g2o, TORO or iSAM file, and print the constraints with the largest energies."""

import argparse
import json
import math
from pathlib import Path
import sys
import time
from typing import Any, TYPE_CHECKING

import numpy as np

from pose_graph_ros.cli.arguments import METHODS
from pose_graph_ros.cli.graph_input import read_file
from pose_graph_ros.cli.solve_starts import Problem, Solution, solve
from pose_graph_ros.core.batch.outcome import Status
from pose_graph_ros.core.exceptions import ConfigError, PoseGraphError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray

if TYPE_CHECKING:
    from pose_graph_ros.cli.believe import Doubt
    from pose_graph_ros.cli.marginals import Marginals

TOLD = 1e-6  # relative error of covariances from which on it is told
N_LARGEST = 5  # number of edges, of observed nodes, and of names, that are printed


def _arguments(options: argparse.Namespace) -> None:
    """Complete the arguments: in `--robust FILE`, what follows the option is the file."""
    if options.robust not in (None, *METHODS):
        if options.graph is not None:
            raise ConfigError(
                f'--robust: expected {", ".join(METHODS)} or nothing, got {options.robust!r}')
        options.graph, options.robust = Path(options.robust), METHODS[0]
    if options.graph is None:
        raise ConfigError('expected the file of a graph')
    for path in options.out:
        if not path.parent.is_dir():
            raise ConfigError(f'--out: there is no folder {path.parent} for {path.name}')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    _arguments(options)
    file, order = read_file(options.graph, options.edge2)
    tables = [path for path in options.out if path.suffix == '.csv']
    which = options.marginals or ('all' if len(tables) > 0 else None)
    problem = Problem(file, plain=(
        options.robust is None and which is None and options.start == 'chordal'))
    rows = None if which is None else _chosen_rows(problem, which)
    text = _Text(options.json)
    held = problem.hold_parts()
    graph = problem.graph
    before = graph.energies().chi2
    text.add(f'{graph.n_nodes} hidden nodes, {len(graph.edges)} edges, '
             f'{len(graph.observed)} observed nodes; chi2 {before:.9g} as read')
    if not file.has_start:
        text.add('nodes without a pose in the file start at poses composed from the edges')
    if len(held) > 0:
        text.add(f'nothing held {len(held)} more parts of the graph; now their first nodes are '
                 f'fixed: {_listed(file.ids[held])}')
    begin = time.monotonic()
    doubt = None if options.robust is None else _doubt(problem, options)
    for line in () if doubt is None else doubt.lines:
        text.add(line)
    decided = doubt is not None and doubt.cost is not None
    solution = solve(problem, 'present' if decided else options.start)
    seconds = time.monotonic() - begin
    certificate = None
    if options.certificate:
        from pose_graph_ros.cli.solve_certificate import with_certificate  # noqa: PLC0415

        solution, certificate = with_certificate(problem, solution, eigenvalue=options.json)
    doubted = np.empty(0, np.int64) if doubt is None else doubt.doubted
    _tell(problem, solution, seconds, doubted, text)
    if certificate is not None:
        for line in certificate.lines():
            text.add(line)
    table = None if rows is None else _marginals(problem, solution, rows)
    for path in options.out:
        if path in tables:
            path.write_text('\n'.join(table.lines() if table else ()) + '\n', encoding='ascii')
        else:
            _write_graph(problem, path)
    if options.json:
        values = _values(problem, solution, doubted, file.ids[held])
        values |= {'chi2_start': before, 'seconds': seconds, 'edge2': order,
                   'robust': _decision(doubt),
                   'certificate': None if certificate is None else certificate.values()}
        if table is not None:
            values |= {'marginals_relative_error': table.relative_error,
                       **({} if len(tables) > 0 else {'marginals': table.rows})}
        print(json.dumps(_finite(values), indent=2, allow_nan=False))
    elif table is not None and len(tables) == 0:
        print('\n'.join(table.lines()))
    return 0 if solution.result.status is Status.CONVERGED else 1


class _Text:
    """Prints lines for people; with JSON there are none."""

    def __init__(self, silent: bool) -> None:
        self._silent = silent

    def add(self, line: str) -> None:
        if not self._silent:
            print(line)


def _tell(
    problem: Problem, solution: Solution, seconds: float, doubted: IntArray, text: _Text,
) -> None:
    """Print chi2 with how it was reached, and the largest energies."""
    graph, ids, result = problem.graph, problem.ids, solution.result
    for name, each in solution.tried:
        text.add(f'  from the {name}: chi2 {each.chi2:.9g}, {each.status.value} after '
                 f'{each.iterations} iterations')
    text.add(f'chi2 {result.chi2:.9g}, {result.status.value} after {result.iterations} iterations '
             f'from the {solution.start}, {seconds:.3f} s'
             f'{": " if result.reason else ""}{result.reason}')
    energies = graph.energies()
    for k in _largest(energies.edges, doubted):
        text.add(f'  edge {ids[graph.edges.i[k]]} -> {ids[graph.edges.j[k]]}: '
                 f'energy {energies.edges[k]:.4g}')
    for k in np.argsort(energies.observed)[::-1][:N_LARGEST]:
        text.add(f'  observed node on {ids[graph.observed.node[k]]}: '
                 f'energy {energies.observed[k]:.4g}')


def _values(
    problem: Problem, solution: Solution, doubted: IntArray, held: IntArray,
) -> dict[str, Any]:
    """Return most of the JSON output."""
    graph, ids, result = problem.graph, problem.ids, solution.result
    edges = graph.edges_at(doubted)
    return {
        'hidden_nodes': graph.n_nodes, 'edges': len(graph.edges),
        'observed_nodes': len(graph.observed), 'chi2': result.chi2,
        'iterations': result.iterations, 'status': result.status.value, 'reason': result.reason,
        'start': solution.start, 'starts': [
            {'start': name, 'chi2': each.chi2, 'iterations': each.iterations,
             'status': each.status.value} for name, each in solution.tried],
        'held': held.tolist(),
        'doubted': np.stack((ids[edges.i], ids[edges.j]), axis=1).tolist()}


def _finite(value: Any) -> Any:
    """Return values for JSON, which has no infinity: None in its place."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _chosen_rows(problem: Problem, which: str) -> IntArray:
    """Return the rows of nodes; what knows of covariances is loaded only if asked for."""
    from pose_graph_ros.cli.marginals import chosen_rows  # noqa: PLC0415

    return chosen_rows(problem, which)


def _decision(doubt: 'Doubt | None') -> dict[str, Any] | None:
    """Return the key `robust` of the JSON output."""
    if doubt is None:
        return None
    return {'method': doubt.method, 'closures': doubt.n_closures,
            'doubted': len(doubt.doubted), 'scale': doubt.scale,
            'truncated_cost': doubt.cost, 'truncated_cost_of_all': doubt.cost_of_all}


def _doubt(problem: Problem, options: argparse.Namespace) -> 'Doubt':
    """Decide about closures; what does so takes longer to load than all else here."""
    from pose_graph_ros.cli.believe import doubt  # noqa: PLC0415

    return doubt(problem, options.robust, options.closure_sigma)


def _write_graph(problem: Problem, path: Path) -> None:
    from pose_graph_ros.core.io.g2o_writing import write_g2o  # noqa: PLC0415

    write_g2o(problem.graph, path, problem.ids)


def _marginals(problem: Problem, solution: Solution, rows: IntArray) -> 'Marginals':
    from pose_graph_ros.cli.marginals import marginals  # noqa: PLC0415

    if solution.result.status is Status.FAILED or not solution.determined:
        raise PoseGraphError(f'--marginals: {solution.result.reason}')
    table = marginals(problem, rows)
    if table.relative_error > TOLD:
        print(f'warning: by rounding, covariances may be off by {table.relative_error:.1g} of '
              f'themselves', file=sys.stderr)
    return table


def _largest(energies: FloatArray, left_out: IntArray) -> IntArray:
    """Return the rows with the largest energies, without some of them."""
    order = np.argsort(energies)[::-1]
    return np.asarray(order[~np.isin(order, left_out)][:N_LARGEST])


def _listed(names: IntArray) -> str:
    """Return names separated by commas, at most five."""
    return ', '.join(map(str, names[:N_LARGEST].tolist())) + (
        ', ...' if len(names) > N_LARGEST else '')
