# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The linear system `H dx = -b` of a graph, assembled by 3x3 blocks.

An edge from i to j with Jacobians A = de/dx_i and B = de/dx_j (3.54) and information W adds
A^T W A, A^T W B, B^T W A and B^T W B to the blocks ii, ij, ji and jj of H (3.55)-(3.59), and
A^T W e and B^T W e to the blocks i and j of b (3.60). An observed node adds A^T W A to the one
diagonal block of its hidden node and A^T W e to b (3.61): it never changes the pattern of H.
Fixed nodes have no unknown: their rows and columns are left out.

The pattern depends on the structure of the graph only: it is computed once and filled in every
iteration. SciPy factorises H, so the way from constraints to a step is independent of the package.
"""

from typing import cast

import jacobians
import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph

BLOCK = 3


class LinearSystem:
    """
    H and b of a graph whose structure does not change.

    Parameters
    ----------
    graph : Graph

    Raises
    ------
    LinearSolveError
        If a connected part of the graph has neither a fixed nor an observed node: its poses are
        not determined, and H is singular. The message has one of its nodes.

    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        edges, observed = graph.edges, graph.observed
        free = ~graph.fixed
        self.free_nodes: IntArray = np.flatnonzero(free)
        """Hidden nodes with unknowns, in the order of the blocks of H, shape (F,)."""
        unknown = np.full(graph.n_nodes, -1, dtype=np.int64)
        unknown[self.free_nodes] = np.arange(len(self.free_nodes))
        _require_anchors(graph)

        i, j, node = unknown[edges.i], unknown[edges.j], unknown[observed.node]
        diagonal = np.arange(len(self.free_nodes))
        # the order of the block contributions here is that in `_contributions`
        rows = np.concatenate((diagonal, i, j, i, j, node))
        columns = np.concatenate((diagonal, i, j, j, i, node))
        self._kept = np.flatnonzero((rows >= 0) & (columns >= 0))
        keys = rows[self._kept] * max(len(self.free_nodes), 1) + columns[self._kept]
        self._order = np.argsort(keys, kind='stable')
        blocks, self._starts = np.unique(keys[self._order], return_index=True)
        self._block_rows, self._block_columns = np.divmod(blocks, max(len(self.free_nodes), 1))
        self._indptr = np.searchsorted(
            self._block_rows, np.arange(len(self.free_nodes) + 1)).astype(np.int32)
        self._gradient_rows = np.concatenate((i, j, node))

    @property
    def size(self) -> int:
        """Number of scalar unknowns."""
        return BLOCK * len(self.free_nodes)

    def pattern(self) -> npt.NDArray[np.bool_]:
        """Return which 3x3 blocks of H exist, shape (F, F); for tests of small graphs."""
        pattern = np.zeros((len(self.free_nodes),) * 2, dtype=bool)
        pattern[self._block_rows, self._block_columns] = True
        return pattern

    def assemble(self, poses: FloatArray) -> tuple[scipy.sparse.csc_array, FloatArray]:
        """
        Linearize at poses, shape (N, 3), and return H, shape (3F, 3F), and b, shape (3F,).

        Returns
        -------
        hessian : csc_array
            Symmetric, both triangles stored.
        gradient : ndarray
            b = sum of A^T W e.

        """
        blocks, gradients = self._contributions(poses)
        data = np.add.reduceat(blocks[self._kept][self._order], self._starts, axis=0)
        hessian = scipy.sparse.bsr_array(
            (data, self._block_columns.astype(np.int32), self._indptr),
            shape=(self.size, self.size), blocksize=(BLOCK, BLOCK))
        b = np.zeros((len(self.free_nodes), BLOCK))
        kept = self._gradient_rows >= 0
        np.add.at(b, self._gradient_rows[kept], gradients[kept])
        return hessian.tocsc(), b.ravel()

    def moved(self, poses: FloatArray, step: FloatArray) -> FloatArray:
        """Return the poses, shape (N, 3), after adding a step, shape (3F,); nothing is wrapped."""
        poses = poses.copy()
        poses[self.free_nodes] += step.reshape(-1, BLOCK)
        return poses

    def _contributions(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the blocks for H, in the order of the constructor, and the rows for b."""
        edges, observed = self._graph.edges, self._graph.observed
        error, a, b = jacobians.linearize_edges(poses, edges)
        a_w = np.swapaxes(a, 1, 2) @ edges.weighted_information
        b_w = np.swapaxes(b, 1, 2) @ edges.weighted_information
        unary_error, unary = jacobians.linearize_observed(poses, observed)
        unary_w = np.swapaxes(unary, 1, 2) @ observed.weighted_information
        a_w_b = a_w @ b
        blocks = np.concatenate((
            np.zeros((len(self.free_nodes), BLOCK, BLOCK)),
            a_w @ a, b_w @ b, a_w_b, np.swapaxes(a_w_b, 1, 2), unary_w @ unary))
        gradients = np.concatenate((
            _times(a_w, error), _times(b_w, error), _times(unary_w, unary_error)))
        return blocks, gradients


class Factorization:
    """
    Factorised symmetric positive definite matrix.

    Raises
    ------
    LinearSolveError
        If the matrix is singular or not finite.

    """

    def __init__(self, hessian: scipy.sparse.csc_array) -> None:
        if not np.all(np.isfinite(hessian.data)):
            raise LinearSolveError('H holds numbers that are not finite')
        try:
            self._factor = scipy.sparse.linalg.splu(
                hessian, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                options={'SymmetricMode': True})
        except RuntimeError as error:
            raise LinearSolveError(f'H is singular ({error})') from error

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution for one or several right-hand sides, shape (3F,) or (3F, K)."""
        solution = cast('FloatArray', self._factor.solve(right))
        if not np.all(np.isfinite(solution)):
            raise LinearSolveError('H is singular to working precision')
        return solution

    def covariance(self, block: int) -> FloatArray:
        """Return the diagonal 3x3 block of the inverse: a node's marginal covariance."""
        rows = slice(BLOCK * block, BLOCK * (block + 1))
        right = np.zeros((self._factor.shape[0], BLOCK))
        right[rows] = np.eye(BLOCK)
        covariance = self.solve(right)[rows]
        return 0.5 * (covariance + covariance.T)


def _times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    return np.einsum('mij,mj->mi', matrix, vector)


def _require_anchors(graph: Graph) -> None:
    """Raise LinearSolveError if a connected part has neither a fixed nor an observed node."""
    if graph.n_nodes == 0:
        return
    edges = graph.edges
    adjacency = scipy.sparse.coo_array(
        (np.ones(len(edges)), (edges.i, edges.j)), shape=(graph.n_nodes, graph.n_nodes))
    n_parts, part = scipy.sparse.csgraph.connected_components(adjacency, directed=False)
    anchored = np.zeros(n_parts, dtype=bool)
    anchored[part[graph.fixed]] = True
    anchored[part[graph.observed.node]] = True
    if not np.all(anchored):
        loose = np.flatnonzero(~anchored[part])
        raise LinearSolveError(
            f'hidden node {loose[0]} and {len(loose) - 1} others are tied to no fixed and no '
            f'observed node: their poses are not determined')
