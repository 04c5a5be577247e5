# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The motion between two instants by odometry, its covariance, and what errors do to both.

Measurements in the map show errors of odometry (`OdometryErrors`). The noise of a motion has a
part that no error of a heading makes, that of the way: the covariance of its position where the
turn is known. It and all the rest, which errors of headings make, have a factor each. An error of
the yaw rate and of the scale that stay the same are taken out of the motion itself. Both can be
done to edges with any errors in use, and undone, without loss.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import NoiseFrom, OdometryNoise, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.se2 import between_one, exp_one, FloatArray, Pose
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.saved_columns import Numbers, Rows3

Variances = tuple[float, float, float]  # of (x, y, theta) [m^2, m^2, rad^2], or of a twist
NO_VARIANCE: FloatArray = np.zeros(3)
NO_VARIANCE.flags.writeable = False


class Motion(NamedTuple):
    """Motion between two instants."""

    # pose at the later instant seen from the earlier one, shape (3,) [m, m, rad]
    increment: FloatArray
    distance: float  # length of the path in between [m]
    turn: float  # sum of the absolute turns in between [rad]
    # variance of (x, y, theta) in addition to the noise by path and turns, shape (3,): noise by
    # the twist, jumps, interpolation [m^2, m^2, rad^2]
    variance: FloatArray = NO_VARIANCE


class Span(NamedTuple):
    """A motion, such as from the newest node to the first stamp of a new primary source."""

    mean: Numbers  # shape (3,)
    covariance: Rows3  # in the frame at its end

    def continued(self, mean: FloatArray, covariance: FloatArray) -> 'Span':
        """Return this motion and another one after it; or several, each and one after it."""
        adjoint = se2.adjoint(se2.inverse(mean))
        return Span(se2.compose(self.mean, mean),
                    adjoint @ self.covariance @ np.swapaxes(adjoint, -1, -2) + covariance)


NO_MOTION = Motion(np.zeros(3), 0.0, 0.0)


class Attachment(NamedTuple):
    """An instant, given by the last hidden node before it and the motion since."""

    node: int  # id of the node in the graph
    # `T_at`, pose at the instant in the frame of the node, shape (3,) [m, m, rad]
    motion: FloatArray
    noise: FloatArray  # covariance of the motion in the frame at the instant, shape (3, 3)


def integrated(first: Pose, last: Pose, elapsed: float) -> Pose:
    """Return the motion during a time [s] by the mean of the twists at its begin and end."""
    x, y, theta = (0.5 * (one + other) * elapsed for one, other in zip(first, last, strict=True))
    return exp_one((x, y, theta))


def step_variance(source: OdometrySource, twist: Variances | None, step: tuple[float, float],
                  elapsed: float) -> Variances:
    """
    Return the variance of (x, y, theta) of a short motion in the robot's frame, but its scale.

    `twist` is the variance of the twist in its message, `step` length and absolute turn.
    """
    noise = source.noise
    by_model = (noise.sigma_distance**2 * step[0], noise.sigma_lateral**2 * step[0],
                noise.sigma_heading_distance**2 * step[0] + noise.sigma_heading_turn**2 * step[1])
    if source.noise_from is not NoiseFrom.TWIST or twist is None:
        return by_model
    x, y, theta = (
        # larger ones, and zero, stand for unknown
        variance * elapsed if 0.0 < variance <= 1e4 else instead
        for variance, instead in zip(twist, by_model, strict=True))
    return x, y, theta


def odometry_covariance(noise: OdometryNoise, motion: Motion, *, floor: bool = True) -> FloatArray:
    """
    Return the covariance, shape (3, 3), of a motion by odometry in the frame at its end.

    The heading is a random walk along the path, and an error of the heading turns the rest of the
    path. With c the chord in the frame at the end, n = c turned by 90 degrees, and q the variance
    of the heading, this adds q n n^T / 3 to the covariance of the position and gives it the
    covariance q n / 2 with the heading.
    """
    increment, distance, turn, variance = motion
    # the variance of a heading is at most that of the uniform distribution
    q = min(noise.sigma_heading_distance**2 * distance + noise.sigma_heading_turn**2 * turn
            + float(variance[2]), UNKNOWN_HEADING_VARIANCE)
    c, s = np.cos(increment[2]), np.sin(increment[2])
    chord_x, chord_y = c * increment[0] + s * increment[1], c * increment[1] - s * increment[0]
    sweep = np.array([-chord_y, chord_x])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = q / 3.0 * np.outer(sweep, sweep)
    covariance[0, 0] += noise.sigma_distance**2 * distance + variance[0]
    covariance[1, 1] += noise.sigma_lateral**2 * distance + variance[1]
    covariance[:2, 2] = covariance[2, :2] = q / 2.0 * sweep
    covariance[2, 2] = q
    if floor:
        covariance[0, 0] += noise.sigma_floor_position**2
        covariance[1, 1] += noise.sigma_floor_position**2
        covariance[2, 2] += noise.sigma_floor_heading**2
    return covariance


