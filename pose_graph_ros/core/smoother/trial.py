# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The batch optimiser on copies of the graph: for a step that diverges, and for trials.

Gauss-Newton converges from a good estimate. A loop closure that contradicts the estimate by
radians, over a part of the graph with little information, can make it diverge. That is rare and
detected at once, so steps are not damped. `solved` begins at a linear start, and begins
again at the poses before the step if the result has a higher chi2 than these. The minimum that it
finds is better than the result of a damped step, at the cost of a few steps.

A trial is the graph with other weights, optimised as a copy while the graph itself goes on.

The batch optimisation of a large graph takes much longer than an update may, so a trial is worked
on in parts of at most an iteration; the last one eliminates the copy. It fails where it takes many
iterations: every update after it would take as many, or diverge. The result can be compared
with the graph, and adopted by the smoother with all that was added meanwhile
(`IncrementalSmoother.adopt`); or it is dropped, without a trace.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import BatchResult, Optimization, Start, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import IntArray, Poses
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate
from pose_graph_ros.core.graph.priors import packed

_OF_STEP = SolverConfig(max_iterations=50, step_tolerance=1e-6)
# Unit headings take longer than an update may.
_STARTS_OF_STEP = (Start.CHORDAL, Start.JOINT, Start.PRESENT)
# With more iterations a trial would converge where an update does not: at a minimum with errors so
# large that Gauss-Newton leads away from it.
_CONFIG = SolverConfig(max_iterations=optimizer.TRUSTED_ITERATIONS, step_tolerance=1e-6)
# The others take longer than a part may.
_STARTS = (Start.CHORDAL, Start.PRESENT)


def solved(copy: Graph, rows: GraphRows, update: GraphUpdate, config: SolverConfig = _OF_STEP,
           starts: Sequence[Start] = _STARTS_OF_STEP) -> Optimization:
    """Optimise a copy, empty at first, with an update; it pauses at each iteration."""
    copy.fill(rows)
    copy.apply(update)
    yield
    result = yield from optimizer.in_parts(copy, config, starts)
    yield
    copy.set_poses(copy.poses)
    return result


class Trial:
    """
    A copy, empty at first, of a solved graph with other weights, which is optimised in parts.

    `eliminate` eliminates the copy as a whole and tells whether that was possible. By default it
    starts at the better of a linear start and the present poses.
    """

    def __init__(self, graph: Graph, copy: Graph, update: GraphUpdate,
                 eliminate: Callable[[], bool], poses: Poses | None = None) -> None:
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

    def _optimization(self, copy: Graph) -> Optimization:
        rows, start = self._before, self._start
        if start is not None:
            rows = rows._replace(poses=start)
        result = yield from solved(copy, rows, self._update, _CONFIG,
                                   _STARTS if start is None else (Start.PRESENT,))
        # from poses of a solution it needs few iterations, if any number of them is enough
        all_used = start is not None and result.iterations == _CONFIG.max_iterations
        if result.status is Status.CONVERGED and not all_used and self._eliminate():
            return result
        return replace(result, status=Status.FAILED)

    @property
    def is_outdated(self) -> bool:
        """
        Whether the trial cannot be adopted any more.

        That is so if the poses of the graph were set since, as an alignment with the map does, or
        if all poses that it began with have left the graph.
        """
        poses = self.graph.node_ids[self.graph.is_pose]
        return self._graph.n_moves != self._moves or not np.any(self._graph.node_rows(poses) >= 0)

    def catch_up(self) -> None:
        """
        Apply to the copy what has been done to the graph since; the smoother has to solve.

        What has left the graph leaves the copy. What is left of it in the graph, as priors, was
        computed with the weights of the graph; so it is used as it is.
        """
        now, before, copy = self._graph.rows(), self._before, self.graph
        poses = continued(self._graph, copy.poses, copy.node_ids)
        copy.fill(now._replace(poses=poses).since(before.next_ids))
        # weights that have changed and are not chosen, of what is still in the graph
        ids, old, new = np.intersect1d(
            before.factor_ids, now.factor_ids, assume_unique=True, return_indices=True)
        changed = (before.factors.weight[old] != now.factors.weight[new]) & ~np.isin(
            ids, list(self._update.weigh))
        was_fixed = copy.fixed[copy.node_rows(now.node_ids)]
        known = {prior.nodes.tobytes() + packed(prior).tobytes() for prior in before.priors}
        copy.apply(GraphUpdate(
            remove_nodes=copy.node_ids[self._graph.node_rows(copy.node_ids) < 0].tolist(),
            drop=copy.factor_ids[self._graph.factor_rows(copy.factor_ids) < 0].tolist(),
            priors=[prior for prior in now.priors
                    if prior.nodes.tobytes() + packed(prior).tobytes() not in known],
            weigh=dict(zip(ids[changed].tolist(),
                           now.factors.weight[new[changed]].tolist(), strict=True)),
            fix=self._graph.node_ids[now.fixed & ~was_fixed].tolist(),
            free=self._graph.node_ids[was_fixed & ~now.fixed].tolist()))


def continued(graph: Graph, poses: Poses, ids: IntArray | None = None) -> Poses:
    """
    Return poses of all nodes: newer ones than those given move with the last of these.

    Those given have ids, some of which may have left the graph, or are its first nodes.
    """
    rows = np.arange(len(poses)) if ids is None else graph.node_rows(ids)
    moved, is_pose = graph.poses.copy(), graph.is_pose
    n = int(np.max(rows)) + 1
    last = int(rows[(rows >= 0) & is_pose[rows]][-1])
    moved[rows[rows >= 0]] = poses[rows >= 0]
    newer = n + np.flatnonzero(is_pose[n:])
    moved[newer] = se2.compose(moved[last], se2.between(graph.poses[last], graph.poses[newer]))
    return moved
