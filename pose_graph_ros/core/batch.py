# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Batch optimisation of a whole graph, in its tables.

The order of elimination and the cliques are worked out once (`symbolic`), the iterations run over
them without Python (`descent`). Afterwards the tree of cliques is that of the last linearization,
and the incremental smoother goes on from there.
"""

import contextlib
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from pose_graph_ros.core import (
    editing,
    gauss_newton,
    initialization,
    symbolic,
    tables as tb,
)
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.descent import descend, End
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.graph import Graph
from pose_graph_ros.core.se2 import FloatArray


class Status(Enum):
    """How an optimisation ended."""

    CONVERGED = 'converged'
    MAX_ITERATIONS = 'max_iterations'
    STALLED = 'stalled'
    """No step lowers chi2, though H and b promise it: at the jump of a wrapped angle."""
    FAILED = 'failed'


@dataclass(frozen=True, slots=True)
class BatchResult:
    """What an optimisation did."""

    status: Status
    reason: str
    """One sentence when the status is FAILED, else empty."""
    iterations: int
    """Steps that were taken."""
    chi2_before: float
    chi2: float


_STATUS = {End.CONVERGED: Status.CONVERGED, End.STALLED: Status.STALLED,
           End.OUT_OF_ITERATIONS: Status.MAX_ITERATIONS, End.UNDETERMINED: Status.FAILED}


def optimize(graph: Graph, config: SolverConfig) -> BatchResult:
    """
    Move the hidden nodes to the minimum of chi2 that lies downhill.

    A numerical failure is a result, not an exception; the poses are then as before the call, and
    the smoother eliminates everything anew at its next step. Not for use between `Graph.begin`
    and `Graph.undo`: the tree of cliques is a new one.
    """
    chi2, answer = _look_before(graph)
    if answer is not None:
        return answer
    poses = graph.poses.copy()
    return _finished(graph, poses, chi2, _descend(graph, config, _analysed(graph), chi2))


def optimize_from_nothing(graph: Graph, config: SolverConfig) -> BatchResult:
    """
    Move the hidden nodes to a minimum of chi2 without the present poses for a guess.

    The start is the chordal one where the constraints determine headings, else that of headings
    and positions solved for together. If it leads to something worse than the present poses are,
    they are the start after all. Else as `optimize`.
    """
    chi2, answer = _look_before(graph)
    if answer is not None:
        return answer
    poses, cliques = graph.poses.copy(), _analysed(graph)
    head = graph.memory.head
    result = None
    with contextlib.suppress(LinearSolveError):
        try:
            start = initialization.chordal_poses(head, cliques)
        except LinearSolveError:
            from pose_graph_ros.core.joint_start import joint  # noqa: PLC0415  (it needs SciPy)

            start = joint(graph)
        gauss_newton.put_poses(head, start)
        result = _descend(graph, config, cliques, _chi2(graph))
    if result is None or result.status is Status.FAILED or not result.chi2 <= chi2:
        gauss_newton.put_poses(head, poses)
        result = _descend(graph, config, cliques, chi2)
    return _finished(graph, poses, chi2, result)


def _look_before(graph: Graph) -> tuple[float, BatchResult | None]:
    """Return chi2, and the result if there is nothing to optimise or no way to."""
    head = graph.memory.head
    chi2 = _chi2(graph)
    if not np.isfinite(chi2):
        return chi2, _failed('chi2 is not finite', chi2)
    if np.all(graph.fixed):
        return chi2, BatchResult(Status.CONVERGED, '', 0, chi2, chi2)
    node, count = symbolic.loose_part(head)
    if node >= 0:
        return chi2, _failed(
            f'hidden node {node} and {count - 1} others are tied to no fixed and no observed '
            f'node: their poses are not determined', chi2)
    return chi2, None


def _chi2(graph: Graph) -> float:
    return float(gauss_newton.evaluate(graph.memory.head, np.empty((graph.n_nodes, 3)))[0])


def _analysed(graph: Graph) -> symbolic.Cliques:
    """Work out the cliques and make room for them."""
    memory = graph.memory
    analysis = symbolic.analyse(memory.head)
    memory.ensure('pool_f', analysis.need_f)
    memory.ensure('pool_i', analysis.need_i)
    memory.ensure('work_f', analysis.largest)
    return analysis.cliques


def _descend(
    graph: Graph, config: SolverConfig, cliques: symbolic.Cliques, chi2: float,
) -> BatchResult:
    """Optimise from the present poses; if that fails they may be anywhere."""
    head = graph.memory.head
    symbolic.plant(head, cliques)
    end, iterations, after = descend(head, chi2, config)
    if end is End.UNDETERMINED:
        return _failed(f'hidden node {head[tb.BAD_NODE]} is not determined', chi2)
    return BatchResult(_STATUS[end], '', iterations, chi2, after)


def _finished(graph: Graph, poses: FloatArray, chi2: float, result: BatchResult) -> BatchResult:
    """Return the result for the whole call, the poses as they were if it has failed."""
    if result.status is Status.FAILED:
        gauss_newton.put_poses(graph.memory.head, poses)
        editing.restart(graph.memory.head)
        return _failed(result.reason, chi2)
    return replace(result, chi2_before=chi2)


def _failed(reason: str, chi2: float) -> BatchResult:
    return BatchResult(Status.FAILED, reason, 0, chi2, chi2)
