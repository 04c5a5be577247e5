# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What has been measured in the map since the newest odometry that is settled.

A measurement is added to the graph once no older odometry can come any more. Until then one that
odometry has passed corrects the newest hidden node by a Kalman filter, for the estimate alone:
the graph, and so what is left in the end, does not depend on it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.truncated import LIMITS
from pose_graph_ros.core.config import Loss, Robust
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.io.capture import Parts
from pose_graph_ros.core.measurements import Absolute, Fix, LoopClosure, Position, value_defect
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.gauss_markov import (
    biased_constraint,
    CorrelatedErrors,
    GaussMarkovBias,
)
from pose_graph_ros.core.sources.measurement_constraints import absolute_constraint, motion_noise


class Corrected(NamedTuple):
    """The newest hidden node."""

    pose: FloatArray
    """Shape (3,) [m, m, rad]."""
    covariance: FloatArray
    """In map axes, shape (3, 3)."""


class _Passed(NamedTuple):
    edge: Edges
    """From the newest node to a state of the bias of its source, or to none, -1."""
    is_gated: bool


def corrected(parts: Parts, smoother: IncrementalSmoother, node: Corrected) -> Corrected:
    """Return the newest node of an aligned graph with what odometry has passed."""
    if parts.graph.has_touched:
        return node     # an update has failed
    passed = _passed(parts)
    if len(passed) == 0:
        return node
    ids = [int(parts.nodes.ids[-1]), *sorted({int(each.edge.j[0]) for each in passed} - {-1})]
    state, joint = parts.graph.poses_of(ids), _joint(smoother, ids)
    for edge, is_gated in passed:
        error, jacobian, noise = _linearized(edge, state, ids)
        spread = jacobian @ joint @ jacobian.T + noise
        gain = np.linalg.solve(spread, jacobian @ joint).T
        if is_gated and error @ np.linalg.solve(spread, error) > LIMITS[len(error)]:
            continue
        state = state + (gain @ error).reshape(-1, 3)
        joint = joint - gain @ jacobian @ joint
    return Corrected(se2.wrapped(state[0]), 0.5 * (joint[:3, :3] + joint[:3, :3].T))


def _passed(parts: Parts) -> list[_Passed]:
    """Return what waits for odometry to be settled only, in the order of stamps."""
    found = []
    for source, given in parts.pipeline.waiting.until(parts.nodes.newest_ns):
        attachment = parts.nodes.attach_ahead(given.stamp_ns)
        # the first one of a source may set the origin of the map, but not before it is attached
        if (isinstance(given, LoopClosure) or attachment is None
                or not parts.factors.has(source)):
            continue
        model = parts.factors.error_model(source)
        measurement = given.placed() if isinstance(given, Fix) else given
        if isinstance(measurement, Position) and value_defect(measurement.position) is not None:
            continue
        settings = parts.factors.config.measurement_source(source, type(measurement))
        found.append(_Passed(
            _edge(measurement, attachment, model),
            settings.robust is Robust.JUDGED or settings.applied_loss is not Loss.NONE))
    return found


def _edge(
    measurement: Absolute, attachment: Attachment, model: GaussMarkovBias | None,
) -> Edges:
    """Return a measurement as an edge to the last state of the bias before it, or to none, -1."""
    observed = absolute_constraint(measurement, attachment)
    noise = motion_noise(measurement, attachment)
    edge = None if model is None else model.preview(measurement.stamp_ns, observed, noise)
    return edge if edge is not None else biased_constraint(
        observed, noise, -1, 1.0, CorrelatedErrors(0.0, 0.0, 1.0))


def _joint(smoother: IncrementalSmoother, ids: Sequence[int]) -> FloatArray:
    """Return the joint covariance of a few nodes, shape (3 N, 3 N)."""
    joint = np.empty((3 * len(ids), 3 * len(ids)))
    joint[:3, :3] = smoother.covariance(ids[0])
    for k in range(1, len(ids)):
        for m in range(k):
            pair = smoother.joint_covariance(ids[m], ids[k])
            rows = np.concatenate((np.arange(3 * m, 3 * m + 3), np.arange(3 * k, 3 * k + 3)))
            joint[np.ix_(rows, rows)] = pair
    return joint


def _linearized(
    edge: Edges, state: FloatArray, ids: Sequence[int],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what was measured less what is expected, its Jacobian, and its covariance."""
    information = edge.weighted_information[0]
    used = np.flatnonzero(np.diagonal(information) > 0.0)
    x, y, factor, factor_heading = edge.bias[0].tolist()
    arm = se2.rotation(state[0, 2]) @ (x, y)
    jacobian = np.zeros((3, 3 * len(ids)))
    jacobian[:, :3] = np.eye(3)
    jacobian[:2, 2] = -arm[1], arm[0]
    error = edge.mean[0] - state[0] - (*arm, 0.0)
    if edge.j[0] >= 0:
        at = ids.index(int(edge.j[0]))
        factors = np.array((factor, factor, factor_heading))
        jacobian[:, 3 * at:3 * at + 3] = -np.diag(factors)
        error = error + factors * state[at]
    error[2] = se2.wrap(error[2])
    return error[used], jacobian[used], np.linalg.inv(information[np.ix_(used, used)])
