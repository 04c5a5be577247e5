# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose of the odometry frame in the map, and when it counts as known.

A global pose with a good heading tells it at once, positions as soon as they span some length. As
odometry drifts, a fit of positions is local: each stretch of the drive makes its own
(`consensus`), and most of the stretches must agree but for that drift. What was found from the
first few positions is judged again when there are more.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.config import AlignmentPolicy
from pose_graph_ros.core.consensus import (
    Consensus,
    consensus,
    LARGEST_SCALE,
    LEAST_SHARE,
    Lifetime,
    mirrored,
    Positions,
    positions_along,
)
from pose_graph_ros.core.constraints import ObservedKind, ObservedNodes
from pose_graph_ros.core.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.linearize import observed_errors
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sources import OdometryNoise

# A global pose tells the angle at once if its heading is at least this certain [rad].
ALIGNING_SIGMA = 0.5
# The lengths of two positions must agree within 2 sigmas and 2 of this: nothing else bears
# witness to them.
SCALE_OF_TWO = 0.05
# A stretch of the drive is so short that its heading drifts by no more than this by odometry [rad]
# or, where that does not fit, a third of it, a ninth ...
STRETCH = 0.3
SHORTENINGS = (1.0, 3.0, 9.0, 27.0)
# ... so many of them at the most, and ...
MOST_STRETCHES = 8
# ... of so many positions at the least, lest three that fit by chance are believed.
LEAST_OF_SHORTENED = 5
# Twice the sigma is much less certain.
MUCH = 2.0
# Angles differ if they do by more than both of these [sigma, rad]; less is left to the solver.
DISAGREEMENT = 4.0
LEAST_CORRECTION = 0.3


@dataclass(frozen=True, slots=True)
class Alignment:
    """Pose of the odometry frame in the map, from positions."""

    T_map_odom: FloatArray
    """Shape (3,) [m, m, rad]."""
    sigma_heading: float
    """Standard deviation of the heading [rad]; infinite without a baseline."""
    baseline: float
    """Diagonal of the box around the positions in the odometry frame [m]."""
    sigma_position: float
    """Of a position, by the mean of their weights: a few poor ones do not raise it [m]."""
    scale: float
    """Length of a motion in the map over its length by odometry; 1 if both tell the same."""


def align(odometry: FloatArray, observed: FloatArray, variance: FloatArray) -> Alignment:
    """
    Fit the pose of the odometry frame in the map to all positions, believing every one.

    Parameters
    ----------
    odometry, observed : ndarray, shape (K, 2)
        The same positions in the odometry frame and in the map [m]; K >= 1.
    variance : ndarray, shape (K,)
        Variance of a coordinate of each observed position [m^2], of white noise.

    """
    weight = 1.0 / variance
    p_mean = np.average(odometry, axis=0, weights=weight)
    q_mean = np.average(observed, axis=0, weights=weight)
    p, q = odometry - p_mean, observed - q_mean
    cross = np.sum(weight * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))
    dot = np.sum(weight * np.sum(p * q, axis=1))
    theta = float(np.arctan2(cross, dot))
    spread = float(np.sum(weight * np.sum(p**2, axis=1)))
    shift = q_mean - se2.rotation(theta) @ p_mean
    return Alignment(
        T_map_odom=np.array([shift[0], shift[1], theta]),
        sigma_heading=1.0 / np.sqrt(spread) if spread > 0.0 else np.inf,
        baseline=float(np.hypot(*np.ptp(odometry, axis=0))),
        sigma_position=float(np.sqrt(1.0 / np.mean(weight))),
        scale=float(np.hypot(cross, dot)) / spread if spread > 0.0 else 0.0)


class Turn(NamedTuple):
    """What observed nodes tell of the pose of a graph in the map."""

    T_map_graph: FloatArray | None
    """Shape (3,) [m, m, rad]; None while the angle is not known well enough."""
    sigma: float
    """Standard deviation of the angle at the node, odometry's drift included [rad]."""
    node: int = -1
    """Hidden node at which the angle is known best; -1 while it is known nowhere."""


