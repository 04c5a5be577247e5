# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the robot is if some measurements in the map are believed and others are not.

A *track* is the pose at one hidden node with its covariance in map axes: an extended Kalman filter
that moves along the odometry chain and takes in measurements one by one.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.jit import INTEGER, INTEGERS, kernel, NUMBER, NUMBERS, ROWS
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.sources.bias import STRETCH

# Least sigmas of a measurement while it is judged, and a factor on its covariance: what is stated
# is often too small [m], [rad].
LEAST_SIGMA = (0.3, 0.05)


class Observation(NamedTuple):
    """A position or a pose in the map, as it is judged."""

    node: int  # id of the hidden node before it
    offset: FloatArray  # pose of what was measured in the node, shape (3,) [m, m, rad]
    mean: FloatArray  # shape (3,) [m, m, rad]; of a position, the heading is 0
    noise: FloatArray  # covariance in map axes, shape (2, 2) of a position, (3, 3) of a pose

    @property
    def size(self) -> int:
        return len(self.noise)


class Innovation(NamedTuple):
    """Difference of an observation from what a track predicts."""

    error: FloatArray  # in map axes, shape (2,) or (3,) [m, m, rad]
    jacobian: FloatArray  # of the prediction by the pose in map axes, shape (2, 3) or (3, 3)
    cov: FloatArray  # covariance of the error
    d2: float  # squared Mahalanobis distance
    spread: float  # logarithm of the determinant of `cov`


class Track(NamedTuple):
    """The pose of the robot at a hidden node, by what is believed up to there."""

    node: int
    pose: FloatArray  # shape (3,), in the map [m, m, rad]
    cov: FloatArray  # in map axes, shape (3, 3)

    def moved(self, chain: OdometryChain, node: int) -> 'Track':
        if node == self.node:
            return self
        pose, cov = np.empty(3), np.empty((3, 3))
        if not _move(chain.nodes, chain.poses, chain.sums, self.node, node, chain.noise_factor,
                     self.pose, self.cov, pose, cov):
            raise KeyError('expected nodes that are chained by odometry')
        return Track(node, pose, cov)

    def carried(self, chain: OdometryChain, nodes: IntArray) -> 'Track':
        """Return the track at the next node that stays, if its own leaves the graph."""
        if self.node not in nodes:
            return self
        later = chain.nodes[np.searchsorted(chain.nodes, self.node):]
        return self.moved(chain, int(later[~np.isin(later, nodes)][0]))

    def bent(self, begin: FloatArray) -> 'Track':
        """
        Return the track with the variance of a path that is bent since the pose measured last.
        """
        x, y, _ = (self.pose - begin).tolist()
        more = 0.25 * (x * x + y * y) * min(float(self.cov[2, 2]), 1.0)**2
        cov = self.cov.copy()
        cov[0, 0] += more
        cov[1, 1] += more
        return Track(self.node, self.pose, cov)

    def innovation(self, seen: Observation) -> Innovation:
        size = len(seen.noise)
        error, jacobian, cov = np.empty(size), np.empty((size, 3)), np.empty((size, size))
        d2, spread = _innovate(self.pose, self.cov, seen.offset, seen.mean, seen.noise,
                               error, jacobian, cov)
        return Innovation(error, jacobian, cov, d2, spread)

    def updated(self, innovation: Innovation) -> 'Track':
        pose, cov = np.empty(3), np.empty((3, 3))
        _update(self.pose, self.cov, innovation.error, innovation.jacobian, innovation.cov,
                pose, cov)
        return Track(self.node, pose, cov)


def observations(factors: Factors) -> list[Observation | None]:
    """Return observations, in the map or by edges to biases; None for a heading alone."""
    information, biased = factors.information, factors.j >= 0
    offset = factors.constants[:, :3].copy()
    offset[biased, 2] = 0.0
    correlated = np.where(biased[:, None], factors.constants[:, [2, 2, 3]], 0.0) ** 2
    correlated[:, 2] /= STRETCH**2
    size = np.where(np.where(
        biased, information[:, 2, 2] == 0.0, factors.kind == FactorKind.POSITION), 2, 3)
    found: list[Observation | None] = [None] * len(factors)
    for n in (2, 3):
        rows = np.flatnonzero((size == n) & (information[:, 0, 0] > 0.0))
        own = np.linalg.inv(information[rows, :n, :n])
        own *= np.where(biased[rows], 1.0, BELIEF.stated)[:, None, None]
        noise = _floored(_turned(own, np.where(biased[rows], 0.0, factors.mean[rows, 2]))
                         + correlated[rows, :n, None] * np.eye(n))
        for row, each in zip(rows.tolist(), noise, strict=True):
            found[row] = Observation(
                int(factors.i[row]), offset[row], factors.mean[row], each)
    return found


