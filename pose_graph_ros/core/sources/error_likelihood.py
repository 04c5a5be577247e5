# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How likely the measured positions of a source are, for given statistics of their errors.

The estimate of the graph follows the measurements, so its residuals show too little of their
errors. Here the positions are compared with odometry alone: a Kalman filter runs along the path
with the states

    x, y, theta      pose of the robot in the map
    w, k             constant errors of the yaw rate and of the scale of odometry
    m_x, m_y         correlated error of the source, of variance 1 and with time constant tau

and sums up the negative logarithm of the likelihood of each position given those before it. The
error of a position is `sqrt(correlated v) m` plus white noise of variance `white v`; v is the
claimed variance. The noise of odometry is that of the edges of the graph, with one factor for what
the way adds and one for what errors of the heading do, so that neither hides what the other one
shows. See e.g. Y. Bar-Shalom et al., "Estimation with applications to tracking and navigation",
sections 8.2 and 11.4.
"""

from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.jit import (
    FLAG,
    INTEGER,
    INTEGERS,
    kernel,
    MATRICES,
    NUMBER,
    NUMBERS,
    ROWS,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import full, upper
from pose_graph_ros.core.saved_columns import Integers, Numbers, Rows2, Rows3, Rows6
from pose_graph_ros.core.sources.settings import SOURCES

# Squared Mahalanobis distance beyond which a position is taken for wrong, and left out.
GATE = 16.0
# Number of successive positions that are left out after which the filter starts again.
LOST = 5
# Variance of the heading of a motion above which the filter starts again after it [rad^2].
UNKNOWN = 0.3
# Variances of a motion without an odometry edge [m^2, m^2, rad^2].
NO_ODOMETRY = 1e4, 1e4, 2.0 * UNKNOWN
# Variance of the heading at the first start, and at a later one [rad^2].
START_VARIANCE, RESTART_VARIANCE = 0.1, 1.0
# Variance of a position at a start, in units of the claimed variance.
START_SPREAD = 1e4
# States of the filter after the pose.
RATE, SCALE, MX, MY, N_STATES = 3, 4, 5, 6, 7
# Variances of the constant errors of odometry, before they are seen [rad^2/s^2, 1].
RATE_VARIANCE, SCALE_VARIANCE = 0.005**2, 0.01**2


class MeasuredPath(NamedTuple):
    """K measured positions in the order of their stamps, and the motion by odometry between."""

    seconds: FloatArray  # stamps since the first one, shape (K,) [s]
    position: FloatArray  # measured positions in the map, shape (K, 2) [m]
    variance: FloatArray  # claimed variance of a coordinate, shape (K,) [m^2]
    offset: FloatArray  # positions in their hidden nodes, shape (K, 2) [m]
    # pose of each one's hidden node in that of the one before, shape (K, 3); 0 for the first
    motion: FloatArray
    noise: FloatArray  # covariance of that motion in the frame at its end, shape (K, 3, 3)
    way: FloatArray  # part of it that no error of a heading makes: of xx, xy and yy, shape (K, 3)
    lever: FloatArray  # how a higher yaw rate changes the motion, shape (K, 3) [m s, m s, s]
    # yaw rate and scale that are no longer in the motion, shape (K, 2) [rad/s, 1]
    taken_out: FloatArray


@kernel(signature=(ROWS, ROWS, NUMBERS, INTEGERS, INTEGER, INTEGER, ROWS, MATRICES, ROWS, ROWS))
def chain_motions(  # type: ignore[no-untyped-def]
    means, informations, seconds, until, begin, end, out_motion, out_noise, out_way, out_lever,
):
    """
    Join the motions of a path: row k of the result is that from pose until[k - 1] to until[k].

    Means and informations (upper triangles, 0 for none) are those of the edge after each pose,
    with the seconds to the next one. Rows from `begin` to `end` are written, as columns of a
    `MeasuredPath`.
    """
    for k in range(begin, end):
        x = y = theta = 0.0
        lever_x = lever_y = time = 0.0
        cov = out_noise[k]
        cov[:] = 0.0
        way_xx = way_xy = way_yy = 0.0
        for n in range(until[k - 1] if k > 0 else until[k], until[k]):
            xx, xy, xt, yy, yt, tt = informations[n]
            if xx <= 0.0:
                cov[0, 0] += NO_ODOMETRY[0]
                cov[1, 1] += NO_ODOMETRY[1]
                cov[2, 2] += NO_ODOMETRY[2]
                way_xx += NO_ODOMETRY[0]
                way_yy += NO_ODOMETRY[1]
                continue
            dx, dy, turn = means[n]
            c, s = math.cos(turn), math.sin(turn)
            # adjoint of the inverse of the motion maps the covariance to the frame at its end
            a, b = -c * dy + s * dx, s * dy + c * dx
            for i in range(3):
                p, q, r = cov[i, 0], cov[i, 1], cov[i, 2]
                cov[i, 0] = c * p + s * q + a * r
                cov[i, 1] = -s * p + c * q + b * r
            for i in range(3):
                p, q, r = cov[0, i], cov[1, i], cov[2, i]
                cov[0, i] = c * p + s * q + a * r
                cov[1, i] = -s * p + c * q + b * r
            first, second, third = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
            det = xx * first + xy * second + xt * third
            cov[0, 0] += first / det
            cov[1, 1] += (xx * tt - xt * xt) / det
            cov[2, 2] += (xx * yy - xy * xy) / det
            cov[0, 1] += second / det
            cov[1, 0] += second / det
            cov[0, 2] += third / det
            cov[2, 0] += third / det
            cov[1, 2] += (xt * xy - xx * yt) / det
            cov[2, 1] += (xt * xy - xx * yt) / det
            # what is left of the noise of the position where that of the heading is known
            flat = xx * yy - xy * xy
            way_xx, way_xy, way_yy = (
                c * c * way_xx + 2.0 * c * s * way_xy + s * s * way_yy + yy / flat,
                c * s * (way_yy - way_xx) + (c * c - s * s) * way_xy - xy / flat,
                s * s * way_xx - 2.0 * c * s * way_xy + c * c * way_yy + xx / flat)
            c, s = math.cos(theta), math.sin(theta)
            wx, wy = c * dx - s * dy, s * dx + c * dy
            # a rate turns this motion by all of what it has turned before, and by half of its own
            turned = time + 0.5 * seconds[n]
            lever_x, lever_y = lever_x - wy * turned, lever_y + wx * turned
            time += seconds[n]
            x, y, theta = x + wx, y + wy, theta + turn
        out_motion[k, 0], out_motion[k, 1], out_motion[k, 2] = x, y, theta
        out_way[k, 0], out_way[k, 1], out_way[k, 2] = way_xx, way_xy, way_yy
        out_lever[k, 0], out_lever[k, 1], out_lever[k, 2] = lever_x, lever_y, time


@kernel
def _start(pose, p, z, offset, variance, heading_variance):  # type: ignore[no-untyped-def]
    """Start the filter at a position; the heading of `pose` stays, and what is constant."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    pose[0] = z[0] - c * offset[0] + s * offset[1]
    pose[1] = z[1] - s * offset[0] - c * offset[1]
    pose[MX] = pose[MY] = 0.0
    for i in range(N_STATES):
        for j in range(N_STATES):
            if not (RATE <= i <= SCALE and RATE <= j <= SCALE):
                p[i, j] = 0.0
    p[0, 0] = p[1, 1] = START_SPREAD * variance
    p[2, 2] = heading_variance
    p[MX, MX] = p[MY, MY] = 1.0


