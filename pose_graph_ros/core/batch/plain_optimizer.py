# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Gauss-Newton from a chordal start for a `PlainGraph`, with NumPy and SuperLU.

The method is that of `optimizer`, for the usual case: from a chordal start (`chordal_start` says
what it is) few steps of Gauss-Newton lead to the minimum, the last ones with the factorisation of
an earlier step. What is not so simple is left to `optimizer`: there is no damping, no other start,
and no result unless the poses converge in a few steps.
"""

from collections.abc import Iterator

import numpy as np

from pose_graph_ros.core.batch.outcome import (
    BatchResult,
    CHORD_RATIO,
    has_converged,
    KEEP_RATIO,
    Start,
    Status,
    TRUSTED_ITERATIONS,
    UPHILL_STEPS,
)
from pose_graph_ros.core.batch.plain_graph import linearized, PlainGraph
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray
from pose_graph_ros.core.solver_config import SolverConfig
from pose_graph_ros.core.sparse.block_matrix import BlockFactors, BlockPattern, order_of

# Smallest |u| of the chordal start before normalisation, as in `chordal_start`.
SMALLEST_ROTATION = 1e-6
# Relative rounding error of chi2.
ROUNDING = 1e-9
# What overflows has no finite chi2, and is no result.
_quiet = np.errstate(over='ignore', invalid='ignore', divide='ignore')


class PlainOptimizer:
    """
    Optimiser of one graph, whose poses it changes.

    Parameters
    ----------
    graph : PlainGraph
        Every node has to be connected to a fixed one.
    config : SolverConfig

    """

    def __init__(self, graph: PlainGraph, config: SolverConfig) -> None:
        self._graph, self._config = graph, config
        self._free = np.flatnonzero(~graph.fixed)
        number = np.full(graph.n_nodes, -1)
        number[self._free] = np.arange(len(self._free))
        i, j = number[graph.edges.i], number[graph.edges.j]
        # of the blocks (i, i), (i, j), (j, i) and (j, j) of the edges those of free nodes
        pairs = ((i, i), (i, j), (j, i), (j, j))
        self._kept = [(row >= 0) & (column >= 0) for row, column in pairs]
        both = self._kept[1]
        rows, columns = (np.concatenate([pair[side][kept] for pair, kept in zip(
            pairs, self._kept, strict=True)]) for side in (0, 1))
        self.places = order_of(i[both], j[both], len(self._free))
        """Place of each node that is not fixed in the order of elimination."""
        self._last: BlockFactors | None = None
        self._pattern = BlockPattern(rows, columns, self.places)

    @_quiet
    def from_chordal_start(self) -> BatchResult | None:
        """
        Return the result of moving the poses to a minimum from a chordal start.

        None, with the poses as they were, if it is not reached in a few steps, or is above chi2 of
        the poses before.
        """
        graph = self._graph
        before, chi2 = graph.poses, graph.energies().chi2
        if not chi2 < np.inf:
            return None
        try:
            graph.poses = self._chordal()
            result = self._minimize(TRUSTED_ITERATIONS, Start.CHORDAL)
        except LinearSolveError:
            result = None
        if result is None or not result.chi2 <= chi2:
            graph.poses = before
            return None
        return result

    @_quiet
    def from_present_poses(self) -> BatchResult | None:
        """Return the result of moving the poses to the near minimum; None as above."""
        before = self._graph.poses
        try:
            result = self._minimize(self._config.max_iterations, Start.PRESENT)
        except LinearSolveError:
            result = None
        if result is None:
            self._graph.poses = before
        return result

    def heading_steps(self, derivative: FloatArray) -> FloatArray:
        """
        Return a step of Gauss-Newton of the headings of nodes that are not fixed, shape (F,).

        Parameters
        ----------
        derivative : ndarray, shape (F,), of chi2 by these headings

        """
        assert self._last is not None
        right = np.zeros((len(self._free), 3))
        right[:, 2] = derivative
        return self._last.solve(right.ravel())[2::3]

    def _minimize(self, steps: int, start: Start) -> BatchResult | None:
        graph, free = self._graph, self._free
        chi2, best, uphill = np.inf, graph.poses, 0
        length, previous, chord = np.inf, np.inf, False
        factors: BlockFactors | None = None
        for iteration in range(min(steps, self._config.max_iterations) + 1):
            error, by_i, by_j = linearized(graph.poses, graph.edges)
            weighted = np.einsum('mij,mj->mi', graph.edges.information, error)
            after = float(np.einsum('mi,mi->', weighted, error))
            if not after < np.inf:
                return None
            if after <= chi2 * (1.0 + ROUNDING):
                comparable = uphill == 0
                chi2, best, uphill = after, graph.poses, 0
                if comparable and iteration > 0 and has_converged(
                        length, previous, self._config.step_tolerance):
                    return BatchResult(Status.CONVERGED, '', iteration, chi2, start)
                # the factors of an earlier step do while steps become shorter fast
                chord = comparable and previous < np.inf and (
                    length < (CHORD_RATIO if chord else KEEP_RATIO) * previous)
            elif chord:
                # with a new factorisation from the poses before
                graph.set_poses(best)
                chord, length, previous, factors = False, np.inf, np.inf, None
                continue
            elif uphill == UPHILL_STEPS:
                return None
            else:
                uphill += 1
            previous = length
            if not chord or factors is None:
                factors = self._last = self._factors(by_i, by_j)
            right = np.zeros((graph.n_nodes, 3))
            for end, by in ((graph.edges.i, by_i), (graph.edges.j, by_j)):
                gradient = np.einsum('mji,mj->mi', by, weighted)
                for k in range(3):
                    right[:, k] -= np.bincount(end, gradient[:, k], graph.n_nodes)
            step = factors.solve(right[free].ravel()).reshape(-1, 3)
            length = float(np.max(np.abs(step), initial=0.0))
            poses = graph.poses.copy()
            poses[free] += step
            graph.set_poses(poses)
        return None

    def _factors(self, by_i: FloatArray, by_j: FloatArray) -> BlockFactors:
        """Return the factors of H, from the Jacobians of all edges."""
        information = self._graph.edges.information

        def blocks() -> Iterator[FloatArray]:
            for a, b, kept in zip((by_i, by_i, by_j, by_j), (by_i, by_j, by_i, by_j), self._kept,
                                  strict=True):
                yield np.swapaxes(a[kept], 1, 2) @ (information[kept] @ b[kept])

        return self._pattern.factors(blocks())

    def _chordal(self) -> FloatArray:
        """Return the poses of the chordal start, or raise LinearSolveError."""
        graph, edges, free = self._graph, self._graph.edges, self._free
        u = np.exp(1j * graph.poses[:, 2])
        turn = np.exp(1j * edges.mean[:, 2])
        u = self._relaxed(edges.information[:, 2, 2], turn, np.zeros(len(turn), complex), u)
        length = np.abs(u)
        if np.any(length < SMALLEST_ROTATION):
            raise LinearSolveError('chordal start: the measured headings cancel each other out')
        u /= length
        t = self._relaxed(
            0.5 * (edges.information[:, 0, 0] + edges.information[:, 1, 1]),
            np.ones(len(turn)),
            u[edges.i] * (edges.mean[:, 0] + 1j * edges.mean[:, 1]),
            graph.poses[:, 0] + 1j * graph.poses[:, 1])
        poses = graph.poses.copy()
        poses[free] = np.stack((t.real, t.imag, np.angle(u)), axis=1)[free]
        return poses

    def _relaxed(
        self, weight: FloatArray, factor: ComplexArray | FloatArray, offset: ComplexArray,
        known: ComplexArray,
    ) -> ComplexArray:
        """
        Return v at the minimum of the sum of weight |v_j - factor v_i - offset|^2 over all edges.

        Parameters
        ----------
        weight, factor, offset : ndarray, shape (M,)
        known : ndarray, shape (N,), v of the fixed nodes

        """
        graph, edges = self._graph, self._graph.edges
        v = np.where(graph.fixed, known, 0.0)
        residual = weight * (offset + factor * v[edges.i] - v[edges.j])
        right = np.zeros(graph.n_nodes, dtype=complex)
        for end, value in ((edges.j, residual), (edges.i, -factor.conj() * residual)):
            right += np.bincount(end, value.real, graph.n_nodes)
            right += 1j * np.bincount(end, value.imag, graph.n_nodes)
        own = weight.astype(factor.dtype)
        blocks = (own, -weight * factor.conj(), -weight * factor, own)
        factors = self._pattern.factors(
            block[kept][:, None, None] for block, kept in zip(blocks, self._kept, strict=True))
        free = right[self._free][:, None]
        if factor.dtype == np.float64:
            # a complex column as two real ones
            solved = np.ascontiguousarray(factors.solve(free.view(np.float64)))
            v[self._free] = solved.view(np.complex128)[:, 0]
        else:
            v[self._free] = factors.solve(free)[:, 0]
        return v
