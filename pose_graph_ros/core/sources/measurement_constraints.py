# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Constraints on hidden nodes from measurements with stamps of their own.

A measurement at stamp t constrains the last hidden node a before t through T_at, the motion by
odometry from a to t. The noise of that motion is added to that of the measurement. Measurements
make no hidden nodes, and a constraint depends neither on the order of arrival nor on the estimate.
"""

import numpy as np

from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.measurements import (
    Absolute,
    Answer,
    HeadingOnly,
    LoopClosure,
    Position,
    rejected,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import Attachment


def attach(nodes: HiddenNodes, stamp_ns: int) -> Attachment | Answer:
    """Return the motion from the last hidden node before a stamp, or why there is none."""
    first_ns = int(nodes.stamps_ns[0])
    if stamp_ns < first_ns:
        return rejected('before_odometry', f'stamp {1e-9 * stamp_ns:.3f} s, odometry begins at '
                                           f'{1e-9 * first_ns:.3f} s')
    if stamp_ns < nodes.last_frozen_ns:
        return _before_window(stamp_ns, nodes)
    attachment = nodes.attach(stamp_ns)
    if attachment is None:
        return rejected(
            'no_odometry', f'no odometry covers the motion up to {1e-9 * stamp_ns:.3f} s')
    return attachment


def _before_window(stamp_ns: int, nodes: HiddenNodes) -> Answer:
    return rejected('before_window', f'stamp {1e-9 * stamp_ns:.3f} s, the graph begins at '
                                     f'{1e-9 * nodes.last_frozen_ns:.3f} s')


def attach_reference(nodes: HiddenNodes, closure: LoopClosure) -> Attachment | Answer:
    """Return the attachment of the reference pose of a loop closure, or why it has none."""
    if closure.reference_ns is not None:
        return attach(nodes, closure.reference_ns)
    node = closure.reference_node
    if node is None or not 0 <= node < len(nodes):
        return rejected('unknown_node', f'there is no hidden node {node}')
    if node < nodes.n_frozen:
        return _before_window(int(nodes.stamps_ns[node]), nodes)
    return nodes.attachment(node, np.zeros(3), np.zeros((3, 3)))


def absolute_constraint(measurement: Absolute, attachment: Attachment) -> Factors:
    """
    Return the observed node of a measurement.

    That of a position has no information on the heading and lies in map axes; that of a heading
    has none on the position; that of a global pose is (3.51)-(3.53).
    """
    offset, noise, information = attachment.motion, attachment.noise, np.zeros((3, 3))
    if isinstance(measurement, Position):
        kind, mean = FactorKind.POSITION, np.append(measurement.position, 0.0)
        offset = se2.compose(offset, np.append(measurement.lever_arm, 0.0))
        information[:2, :2] = covariance.information(
            measurement.covariance + swept_variance(measurement, attachment) * np.eye(2))
    elif isinstance(measurement, HeadingOnly):
        kind, mean = FactorKind.HEADING, np.array((0.0, 0.0, measurement.heading))
        information[2, 2] = 1.0 / (measurement.variance + noise[2, 2])
    else:
        kind, mean = FactorKind.GLOBAL_POSE, measurement.pose
        information = covariance.information(
            covariance.turned(measurement.covariance, float(mean[2])) + noise)
    return Factors.on([attachment.node], [offset], [mean], [information], [kind])


def swept_variance(measurement: Position, attachment: Attachment) -> float:
    """
    Return the variance that the motion since the node adds to a position [m^2].

    The noise of the motion, including the effect of its heading on the end of the lever arm, is
    given in the frame of the robot, whose heading in the map is unknown. The largest eigenvalue of
    its covariance is therefore used in all directions.
    """
    jacobian = np.eye(2, 3)
    jacobian[:, 2] = -measurement.lever_arm[1], measurement.lever_arm[0]
    return float(np.linalg.eigvalsh(jacobian @ attachment.noise @ jacobian.T)[-1])


def motion_noise(measurement: Absolute, attachment: Attachment) -> FloatArray:
    """Return the variances of position and heading that the motion since the node adds."""
    noise = attachment.noise
    if isinstance(measurement, Position):
        return np.array((swept_variance(measurement, attachment), 0.0))
    if isinstance(measurement, HeadingOnly):
        return np.array((0.0, noise[2, 2]))
    return np.array((np.linalg.eigvalsh(noise[:2, :2])[-1], noise[2, 2]))


def loop_closure_constraint(
    measurement: LoopClosure, reference: Attachment, attachment: Attachment,
) -> Factors:
    """
    Return the edge of a loop closure between the hidden nodes before its two stamps.

    With T_i and T_j the motions from the nodes to the stamps, the edge measures
    `z' = T_i z T_j^-1`. A small error at the end of z is mapped to the end of z' by the adjoint of
    T_j, an error at its start by that of T_j z^-1. If the variances of x and y are infinite, the
    edge constrains the headings alone.
    """
    z = measurement.pose
    mean = se2.compose(se2.compose(reference.motion, z), se2.inverse(attachment.motion))
    if not np.isfinite(measurement.covariance[0, 0]):
        information = np.zeros((3, 3))
        information[2, 2] = 1.0 / float(
            measurement.covariance[2, 2] + attachment.noise[2, 2] + reference.noise[2, 2])
    else:
        information = covariance.information(closure_covariance(
            covariance.turned(measurement.covariance, float(z[2])), z, reference, attachment))
    return Factors([reference.node], [attachment.node], [mean], [information],
                 [FactorKind.LOOP_CLOSURE])


def closure_covariance(
    own: FloatArray, pose: FloatArray, reference: Attachment, attachment: Attachment,
) -> FloatArray:
    """Return the covariance of a closure with that of the motions since its nodes."""
    back, out = se2.adjoint(se2.inverse(pose)), se2.adjoint(attachment.motion)
    return np.asarray(
        out @ (own + attachment.noise + back @ reference.noise @ back.T) @ out.T)