@kernel
def _move(  # type: ignore[no-untyped-def]
    pose, p, motion, lever, taken_out, noise, way, way_scale, turn_scale,
):
    """Predict the pose after a motion, with both parts of its noise times a scale."""
    rate, length = pose[RATE] - taken_out[0], 1.0 / (1.0 + taken_out[1])
    by_scale = (1.0 + pose[SCALE]) * length
    x = by_scale * motion[0] + rate * lever[0]
    y = by_scale * motion[1] + rate * lever[1]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = c * x - s * y, s * x + c * y
    # derivatives by the scale and by the rate
    kx = length * (c * motion[0] - s * motion[1])
    ky = length * (s * motion[0] + c * motion[1])
    rx, ry = c * lever[0] - s * lever[1], s * lever[0] + c * lever[1]
    pose[0] += dx
    pose[1] += dy
    pose[2] += motion[2] + rate * lever[2]
    for i in range(N_STATES):
        p[i, 0] += kx * p[i, SCALE] + rx * p[i, RATE] - dy * p[i, 2]
        p[i, 1] += ky * p[i, SCALE] + ry * p[i, RATE] + dx * p[i, 2]
        p[i, 2] += lever[2] * p[i, RATE]
    for i in range(N_STATES):
        p[0, i] += kx * p[SCALE, i] + rx * p[RATE, i] - dy * p[2, i]
        p[1, i] += ky * p[SCALE, i] + ry * p[RATE, i] + dx * p[2, i]
        p[2, i] += lever[2] * p[RATE, i]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    more = way_scale - turn_scale
    xx = turn_scale * noise[0, 0] + more * way[0]
    xy = turn_scale * noise[0, 1] + more * way[1]
    yy = turn_scale * noise[1, 1] + more * way[2]
    p[0, 0] += c * c * xx - 2.0 * c * s * xy + s * s * yy
    p[1, 1] += s * s * xx + 2.0 * c * s * xy + c * c * yy
    cross = c * s * (xx - yy) + (c * c - s * s) * xy
    xt = turn_scale * (c * noise[0, 2] - s * noise[1, 2])
    yt = turn_scale * (s * noise[0, 2] + c * noise[1, 2])
    p[0, 1] += cross
    p[1, 0] += cross
    p[0, 2] += xt
    p[2, 0] += xt
    p[1, 2] += yt
    p[2, 1] += yt
    p[2, 2] += turn_scale * noise[2, 2]


