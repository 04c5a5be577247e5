# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the robot is if some measurements in the map are believed and others are not.

A *track* is the pose at one hidden node with its covariance in map axes: an extended Kalman filter
that moves along the odometry chain and takes in measurements one by one.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.consistency import OdometryChain
from pose_graph_ros.core.sources.gauss_markov import STRETCH

# Least sigmas of a measurement while it is judged, and a factor on its covariance: what is stated
# is often too small [m], [rad].
LEAST_SIGMA = (0.3, 0.05)
STATED = 2.0


class Observation(NamedTuple):
    """A position or a pose in the map, as it is judged."""

    node: int
    """Row of the hidden node before it."""
    offset: FloatArray
    """Pose of what was measured in the node, shape (3,) [m, m, rad]."""
    mean: FloatArray
    """Shape (3,) [m, m, rad]; of a position, the heading is 0."""
    noise: FloatArray
    """Covariance in map axes, shape (2, 2) of a position, (3, 3) of a pose."""

    @classmethod
    def of(cls, observed: ObservedNodes) -> 'Observation':
        """Return the observation of a table with one row, which is no heading."""
        mean, information = observed.mean[0], observed.information[0]
        size = 2 if observed.kind[0] == ObservedKind.POSITION else 3
        noise = STATED * covariance.turned(
            np.linalg.inv(information[:size, :size]), -float(mean[2]))
        return cls(int(observed.node[0]), observed.offset[0], mean, _floored(noise))

    @classmethod
    def of_biased(cls, edge: Edges) -> 'Observation | None':
        """Return that of an edge to a bias, a table with one row; None for a heading."""
        information, (x, y, factor, turn_factor) = edge.information[0], edge.bias[0].tolist()
        if information[0, 0] == 0.0:
            return None
        size = 3 if information[2, 2] > 0.0 else 2
        correlated = (factor**2, factor**2, (turn_factor / STRETCH)**2)
        noise = np.linalg.inv(information[:size, :size]) + np.diag(correlated[:size])
        return cls(int(edge.i[0]), np.array((x, y, 0.0)), edge.mean[0], _floored(noise))

    @property
    def size(self) -> int:
        """2 for a position, 3 for a pose."""
        return len(self.noise)


class Innovation(NamedTuple):
    """Difference of an observation from what a track predicts."""

    error: FloatArray
    """In map axes, shape (2,) or (3,) [m, m, rad]."""
    jacobian: FloatArray
    """Of the prediction by the pose in map axes, shape (2, 3) or (3, 3)."""
    cov: FloatArray
    """Covariance of the error."""
    d2: float
    """Squared Mahalanobis distance."""
    spread: float
    """Logarithm of the determinant of `cov`."""


class Track(NamedTuple):
    """The pose of the robot at a hidden node, by what is believed up to there."""

    node: int
    pose: FloatArray
    """Shape (3,), in the map [m, m, rad]."""
    cov: FloatArray
    """In map axes, shape (3, 3)."""

    def moved(self, chain: OdometryChain, node: int) -> 'Track':
        """
        Return the track at a later hidden node.

        Parameters
        ----------
        chain : OdometryChain
        node : int, row of the node in the graph

        """
        if node == self.node:
            return self
        motion, noise = motion_between(chain, self.node, node)
        return Track(node, se2.compose(self.pose, motion),
                     covariance.propagated(self.pose, self.cov, motion, noise))

    def bent(self, begin: FloatArray) -> 'Track':
        """
        Return the track with the variance of a path that is bent, which has no linear part.

        `begin` is the pose where it was last measured, shape (3,).
        """
        chord2 = float((self.pose[0] - begin[0])**2 + (self.pose[1] - begin[1])**2)
        more = 0.25 * chord2 * min(float(self.cov[2, 2]), 1.0)**2
        return self._replace(cov=self.cov + np.diag((more, more, 0.0)))

    def innovation(self, seen: Observation) -> Innovation:
        """Return the innovation of an observation at the node of the track."""
        x, y, theta = self.pose.tolist()
        c, s = np.cos(theta), np.sin(theta)
        ox, oy, turn = seen.offset.tolist()
        rx, ry = c * ox - s * oy, s * ox + c * oy
        size = seen.size
        jacobian = np.eye(size, 3)
        jacobian[0, 2], jacobian[1, 2] = -ry, rx
        error = np.empty(size)
        error[0], error[1] = seen.mean[0] - x - rx, seen.mean[1] - y - ry
        if size == 3:
            error[2] = float(se2.wrap(seen.mean[2] - theta - turn))
        cov = jacobian @ self.cov @ jacobian.T + seen.noise
        d2 = float(error @ np.linalg.solve(cov, error))
        return Innovation(error, jacobian, cov, d2, float(np.log(np.linalg.det(cov))))

    def updated(self, innovation: Innovation) -> 'Track':
        """Return the track after taking in an observation."""
        gain = np.linalg.solve(innovation.cov, innovation.jacobian @ self.cov).T
        pose = se2.wrapped(self.pose + gain @ innovation.error)
        cov = self.cov - gain @ innovation.cov @ gain.T
        return Track(self.node, pose, 0.5 * (cov + cov.T))


def seen_in(graph: Graph, row: int, *, edge: bool) -> Observation | None:
    """
    Return the observation that a row of a graph holds; None for a heading.

    Parameters
    ----------
    graph : Graph
    row : int
    edge : bool, whether it is one of an edge, to a bias

    """
    at = np.array((row,))
    if edge:
        return Observation.of_biased(graph.edges_at(at))
    return Observation.of(graph.observed_at(at))


def motion_between(
    chain: OdometryChain, begin: int, end: int,
) -> tuple[FloatArray, FloatArray]:
    """
    Return the motion by odometry between two nodes, and its covariance in the frame of the later.

    Parameters
    ----------
    chain : OdometryChain
    begin, end : int, rows of the nodes in the graph

    """
    motion, noise = chain.between(np.array((begin,)), np.array((end,)))
    return motion[0], noise[0]


def _floored(noise: FloatArray) -> FloatArray:
    least = np.square((LEAST_SIGMA[0], LEAST_SIGMA[0], LEAST_SIGMA[1]))[:len(noise)]
    return noise + np.diag(np.maximum(least - noise.diagonal(), 0.0))