class OdometryErrors(NamedTuple):
    """Errors of the primary odometry, in units of what it claims and as constants."""

    way: float = 1.0  # factor on the part of the variances that no error of a heading makes
    turn: float = 1.0  # factor on the rest
    rate: float = 0.0  # what the yaw rate is larger than odometry says [rad/s]
    scale: float = 0.0  # by which part the way is longer than odometry says
    rate_sigma: float = 0.0  # standard deviations of these two; 0 where they are not corrected
    scale_sigma: float = 0.0

    @classmethod
    def scaled(cls, sigmas: float) -> 'OdometryErrors':
        """Return errors with all sigmas times a factor."""
        return cls(sigmas**2, sigmas**2)

    def motions(self, means: FloatArray, seconds: FloatArray) -> FloatArray:
        """Return motions, as odometry says them, without their constant errors."""
        return bent(means, self.rate * seconds, 1.0 + self.scale)

    def as_odometry_says(self, means: FloatArray, seconds: FloatArray) -> FloatArray:
        """Undo `motions`."""
        return bent(means, -self.rate * seconds, 1.0 / (1.0 + self.scale))

    def covariances(self, claimed: FloatArray) -> FloatArray:
        """Return covariances of motions, shape (M, 3, 3), from those that odometry claims."""
        heading = np.where(claimed[:, 2:, 2:] > 0.0, claimed[:, 2:, 2:], np.inf)
        by_turn = claimed[:, :, 2:] @ claimed[:, 2:, :] / heading
        return np.asarray(self.turn * by_turn + self.way * (claimed - by_turn))

    def informations(self, claimed: FloatArray) -> FloatArray:
        """Return the inverses of `covariances` from those of what is claimed, as accurately."""
        result = claimed / self.way
        position = claimed[:, :2, :2]
        turn = claimed[:, 2, 2] - np.einsum(
            'mi,mi->m', claimed[:, 2, :2], np.linalg.solve(position, claimed[:, :2, 2:])[..., 0])
        result[:, 2, 2] += turn * (1.0 / self.turn - 1.0 / self.way)
        return np.asarray(result)

    @property
    def inverse_noise(self) -> 'OdometryErrors':
        """What undoes the factors of the noise, without constant errors."""
        return OdometryErrors(1.0 / self.way, 1.0 / self.turn)

    @property
    def mean_sigma(self) -> float:
        """Factor on the sigmas of an edge, in the geometric mean."""
        return float((self.way**2 * self.turn)**(1.0 / 6.0))


AS_CLAIMED = OdometryErrors()


def bent(means: FloatArray, turn: FloatArray, length: FloatArray | float) -> FloatArray:
    """Return motions that turn by more at a constant rate, and are longer by a factor."""
    # the chord turns by half of what the end turns by
    c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
    x, y = means[:, 0], means[:, 1]
    return np.column_stack((
        length * (c * x - s * y), length * (s * x + c * y), means[:, 2] + turn))


def as_calibrated(edges: Factors, nodes: FloatArray) -> Factors:
    """Return edges of odometry as what they measure with the values of their third nodes."""
    rate, scale, _ = nodes[edges.k].T
    return edges.replaced(constants=0.0, k=-1, mean=bent(
        edges.mean, -edges.constants[:, 3] * rate, 1.0 + scale))


def changed(means: FloatArray, informations: FloatArray, seconds: FloatArray,
            before: OdometryErrors, after: OdometryErrors) -> tuple[FloatArray, FloatArray]:
    """Return means and informations of edges with other errors than those that they have."""
    claimed = before.inverse_noise.informations(informations)
    return (after.motions(before.as_odometry_says(means, seconds), seconds),
            after.informations(claimed))