@kernel
def _fade(pose, p, phi):  # type: ignore[no-untyped-def]
    """Predict the correlated error, of which the part phi is left."""
    for i in range(MX, N_STATES):
        pose[i] *= phi
        for j in range(N_STATES):
            p[i, j] *= phi
        for j in range(N_STATES):
            p[j, i] *= phi
        p[i, i] += 1.0 - phi * phi


@kernel
def _measure(pose, p, gain, z, offset, factor, white):  # type: ignore[no-untyped-def]
    """Correct by a position; return its -2 log likelihood, and whether it was left out."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    ox, oy = c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]
    ex = z[0] - pose[0] - ox - factor * pose[MX]
    ey = z[1] - pose[1] - oy - factor * pose[MY]
    for i in range(N_STATES):
        gain[i, 0] = p[i, 0] - oy * p[i, 2] + factor * p[i, MX]
        gain[i, 1] = p[i, 1] + ox * p[i, 2] + factor * p[i, MY]
    sxx = gain[0, 0] - oy * gain[2, 0] + factor * gain[MX, 0] + white
    sxy = gain[0, 1] - oy * gain[2, 1] + factor * gain[MX, 1]
    syy = gain[1, 1] + ox * gain[2, 1] + factor * gain[MY, 1] + white
    det = sxx * syy - sxy * sxy
    distance = (syy * ex * ex - 2.0 * sxy * ex * ey + sxx * ey * ey) / det
    if not distance <= GATE:
        return math.log(det) + GATE, True
    ax, ay = (syy * ex - sxy * ey) / det, (sxx * ey - sxy * ex) / det
    for i in range(N_STATES):
        pose[i] += gain[i, 0] * ax + gain[i, 1] * ay
    for i in range(N_STATES):
        kx = (syy * gain[i, 0] - sxy * gain[i, 1]) / det
        ky = (sxx * gain[i, 1] - sxy * gain[i, 0]) / det
        for j in range(i, N_STATES):
            p[i, j] -= kx * gain[j, 0] + ky * gain[j, 1]
            p[j, i] = p[i, j]
    return math.log(det) + distance, False


@kernel(signature=(NUMBERS, ROWS, NUMBERS, ROWS, ROWS, MATRICES, ROWS, ROWS, ROWS, NUMBER, NUMBER,
                   NUMBER, NUMBER, NUMBER, NUMBER, FLAG), allocates=True)
def filtered(  # type: ignore[no-untyped-def]
    seconds, position, variance, offset, motion, noise, way, lever, taken_out, tau, correlated,
    by_way, by_turn, white, heading, constant,
):
    """
    Return twice the negative logarithm of the likelihood of positions, and how often it was lost.

    Then come the constant errors of odometry and their variances: of the yaw rate, of the scale;
    they stay 0 unless `constant`. Correlated and white part are in units of the claimed variance,
    the noise by way and by turn in units of that of the motions; the heading is that at the first
    position.
    """
    pose, p = np.zeros(N_STATES), np.zeros((N_STATES, N_STATES))
    gain = np.zeros((N_STATES, 2))
    pose[2] = heading
    if constant:
        p[RATE, RATE], p[SCALE, SCALE] = RATE_VARIANCE, SCALE_VARIANCE
    total, left_out, n_lost = 0.0, 0, 0
    for k in range(len(seconds)):
        if k > 0:
            gap = seconds[k] - seconds[k - 1]
            _move(pose, p, motion[k], lever[k], taken_out[k], noise[k], way[k], by_way, by_turn)
            _fade(pose, p, math.exp(-gap / tau))
        n_lost += 1 if left_out >= LOST else 0
        if k == 0 or left_out >= LOST or noise[k, 2, 2] > UNKNOWN:
            _start(pose, p, position[k], offset[k], variance[k],
                   RESTART_VARIANCE if k > 0 else START_VARIANCE)
            left_out = 0
        cost, wrong = _measure(pose, p, gain, position[k], offset[k],
                               math.sqrt(correlated * variance[k]), white * variance[k])
        total += cost
        left_out = left_out + 1 if wrong else 0
    return total, n_lost, pose[RATE], pose[SCALE], p[RATE, RATE], p[SCALE, SCALE]


_Motions = tuple[FloatArray, ...]   # with `noise`, `way` and `lever`


@dataclass(frozen=True, slots=True)
class PastPath:
    """
    Positions that have left the graph, with the motions between them; see `MeasuredPath`.

    The statistics of errors are estimated from these as well, as a window may be shorter than the
    time in which errors change. Every second one is dropped when there are too many, and the
    motions on both sides of it are joined.
    """

    stamps_ns: Integers
    position: Rows2
    variance: Numbers
    offset: Rows2
    motion: Rows3  # shape (K + 1, 3); the last one leads to `node`
    noise: Rows6  # upper triangles of the covariances of the motions, shape (K + 1, 6)
    node: int  # id of the first node that is left in the graph
    # their parts by the way, shape (K + 1, 3); empty in files of older versions
    way: Rows3 = field(default_factory=lambda: np.empty((0, 3)))
    # how a higher yaw rate changes them, shape (K + 1, 3); empty in files of older versions
    lever: Rows3 = field(default_factory=lambda: np.empty((0, 3)))

    def continued(self, stamps_ns: IntArray, path: MeasuredPath) -> MeasuredPath:
        """Return the path with these positions before those that are in the graph."""
        stamps_ns = np.maximum.accumulate(np.concatenate((self.stamps_ns, stamps_ns)))
        seconds = np.asarray((stamps_ns - stamps_ns[:1]) * 1e-9, dtype=np.float64)
        taken_out = np.zeros((len(seconds), 2))
        taken_out[len(self.stamps_ns):] = path.taken_out
        position, variance, offset, motion, noise, way, lever = _with_next(self, path)
        return MeasuredPath(
            seconds, position, variance, offset, motion, noise, way, lever, taken_out)

    def extended(
        self, stamps_ns: IntArray, path: MeasuredPath, node: int,
    ) -> 'PastPath':
        position, variance, offset, motion, noise, way, lever = _with_next(self, path)
        grown = PastPath(np.concatenate((self.stamps_ns, stamps_ns)), position, variance, offset,
                         motion, upper(noise), node, way, lever)
        return grown.thinned() if len(grown.stamps_ns) > 2 * SOURCES.kept_positions else grown

    def thinned(self) -> 'PastPath':
        """Return every second position."""
        n = len(self.stamps_ns) // 2 * 2
        first, second = self.motion[:n:2], self.motion[1:n:2]
        noises = full(self.noise)
        joined, noise, way, lever = _joined(
            (first, noises[:n:2], self.way[:n:2], self.lever[:n:2]),
            (second, noises[1:n:2], self.way[1:n:2], self.lever[1:n:2]))
        rest, kept = slice(n, None), slice(1, n, 2)
        every = np.arange(len(self.stamps_ns))
        which = np.append(every[kept], every[rest])
        return PastPath(
            self.stamps_ns[which], self.position[which], self.variance[which],
            self.offset[which], np.concatenate((joined, self.motion[rest])),
            upper(np.concatenate((noise, noises[rest]))), self.node,
            np.concatenate((way, self.way[rest])), np.concatenate((lever, self.lever[rest])))


def no_past(node: int) -> PastPath:
    """Return a path without positions before a node, given by its id."""
    return PastPath(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty((0, 2)),
                    np.zeros((1, 3)), np.zeros((1, 6)), node, np.zeros((1, 3)), np.zeros((1, 3)))


def _with_next(past: PastPath, path: MeasuredPath) -> _Motions:
    """
    Return the positions of both, and the motions, those where one path ends joined.
    """
    last = past.motion, full(past.noise), past.way, past.lever
    new = path.motion, path.noise, path.way, path.lever
    joined = _joined(tuple(column[-1:][:len(path.motion)] for column in last),
                     tuple(column[:1] for column in new))
    return (np.concatenate((past.position, path.position)),
            np.concatenate((past.variance, path.variance)),
            np.concatenate((past.offset, path.offset)),
            *(np.concatenate((one[:-1], both, other[1:]))
              for one, both, other in zip(last, joined, new, strict=True)))


def _joined(first: _Motions, second: _Motions) -> _Motions:
    """Return motions one after the other, and their covariances in the frames at their ends."""
    adjoint = se2.adjoint(se2.inverse(second[0]))
    turned = np.swapaxes(adjoint, 1, 2)
    way = adjoint[:, :2, :2] @ first[2][:, [[0, 1], [1, 2]]] @ turned[:, :2, :2]
    c, s = np.cos(first[0][:, 2]), np.sin(first[0][:, 2])
    # the second motion and its lever in the frame that the first one begins in
    x, y = (c * second[0][:, 0] - s * second[0][:, 1], s * second[0][:, 0] + c * second[0][:, 1])
    by_x, by_y, time = second[3].T
    lever = first[3] + np.column_stack((
        c * by_x - s * by_y - y * first[3][:, 2], s * by_x + c * by_y + x * first[3][:, 2], time))
    return (np.asarray(se2.compose(first[0], second[0])),
            adjoint @ first[1] @ turned + second[1],
            way[:, [0, 0, 1], [0, 1, 1]] + second[2], lever)
