# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outputs of the engine, as immutable values, and their prediction to newer odometry."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.se2 import between_one, compose_one, FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, OdometryErrors, step_variance
from pose_graph_ros.core.odometry.timeline import JITTER_DISTANCE, JITTER_HEADING


class UpdateReport(NamedTuple):
    """Result of an update or of an optimisation."""

    status: Status
    reason: str = ''  # why it failed; empty if it did not
    new_constraints: int = 0  # number of constraints that were added to the graph
    iterations: int = 0
    chi2: float = 0.0
    relinearized: int = 0  # number of constraints that the smoother linearised again
    eliminated: int = 0  # number of hidden nodes that it eliminated again
    visited: int = 0  # number of cliques of hidden nodes that it solved for again

    def before(self, again: 'UpdateReport') -> 'UpdateReport':
        """Return one report of this update and the one after it; only the last may have failed."""
        return again._replace(new_constraints=self.new_constraints + again.new_constraints)

    def after(self, solved: 'UpdateReport') -> 'UpdateReport':
        """Return one report of this update and the optimisation of the whole graph after it."""
        failed = next((part for part in (self, solved) if part.status is Status.FAILED), solved)
        return self._replace(status=failed.status, reason=failed.reason, chi2=solved.chi2,
                             iterations=self.iterations + solved.iterations)


@dataclass(frozen=True, slots=True)
class Estimate:
    """An estimate for publishing; its arrays are read-only."""

    stamp_ns: int  # stamp of the newest odometry [ns]
    T_odom_base: FloatArray  # newest odometry, shape (3,) [m, m, rad]
    T_map_base: FloatArray  # estimate at the newest odometry, shape (3,) [m, m, rad]
    T_map_odom: FloatArray  # pose of the odometry frame in the map, shape (3,) [m, m, rad]
    covariance: FloatArray  # of `T_map_base`, in map axes, shape (3, 3)
    alignment: AlignmentState
    # of the angle between odometry and map [rad]; infinite if it is unknown
    alignment_sigma: float
    chi2: float
    n_hidden: int  # hidden nodes of the path
    n_edges: int  # edges between hidden nodes
    n_observed: int  # observed nodes, including measurements with a bias
    n_biases: int  # hidden nodes that are biases: states of time-correlated errors
    primary: str  # source of the odometry in `T_odom_base`
    odometry: OdometrySource  # settings of that source
    # errors of the primary odometry that the graph knows of
    odometry_errors: OdometryErrors = AS_CLAIMED
    # how many of the hidden nodes have left the graph; their poses do not change any more
    n_frozen: int = 0
    # how many of the others have left it; their poses move with those of nodes that stay
    n_thinned: int = 0
    n_priors: int = 0  # priors that stand for frozen nodes in the graph
    # the value of `path`; None if the estimate was made without it
    trajectory: Trajectory | None = None

    @property
    def path(self) -> Trajectory:
        """`T_map_base` at all hidden nodes, last at the newest odometry; ValueError without it."""
        if self.trajectory is None:
            raise ValueError('the estimate was made without its path')
        return self.trajectory

    def __post_init__(self) -> None:
        for array in (self.T_odom_base, self.T_map_base, self.T_map_odom, self.covariance):
            array.flags.writeable = False


class Prediction(NamedTuple):
    """Predicted pose and covariance of the robot."""

    T_map_base: FloatArray  # shape (3,) [m, m, rad]
    covariance: FloatArray  # in map axes, shape (3, 3)


def predict(estimate: Estimate, sample: OdometrySample) -> Prediction:
    """
    Return the estimate propagated to odometry shortly after or before it.

    The path in between is assumed to be straight, and the twist to be uncertain as in the sample;
    it is short because each update makes a new estimate.
    """
    x, y, theta = between_one(estimate.T_odom_base.tolist(), sample.pose.tolist())
    begin = estimate.T_map_base.tolist()
    # noise of the odometry in between, along (a) and across (b) the robot's final heading
    odometry, twist, errors = estimate.odometry, sample.twist_variance, estimate.odometry_errors
    since = (sample.stamp_ns - estimate.stamp_ns) * 1e-9
    step, elapsed = (math.hypot(x, y), abs(theta)), abs(since)
    if step[0] < JITTER_DISTANCE and step[1] < JITTER_HEADING:
        since = elapsed = 0.0   # at rest the twist adds nothing, and the robot does not turn
    along, across, heading = step_variance(
        odometry, None if twist is None else tuple(twist.tolist()), step, elapsed)
    factor = odometry.covariance_scale
    claimed = factor * min(heading, UNKNOWN_HEADING_VARIANCE)
    c, s = math.cos(theta), math.sin(theta)
    sweep_a, sweep_b = s * x - c * y, c * x + s * y
    # of q / 3 the part q / 4 is what the heading at the end tells
    q, by_sweep = errors.turn * claimed, (errors.turn / 4.0 + errors.way / 12.0) * claimed
    aa = by_sweep * sweep_a * sweep_a + errors.way * factor * along
    ab = by_sweep * sweep_a * sweep_b
    bb = by_sweep * sweep_b * sweep_b + errors.way * factor * across
    if errors.rate != 0.0 or errors.scale != 0.0:
        c, s = math.cos(0.5 * errors.rate * since), math.sin(0.5 * errors.rate * since)
        x, y, theta = ((1.0 + errors.scale) * (c * x - s * y),
                       (1.0 + errors.scale) * (s * x + c * y), theta + errors.rate * since)
    end = compose_one(begin, (x, y, theta))
    # the same in map axes
    c, s = math.cos(end[2]), math.sin(end[2])
    sweep_x, sweep_y = c * sweep_a - s * sweep_b, s * sweep_a + c * sweep_b
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = estimate.covariance.tolist()
    # an error of the initial heading rotates the increment
    dx, dy = begin[1] - end[1], end[0] - begin[0]
    xx += (2.0 * xt + dx * tt) * dx + c * c * aa - 2.0 * c * s * ab + s * s * bb
    xy += dx * yt + dy * xt + dx * dy * tt + c * s * (aa - bb) + (c * c - s * s) * ab
    yy += (2.0 * yt + dy * tt) * dy + s * s * aa + 2.0 * c * s * ab + c * c * bb
    xt += dx * tt + 0.5 * q * sweep_x
    yt += dy * tt + 0.5 * q * sweep_y
    tt += q
    return Prediction(np.array(end), np.array(((xx, xy, xt), (xy, yy, yt), (xt, yt, tt))))
