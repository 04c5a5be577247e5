# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Optimisation of a graph of poses and edges alone with NumPy and SuperLU, for tools that run once.

Nothing in here is compiled, since to load the kernels takes longer than to solve such a graph. The
method is that of `optimizer` for the usual case: a chordal start or the present poses, and few
steps of Gauss-Newton. What is not so simple is left to `optimizer`: there is no damping, no other
start, and no result unless the poses converge in a few steps.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from pose_graph_ros.core.batch import levenberg_marquardt as lm
from pose_graph_ros.core.batch.linear_starts import chordal, NodeSystem, sparse_chordal
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.checks import are_definite
from pose_graph_ros.core.graph.constraints import FactorKind, Factors, NodeKind
from pose_graph_ros.core.graph.graph_update import Energies, GraphRows
from pose_graph_ros.core.sparse import BlockFactors

# Length of a further step below which it has converged [m, rad], as by default in `config`, whose
# import takes as long as to solve a small graph.
TOLERANCE = 1e-8


class PlainGraph:
    """A graph of poses and edges between them, a `System` of `levenberg_marquardt`."""

    def __init__(self, rows: GraphRows) -> None:
        self._rows, self.n_nodes, self.n_priors = rows, len(rows.poses), 0
        self.poses = rows.poses.copy()
        """Of the hidden nodes in the map, shape (N, 3) [m, m, rad]."""
        self.fixed, self.node_kind, self.is_pose = rows.fixed, rows.node_kind, rows.is_pose
        self.factors = self.factors_by_row = rows.factors
        """All edges; ids are rows."""
        self._factors: BlockFactors
        self._last: lm.Last = None

    @classmethod
    def is_covered(cls, rows: GraphRows) -> bool:
        """
        Tell whether a graph has nothing but poses and edges between them, all with weight 1.

        Each edge has to measure all coordinates. Otherwise a pose may not be determined, and the
        factors of H, without pivoting, need not show that it is singular.
        """
        return (len(rows.priors) == 0
                and bool(np.all(rows.node_kind == NodeKind.POSE))
                and bool(np.all(rows.factors.kind <= FactorKind.LOOP_CLOSURE))
                and bool(np.all(rows.factors.weight == 1.0))
                and bool(np.all(are_definite(rows.factors.information)))
                and np.array_equal(rows.node_ids, np.arange(len(rows.poses))))

    def factors_at(self, rows: IntArray) -> Factors:
        """Return some of the edges."""
        return self.factors.rows(rows)

    def energies(self) -> Energies:
        """Return the energies of all edges."""
        # what overflows is infinite
        with np.errstate(over='ignore', invalid='ignore'):
            error = linearized(self.poses, self.factors)[0]
            return Energies(np.einsum('mi,mij,mj->m', error, self.factors.information, error),
                            np.empty(0))

    def rows(self) -> GraphRows:
        """Return the graph with the present poses."""
        return self._rows._replace(poses=self.poses.copy())

    def optimize(self, start: lm.Start) -> lm.BatchResult | None:
        """
        Return the result of moving the poses to a minimum from a chordal start or where they are.

        None, with the poses as they were, if it is not reached in a few steps, or is above chi2 of
        the poses before.
        """
        before = self.poses
        # what overflows has no finite chi2, and is no result
        with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
            try:
                chi2 = self.evaluate()[0]
                if chi2 < np.inf:
                    if start is lm.Start.CHORDAL:
                        self.poses = chordal(self, sparse_chordal(self, self.nodes))
                    result = lm.to_the_end(lm.minimize(self, TOLERANCE, lm.TRUSTED_ITERATIONS))
                    if lm.is_trusted(result, chi2):
                        return replace(result, start=start)
            except LinearSolveError:
                pass
        self.poses = before
        return None

    @cached_property
    def nodes(self) -> NodeSystem:
        """The normal equations, with the place of each node that is not fixed in their order."""
        return NodeSystem(self.factors.i, self.factors.j, ~self.fixed)

    def heading_steps(self, derivative: FloatArray) -> FloatArray:
        """Return a step of Gauss-Newton of the headings of nodes that are not fixed, (F,)."""
        right = np.zeros((len(derivative), 3))
        right[:, 2] = derivative
        return self._solved(right)[:, 2]

    def _solved(self, right: FloatArray) -> FloatArray:
        return np.asarray(self._factors.solve(right.ravel())).reshape(-1, 3)

    def set_poses(self, poses: FloatArray) -> None:
        """Set the poses of all hidden nodes, shape (N, 3) [m, m, rad]."""
        self.poses = se2.wrapped(poses)

    def evaluate(self) -> tuple[float, float]:
        error, by_i, by_j = linearized(self.poses, self.factors)
        weighted = np.einsum('mij,mj->mi', self.factors.information, error)
        self._by = by_i, by_j
        self._right = -self.nodes.gathered(self._by, weighted)
        chi2 = float(np.einsum('mi,mi->', weighted, error))
        return chi2, 1e-9 * chi2   # its rounding

    def step(self, damping: float, *, chord: bool) -> tuple[float, float]:
        if damping > 0.0:
            raise LinearSolveError('left to the compiled optimiser: it needs damping')
        if not chord:
            information, (by_i, by_j) = self.factors.information, self._by
            self._factors = self.nodes.factors(self._by, (information @ by_i, information @ by_j))
        step = lm.secant_step(self._solved, self._right, self._last if chord else None)
        self._last = step, self._right
        poses = self.poses.copy()
        poses[self.nodes.free] += step
        self.set_poses(poses)
        return float(np.max(np.abs(step), initial=0.0)), float(np.sum(self._right * step))


def linearized(poses: Poses, edges: Factors) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return the errors (3.48) of edges, shape (M, 3), and their Jacobians by both ends, (M, 3, 3).

    With R the rotation by th_i + th_z and d = t_j - t_i, e_t = R^T d - R_z^T t_z. Its derivative
    by t_j is R^T, by t_i -R^T, and by th_i that of R^T d, (y, -x) if that is (x, y).
    """
    start, mean = poses[edges.i], edges.mean
    difference = poses[edges.j] - start
    heading = start[:, 2] + mean[:, 2]
    c, s = np.cos(heading), np.sin(heading)
    own_c, own_s = np.cos(mean[:, 2]), np.sin(mean[:, 2])
    x = c * difference[:, 0] + s * difference[:, 1]
    y = c * difference[:, 1] - s * difference[:, 0]
    error = np.stack((
        x - (own_c * mean[:, 0] + own_s * mean[:, 1]),
        y - (own_c * mean[:, 1] - own_s * mean[:, 0]),
        se2.wrap(difference[:, 2] - mean[:, 2])), axis=1)
    by_j = np.zeros((len(c), 3, 3))
    by_j[:, 0, 0], by_j[:, 0, 1], by_j[:, 1, 0], by_j[:, 1, 1] = c, s, -s, c
    by_j[:, 2, 2] = 1.0
    by_i = -by_j
    by_i[:, 0, 2], by_i[:, 1, 2] = y, -x
    return error, by_i, by_j