# --- jumps: steps that are longer than the robot can have moved
# Speeds are taken from the odometry itself. A step is a jump if it is longer than the recent
# speeds, the greatest speed so far, or the speed limit of the source allow in its time. The engine
# and the publisher of the newest pose use the same test.

# A step within these is never a jump, whatever its time [m, rad].
SLACK = (0.25, 0.5)
# Acceleration by which the recent speed may be exceeded [m/s^2, rad/s^2].
ACCELERATION = (10.0, 20.0)
# Excess over twice the greatest speed so far [m/s, rad/s].
MORE_SPEED = (3.0, 2.0)
# Shortest time over which a speed is computed, as stamps are not evenly spaced [s].
LEAST_TIME = 0.05
# Time constant with which the recent greatest speed decays [s].
MEMORY_TIME = 2.0
# Standard deviations of the motion across a jump or a gap for a robot at rest; the way at the
# previous speed is added [m, rad].
JUMP_SIGMA = (0.5, 0.1)
# Time before a gap over which the speed is averaged [ns].
SPEED_TIME_NS = 500_000_000
# Longest gap after which the odometry of a loaded graph is continued; beyond, it restarts [s].
RESUMED_WITHIN = 10.0
# Variances of the motion across a restart: the robot may have been moved by 1 m and 0.3 rad.
RESTART_VARIANCE: Variances = (1.0, 1.0, 0.09)


class Speeds(NamedTuple):
    """How fast the robot moves by odometry, in [m/s] and [rad/s]."""

    velocity: Pose  # in the robot's frame, with the yaw rate
    recent: tuple[float, float]  # greatest recent speed and yaw rate
    greatest: tuple[float, float]  # greatest speed and yaw rate so far


# Beyond all limits, but finite: a saved state contains it.
_ANY = (1e30, 1e30)
UNKNOWN = Speeds((0.0, 0.0, 0.0), _ANY, _ANY)


class SpeedWindow(NamedTuple):
    """The speeds, and the motion since they were last updated."""

    speeds: Speeds
    since_ns: int  # stamp of the last update [ns]
    since: Pose  # pose at that stamp, in a frame without jumps [m, m, rad]
    # path length [m] and sum of absolute turns [rad] since then
    path: tuple[float, float] = (0.0, 0.0)

    def moved(self, stamp_ns: int, pose: Pose, step: tuple[float, float]) -> 'SpeedWindow':
        """Return the window after a step (length, absolute turn) to a pose that is no jump."""
        path = self.path[0] + step[0], self.path[1] + step[1]
        time = (stamp_ns - self.since_ns) * 1e-9
        if time < LEAST_TIME:
            return self._replace(path=path)
        speed = path[0] / time, path[1] / time
        x, y, theta = between_one(self.since, pose)
        velocity = x / time, y / time, theta / time
        if self.speeds == UNKNOWN:
            speeds = Speeds(velocity, speed, speed)
        else:
            decay, (_, recent, greatest) = math.exp(-time / MEMORY_TIME), self.speeds
            speeds = Speeds(
                velocity, (max(speed[0], decay * recent[0]), max(speed[1], decay * recent[1])),
                (max(speed[0], greatest[0]), max(speed[1], greatest[1])))
        return SpeedWindow(speeds, stamp_ns, pose)


def is_jump(speeds: Speeds, step: tuple[float, float], elapsed: float, stated: float,
            limit: float) -> bool:
    """
    Tell whether a step (length, absolute turn) is longer than the robot can have moved.

    `speeds` are those before the step, `stated` that by the twist in the sample, not finite
    without one, and `limit` that of the source [m/s].
    """
    if step[0] <= SLACK[0] and step[1] <= SLACK[1]:
        return False
    time = elapsed + LEAST_TIME
    stated = abs(stated) if math.isfinite(stated) else 0.0
    for k, stated_k, limit_k in ((0, stated, limit), (1, 0.0, math.inf)):
        recent, greatest = max(speeds.recent[k], stated_k), max(speeds.greatest[k], stated_k)
        allowed = min(2.0 * recent + ACCELERATION[k] * max(time, 0.1),
                      2.0 * greatest + MORE_SPEED[k], limit_k)
        if step[k] > SLACK[k] + allowed * time:
            return True
    return False
