# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The estimate at the newest odometry and along the path, from the parts of the engine."""

import math

import numpy as np

from pose_graph_ros.core.alignment import estimator
from pose_graph_ros.core.alignment.monitor import AlignmentState, in_rows, placed
from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.capture import Parts
from pose_graph_ros.core.passed_fixes import Corrected, corrected
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother


def estimate(
    parts: Parts, smoother: IncrementalSmoother, source: OdometrySource,
    newest_covariance: FloatArray, chi2: float, *, with_path: bool,
) -> Estimate:
    """
    Return the present estimate.

    Parameters
    ----------
    parts : Parts, with at least one hidden node
    smoother : IncrementalSmoother, of the graph
    source : OdometrySource, of the primary odometry
    newest_covariance : ndarray, shape (3, 3), of the newest hidden node, in map axes
    chi2 : float
    with_path : bool, whether with the path, which takes time and memory linear in the graph

    """
    graph, nodes, factors = parts.graph, parts.nodes, parts.factors
    state, sigma = parts.alignment.copy()
    node = Corrected(graph.poses_of(nodes.ids[-1]), newest_covariance)
    if state is AlignmentState.ALIGNED:
        node = corrected(parts, smoother, node)
    motion, motion_noise, odometry = nodes.newest()
    motion, motion_noise = _turned(parts, motion, motion_noise)
    newest = se2.compose(node.pose, motion)
    cov = covariance.propagated(*node, motion, motion_noise)
    shift = np.zeros(3)
    if state is AlignmentState.UNALIGNED:
        # if the aligning update failed, its measurements are in the quarantine
        waiting = placed(parts.pipeline.queue.observed + parts.quarantine.observed)
        if len(waiting) > 0:
            shift, cov = estimator.guess(graph.poses, newest, in_rows(graph, waiting))
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
        n_hidden=len(nodes), n_frozen=nodes.n_frozen, n_thinned=len(nodes.table.thinned),
        n_priors=graph.n_priors,
        n_edges=graph.n_edges - factors.n_bias_edges,
        n_observed=factors.n_measurements, n_biases=int(np.count_nonzero(graph.is_bias)),
        primary=nodes.primary, odometry=source, odometry_errors=nodes.errors,
        trajectory=None if not with_path else Trajectory(
            nodes.stamps_ns, nodes.poses(graph) + shift).continued(stamp_ns, newest))


def path_covariances(parts: Parts, covariances: FloatArray, of: Estimate) -> FloatArray:
    """
    Return the covariances at the poses of a path, in map axes, shape (P, 3, 3).

    They are NaN where they are unknown: at nodes that have left the graph by its window, and at
    all but the newest pose while the angle between odometry and map is unknown.

    Parameters
    ----------
    covariances : ndarray, shape (N, 3, 3), of all nodes in the graph, by row
    of : Estimate, the present one, with its path

    """
    nodes, thinned = parts.nodes, parts.nodes.table.thinned
    rows = parts.graph.node_rows(nodes.ids)
    found = np.full((len(of.path), 3, 3), np.nan)
    inside = np.flatnonzero(rows >= 0)
    found[inside] = covariances[rows[inside]]
    for number in thinned.places().numbers.tolist() if len(thinned) > 0 else ():
        place = thinned.place(number)
        assert place is not None, 'it is among them'
        found[number] = covariance.propagated(
            of.path.poses[place.anchor], found[place.anchor], place.mean, place.noise)
    if of.alignment is AlignmentState.UNALIGNED:
        found[:] = np.nan
    found[-1] = of.covariance
    return found


def _turned(
    parts: Parts, motion: FloatArray, noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the motion since the newest node, and its noise, with what a gyroscope says."""
    gyros, nodes = parts.pipeline.gyros, parts.nodes
    rotation = None if len(gyros.streams) == 0 else gyros.newest(
        int(nodes.stamps_ns[-1]), nodes.newest_ns, parts.factors.gyros.values(parts.graph))
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
