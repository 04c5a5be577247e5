# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose of the odometry frame in the map, and when it counts as known.

One global pose with a good heading is enough; positions must span a baseline. As odometry drifts,
a fit of positions is only valid near them: each stretch of the drive gets its own fit
(`consensus`), and most of the fits must agree up to the drift between them. An angle found from
the first few positions is checked again when there are more.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.alignment import consensus as cs
from pose_graph_ros.core.alignment.consensus import TUNED
from pose_graph_ros.core.config import AlignmentPolicy
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.se2 import FloatArray, Poses, PoseVector
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.factors import errors
from pose_graph_ros.core.quantities import Radians


class GraphAlignment(NamedTuple):
    """Pose of a graph in the map, from observed nodes."""

    # shape (3,) [m, m, rad]; None while the angle is not known well enough
    T_map_graph: FloatArray | None
    sigma: float  # standard deviation of the angle at the node, with the drift of odometry [rad]
    node: int = -1  # hidden node at which the angle has the least variance; -1 without an angle


def find_alignment(poses: FloatArray, given: cs.Given) -> GraphAlignment:
    """
    Return the rigid motion that takes a graph into the map, if it is known well enough.

    It is found from what was observed on its hidden nodes, in any order; at least one of these is
    a position or a global pose.
    """
    by_heading = _by_heading(poses, given.observed)
    by_positions = _from_positions(cs.positions_along(poses, given), given)
    better = by_positions.T_map_graph is None or by_heading.sigma < by_positions.sigma
    return by_heading if better and by_heading.sigma <= TUNED.aligning_sigma else by_positions


def _by_heading(poses: FloatArray, observed: Factors) -> GraphAlignment:
    """Return the alignment by the most certain heading, at its position or at those of others."""
    sigma, full = np.full(len(observed), np.inf), observed.kind == FactorKind.GLOBAL_POSE
    placed = observed.kind != FactorKind.HEADING
    sigma[full] = np.sqrt(np.linalg.inv(observed.information[full])[:, 2, 2])
    sigma[~placed] = observed.information[~placed, 2, 2]**-0.5
    best = int(np.argmin(sigma))
    predicted = se2.compose(poses[observed.i], observed.offset)
    theta = float(se2.wrap(observed.mean[best, 2] - predicted[best, 2]))
    used = np.array([best]) if full[best] else np.flatnonzero(placed)
    weight = np.trace(observed.information[used, :2, :2], axis1=1, axis2=2)
    shift = np.average(
        observed.mean[used, :2] - predicted[used, :2] @ se2.rotation(theta).T, axis=0,
        weights=weight)
    return GraphAlignment(np.array((*shift, theta)), float(sigma[best]), int(observed.i[best]))


def recheck(
    solved: Poses, odometry: Poses, given: cs.Given, sigma: Radians = 0.0,
) -> GraphAlignment | None:
    """
    Return a new alignment if more positions show that the angle in use is wrong.

    The angle found from the positions alone, as by `find_alignment`, is compared with the angle
    between the solved graph and odometry at the same node. The result is the motion from the
    odometry frame into the map; None if the angle in use is right, or none is determined.
    """
    found = _from_positions(cs.positions_along(odometry, given), given)
    if found.T_map_graph is None:
        return None
    in_use = solved[found.node, 2] - odometry[found.node, 2]
    difference = abs(float(se2.wrap(found.T_map_graph[2] - in_use)))
    limit = max(TUNED.least_correction, TUNED.disagreement * float(np.hypot(found.sigma, sigma)))
    return found if difference > limit else None


def _from_positions(positions: cs.Positions, given: cs.Given) -> GraphAlignment:
    """Return the motion that most stretches of the drive agree on."""
    policy = given.policy
    if positions.baseline < policy.minimum_baseline:
        return GraphAlignment(None, np.inf)
    sigma, sparse = np.inf, True
    for shortening in TUNED.shortenings:
        least = TUNED.least_of_shortened if shortening > 1.0 else min(3, len(positions.node))
        stretches = _stretches(positions, shortening)
        found = [cs.consensus(stretch, given) if len(stretch.node) >= least else None
                 for stretch in stretches]
        sparse = sparse and all(len(stretch.node) < least for stretch in stretches)
        left_handed = [item.is_mirrored for item in found if item is not None]
        # the shorter ones may be too straight to show it
        if (shortening == 1.0 and any(left_handed)
                and np.mean(left_handed) >= TUNED.least_agreement):
            return GraphAlignment(None, np.inf)
        sigma = min([sigma, *(item.sigma_heading for item in found if item is not None)])
        best = _supported(stretches, found, policy, least)
        if best is not None:
            return best
    if sparse:
        # every stretch of the long drive has too few positions
        whole = positions.thinned()
        best = _supported([whole], [cs.consensus(whole, given)], policy, 3)
    return best or GraphAlignment(None, sigma)