def _turned(noise: npt.NDArray[Any], theta: FloatArray) -> FloatArray:
    """Return covariances in the axes of poses with headings theta, shape (M,), in map axes."""
    axes = np.zeros(noise.shape)
    axes[:, -1, -1] = 1.0
    axes[:, 0, 0] = axes[:, 1, 1] = np.cos(theta)
    axes[:, 1, 0] = np.sin(theta)
    axes[:, 0, 1] = -axes[:, 1, 0]
    return np.asarray(axes @ noise @ np.swapaxes(axes, 1, 2))


def _floored(noise: FloatArray) -> FloatArray:
    """Return covariances, shape (M, n, n), with the least variances; the argument is changed."""
    least = np.square((LEAST_SIGMA[0], LEAST_SIGMA[0], LEAST_SIGMA[1]))
    for k in range(noise.shape[1]):
        noise[:, k, k] = np.maximum(noise[:, k, k], least[k])
    return noise


@kernel
def _place(rows, node):  # type: ignore[no-untyped-def]
    """Return the place of a node in ascending rows, -1 if it is not one of them."""
    low, high = 0, len(rows)
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < node:
            low = middle + 1
        else:
            high = middle
    return low if low < len(rows) and rows[low] == node else -1


@kernel(signature=(
    INTEGERS, ROWS, ROWS, INTEGER, INTEGER, NUMBER, NUMBERS, ROWS, NUMBERS, ROWS))
def _move(  # type: ignore[no-untyped-def]
    rows, poses, sums, begin, end, factor, pose, cov, pose_out, cov_out,
):
    """
    Move a pose and its covariance in map axes along odometry; return whether both nodes are in it.

    As `covariance.propagated` does, with what `OdometryChain.between` returns.
    """
    i, j = _place(rows, begin), _place(rows, end)
    if i < 0 or j < 0:
        return False
    turn = pose[2] - poses[i, 2]
    c, s = math.cos(turn), math.sin(turn)
    x, y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
    dx, dy = c * x - s * y, s * x + c * y
    pose_out[0], pose_out[1] = pose[0] + dx, pose[1] + dy
    pose_out[2] = factors.wrap(turn + poses[j, 2])
    # the noise of odometry at the second node, in the axes of the chain, then of the map
    ahead = factor if j > i else -factor
    x, y = poses[j, 0], poses[j, 1]
    xx, xy, xt, yy, yt, tt = (ahead * (sums[j, 0] - sums[i, 0]), ahead * (sums[j, 1] - sums[i, 1]),
                              ahead * (sums[j, 2] - sums[i, 2]), ahead * (sums[j, 3] - sums[i, 3]),
                              ahead * (sums[j, 4] - sums[i, 4]), ahead * (sums[j, 5] - sums[i, 5]))
    xx, xy, yy = (xx - 2.0 * y * xt + y * y * tt, xy + x * xt - y * yt - x * y * tt,
                  yy + 2.0 * x * yt + x * x * tt)
    xt, yt = xt - y * tt, yt + x * tt
    xt, yt = c * xt - s * yt, s * xt + c * yt
    xx, xy, yy = (c * c * xx - 2.0 * c * s * xy + s * s * yy,
                  c * s * (xx - yy) + (c * c - s * s) * xy,
                  s * s * xx + 2.0 * c * s * xy + c * c * yy)
    # and that of the pose at the first one
    t = cov[2, 2]
    cov_out[0, 0] = xx + cov[0, 0] - 2.0 * dy * cov[0, 2] + dy * dy * t
    cov_out[0, 1] = xy + cov[0, 1] + dx * cov[0, 2] - dy * cov[1, 2] - dx * dy * t
    cov_out[1, 1] = yy + cov[1, 1] + 2.0 * dx * cov[1, 2] + dx * dx * t
    cov_out[0, 2] = xt + cov[0, 2] - dy * t
    cov_out[1, 2] = yt + cov[1, 2] + dx * t
    cov_out[2, 2] = tt + t
    cov_out[1, 0], cov_out[2, 0], cov_out[2, 1] = cov_out[0, 1], cov_out[0, 2], cov_out[1, 2]
    return True


