# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From a measurement at its own stamp to a constraint on hidden nodes.

A measurement at stamp t acts on the last hidden node a before t, through the odometry T_at in
between, whose noise is added to the measurement's own. No node is made for a measurement, and
nothing here depends on when it arrived or on the present estimate.
"""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.measurements import (
    Absolute,
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    Position,
)
from pose_graph_ros.core.se2 import FloatArray


@dataclass(frozen=True, slots=True)
class Anchor:
    """A stamp, as seen from the last hidden node before it."""

    node: int
    motion: FloatArray
    """`T_at`, shape (3,)."""
    noise: FloatArray
    """Covariance of the motion in the frame at the stamp, shape (3, 3)."""


def absolute_constraint(measurement: Absolute, anchor: Anchor) -> ObservedNodes:
    """Return the observed node on the anchor's node, offset by the motion since."""
    if isinstance(measurement, Position):
        return _position_constraint(measurement, anchor)
    if isinstance(measurement, HeadingOnly):
        return _heading_constraint(measurement, anchor)
    return _global_pose_constraint(measurement, anchor)


def _global_pose_constraint(measurement: GlobalPose, anchor: Anchor) -> ObservedNodes:
    """Return the constraint (3.51)-(3.53) on the anchor's node, offset by the motion since."""
    cov = covariance.turned(measurement.covariance, float(measurement.pose[2])) + anchor.noise
    return ObservedNodes([anchor.node], [anchor.motion], [measurement.pose],
                         [covariance.information(cov)], [ObservedKind.GLOBAL_POSE])


def _position_constraint(measurement: Position, anchor: Anchor) -> ObservedNodes:
    """Return the constraint of a position: no information on the heading, error in map axes."""
    information = np.zeros((3, 3))
    information[:2, :2] = covariance.information(
        measurement.covariance + swept_variance(measurement, anchor) * np.eye(2))
    offset = se2.compose(anchor.motion, np.append(measurement.lever_arm, 0.0))
    return ObservedNodes([anchor.node], [offset], [np.append(measurement.position, 0.0)],
                         [information], [ObservedKind.POSITION])


def swept_variance(measurement: Position, anchor: Anchor) -> float:
    """
    Return the variance that a position has by the motion since the node [m^2].

    The noise of the motion, with what its heading does at the end of the lever arm, lies in axes
    of an unknown heading: its largest variance is taken for all directions.
    """
    jacobian = np.eye(2, 3)
    jacobian[:, 2] = -measurement.lever_arm[1], measurement.lever_arm[0]
    return float(np.linalg.eigvalsh(jacobian @ anchor.noise @ jacobian.T)[-1])


def _heading_constraint(measurement: HeadingOnly, anchor: Anchor) -> ObservedNodes:
    """Return the constraint of a heading: no information on the position."""
    information = np.zeros((3, 3))
    information[2, 2] = 1.0 / (measurement.variance + anchor.noise[2, 2])
    return ObservedNodes([anchor.node], [anchor.motion], [(0.0, 0.0, measurement.heading)],
                         [information], [ObservedKind.HEADING])


def loop_closure_constraint(
    measurement: LoopClosure, reference: Anchor, anchor: Anchor,
) -> Edges:
    """
    Return the edge between the hidden nodes before the two stamps.

    With T_i and T_j the motions from the nodes to the stamps, z' = T_i z T_j^-1. A small error at
    the end of z shows at the end of z' through the adjoint of T_j; one at its start through that
    of T_j z^-1. With infinite variances of x and y it ties the headings alone.
    """
    z = measurement.pose
    mean = se2.compose(se2.compose(reference.motion, z), se2.inverse(anchor.motion))
    if not np.isfinite(measurement.covariance[0, 0]):
        information = np.zeros((3, 3))
        information[2, 2] = 1.0 / float(
            measurement.covariance[2, 2] + anchor.noise[2, 2] + reference.noise[2, 2])
        return Edges([reference.node], [anchor.node], [mean], [information],
                     [EdgeKind.LOOP_CLOSURE])
    cov = covariance.turned(measurement.covariance, float(z[2])) + anchor.noise
    back = se2.adjoint(se2.inverse(z))
    cov = cov + back @ reference.noise @ back.T
    out = se2.adjoint(anchor.motion)
    cov = out @ cov @ out.T
    return Edges([reference.node], [anchor.node], [mean], [covariance.information(cov)],
                 [EdgeKind.LOOP_CLOSURE])
