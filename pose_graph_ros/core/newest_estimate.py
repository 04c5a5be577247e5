# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The estimate at the newest odometry and along the path, from the parts of the engine.

A measurement is added to the graph once no older odometry can come any more. Until then one that
odometry has passed corrects the newest hidden node by a Kalman filter, for the estimate alone:
the graph, and so what is left in the end, does not depend on it.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.alignment import AlignmentState, guess
from pose_graph_ros.core.batch.truncated import LIMITS
from pose_graph_ros.core.config import Loss, OdometrySource, Robust
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.odometry.motion import AS_CLAIMED
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.kinds import KINDS, observed


def estimate(
    parts: Parts, source: OdometrySource, newest_covariance: FloatArray, chi2: float, *,
    with_path: bool,
) -> Estimate:
    """Return the present estimate; there must be a hidden node."""
    graph, nodes, factors = parts.graph, parts.nodes, parts.factors
    state, sigma = parts.alignment.state, parts.alignment.sigma
    node = Corrected(graph.poses_of(nodes.ids[-1]), newest_covariance)
    if state is AlignmentState.ALIGNED:
        node = corrected(parts, node)
    errors = factors.calibration(nodes.primary, graph)
    motion, motion_noise, odometry = nodes.newest(errors)
    motion, motion_noise = _turned(parts, motion, motion_noise)
    newest = se2.compose(node.pose, motion)
    cov = covariance.propagated(*node, motion, motion_noise)
    if state is AlignmentState.ALIGNED:
        # by what may have happened, but is not believed
        (x, y, _), spread = parts.judge.fixes.bank.spread
        moved = np.array(((1.0, 0.0, y - newest[1]), (0.0, 1.0, newest[0] - x), (0.0, 0.0, 1.0)))
        cov = cov + moved @ spread @ moved.T
    shift = np.zeros(3)
    if state is AlignmentState.UNALIGNED:
        # if the aligning update failed, its measurements are in the quarantine
        waiting = [each.factor for each in (*parts.pipeline.queue, *parts.quarantine)
                   if each.is_placed]
        if len(waiting) > 0:
            shift, cov = guess(
                graph.poses, newest, Factors.joined(waiting).renumbered(graph.node_rows))
            newest = newest + shift
        else:
            # the nodes of all of them have left the graph
            state = AlignmentState.LOCAL
    stamp_ns = max(nodes.newest_ns, int(nodes.stamps_ns[-1]))
    return Estimate(
        stamp_ns=stamp_ns, T_odom_base=odometry, T_map_base=newest,
        T_map_odom=se2.compose(newest, se2.inverse(odometry)), covariance=cov,
        alignment=state, chi2=chi2, alignment_sigma=(
            math.sqrt(cov[2, 2]) if state is AlignmentState.ALIGNED else sigma),
        n_hidden=len(nodes), n_frozen=nodes.n_frozen, n_thinned=len(nodes.thinned),
        n_priors=graph.n_priors,
        n_edges=graph.n_edges,
        n_observed=sum(len(each) + each.n_otherwise for each in factors.sources.values()),
        n_biases=int(np.count_nonzero(graph.is_bias)),
        primary=nodes.primary, odometry=source,
        odometry_errors=nodes.errors if errors == AS_CLAIMED else nodes.errors._replace(
            rate=errors.rate, scale=errors.scale),
        trajectory=None if not with_path else Trajectory(
            nodes.stamps_ns, nodes.poses(graph) + shift).continued(stamp_ns, newest))


def path_covariances(parts: Parts, of: Estimate) -> FloatArray:
    """
    Return the covariances at the poses of the path of the present estimate, in map axes.

    They are NaN where they are unknown: at nodes that have left the graph by its window, and at
    all but the newest pose while the angle between odometry and map is unknown.
    """
    nodes, thinned, covariances = parts.nodes, parts.nodes.thinned, parts.smoother.covariances()
    rows = parts.graph.node_rows(nodes.ids)
    found = np.full((len(of.path), 3, 3), np.nan)
    inside = np.flatnonzero(rows >= 0)
    found[inside] = covariances[rows[inside]]
    for number in thinned.places().numbers.tolist():
        place = thinned.place(number)
        assert place is not None, 'it is among them'
        found[number] = covariance.propagated(
            of.path.poses[place.anchor], found[place.anchor], place.mean, place.noise)
    if of.alignment is AlignmentState.UNALIGNED:
        found[:] = np.nan
    found[-1] = of.covariance
    return found


def _turned(parts: Parts, motion: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the motion since the newest node, and its noise, with what a gyroscope says."""
    gyros, nodes = parts.pipeline.gyros, parts.nodes
    rotation = None if len(gyros.streams) == 0 else gyros.newest(
        int(nodes.stamps_ns[-1]), nodes.newest_ns, parts.factors.gyro_rates(parts.graph))
    if rotation is None or noise[2, 2] == 0.0:
        return motion, noise
    angle, variance = rotation
    total = noise[2, 2] + variance
    gain = noise[:, 2] / total
    step = float(se2.wrap(angle - motion[2])) * gain
    # the noise is in the frame at the end of the motion
    turn = se2.rotation(motion[2])
    return (np.append(motion[:2] + turn @ step[:2], motion[2] + step[2]),
            noise - total * np.outer(gain, gain))


class Corrected(NamedTuple):
    """The newest hidden node."""

    pose: FloatArray  # shape (3,) [m, m, rad]
    covariance: FloatArray  # in map axes, shape (3, 3)


def corrected(parts: Parts, node: Corrected) -> Corrected:
    """Return the newest node of an aligned graph with what odometry has passed."""
    if parts.graph.has_touched:
        return node     # an update has failed
    passed = _passed(parts)
    if len(passed) == 0:
        return node
    ids = [int(parts.nodes.ids[-1]), *sorted({int(edge.j[0]) for edge, _ in passed} - {-1})]
    state, joint = parts.graph.poses_of(ids), _joint(parts.smoother, ids)
    for edge, is_gated in passed:
        error, jacobian, noise = _linearized(edge, state, ids)
        spread = jacobian @ joint @ jacobian.T + noise
        gain = np.linalg.solve(spread, jacobian @ joint).T
        if is_gated and error @ np.linalg.solve(spread, error) > LIMITS[len(error)]:
            continue
        state = state + (gain @ error).reshape(-1, 3)
        joint = joint - gain @ jacobian @ joint
    return Corrected(se2.wrapped(state[0]), 0.5 * (joint[:3, :3] + joint[:3, :3].T))


def _passed(parts: Parts) -> list[tuple[Factors, bool]]:
    """
    Return what waits for odometry to be settled only, in the order of stamps, and if it is gated.
    """
    found = []
    for _, source, given in parts.pipeline.waiting_until(parts.nodes.newest_ns):
        attachment = parts.nodes.attach_ahead(given.stamp_ns)
        # the first one of a source may set the origin of the map, but not before it is attached
        if attachment is None or not parts.factors.has(source):
            continue
        measurement = KINDS[type(given)].in_map(given)
        if measurement is None:
            continue
        settings = parts.factors.config.measurement_source(source, type(measurement))
        found.append((
            parts.factors.preview(observed(source, measurement, attachment)),
            settings.robust is Robust.JUDGED or settings.applied_loss is not Loss.NONE))
    return found


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
    edge: Factors, state: FloatArray, ids: Sequence[int],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what was measured less what is expected, its Jacobian, and its covariance."""
    information = edge.weighted_information[0]
    used = np.flatnonzero(np.diagonal(information) > 0.0)
    x, y, factor, factor_heading = edge.constants[0].tolist()
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
