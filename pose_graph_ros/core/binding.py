# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From a measurement at its own stamp to a constraint on hidden nodes.

A measurement at stamp t acts on the last hidden node a before t, through the odometry T_at in
between, whose noise is added to the measurement's own. No node is made for a measurement, and
nothing here depends on when it arrived or on the present estimate.
"""

from dataclasses import dataclass, replace

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.measurements import (
    Answer,
    GlobalPose,
    LoopClosure,
    Measurement,
    Position,
    rejected,
    value_defect,
)
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.timeline import OdometryTimeline


@dataclass(frozen=True, slots=True)
class Anchor:
    """A stamp, as seen from the last hidden node before it."""

    node: int
    motion: FloatArray
    """`T_at`, shape (3,)."""
    noise: FloatArray
    """Covariance of the motion in the frame at the stamp, shape (3, 3)."""


def repaired(measurement: Measurement, config: BackendConfig) -> Measurement | Answer:
    """
    Return the measurement with its covariance floored, or why it cannot be used.

    A global pose whose heading is less certain than a flat guess becomes a position.
    """
    if isinstance(measurement, GlobalPose) and not _heading_known(measurement.covariance):
        measurement = Position(measurement.stamp_ns, measurement.pose[:2],
                               measurement.covariance[:2, :2], np.zeros(2))
    kind = type(measurement).__name__
    value = (np.concatenate((measurement.position, measurement.lever_arm))
             if isinstance(measurement, Position) else measurement.pose)
    broken = value_defect(value)
    if broken is not None:
        return rejected(broken, f'{kind}: {value.tolist()}')
    if measurement.stamp_ns <= 0:
        return rejected('zero_stamp', f'{kind} without a stamp')
    cov = measurement.covariance
    defect = covariance.defect(cov)
    if defect is not None:
        return rejected(f'covariance_{defect}', f'{kind}: {cov.tolist()}')
    floors = np.array([config.position_sigma_floor, config.position_sigma_floor,
                       config.heading_sigma_floor])[:len(cov)] ** 2
    return replace(measurement, covariance=covariance.floored(cov, floors))


def with_default_covariance(
    measurement: GlobalPose | Position, config: BackendConfig,
) -> Position:
    """Return what is left where all covariances are zero, which is how ROS says unknown."""
    position = measurement.position if isinstance(measurement, Position) else measurement.pose[:2]
    lever_arm = measurement.lever_arm if isinstance(measurement, Position) else np.zeros(2)
    return Position(measurement.stamp_ns, position, config.default_position_sigma**2 * np.eye(2),
                    lever_arm)


def _heading_known(cov: FloatArray) -> bool:
    """Tell whether a variance is neither infinite, nor huge, nor zero, nor below."""
    return bool(0.0 < cov[2, 2] < covariance.UNKNOWN_HEADING_VARIANCE)


def anchored(
    stamp_ns: int, node_stamps_ns: IntArray, timeline: OdometryTimeline,
    config: BackendConfig,
) -> Anchor:
    """Return a covered stamp as seen from the last hidden node before it."""
    node = int(np.searchsorted(node_stamps_ns, stamp_ns, side='right')) - 1
    motion = timeline.motion(int(node_stamps_ns[node]), stamp_ns)
    noise = covariance.odometry_covariance(
        config.odometry_noise, *motion, floor=False)
    return Anchor(node, motion.increment, noise)


def global_pose_constraint(measurement: GlobalPose, anchor: Anchor) -> ObservedNodes:
    """Return the constraint (3.51)-(3.53) on the anchor's node, offset by the motion since."""
    cov = covariance.turned(measurement.covariance, float(measurement.pose[2])) + anchor.noise
    return ObservedNodes([anchor.node], [anchor.motion], [measurement.pose],
                         [covariance.information(cov)], [ObservedKind.GLOBAL_POSE])


def position_constraint(measurement: Position, anchor: Anchor) -> ObservedNodes:
    """
    Return the constraint of a position: no information on the heading, error in map axes.

    The noise of the motion since the node, with what its heading does at the end of the lever
    arm, lies in axes of an unknown heading: its largest variance is taken for all directions.
    """
    jacobian = np.eye(2, 3)
    jacobian[:, 2] = -measurement.lever_arm[1], measurement.lever_arm[0]
    variance = float(np.linalg.eigvalsh(jacobian @ anchor.noise @ jacobian.T)[-1])
    information = np.zeros((3, 3))
    information[:2, :2] = covariance.information(measurement.covariance + variance * np.eye(2))
    offset = se2.compose(anchor.motion, np.append(measurement.lever_arm, 0.0))
    return ObservedNodes([anchor.node], [offset], [np.append(measurement.position, 0.0)],
                         [information], [ObservedKind.POSITION])


def loop_closure_constraint(
    measurement: LoopClosure, reference: Anchor, anchor: Anchor,
) -> Edges:
    """
    Return the edge between the hidden nodes before the two stamps.

    With T_i and T_j the motions from the nodes to the stamps, z' = T_i z T_j^-1. A small error at
    the end of z shows at the end of z' through the adjoint of T_j; one at its start through that
    of T_j z^-1.
    """
    z = measurement.pose
    cov = covariance.turned(measurement.covariance, float(z[2])) + anchor.noise
    back = se2.adjoint(se2.inverse(z))
    cov = cov + back @ reference.noise @ back.T
    out = se2.adjoint(anchor.motion)
    cov = out @ cov @ out.T
    mean = se2.compose(se2.compose(reference.motion, z), se2.inverse(anchor.motion))
    return Edges([reference.node], [anchor.node], [mean], [covariance.information(cov)],
                 [EdgeKind.LOOP_CLOSURE])
