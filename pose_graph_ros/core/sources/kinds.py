# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of measurements, one row of a table each: how they are checked, attached, and constrain.

A measurement at stamp t constrains the last hidden node a before t through T_at, the motion by
odometry from a to t. The noise of that motion is added to that of the measurement. Measurements
make no hidden nodes, and a constraint depends neither on the order of arrival nor on the estimate.
"""

from collections.abc import Callable
import math
from typing import Any, NamedTuple
import zlib

import numpy as np

from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.config import CovariancePolicy
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.sources import validation
from pose_graph_ros.core.sources.queued import Queued


class MeasurementKind(NamedTuple):
    """
    What the engine asks of a kind of measurements.

    The first argument of each function is a measurement of that kind.
    """

    numbers: Callable[[Any], FloatArray]  # that must be valid coordinates
    # what is left of it with a valid covariance, or why it is rejected
    check: Callable[[Any, CovariancePolicy], validation.Checked]
    # its constraint, given its source, how its stamp is attached, and the nodes
    constraint: Callable[[Any, str, Attachment, HiddenNodes], Queued | ms.Answer]
    # what it says of the robot in the map; None if that is nothing, or not valid
    in_map: Callable[[Any], ms.Absolute | None] = lambda measurement: measurement
    # of those in the map, the observed node, and the variances of position and heading that the
    # motion since that node adds
    observed: Callable[[Any, Attachment], tuple[Factors, FloatArray]] | None = None
    # tells those of one stamp apart: 0, the stamp of another pose [ns], -2 - k for node k, or less
    key: Callable[[Any], int] = lambda _: 0


def validate(measurement: ms.PoseMeasurement, policy: CovariancePolicy) -> validation.Checked:
    """Return a measurement without what it has no information on, or why it is rejected."""
    kind, name = KINDS[type(measurement)], type(measurement).__name__
    numbers = kind.numbers(measurement)
    defect = ms.value_defect(numbers)
    if defect is not None:
        return ms.rejected(defect, f'{name}: {numbers.tolist()}')
    stamps = measurement.stamp_ns, kind.key(measurement)
    if stamps[0] <= 0 or any(abs(stamp) > ms.LARGEST_STAMP for stamp in stamps):
        return ms.rejected('zero_stamp' if stamps[0] <= 0 else 'no_stamp',
                           f'{name}: expected stamps above 0, got {stamps} ns')
    return kind.check(measurement, policy)


def key(measurement: ms.PoseMeasurement) -> int:
    """Return what tells measurements of one stamp apart; see `MeasurementKind.key`."""
    return KINDS[type(measurement)].key(measurement)


def due_ns(measurement: ms.PoseMeasurement) -> int:
    """Return the stamp that odometry must have reached to attach a measurement [ns]."""
    return max(measurement.stamp_ns, key(measurement))


# --- how they are attached

def attach(nodes: HiddenNodes, stamp_ns: int) -> Attachment | ms.Answer:
    """Return the motion from the last hidden node before a stamp, or why there is none."""
    first_ns = int(nodes.stamps_ns[0])
    if stamp_ns < first_ns:
        return ms.rejected('before_odometry', f'stamp {1e-9 * stamp_ns:.3f} s, odometry begins at '
                           f'{1e-9 * first_ns:.3f} s')
    if stamp_ns < nodes.last_frozen_ns:
        return _before_window(stamp_ns, nodes)
    attachment = nodes.attach(stamp_ns)
    if attachment is None:
        return ms.rejected(
            'no_odometry', f'no odometry covers the motion up to {1e-9 * stamp_ns:.3f} s')
    return attachment


def _before_window(stamp_ns: int, nodes: HiddenNodes) -> ms.Answer:
    return ms.rejected('before_window', f'stamp {1e-9 * stamp_ns:.3f} s, the graph begins at '
                       f'{1e-9 * nodes.last_frozen_ns:.3f} s')


def _observe(given: ms.Absolute, source: str, at: Attachment, _: HiddenNodes) -> Queued:
    return observed(source, given, at)


def _observe_fix(fix: ms.Fix, source: str, at: Attachment, _: HiddenNodes) -> Queued | ms.Answer:
    # the last step: only a fix that nothing else is wrong with may become the datum
    position = fix.placed()
    if (defect := ms.value_defect(position.position)) is not None:
        return ms.rejected(defect, f'Fix: {position.position.tolist()} m from the datum')
    return observed(source, position, at)


def _join(closure: ms.LoopClosure, source: str, at: Attachment,
          nodes: HiddenNodes) -> Queued | ms.Answer:
    node, reference_ns = closure.reference_node, closure.reference_ns
    if reference_ns is not None:
        reference = attach(nodes, reference_ns)
    elif node is None or not 0 <= node < len(nodes):
        return ms.rejected('unknown_node', f'there is no hidden node {node}')
    else:
        reference_ns = int(nodes.stamps_ns[node])
        reference = (_before_window(reference_ns, nodes) if node < nodes.n_frozen
                     else nodes.attachment(node, np.zeros(3), np.zeros((3, 3))))
    if isinstance(reference, ms.Answer):
        return reference
    if reference.node == at.node:
        return ms.rejected('same_node', f'both ends are attached to hidden node {at.node}')
    edge = loop_closure_constraint(closure, reference, at)
    return Queued(source, edge, closure.stamp_ns, reference_ns)


def _reach(given: ms.Range, source: str, at: Attachment, _: HiddenNodes) -> Queued:
    variance = given.variance + swept_variance(given, at)
    antenna = se2.compose(at.motion, np.append(given.lever_arm, 0.0))
    edge = Factors(     # to a landmark that there need not be yet
        [at.node], [-1], [(given.distance, 0.0, 0.0)],
        [np.diag((1.0 / variance, 0.0, 0.0))], [FactorKind.RANGE],
        constants=[(antenna[0], antenna[1], 0.0, 0.0)])
    return Queued(source, edge, given.stamp_ns)


# --- their constraints

def observed(source: str, measurement: ms.Absolute, attachment: Attachment) -> Queued:
    """Return the constraint of a measurement in the map, if its error is treated as white."""
    of_kind = KINDS[type(measurement)].observed
    assert of_kind is not None, 'it is in the map'
    factor, noise = of_kind(measurement, attachment)
    return Queued(source, factor, measurement.stamp_ns, noise=noise)


def _observed_position(given: ms.Position, at: Attachment) -> tuple[Factors, FloatArray]:
    # it has no information on the heading, and lies in map axes
    variance, information = swept_variance(given, at), np.zeros((3, 3))
    information[:2, :2] = covariance.information(given.covariance + variance * np.eye(2))
    offset = se2.compose(at.motion, np.append(given.lever_arm, 0.0))
    return Factors.on([at.node], [offset], [np.append(given.position, 0.0)],
                      [information], [FactorKind.POSITION]), np.array((variance, 0.0))


def _observed_heading(given: ms.HeadingOnly, at: Attachment) -> tuple[Factors, FloatArray]:
    variance, information = float(at.noise[2, 2]), np.zeros((3, 3))
    information[2, 2] = 1.0 / (given.variance + variance)
    return Factors.on([at.node], [at.motion], [(0.0, 0.0, given.heading)],
                      [information], [FactorKind.HEADING]), np.array((0.0, variance))


def _observed_pose(given: ms.GlobalPose, at: Attachment) -> tuple[Factors, FloatArray]:
    noise, pose = at.noise, given.pose
    information = covariance.information(    # (3.51)-(3.53)
        covariance.turned(given.covariance, float(pose[2])) + noise)
    return Factors.on([at.node], [at.motion], [pose], [information], [
        FactorKind.GLOBAL_POSE]), np.array((np.linalg.eigvalsh(noise[:2, :2])[-1], noise[2, 2]))


def swept_variance(measurement: ms.Position | ms.Range, attachment: Attachment) -> float:
    """
    Return the variance that the motion since the node adds to a position [m^2].

    The noise of the motion, including the effect of its heading on the end of the lever arm, is
    given in the frame of the robot, whose heading in the map is unknown. The largest eigenvalue of
    its covariance is therefore used in all directions.
    """
    (x, y), ((xx, xy, xt), (_, yy, yt), (*_, tt)) = (
        measurement.lever_arm.tolist(), attachment.noise.tolist())
    a, b, c = xx - (2.0 * xt - y * tt) * y, xy + xt * x - yt * y - tt * x * y, (
        yy + (2.0 * yt + x * tt) * x)
    return 0.5 * (a + c) + math.hypot(0.5 * (a - c), b)


def loop_closure_constraint(given: ms.LoopClosure, first: Attachment, at: Attachment) -> Factors:
    """
    Return the edge of a loop closure between the hidden nodes before its two stamps.

    With T_i and T_j the motions from the nodes to the stamps, the edge measures
    `z' = T_i z T_j^-1`. A small error at the end of z is mapped to the end of z' by the adjoint of
    T_j, an error at its start by that of T_j z^-1. If the variances of x and y are infinite, the
    edge constrains the headings alone.
    """
    z = given.pose
    mean = se2.compose(se2.compose(first.motion, z), se2.inverse(at.motion))
    if not np.isfinite(given.covariance[0, 0]):
        information = np.zeros((3, 3))
        information[2, 2] = 1.0 / float(
            given.covariance[2, 2] + at.noise[2, 2] + first.noise[2, 2])
    else:
        information = covariance.information(closure_covariance(
            covariance.turned(given.covariance, float(z[2])), z, first, at))
    return Factors([first.node], [at.node], [mean], [information], [FactorKind.LOOP_CLOSURE])


def closure_covariance(own: FloatArray, pose: FloatArray, reference: Attachment,
                       attachment: Attachment) -> FloatArray:
    """Return the covariance of a closure with that of the motions since its nodes."""
    back, out = se2.adjoint(se2.inverse(pose)), se2.adjoint(attachment.motion)
    return np.asarray(out @ (own + attachment.noise + back @ reference.noise @ back.T) @ out.T)


KINDS: dict[type[ms.PoseMeasurement], MeasurementKind] = {
    ms.GlobalPose: MeasurementKind(
        lambda each: each.pose, validation.check_pose, _observe, observed=_observed_pose),
    ms.Position: MeasurementKind(
        lambda each: np.concatenate((each.position, each.lever_arm)), validation.check_position,
        _observe, lambda each: each if ms.value_defect(each.position) is None else None,
        _observed_position),
    ms.Fix: MeasurementKind(   # its position is checked when it is placed
        lambda each: each.lever_arm, validation.check_position, _observe_fix,
        lambda each: KINDS[ms.Position].in_map(each.placed())),
    ms.HeadingOnly: MeasurementKind(
        lambda each: np.array([each.heading]), validation.check_heading, _observe,
        observed=_observed_heading),
    ms.LoopClosure: MeasurementKind(
        lambda each: each.pose, validation.check_closure, _join, lambda _: None,
        key=lambda each: each.reference_ns if each.reference_ns is not None else (
            -1 if each.reference_node is None else -2 - each.reference_node)),
    ms.Range: MeasurementKind(
        lambda each: np.concatenate((
            (each.distance,), each.lever_arm, () if each.place is None else each.place)),
        validation.check_range, _reach, lambda _: None,
        key=lambda each: -2**40 - zlib.crc32(each.beacon.encode())),
}
"""What the engine asks of each kind of measurements, by its class."""
