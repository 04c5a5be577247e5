# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Optimise a g2o, TORO or iSAM file, and print the constraints with the largest energies.

What takes long to load, such as compiled kernels, is imported where it is used.
"""
# ruff: noqa: PLC0415

import argparse
from collections.abc import Callable
import json
import math
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np

from pose_graph_ros.cli.arguments import METHODS
from pose_graph_ros.cli.graph_input import read_file, rows_of
from pose_graph_ros.cli.solve_starts import CONFIG, Problem, Solution, solve, with_certificate
from pose_graph_ros.core.batch.levenberg_marquardt import Status
from pose_graph_ros.core.exceptions import ConfigError, PoseGraphError
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import upper
from pose_graph_ros.core.io.g2o import write_g2o

N_LARGEST = 5  # edges, observed nodes, and names, that are printed
COLUMNS = ('id', 'x', 'y', 'theta', 'cov_xx', 'cov_xy', 'cov_xtheta', 'cov_yy', 'cov_ytheta',
           'cov_thetatheta')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    # in `--robust FILE`, what follows the option is the file
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
    return _solve(options, (lambda _: None) if options.json else print)


def _solve(options: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Solve, write and print the results; return the exit code."""
    file = read_file(options.graph, options.edge2)
    tables = [path for path in options.out if path.suffix == '.csv']
    which = options.marginals or ('all' if len(tables) > 0 else None)
    problem = Problem(file, plain=(
        options.robust is None and which is None and options.start == 'chordal'))
    rows = None if which is None else np.arange(len(problem.ids)) if which == 'all' else (
        np.array([problem.engine.newest_pose]) if which == 'newest'
        else rows_of(problem.ids, which, '--marginals'))
    held, graph = problem.held, problem.graph
    before = graph.energies().chi2
    say(f'{graph.n_nodes} hidden nodes, {len(graph.factors.edges)} edges, '
        f'{len(graph.factors.observed)} observed nodes; chi2 {before:.9g} as read')
    if not file.has_start:
        say('nodes without a pose in the file start at poses composed from the edges')
    if len(held) > 0:
        names = ', '.join(map(str, file.ids[held[:N_LARGEST]].tolist()))
        say(f'nothing held {len(held)} more parts of the graph; now their first nodes are '
            f'fixed: {names}{", ..." if len(held) > N_LARGEST else ""}')
    begin, start = time.monotonic(), options.start
    doubted, decision, certificate = np.empty(0, np.int64), None, None
    if options.robust is not None:
        from pose_graph_ros.cli.believe import doubt

        doubted, decision, lines = doubt(problem, options.robust, options.closure_sigma)
        for line in lines:
            say(line)
        start = start if decision['truncated_cost'] is None else 'present'
    solution = solve(problem, start)
    seconds = time.monotonic() - begin
    if options.certificate:
        solution, certificate = with_certificate(problem, solution, eigenvalue=options.json)
    say('\n'.join([*_lines(problem, solution, seconds, doubted),
                   *([] if certificate is None else certificate.lines())]))
    table, error = ([], 0.0) if rows is None else _marginals(problem, solution, rows)
    text = '\n'.join([','.join(COLUMNS), *(','.join(
        '' if value is None else repr(value) for value in row.values()) for row in table), ''])
    for path in options.out:
        if path in tables:
            path.write_text(text, encoding='ascii')
        else:
            write_g2o(problem.graph, path, problem.ids)
    if options.json:
        graph, result = problem.graph, solution.result
        edges = graph.factors_at(doubted)
        print(json.dumps(_finite({
            'hidden_nodes': graph.n_nodes, 'edges': len(graph.factors.edges),
            'observed_nodes': len(graph.factors.observed), 'chi2': result.chi2,
            'iterations': result.iterations, 'status': result.status.value,
            'reason': result.reason, 'start': solution.start, 'starts': [
                {'start': name, 'chi2': each.chi2, 'iterations': each.iterations,
                 'status': each.status.value} for name, each in solution.tried],
            'held': file.ids[held].tolist(),
            'doubted': np.stack((problem.ids[edges.i], problem.ids[edges.j]), axis=1).tolist(),
            'chi2_start': before, 'seconds': seconds, 'edge2': file.edge2_order,
            'robust': decision,
            'certificate': None if certificate is None else certificate.values(),
            **({} if rows is None else {'marginals_relative_error': error}),
            **({} if rows is None or len(tables) > 0 else {'marginals': table})}),
            indent=2, allow_nan=False))
    elif rows is not None and len(tables) == 0:
        print(text, end='')
    return 0 if solution.result.status is Status.CONVERGED else 1