def find_turn(
    poses: FloatArray, observed: ObservedNodes, policy: AlignmentPolicy,
    noise: OdometryNoise | None = None, correlation: Lifetime | None = None,
) -> Turn:
    """
    Find the rigid motion that takes a graph into the map.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Of the hidden nodes, in a frame of the graph's own.
    observed : ObservedNodes
        Observed nodes on these hidden nodes, in any order; K >= 1.
    policy : AlignmentPolicy
    noise : OdometryNoise, optional
        Of the odometry that led from node to node.
    correlation : Lifetime, optional
        Of the errors of the positions; None for white noise.

    """
    sigma = np.full(len(observed), np.inf)
    full = observed.kind == ObservedKind.GLOBAL_POSE
    sigma[full] = np.sqrt(np.linalg.inv(observed.information[full])[:, 2, 2])
    best = int(np.argmin(sigma))
    if sigma[best] <= ALIGNING_SIGMA:
        predicted = se2.compose(poses[observed.node[best]], observed.offset[best])
        return Turn(se2.compose(observed.mean[best], se2.inverse(predicted)),
                    float(sigma[best]), int(observed.node[best]))
    noise = OdometryNoise() if noise is None else noise
    positions = positions_along(poses, observed, noise, correlation)
    return _from_positions(positions, policy, noise)


def judge_again(
    solved: FloatArray, odometry: FloatArray, observed: ObservedNodes, policy: AlignmentPolicy,
    noise: OdometryNoise | None = None, *, correlation: Lifetime | None = None,
    sigma: float = 0.0,
) -> Turn | None:
    """
    Tell whether the angle in use is wrong, now that there are more positions.

    It is if a new one, found as by `find_turn` from the positions alone, differs from the turn
    that the solved graph gives to odometry at that node.

    Parameters
    ----------
    solved : ndarray, shape (N, 3)
        Hidden nodes in the map, as they are in use.
    odometry : ndarray, shape (N, 3)
        The same by raw odometry, in its own frame.
    observed : ObservedNodes
        All that have come so far, on these nodes; K >= 1.
    policy, noise, correlation
        As in `find_turn`.
    sigma : float
        Standard deviation that the angle in use is believed to have [rad].

    Returns
    -------
    Turn or None
        The motion from the odometry frame into the map, with which to start anew; None if
        nothing speaks against the angle in use.

    """
    noise = OdometryNoise() if noise is None else noise
    positions = positions_along(odometry, observed, noise, correlation)
    turn = _from_positions(positions, policy, noise)
    if turn.T_map_graph is None:
        return None
    in_use = solved[turn.node, 2] - odometry[turn.node, 2]
    difference = abs(float(se2.wrap(turn.T_map_graph[2] - in_use)))
    limit = max(LEAST_CORRECTION, DISAGREEMENT * float(np.hypot(turn.sigma, sigma)))
    return turn if difference > limit else None


def certain(found: Consensus, policy: AlignmentPolicy) -> bool:
    """Tell whether the angle is known well enough to turn the graph."""
    sigmas = policy.baseline_in_sigmas
    if found.count < 3:
        # a third position might have told that one of the two is wrong
        tolerance = 2.0 * float(np.hypot(found.sigma_heading, SCALE_OF_TWO))
        if found.share < 1.0 or abs(found.scale - 1.0) > tolerance:
            return False
        sigmas *= 2.0
    # where the lengths differ much, one of the two does not follow the robot (spinning wheels, a
    # frozen receiver), and the angle between them means nothing
    return (found.sigma_heading <= policy.sigma_heading
            and found.baseline >= policy.minimum_baseline
            and found.baseline >= sigmas * found.sigma_position
            and 1.0 / LARGEST_SCALE <= found.scale <= LARGEST_SCALE
            and found.share >= LEAST_SHARE - 1e-9)


def _from_positions(
    positions: Positions, policy: AlignmentPolicy, noise: OdometryNoise,
) -> Turn:
    """Find the motion that most stretches of the drive agree on."""
    if positions.baseline < policy.minimum_baseline:
        return Turn(None, np.inf)
    sigma, sparse = np.inf, True
    for shortening in SHORTENINGS:
        least = LEAST_OF_SHORTENED if shortening > 1.0 else min(3, len(positions.node))
        stretches = _stretches(positions, shortening)
        found = [consensus(stretch, noise) if len(stretch.node) >= least else None
                 for stretch in stretches]
        sparse = sparse and all(len(stretch.node) < least for stretch in stretches)
        if shortening == 1.0 and _left_handed(stretches, found, noise):
            return Turn(None, np.inf)
        sigma = min([sigma, *(item.sigma_heading for item in found if item is not None)])
        best = _elected(stretches, found, policy, noise, least)
        if best is not None:
            return Turn(best.T_map_odom, best.sigma_heading, best.node)
    if sparse:
        # a few positions on a long drive, too few on each stretch of it
        stretches = [positions.thinned()]
        found = [consensus(stretches[0], noise)]
        best = _elected(stretches, found, policy, noise, 3)
        if best is not None:
            return Turn(best.T_map_odom, best.sigma_heading, best.node)
    return Turn(None, sigma)


