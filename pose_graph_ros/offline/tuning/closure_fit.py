# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Factors on the sigmas of odometry and of loop closures, where nothing else is measured.

The likelihood of all edges of a graph, with the poses integrated out, is to the second order

    -2 log p = r^T W r - g^T H^-1 g + log det H - sum log det W,    H = J^T W J, g = J^T W r,

with errors r and Jacobian J at poses near the optimum and the information W of the edges
(Laplace's approximation; e.g. C. M. Bishop, "Pattern recognition and machine learning", section
4.4). Unlike chi2, it is least at the right factors. Edges that disagree show the sum of their
noise; that of odometry grows with the length of the loop, which tells both apart.
"""

from collections.abc import Callable, Sequence
import math
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import splu

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.error_functions import edge_errors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.offline.tuning.fit import decided, Fit, Minimum, minimum
from pose_graph_ros.offline.tuning.likelihood import Parameter, PRIOR_SPREAD, Role

# Largest number of hidden nodes: each evaluation factorises H.
MOST_NODES = 20_000
# Sigma of the logarithm of the factor on the sigmas of closures, before it is seen.
CLOSURE_SPREAD = 1.5


class ClosureProblem:
    """Costs of a graph of odometry and closures as a function of two factors on sigmas."""

    def __init__(self, graph: Graph, tick: Callable[[], None] = lambda: None) -> None:
        edges, poses = graph.edges_by_row, graph.poses
        used = np.isin(edges.kind, (EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE)) & (
            edges.weight > 0.0)
        edges = edges.rows(used)
        self.is_closure: BoolArray = np.asarray(edges.kind == EdgeKind.LOOP_CLOSURE)
        """Which of the edges are believed closures, shape (M,)."""
        self.n_evaluations, self.n_beyond, self._tick = 0, 0, tick
        parts = _parts(poses, edges)
        size = 3 * len(poses)
        fixed = 3 * int(edges.i[0]) + np.arange(3)
        kept = np.setdiff1d(np.unique(np.concatenate((
            3 * edges.i[:, None] + np.arange(3), 3 * edges.j[:, None] + np.arange(3)))), fixed)
        # at a factor of 1, of odometry and of closures
        self._hessians, self._gradients, self._squares = [], [], []
        self._counts = []
        for which in (~self.is_closure, self.is_closure):
            weighted, errors = parts.jacobian(which, size)
            self._hessians.append(csc_matrix((weighted.T @ weighted)[kept][:, kept]))
            self._gradients.append(np.asarray(weighted.T @ errors)[kept])
            self._squares.append(float(errors @ errors))
            self._counts.append(int(np.sum(np.diagonal(
                edges.information[which], axis1=1, axis2=2) > 0.0)))

    def value(self, parameters: Sequence[Parameter], x: FloatArray) -> float:
        """
        Return twice the negative logarithm of the likelihood, with the prior, but for a constant.

        Parameters
        ----------
        parameters : sequence of Parameter, of both factors
        x : ndarray, shape (2,), their logarithms

        """
        logs = {each.role: float(value) for each, value in zip(parameters, x, strict=True)}
        logs = {Role.ODOMETRY: 0.0, Role.CLOSURE: 0.0} | logs
        self.n_evaluations += 1
        self._tick()
        factors = [math.exp(-2.0 * logs[role]) for role in (Role.ODOMETRY, Role.CLOSURE)]
        hessian = factors[0] * self._hessians[0] + factors[1] * self._hessians[1]
        gradient = factors[0] * self._gradients[0] + factors[1] * self._gradients[1]
        solver = splu(hessian, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                      options={'SymmetricMode': True})
        energy = (factors[0] * self._squares[0] + factors[1] * self._squares[1]
                  - float(gradient @ solver.solve(gradient)))
        determinant = float(np.sum(np.log(np.abs(solver.U.diagonal()))))
        return (energy + determinant + 2.0 * logs[Role.ODOMETRY] * self._counts[0]
                + 2.0 * logs[Role.CLOSURE] * self._counts[1]
                + (logs[Role.ODOMETRY] / PRIOR_SPREAD)**2
                + (logs[Role.CLOSURE] / CLOSURE_SPREAD)**2)


class _Parts(NamedTuple):
    """Jacobians and errors of edges."""

    i: IntArray
    j: IntArray
    by_i: FloatArray
    by_j: FloatArray
    root: FloatArray
    errors: FloatArray

    def jacobian(self, which: BoolArray, size: int) -> tuple[csr_matrix, FloatArray]:
        """Return the Jacobian and the errors of some edges, times the root of the information."""
        count = int(np.sum(which))
        root = self.root[which]
        blocks = np.concatenate((root @ self.by_i[which], root @ self.by_j[which]), axis=2)
        columns = np.concatenate((3 * self.i[which, None] + np.arange(3),
                                  3 * self.j[which, None] + np.arange(3)), axis=1)
        rows = np.broadcast_to(np.arange(3 * count).reshape(count, 3, 1), blocks.shape)
        matrix = csr_matrix((blocks.ravel(), (rows.ravel(), np.broadcast_to(
            columns[:, None, :], blocks.shape).ravel())), shape=(3 * count, size))
        return matrix, np.einsum('kij,kj->ki', root, self.errors[which]).ravel()


def _parts(poses: FloatArray, edges: Edges) -> _Parts:
    """Return the Jacobians of the errors (3.48) by the poses of both ends, in map axes."""
    i, j = edges.i, edges.j
    turn = np.swapaxes(se2.rotation(poses[i, 2] + edges.mean[:, 2]), 1, 2)
    chord = poses[j, :2] - poses[i, :2]
    by_j = np.zeros((len(i), 3, 3))
    by_j[:, :2, :2], by_j[:, 2, 2] = turn, 1.0
    by_i = -by_j
    by_i[:, :2, 2] = np.einsum('kij,kj->ki', turn, np.column_stack((chord[:, 1], -chord[:, 0])))
    values, vectors = np.linalg.eigh(edges.information)
    root = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
    return _Parts(i, j, by_i, by_j, root, edge_errors(poses, edges))


def fit_closures(problem: ClosureProblem) -> Fit:
    """Return the most likely factors on the sigmas of odometry and of closures."""
    parameters = Parameter(Role.ODOMETRY, 0, 1.0), Parameter(Role.CLOSURE, 0, 1.0)
    best = Minimum(parameters, *minimum(problem, parameters, np.zeros(2)))
    return decided(problem, best, 1.0, int(np.sum(problem.is_closure)))