def _lines(problem: Problem, solution: Solution, seconds: float, doubted: IntArray) -> list[str]:
    """Return chi2 with how it was reached, and the largest energies."""
    graph, ids, result = problem.graph, problem.ids, solution.result
    energies, factors = graph.energies().factors, graph.factors
    order = np.argsort(energies)[::-1]
    is_edge = factors.j[order] >= 0
    return [
        *(f'  from the {name}: chi2 {each.chi2:.9g}, {each.status.value} after '
          f'{each.iterations} iterations' for name, each in solution.tried),
        f'chi2 {result.chi2:.9g}, {result.status.value} after {result.iterations} iterations '
        f'from the {solution.start}, {seconds:.3f} s'
        f'{": " if result.reason else ""}{result.reason}',
        *(f'  edge {ids[factors.i[k]]} -> {ids[factors.j[k]]}: energy {energies[k]:.4g}'
          for k in order[is_edge & ~np.isin(order, doubted)][:N_LARGEST]),
        *(f'  observed node on {ids[factors.i[k]]}: energy {energies[k]:.4g}'
          for k in order[~is_edge][:N_LARGEST])]


def _finite(value: Any) -> Any:
    """Return values for JSON, which has no infinity: None in its place."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _marginals(
    problem: Problem, solution: Solution, rows: IntArray,
) -> tuple[list[dict[str, float | None]], float]:
    """
    Return poses and covariances in map axes of some nodes by `COLUMNS`, after the optimisation.

    The heading of a point is None. With them comes the relative error that rounding may make: the
    condition number times epsilon.
    """
    from pose_graph_ros.core.batch.optimizer import optimize
    from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

    if solution.result.status is Status.FAILED or not solution.determined:
        raise PoseGraphError(f'--marginals: {solution.result.reason}')
    graph = problem.engine
    # H at the optimum; the last step before it was linearised one step away
    optimize(graph, CONFIG)
    covariances = IncrementalSmoother(graph=graph).covariances()
    table = []
    for row, pose, numbers in zip(rows.tolist(), graph.poses[rows].tolist(),
                                  upper(covariances[rows]).tolist(), strict=True):
        values: list[float | None] = [*pose, *numbers]
        if not graph.is_pose[row]:
            values = [None if k in {2, 5, 7, 8} else value for k, value in enumerate(values)]
        table.append(dict(zip(COLUMNS, [int(problem.ids[row]), *values], strict=True)))
    # a bound of the condition number of H with a diagonal of ones: the trace of its inverse, each
    # variance times what constraints add to H there
    added, factors = np.zeros((graph.n_nodes, 3)), graph.factors_by_row
    information = factors.weighted_information
    position = information[:, 0, 0] + information[:, 1, 1]
    arm = np.where(factors.j >= 0, np.sum(factors.mean[:, :2]**2, axis=1), 0.0)
    by_factor = np.column_stack((position, position, information[:, 2, 2] + arm * position))
    for ends in (factors.i, factors.j):
        np.add.at(added, ends[ends >= 0], by_factor[ends >= 0])
    error = float(np.finfo(float).eps) * max(
        float(np.sum(added * np.einsum('mii->mi', covariances))), 1.0)
    if error > 1e-6:
        print(f'warning: by rounding, covariances may be off by {error:.1g} of themselves',
              file=sys.stderr)
    return table, error
