# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A graph as it is, by dense matrices: chi2, the step that is left, and covariances."""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.factors import errors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.priors import model

STEP = 1e-6  # of the differences that are the Jacobians [m, rad]


def chi2_of(graph: Graph) -> float:
    """Return the energy of all factors and priors, one by one."""
    poses, factors = graph.poses.copy(), graph.factors_by_row
    error = errors(poses, factors)
    return float(sum(e @ W @ e for e, W in zip(
        error, factors.weighted_information, strict=True))) + sum(
            model(prior, poses[rows], graph.is_pose[rows]).energy
            for prior in graph.priors for rows in (graph.node_rows(prior.nodes),))


@dataclass(frozen=True)
class DenseGraph:
    """H and b of the coordinates that are unknown, by differences of the errors."""

    unknown: IntArray  # rows of H among the three coordinates of all nodes
    H: FloatArray
    b: FloatArray

    @classmethod
    def of(cls, graph: Graph) -> 'DenseGraph':
        poses, factors, n = graph.poses.copy(), graph.factors_by_row, graph.n_nodes
        ends, number = np.stack((factors.i, factors.j, factors.k)), np.arange(len(factors))
        # each factor gets nodes of its own, so that all are moved at once
        own = factors.replaced(**{name: np.where(row < 0, -1, k * len(factors) + number)
                                  for k, (name, row) in enumerate(zip('ijk', ends, strict=True))})
        spread, information = poses[ends.ravel()], factors.weighted_information
        error, jacobian = errors(spread, own), np.zeros((3, len(factors), 3, 3))
        for k in range(3):
            for c in range(3):
                moved = np.zeros((3, len(factors), 3))
                moved[k, :, c] = STEP
                change = (errors(spread + moved.reshape(-1, 3), own)
                          - errors(spread - moved.reshape(-1, 3), own))
                change[:, 2] = se2.wrap(change[:, 2])
                jacobian[k, :, :, c] = np.where(ends[k, :, None] < 0, 0.0, change / (2.0 * STEP))
        H, b = np.zeros((n, n, 3, 3)), np.zeros((n, 3))
        for k in range(3):
            np.add.at(b, ends[k], np.einsum('mji,mjk,mk->mi', jacobian[k], information, error))
            for m in range(3):
                np.add.at(H, (ends[k], ends[m]), np.einsum(
                    'mji,mjk,mkl->mil', jacobian[k], information, jacobian[m]))
        H, b = H.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n), b.ravel()
        for prior in graph.priors:
            rows = graph.node_rows(prior.nodes)
            of_prior = model(prior, poses[rows], graph.is_pose[rows])
            at = (3 * rows[:, None] + np.arange(3)).ravel()
            H[np.ix_(at, at)] += of_prior.information
            b[at] += of_prior.gradient
        unknown = np.flatnonzero(
            (np.arange(3) < graph.dimension[:, None]) & ~graph.fixed[:, None])
        return cls(unknown, H[np.ix_(unknown, unknown)], b[unknown])

    def covariance(self) -> FloatArray:
        """Return the covariance of all that is unknown."""
        scale = 1.0 / np.sqrt(np.diagonal(self.H))
        return np.linalg.inv(self.H * scale * scale[:, None]) * scale * scale[:, None]

    def step(self) -> FloatArray:
        """Return the next step of Gauss-Newton, relative to the sigmas that it is known to."""
        covariance = self.covariance()
        return -covariance @ self.b / np.sqrt(np.diagonal(covariance))

    def covariance_of(self, row: int) -> FloatArray:
        """Return the covariance of a pose."""
        at = np.searchsorted(self.unknown, 3 * row + np.arange(3))
        return self.covariance()[np.ix_(at, at)]
