# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A trial: the graph with other weights, optimised as a copy while the graph itself goes on.

The batch optimisation of a large graph takes much longer than an update may, so a trial is worked
on in parts of at most an iteration; the last one eliminates the copy. It fails where it takes many
iterations: every update after it would take as many, or diverge. The result can be compared
with the graph, and adopted by the smoother with all that was added meanwhile
(`IncrementalSmoother.adopt`); or it is dropped, without a trace.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import BatchResult, Parts, Start, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# With more iterations it would converge where an update does not: at a minimum with errors so
# large that Gauss-Newton leads away from it.
_CONFIG = SolverConfig(max_iterations=optimizer.TRUSTED_ITERATIONS, step_tolerance=1e-6)
# The others take longer than a part may.
_STARTS = (Start.CHORDAL, Start.PRESENT)


class Trial:
    """
    A copy of a graph with other weights, which is optimised in parts.

    Parameters
    ----------
    graph : Graph, of which the smoother has solved for all edits
    copy : Graph, empty
    update : GraphUpdate, new weights
    eliminate : callable, eliminates the copy as a whole; tells whether that was possible
    poses : ndarray, shape (N, 3), optional
        Where to start; by default the better of a linear start and the present poses.

    """

    def __init__(
        self, graph: Graph, copy: Graph, update: GraphUpdate, eliminate: Callable[[], bool],
        poses: FloatArray | None = None,
    ) -> None:
        self._graph, self._update, self._eliminate = graph, update, eliminate
        self._start = poses
        self._before = graph.rows()
        self._moves = graph.n_moves
        self._parts = self._optimization(copy)
        self.graph = copy
        """The copy; its poses mean something once there is a result."""
        self.result: BatchResult | None = None
        """Of the optimisation; None while it goes on, FAILED if there is nothing to adopt."""

    def work(self) -> bool:
        """Do a part of the optimisation; tell whether there is more."""
        if self.result is None:
            try:
                next(self._parts)
            except StopIteration as end:
                self.result = end.value
        return self.result is None

    def _optimization(self, copy: Graph) -> Parts:
        rows, start = self._before, self._start
        copy.fill(rows if start is None else rows._replace(poses=start))
        copy.apply(self._update)
        yield
        result = yield from (optimizer.from_linear_start(copy, _CONFIG, _STARTS)
                             if start is None else optimizer.in_parts(copy, _CONFIG))
        yield
        copy.set_poses(copy.poses)
        # from poses of a solution it needs few iterations, if any number of them is enough
        all_used = start is not None and result.iterations == _CONFIG.max_iterations
        if result.status is Status.CONVERGED and not all_used and self._eliminate():
            return result
        return replace(result, status=Status.FAILED)

    @property
    def is_outdated(self) -> bool:
        """Whether the poses of the graph were set since, as an alignment with the map does."""
        return self._graph.n_moves != self._moves

    def catch_up(self) -> None:
        """Apply to the copy what has been done to the graph since; the smoother has to solve."""
        now, before = self._graph, self._before
        n, copy = len(before.poses), self.graph
        copy.append_nodes(continued(now, copy.poses)[n:], now.is_bias[n:])
        weights = []
        for new, old, chosen in zip(
                now.weights, (before.edges.weight, before.observed.weight),
                (self._update.weigh_edges, self._update.weigh_observed), strict=True):
            changed = np.flatnonzero(new[:len(old)] != old)
            weights.append({row: float(new[row]) for row in changed.tolist() if row not in chosen})
        fixed = now.fixed
        was_fixed = np.zeros(now.n_nodes, dtype=bool)
        was_fixed[:n] = before.fixed
        copy.apply(GraphUpdate(
            edges=now.edges_at(np.arange(len(before.edges), now.n_edges)),
            observed=now.observed_at(np.arange(len(before.observed), now.n_observed)),
            weigh_edges=weights[0], weigh_observed=weights[1],
            fix=np.flatnonzero(fixed & ~was_fixed).tolist(),
            free=np.flatnonzero(was_fixed & ~fixed).tolist()))


def continued(graph: Graph, poses: FloatArray) -> FloatArray:
    """
    Return poses of all nodes: newer ones than those given move with the last of these.

    Parameters
    ----------
    graph : Graph, of N nodes
    poses : ndarray, shape (K, 3), other poses of its first nodes, K <= N

    """
    n, now, is_bias = len(poses), graph.poses, graph.is_bias
    newer, last = now[n:].copy(), int(np.flatnonzero(~is_bias[:n])[-1])
    moved = np.flatnonzero(~is_bias[n:])
    newer[moved] = se2.compose(poses[last], se2.between(now[last], newer[moved]))
    return np.concatenate((poses, newer))