def _stretches(positions: cs.Positions, shortening: float) -> list[cs.Positions]:
    """Return stretches of the drive with about the same drift of odometry, newest first."""
    # the path length decides where odometry has no noise of the heading
    to_come = positions.walk[-1] - positions.walk + 1e-9 * (positions.path[-1] - positions.path)
    n = shortening * np.ceil(to_come[0] / TUNED.stretch**2)
    if n == 0.0:
        return [positions.thinned()]
    number = np.minimum(np.floor(to_come * (n / to_come[0])), n - 1.0)
    used = np.unique(number)
    # the newest, the oldest, and some evenly in between
    used = used[np.unique(np.linspace(0, len(used) - 1, TUNED.stretches).round().astype(np.int64))]
    return [positions.rows(number == k).thinned() for k in used]


def _supported(
    stretches: list[cs.Positions], found: list[cs.Consensus | None], policy: AlignmentPolicy,
    least: int,
) -> GraphAlignment | None:
    """Return the newest certain fit that enough stretches agree with, up to odometry's drift."""
    candidates, n_relevant = [], 0
    for stretch, item in zip(stretches, found, strict=True):
        if item is not None and item.is_certain:
            candidates.append(item)
            n_relevant += 1
        else:
            # a long stretch without a certain fit counts as one that disagrees
            sigma = float(np.sqrt(np.median(stretch.variance)))
            far = max(policy.minimum_baseline, policy.baseline_in_sigmas * sigma)
            n_relevant += len(stretch.node) >= least and (
                stretch.path[-1] - stretch.path[0] >= far if least == TUNED.least_of_shortened
                else stretch.baseline >= 2.0 * far)
    if len(candidates) == 0:
        return None
    theta, variance, walk = np.array([
        (item.T_map_odom[2], item.sigma_heading**2, item.walk) for item in candidates]).T
    allowed = variance[:, None] + variance + np.abs(walk[:, None] - walk)
    agree = np.abs(se2.wrap(theta[:, None] - theta)) <= np.maximum(
        TUNED.disagreement * np.sqrt(allowed), TUNED.least_correction)
    # also through fits in between, as odometry may drift more than its noise allows
    reached = np.linalg.matrix_power(agree.astype(np.int64), len(theta)) > 0
    supported = np.sum(reached, axis=1) >= TUNED.least_agreement * n_relevant - 1e-9
    if not np.any(supported):
        return None
    # the newest, as receivers converge over time, unless it is much less certain
    good = supported & (variance <= TUNED.comparable_sigma**2 * np.min(variance[supported]))
    best = candidates[int(np.argmax(good))]
    return GraphAlignment(best.T_map_odom, best.sigma_heading, best.node)


def guess(poses: Poses, newest: PoseVector, observed: Factors) -> tuple[FloatArray, FloatArray]:
    """
    Return a shift of the graph into the map and a covariance while the angle is not known.

    The graph is shifted, without a turn, onto the most certain position. The covariance is that of
    the shifted pose of the robot in map axes. With d the distance from there and an angle that is
    uniform on the circle, the mean square error of each coordinate is d^2, that of the heading
    pi^2 / 3.
    """
    certainty = np.trace(observed.information[:, :2, :2], axis1=1, axis2=2)
    best = int(np.argmax(certainty))
    first = observed.rows(slice(best, best + 1))
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(first.mean[0, 2])
    shift = -(turn @ errors(poses, first)[0])
    shift[2] = 0.0
    where = se2.compose(poses[first.i], first.offset)[0]
    variance = float(np.sum((newest[:2] - where[:2])**2) + 2.0 / certainty[best])
    return shift, np.diag((variance, variance, UNKNOWN_HEADING_VARIANCE))
