# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Graphs with nearly singular covariances, and their optimum from square roots of the information.

Scan matching in a corridor, or a turn on the spot, gives some edges an information whose
eigenvalues differ by twelve orders of magnitude. H then has condition numbers that a Cholesky
factorisation of it cannot be judged by; the oracle solves the least-squares problem of the
square-root factors, whose condition number is the root of that, by orthogonal transformations.
"""

from dataclasses import dataclass

import jacobians
import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# Sigmas of an ordinary edge [m, m, rad].
SIGMAS = np.array([0.05, 0.03, 0.04])


@dataclass
class StiffGraph:
    """A drive in circles, node 0 fixed; the poses are those by odometry, the edges the truth's."""

    poses: FloatArray
    edges: Factors
    truth: FloatArray

    def graph(self) -> Graph:
        graph = Graph()
        graph.apply(GraphUpdate(hidden=self.poses, factors=self.edges, fix=[0]))
        return graph

    def optimum(self) -> tuple[FloatArray, float, FloatArray]:
        """Return poses, chi2 and covariances of the minimum, shapes (N, 3), () and (N, 3, 3)."""
        root = np.swapaxes(_cholesky(self.edges.information), 1, 2).astype(np.float64)
        poses, n = self.truth.copy(), len(self.truth)
        for _ in range(50):
            whitened, jacobian = self._system(poses, root)
            q, r = np.linalg.qr(jacobian)
            step = np.linalg.solve(r, -q.T @ whitened).reshape(-1, 3)
            poses[1:] = se2.wrapped(poses[1:] + step)
            if np.max(np.abs(step)) < 1e-10:
                break
        whitened, jacobian = self._system(poses, root)
        inverse = np.linalg.inv(np.linalg.qr(jacobian)[1])
        covariances = np.zeros((n, 3, 3))
        for v in range(1, n):
            rows = inverse[3 * v - 3:3 * v]
            covariances[v] = rows @ rows.T
        return poses, float(whitened @ whitened), covariances

    def _system(self, poses: FloatArray, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the whitened errors and their Jacobian, without the columns of node 0."""
        edges, at = self.edges, jacobians.linearize_edges(poses, self.edges)
        jacobian = np.zeros((3 * len(edges), 3 * len(poses)))
        for k, (i, j) in enumerate(zip(edges.i.tolist(), edges.j.tolist(), strict=True)):
            jacobian[3 * k:3 * k + 3, 3 * i:3 * i + 3] += root[k] @ at.jacobian_i[k]
            jacobian[3 * k:3 * k + 3, 3 * j:3 * j + 3] += root[k] @ at.jacobian_j[k]
        return (root @ at.error[:, :, None]).ravel(), jacobian[:, 3:]


def stiff_graph(seed: int, decades: float, n_nodes: int = 30, share: float = 0.4) -> StiffGraph:
    """
    Return a graph in which a share of the edges is stiff in a random direction of the plane.

    Parameters
    ----------
    seed : int
    decades : float, decimal logarithm of how much more information that direction has
    n_nodes : int
    share : float

    """
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi * np.arange(n_nodes) / (0.45 * n_nodes)
    truth = np.column_stack((4.0 * np.sin(turn), 4.0 - 4.0 * np.cos(turn), se2.wrap(turn)))
    spot = rng.random(n_nodes) < 0.25   # turns on the spot, which take the heading elsewhere
    for k in np.flatnonzero(spot[1:]) + 1:
        truth[k] = truth[k - 1] + (0.0, 0.0, rng.uniform(-1.5, 1.5))
    truth[0] = 0.0
    loops = rng.integers(0, n_nodes, (n_nodes // 3, 2))
    ends = np.vstack((np.column_stack((np.arange(n_nodes - 1), np.arange(1, n_nodes))),
                      loops[np.abs(np.diff(loops, axis=1)[:, 0]) > 1]))
    sigmas = np.tile(SIGMAS, (len(ends), 1))
    stiff = rng.random(len(ends)) < share
    sigmas[stiff, 0] *= 10.0**(-0.5 * decades)
    direction = rng.uniform(-np.pi, np.pi, len(ends))
    c, s, zero = np.cos(direction), np.sin(direction), np.zeros(len(ends))
    turned = np.moveaxis(np.array(((c, -s, zero), (s, c, zero), (zero, zero, zero + 1.0))), 2, 0)
    information = (turned * sigmas[:, None, :]**-2) @ np.swapaxes(turned, 1, 2)
    information = 0.5 * (information + np.swapaxes(information, 1, 2))
    noise = (turned @ (sigmas * rng.standard_normal(sigmas.shape))[:, :, None])[:, :, 0]
    mean = se2.compose(se2.between(truth[ends[:, 0]], truth[ends[:, 1]]), noise)
    kind = np.where(np.diff(ends, axis=1)[:, 0] == 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
    poses = np.zeros((n_nodes, 3))
    for k in range(1, n_nodes):
        poses[k] = se2.compose(poses[k - 1], mean[k - 1])
    return StiffGraph(poses, Factors(*ends.T, mean, information, kind), truth)


def _cholesky(matrices: FloatArray) -> FloatArray:
    """Return L with L L^T = matrices, shape (M, 3, 3), computed in extended precision."""
    a = matrices.astype(np.longdouble)
    lower = np.zeros_like(a)
    for j in range(3):
        lower[:, j, j] = np.sqrt(a[:, j, j] - np.sum(lower[:, j, :j]**2, axis=1))
        for i in range(j + 1, 3):
            rest = a[:, i, j] - np.sum(lower[:, i, :j] * lower[:, j, :j], axis=1)
            lower[:, i, j] = rest / lower[:, j, j]
    return lower
