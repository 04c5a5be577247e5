# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Optimise a g2o, TORO or iSAM file, and print the constraints with the largest energies.

It is optimised from one or several starts, and the minimum is certified, which may lead to a
better one. What takes long to load, such as compiled kernels, is imported where it is used.
"""
# ruff: noqa: PLC0415

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
import re
import sys
import time
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np

from pose_graph_ros.cli import finite
from pose_graph_ros.cli.arguments import METHODS, STARTS
from pose_graph_ros.cli.graph_input import read_file, rows_of
from pose_graph_ros.cli.solved_graph import SolvedGraph
from pose_graph_ros.core import sparse
from pose_graph_ros.core.batch.levenberg_marquardt import BatchResult, Start, Status
from pose_graph_ros.core.batch.plain_optimizer import PlainGraph
from pose_graph_ros.core.exceptions import ConfigError, LinearSolveError, PoseGraphError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Poses
from pose_graph_ros.core.graph import constraints, graph_update
from pose_graph_ros.core.io.g2o import compose_missing, GraphFile, write_g2o
from pose_graph_ros.offline.certify import Certificate, certify, NearHessian, Verdict
from pose_graph_ros.offline.chordal_objective import formulate, NotCoveredError

if TYPE_CHECKING:
    from pose_graph_ros.core.graph.graph import Graph

N_LARGEST = 5  # edges, observed nodes, and names, that are printed
COLUMNS = ('id', 'x', 'y', 'theta', 'cov_xx', 'cov_xy', 'cov_xtheta', 'cov_yy', 'cov_ytheta',
           'cov_thetatheta')
MOST_PLAIN_NODES = 20_000  # up to which a graph is solved without compiled kernels, if possible


Report = tuple[dict[str, Any], list[str]]
"""What is said of the minimum: `certificate` in the JSON output, docs/tools/solve.md; lines."""


class Solution(NamedTuple):
    """A graph at the lowest minimum that was found."""

    result: BatchResult
    start: str  # poses from which it was reached
    determined: bool  # whether the constraints determine all poses
    tried: tuple[tuple[str, BatchResult], ...] = ()  # all starts, if there were several
    optimizer: PlainGraph | None = None  # what found it, if no compiled kernels were used


class Problem:
    """
    A graph from a file that is to be optimised; parts that nothing holds have a fixed node.

    With `plain` compiled kernels are not used if the graph is simple and not large: loading them
    takes longer than to solve such a graph.
    """

    def __init__(self, file: GraphFile, *, plain: bool) -> None:
        rows, edges, observed = file.rows, file.rows.factors.edges, file.rows.factors.observed
        part = sparse.components(edges.i, edges.j, len(file.ids))
        is_held = np.isin(part, part[rows.fixed]) | np.isin(part, part[observed.i])
        is_first = (part == np.arange(len(part))) & ~is_held
        self.ids, self.has_start = file.ids, file.has_start
        self.held = np.flatnonzero(is_first)
        """First nodes of the parts that had no fixed and no observed one."""
        self._file = replace(file, rows=rows._replace(fixed=rows.fixed | is_first))
        self.plain: PlainGraph | None = None  # the graph, if no kernels are used
        if (plain and len(rows.poses) <= MOST_PLAIN_NODES and not np.all(rows.fixed)
                and PlainGraph.is_covered(rows)):
            self.plain = PlainGraph(self._file.rows)

    @property
    def graph(self) -> 'Graph | PlainGraph':
        """The graph, with the best poses that were found."""
        return self._compiled if self.plain is None else self.plain

    @cached_property
    def _compiled(self) -> 'Graph':
        graph = self._file.graph
        del self._file  # of a large graph the rows are a fifth of all memory
        return graph

    @property
    def engine(self) -> 'Graph':
        """The graph for the compiled kernels, at its present poses; it is used from now on."""
        graph = self._compiled
        if self.plain is not None:
            graph.set_poses(self.plain.poses)
            self.plain = None
        return graph

    def solved(self, before: Poses, chi2_before: float, result: BatchResult,
               doubted: IntArray) -> SolvedGraph:
        """Return the graph at its optimum; `doubted` are rows of edges, whose weight is 0."""
        graph = self.graph
        factors, place = graph.factors_by_row, np.cumsum(graph.is_pose)
        squares = graph.energies().factors
        if len(doubted) > 0:
            squares[doubted] = self.engine.unweighted_energies(doubted)
        return SolvedGraph(
            self.ids, graph.is_pose, graph.fixed, before, graph.poses.copy(), factors,
            np.sqrt(squares),
            (factors.kind <= constraints.FactorKind.LOOP_CLOSURE) & (
                np.abs(place[factors.j] - place[factors.i]) == 1),
            np.isin(np.arange(len(factors)), doubted), chi2_before, result)


def solve(problem: Problem, start: str) -> Solution:
    """Return the result of optimising a graph in place."""
    if start != 'best':
        return _solve_from(problem, start, problem.graph.poses.copy())
    present, found = problem.graph.poses.copy(), list[tuple[Solution, FloatArray]]()
    # poses that were composed from edges are those of odometry
    names = [name for name in STARTS if name != 'best' and (name != 'file' or problem.has_start)]
    for name in names:
        found.append((_solve_from(problem, name, present), problem.graph.poses.copy()))
    best, poses = min(found, key=lambda each: (
        each[0].result.status is Status.FAILED, each[0].result.chi2))
    if best is not found[-1][0]:
        best = resumed(problem, best, poses)
    return best._replace(tried=tuple((each.start, each.result) for each, _ in found))


def resumed(problem: Problem, solution: Solution, poses: Poses) -> Solution:
    """
    Return a solution after optimising from its poses again, so that the graph is factorised there.
    """
    again = _solve_from(problem, 'present', poses)
    return (solution._replace(result=replace(solution.result, chi2=again.result.chi2))
            if again.result.status is Status.CONVERGED else again._replace(start=solution.start))


def _solve_from(problem: Problem, start: str, poses: FloatArray) -> Solution:
    if problem.plain is not None and start in {'chordal', 'present'}:
        problem.plain.set_poses(poses)
        found = problem.plain.optimize(Start.CHORDAL if start == 'chordal' else Start.PRESENT)
        if found is not None:
            return Solution(found, found.start.value, True, (), problem.plain)
    # loads the compiled kernels
    from pose_graph_ros.core.batch import optimizer

    graph = problem.engine
    if start == 'odometry':
        # composed from odometry if that joins all nodes, else from all edges
        edges, poses, known = graph.factors.edges, graph.poses.copy(), graph.fixed.copy()
        edges = edges.rows(edges.weight > 0.0)
        steps = edges.rows(np.abs(edges.j - edges.i) == 1)
        joins_all = len(np.unique(np.minimum(steps.i, steps.j))) == graph.n_nodes - 1
        compose_missing(poses, known, steps if joins_all else edges)
        poses[~graph.is_pose, 2] = 0.0
    graph.set_poses(poses)
    del poses   # a large graph has its own copies while it is optimised
    optimize = (optimizer.optimize_from_linear_start if start == 'chordal' else optimizer.optimize)
    result, determined = _held_weakly(graph, partial(optimize, config=optimizer.PATIENT))
    reason = re.sub(r'hidden node (\d+)', lambda node: f'hidden node {problem.ids[int(node[1])]}',
                    result.reason)
    # where it failed, the poses are those before, but all linear starts were tried
    names = {'file': 'present poses', 'odometry': 'odometry'} | (
        {'chordal': Start.CHORDAL.value} if result.status is Status.FAILED else {})
    return Solution(replace(result, reason=reason), names.get(start, result.start.value),
                    determined)


def _held_weakly(
    graph: 'Graph', optimize: Callable[['Graph'], BatchResult],
) -> tuple[BatchResult, bool]:
    """
    Optimise a graph; if poses are not determined, choose those near the present ones.

    The result has the reason then. It is the minimum of chi2 with a weak prior on each node, which
    is not added to the graph. Also return whether the poses are determined.
    """
    result = optimize(graph)
    if result.status is not Status.FAILED or not np.isfinite(result.chi2):
        return result, True
    copy, n = type(graph)(), graph.n_nodes
    copy.fill(graph.rows())
    typical = np.einsum('mii->mi', graph.factors.weighted_information)
    weak = 1e-7 * np.median(typical[typical > 0.0]) * (
        np.eye(3) * (np.arange(3) < graph.dimension[:, None, None]))
    copy.apply(graph_update.GraphUpdate(factors=constraints.Factors.on(
        np.arange(n), None, graph.poses.copy(), weak, [constraints.FactorKind.GLOBAL_POSE] * n)))
    other = optimize(copy)
    if other.status is Status.FAILED:
        return result, False
    graph.set_poses(copy.poses)
    return replace(other, chi2=graph.energies().chi2,
                   reason=f'{result.reason}; it is held near its start'), False


def _report(made: Certificate | None, reason: str, seconds: float, chi2: float, *,
            bound: float | None = None, from_it: float | None = None) -> Report:
    """
    Return what a certificate says of a solution, given its chi2 with the error (3.48).

    Without one there is a reason. A lower bound of chi2 is given if one was proved, and the chi2
    that was reached from the minimum that it found, if that was tried.
    """
    values = {
        'verdict': (Verdict.NOT_ATTEMPTED if made is None else made.verdict).value,
        'reason': reason, 'seconds': seconds,
        **{key: getattr(made, {'lambda_min': 'smallest'}.get(key, key), None) for key in (
            'chi2', 'gap', 'relative_gap', 'lambda_min', 'rank')},
        'lower_minimum': made is not None and made.is_lower, 'chi2_from_it': from_it,
        'chi2_bound': bound, 'chi2_gap': None if bound is None else max(chi2 - bound, 0.0)}
    if made is None:
        return values, [f'certificate: not attempted, because {reason}']
    lines = [(f'certificate: certified, {seconds:.3f} s: the chordal objective, {made.chi2:.9g} '
              f'at its minimum, is nowhere lower by more than {made.gap:.2g}')
             if made.verdict is Verdict.CERTIFIED else
             (f'certificate: not certified, gap {made.gap:.4g} ({made.relative_gap:.2%}), '
              f'{seconds:.3f} s: the chordal objective is {made.chi2:.9g} at the lowest minimum '
              'found')]
    if made.is_lower:
        lines.append(f'  near the poses found first, its minimum is {made.near:.9g}')
    if from_it is not None:
        lines.append(f'  from there, chi2 becomes {from_it:.9g}')
    return values, [*lines, '  this bounds no chi2, whose information depends on the direction; '
                    'it only speaks for the headings' if bound is None else
                    f'  so no poses have a chi2 below {bound:.9g}; that found is '
                    f'{max(chi2 - bound, 0.0):.2g} above this']


def _hessian(problem: Problem, solution: Solution) -> NearHessian:
    """Return what the solver has left of the Hessian at the minimum."""
    if solution.optimizer is not None:
        return NearHessian(solution.optimizer.nodes.places, solution.optimizer.heading_steps)
    from pose_graph_ros.core.batch import gauss_newton

    return NearHessian(None, partial(gauss_newton.heading_steps, problem.engine.memory))


def with_certificate(problem: Problem, solution: Solution, *,
                     eigenvalue: bool) -> tuple[Solution, Report]:
    """Return the certificate of a solution, and a better solution if it leads to one."""
    begin, graph = time.monotonic(), problem.graph

    def none(reason: str) -> tuple[Solution, Report]:
        return solution, _report(None, reason, time.monotonic() - begin, solution.result.chi2)

    if not solution.determined:
        return none('the constraints do not determine the poses')
    if solution.result.status is Status.FAILED:
        return none(f'the optimisation failed: {solution.result.reason}')
    try:
        formulation = formulate(graph)
        made = certify(formulation, graph.poses, eigenvalue=eigenvalue,
                       hessian=_hessian(problem, solution))
    except (NotCoveredError, LinearSolveError) as error:
        return none(str(error))
    found = None
    if made.is_lower:
        poses = graph.poses.copy()
        graph.set_poses(made.poses)
        other = solve(problem, 'present')
        found = other.result.chi2
        solution = Solution(
            other.result, 'minimum of the chordal objective', other.determined, solution.tried,
        ) if other.result.is_better_than(solution.result) else resumed(problem, solution, poses)
    bound = max(made.bound, 0.0) if formulation.below_chi2 else None
    return solution, _report(made, '', time.monotonic() - begin, solution.result.chi2,
                             bound=bound, from_it=found)


# --- the tool

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
    for option, path in (*(('--out', each) for each in options.out),
                         *([] if options.picture is None else [('--picture', options.picture)])):
        if not path.parent.is_dir():
            raise ConfigError(f'{option}: there is no folder {path.parent} for {path.name}')
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
    has_start, edge2 = file.has_start, file.edge2_order
    del file
    held, graph = problem.held, problem.graph
    before = graph.energies().chi2
    say(f'{graph.n_nodes} hidden nodes, {len(graph.factors.edges)} edges, '
        f'{len(graph.factors.observed)} observed nodes; chi2 {before:.9g} as read')
    if not has_start:
        say('nodes without a pose in the file start at poses composed from the edges')
    if len(held) > 0:
        names = ', '.join(map(str, problem.ids[held[:N_LARGEST]].tolist()))
        say(f'nothing held {len(held)} more parts of the graph; now their first nodes are '
            f'fixed: {names}{", ..." if len(held) > N_LARGEST else ""}')
    poses = graph.poses.copy()
    solution, doubted, decision, certificate, proof, seconds = optimised(problem, options, say)
    if problem.plain is None:
        from pose_graph_ros.core.batch.optimizer import uproot

        uproot(problem.engine)  # what follows needs memory as well
    say('\n'.join([*_lines(problem, solution, seconds, doubted), *proof]))
    table, error = ([], 0.0) if rows is None else _marginals(problem, solution, rows)
    text = '\n'.join([','.join(COLUMNS), *(','.join(
        '' if value is None else repr(value) for value in row.values()) for row in table), ''])
    for path in options.out:
        if path in tables:
            path.write_text(text, encoding='ascii')
        else:
            write_g2o(problem.graph, path, problem.ids)
    if options.picture is not None:
        # matplotlib takes half a second to load
        from pose_graph_ros.cli.picture import draw_solved

        draw_solved(problem.solved(poses, before, solution.result, doubted),
                    options.picture, options.graph.name)
    if options.json:
        import json

        graph, result = problem.graph, solution.result
        edges = graph.factors_at(doubted)
        print(json.dumps(finite({
            'hidden_nodes': graph.n_nodes, 'edges': len(graph.factors.edges),
            'observed_nodes': len(graph.factors.observed), 'chi2': result.chi2,
            'iterations': result.iterations, 'status': result.status.value,
            'reason': result.reason, 'start': solution.start, 'starts': [
                {'start': name, 'chi2': each.chi2, 'iterations': each.iterations,
                 'status': each.status.value} for name, each in solution.tried],
            'held': problem.ids[held].tolist(),
            'doubted': np.stack((problem.ids[edges.i], problem.ids[edges.j]), axis=1).tolist(),
            'chi2_start': before, 'seconds': seconds, 'edge2': edge2,
            'robust': decision, 'certificate': certificate,
            **({} if rows is None else {'marginals_relative_error': error}),
            **({} if rows is None or len(tables) > 0 else {'marginals': table})}),
            indent=2, allow_nan=False))
    elif rows is not None and len(tables) == 0:
        print(text, end='')
    return 0 if solution.result.status is Status.CONVERGED else 1


class Optimised(NamedTuple):
    """What was found of a graph."""

    solution: Solution
    doubted: IntArray  # rows of closures
    decision: dict[str, Any] | None  # `robust` in the JSON output
    certificate: dict[str, Any] | None  # and this and the next as in `Report`
    proof: list[str]
    seconds: float  # without the certificate


def optimised(problem: Problem, options: argparse.Namespace,
              say: Callable[[str], None]) -> Optimised:
    """Solve a graph in place, by the options for how to start, what to doubt and to certify."""
    begin, start = time.monotonic(), options.start
    doubted, decision, certificate, proof = np.empty(0, np.int64), None, None, list[str]()
    if options.robust is not None:
        from pose_graph_ros.cli.believe import doubt

        doubted, decision, lines = doubt(problem, options.robust, options.closure_sigma)
        for line in lines:
            say(line)
        start = start if decision['truncated_cost'] is None else 'present'
    solution = solve(problem, start)
    seconds = time.monotonic() - begin
    if options.certificate:
        solution, (certificate, proof) = with_certificate(
            problem, solution, eigenvalue=options.json)
    return Optimised(solution, doubted, decision, certificate, proof, seconds)


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
        f'from the {solution.start}, {seconds:.3f} s{": " if result.reason else ""}'
        f'{result.reason}',
        *(f'  edge {ids[factors.i[k]]} -> {ids[factors.j[k]]}: energy {energies[k]:.4g}'
          for k in order[is_edge & ~np.isin(order, doubted)][:N_LARGEST]),
        *(f'  observed node on {ids[factors.i[k]]}: energy {energies[k]:.4g}'
          for k in order[~is_edge][:N_LARGEST])]


def _marginals(problem: Problem, solution: Solution,
               rows: IntArray) -> tuple[list[dict[str, float | None]], float]:
    """
    Return poses and covariances in map axes of some nodes by `COLUMNS`, after the optimisation.

    The heading of a point is None. With them comes the relative error that rounding may make: the
    condition number times epsilon.
    """
    from pose_graph_ros.core.batch.optimizer import optimize, PATIENT
    from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

    if solution.result.status is Status.FAILED or not solution.determined:
        raise PoseGraphError(f'--marginals: {solution.result.reason}')
    graph = problem.engine
    # H at the optimum; the last step before it was linearised one step away
    optimize(graph, PATIENT)
    covariances = IncrementalSmoother(graph=graph).covariances()
    table = []
    for row, pose, numbers in zip(rows.tolist(), graph.poses[rows].tolist(),
                                  constraints.upper(covariances[rows]).tolist(), strict=True):
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