@kernel
def _factor(cov, n):  # type: ignore[no-untyped-def]
    """Return the factors l10, l20, l21 and d0, d1, d2 of `L D L^T`, shape (n, n), n 2 or 3."""
    d0 = cov[0, 0]
    l10 = cov[1, 0] / d0
    d1 = cov[1, 1] - l10 * cov[1, 0]
    if n == 2:
        return l10, 0.0, 0.0, d0, d1, 1.0
    l20 = cov[2, 0] / d0
    l21 = (cov[2, 1] - l20 * cov[1, 0]) / d1
    return l10, l20, l21, d0, d1, cov[2, 2] - l20 * cov[2, 0] - l21 * l21 * d1


@kernel(signature=(NUMBERS, ROWS, NUMBERS, NUMBERS, ROWS, NUMBERS, ROWS, ROWS))
def _innovate(  # type: ignore[no-untyped-def]
    pose, cov, offset, mean, noise, error, jacobian, cov_out,
):
    """Write an innovation; return its squared Mahalanobis distance and log determinant."""
    n = len(noise)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    rx, ry = c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]
    error[0], error[1] = mean[0] - pose[0] - rx, mean[1] - pose[1] - ry
    for i in range(n):
        for j in range(3):
            jacobian[i, j] = 1.0 if i == j else 0.0
    jacobian[0, 2], jacobian[1, 2] = -ry, rx
    if n == 3:
        error[2] = factors.wrap(mean[2] - pose[2] - offset[2])
    for i in range(n):
        for j in range(n):
            total = noise[i, j]
            for k in range(3):
                for m in range(3):
                    total += jacobian[i, k] * cov[k, m] * jacobian[j, m]
            cov_out[i, j] = total
    l10, l20, l21, d0, d1, d2 = _factor(cov_out, n)
    if not (d0 > 0.0 and d1 > 0.0 and d2 > 0.0):
        # far from the origin of odometry the rounding of its sums may exceed what is left of them
        for i in range(n):
            least = LEAST_SIGMA[0] if i < 2 else LEAST_SIGMA[1]
            total = max(cov_out[i, i], noise[i, i], least * least)
            cov_out[i, :] = 0.0
            cov_out[i, i] = total
        l10, l20, l21, d0, d1, d2 = _factor(cov_out, n)
    y = error[1] - l10 * error[0]
    distance2 = error[0] * error[0] / d0 + y * y / d1
    if n == 3:
        z = error[2] - l20 * error[0] - l21 * y
        distance2 += z * z / d2
    return distance2, math.log(d0 * d1 * d2)


@kernel(signature=(NUMBERS, ROWS, NUMBERS, ROWS, ROWS, NUMBERS, ROWS))
def _update(  # type: ignore[no-untyped-def]
    pose, cov, error, jacobian, innovation, pose_out, cov_out,
):
    """Write the pose and the covariance after taking in an observation, as a Kalman filter."""
    n = len(error)
    l10, l20, l21, d0, d1, d2 = _factor(innovation, n)
    for i in range(3):
        pose_out[i] = pose[i]
        for j in range(3):
            cov_out[i, j] = cov[i, j]
    # the rows of `L^-1 J P` are independent observations
    for k in range(n):
        d = d0 if k == 0 else d1 if k == 1 else d2
        a = 1.0 if k == 0 else -l10 if k == 1 else l10 * l21 - l20
        b = 0.0 if k == 0 else 1.0 if k == 1 else -l21
        e = a * error[0] + b * error[1] + (error[2] if k == 2 else 0.0)
        h = (a * jacobian[0, 0] + b * jacobian[1, 0] + (jacobian[2, 0] if k == 2 else 0.0),
             a * jacobian[0, 1] + b * jacobian[1, 1] + (jacobian[2, 1] if k == 2 else 0.0),
             a * jacobian[0, 2] + b * jacobian[1, 2] + (jacobian[2, 2] if k == 2 else 0.0))
        g = (h[0] * cov[0, 0] + h[1] * cov[1, 0] + h[2] * cov[2, 0],
             h[0] * cov[0, 1] + h[1] * cov[1, 1] + h[2] * cov[2, 1],
             h[0] * cov[0, 2] + h[1] * cov[1, 2] + h[2] * cov[2, 2])
        for i in range(3):
            pose_out[i] += g[i] * e / d
            for j in range(3):
                cov_out[i, j] -= g[i] * g[j] / d
    pose_out[2] = factors.wrap(pose_out[2])