def _stretches(positions: Positions, shortening: float) -> list[Positions]:
    """Cut the drive where odometry has drifted by so much; return some stretches, newest first."""
    # where odometry is believed to be perfect, the length of the path decides
    to_come = positions.walk[-1] - positions.walk + 1e-9 * (positions.path[-1] - positions.path)
    n = shortening * np.ceil(to_come[0] / STRETCH**2)
    if n == 0.0:
        return [positions.thinned()]
    number = np.minimum(np.floor(to_come * (n / to_come[0])), n - 1.0)
    used = np.unique(number)
    # the newest, the oldest, and some between
    used = used[np.unique(np.linspace(0, len(used) - 1, MOST_STRETCHES).round().astype(np.int64))]
    return [positions.rows(number == k).thinned() for k in used]


def _left_handed(
    stretches: list[Positions], found: list[Consensus | None], noise: OdometryNoise,
) -> bool:
    """Tell whether most stretches are mirrored; parts that are straight would not show it."""
    left = [mirrored(stretch, item, noise)
            for stretch, item in zip(stretches, found, strict=True) if item is not None]
    return any(left) and sum(left) >= LEAST_SHARE * len(left)


def _elected(
    stretches: list[Positions], found: list[Consensus | None], policy: AlignmentPolicy,
    noise: OdometryNoise, least: int,
) -> Consensus | None:
    """Return one of the most certain that most others agree with but for odometry's drift."""
    candidates, voters = [], 0
    for stretch, item in zip(stretches, found, strict=True):
        if (item is not None and certain(item, policy)
                and not mirrored(stretch, item, noise)):
            candidates.append(item)
            voters += 1
        else:
            # who had come far and still cannot tell speaks against the others
            sigma = float(np.sqrt(np.median(stretch.variance)))
            far = max(policy.minimum_baseline, policy.baseline_in_sigmas * sigma)
            voters += len(stretch.node) >= least and (
                stretch.path[-1] - stretch.path[0] >= far if least == LEAST_OF_SHORTENED
                else stretch.baseline >= 2.0 * far)
    if len(candidates) == 0:
        return None
    theta, variance, walk = np.array([
        (item.T_map_odom[2], item.sigma_heading**2, item.walk) for item in candidates]).T
    allowed = variance[:, None] + variance + np.abs(walk[:, None] - walk)
    agree = np.abs(se2.wrap(theta[:, None] - theta)) <= np.maximum(
        DISAGREEMENT * np.sqrt(allowed), LEAST_CORRECTION)
    # through those between them too, where odometry drifts more than it is believed to
    reached = np.linalg.matrix_power(agree.astype(np.int64), len(theta)) > 0
    elected = np.sum(reached, axis=1) >= LEAST_SHARE * voters - 1e-9
    if not np.any(elected):
        return None
    # a receiver becomes better, not worse: the newest, unless it is much less certain
    good = elected & (variance <= MUCH**2 * np.min(variance[elected]))
    return candidates[int(np.argmax(good))]


class Guess(NamedTuple):
    """Where the robot is while the angle is not known."""

    shift: FloatArray
    """Of the graph into the map, shape (3,); the heading's is 0."""
    covariance: FloatArray
    """Of the robot's pose, shape (3, 3)."""


def guess(poses: FloatArray, newest: FloatArray, observed: ObservedNodes) -> Guess:
    """
    Say where the robot is while the angle is not known, and how little that is.

    The graph is shifted onto the most certain position. With d the distance from there and an
    angle that is uniform on the circle, the mean square error of each coordinate is d^2, that of
    the heading pi^2 / 3.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Of the hidden nodes, in a frame of the graph's own.
    newest : ndarray, shape (3,)
        Of the robot, in the same frame.
    observed : ObservedNodes
        Observed nodes on these hidden nodes; K >= 1.

    """
    certainty = np.trace(observed.information[:, :2, :2], axis1=1, axis2=2)
    best = int(np.argmax(certainty))
    first = observed.rows(slice(best, best + 1))
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(first.mean[0, 2])
    shift = -(turn @ observed_errors(poses, first)[0])
    shift[2] = 0.0
    where = se2.compose(poses[first.node], first.offset)[0]
    variance = float(np.sum((newest[:2] - where[:2])**2) + 2.0 / certainty[best])
    return Guess(shift, np.diag((variance, variance, UNKNOWN_HEADING_VARIANCE)))
