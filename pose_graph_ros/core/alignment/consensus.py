# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A motion from the odometry frame into the map that most positions agree on, and its sigma.

Points of the plane are complex numbers. Positions p_k in the odometry frame (where the antenna
was) and q_k in the map are related by q = z p + s. With both centred on their weighted means the
least squares of sum w_k |q_k - z p_k - s|^2 is z = sum w conj(p) q / sum w |p|^2. Its angle is
that of the rigid motion (the planar case of Horn 1987 and Umeyama 1991); its length is the scale,
which differs from 1 if wheels slip or their radius is wrong.

Wrong positions are excluded by consensus: pairs of positions make hypotheses, which are scored by
a truncated quadratic of the residuals, and the best are refined by the closed form on their
inliers. Nothing is drawn at random and positions are sorted first, so the result does not depend
on their order.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np

from pose_graph_ros.core.config import AlignmentPolicy, OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, ComplexArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind, Factors


@dataclass(frozen=True, slots=True)
class Tuning:
    """When a motion of odometry into the map counts as known."""

    # fraction of positions that must agree on a motion, or of parts of a drive on an angle
    least_agreement: float = 0.6
    # squared residual of an outlier; 0.25 % of a Gaussian in the plane are beyond [sigma^2]
    truncation: float = 12.0
    # factor by which stated variances may be too small at most; with K positions it is at most K
    largest_inflation: float = 100.0
    # cost of inflated variances for each position, as a factor on the logarithm of the inflation;
    # the likelihood has 2, this is larger as outliers are likelier than understated variances
    price: float = 4.0
    largest_scale: float = 2.0  # of a motion, or of its inverse
    places: int = 25  # sections of the path
    per_place: int = 4  # positions that a fit uses of each
    anchors: int = 20  # positions whose pairs make hypotheses
    refined: int = 6  # best hypotheses that are refined
    iterations: int = 10  # of that

    # sigma of the heading of a global pose that aligns the graph alone [rad]
    aligning_sigma: float = 0.5
    # sigma of the scale between two positions without noise; two alone are only used if the scale
    # is within 2 sigma of 1, as no third one could show an error
    scale_of_two: float = 0.05
    stretch: float = 0.3  # drift of the heading by odometry within a stretch of the drive [rad]
    # factors by which stretches are shortened, one after the other, until their fits agree
    shortenings: tuple[float, ...] = (1.0, 3.0, 9.0, 27.0)
    stretches: int = 8  # that are used at most
    # positions of a shortened stretch, as three may fit a wrong motion by chance
    least_of_shortened: int = 5
    # the newest angle is preferred unless its sigma is greater than the least by this factor
    comparable_sigma: float = 2.0
    # two angles disagree if they differ by more than both of these [sigma, rad]; the solver
    # corrects smaller differences
    disagreement: float = 4.0
    least_correction: float = 0.3
    # numbers of measurements at which the angle is checked first, and beyond which not any more
    first_recheck: int = 8
    last_recheck: int = 4096


TUNED = Tuning()


@dataclass(frozen=True, slots=True)
class Positions:
    """K observed positions in the order of the drive, one row of each array per position."""

    odometry: ComplexArray  # position of the antenna in the odometry frame [m]
    observed: ComplexArray  # observed position in the map [m]
    # Cholesky factor of the covariance of `observed` in map axes, shape (K, 2, 2) [m]
    root: FloatArray
    # heading of the robot in the odometry frame, a complex number of length 1
    direction: ComplexArray
    node: IntArray  # row of the hidden node in the table of poses
    path: FloatArray  # path length so far [m]
    walk: FloatArray  # variance of the heading by odometry so far [rad^2]
    stamp: FloatArray  # [s]
    # correlation time of the error of `observed` [s]; 0 for white noise
    correlation_time: FloatArray

    def rows(self, index: IntArray | BoolArray) -> Self:
        """Return the chosen positions, in order."""
        return type(self)(*(getattr(self, item.name)[index] for item in fields(self)))

    @property
    def baseline(self) -> float:
        """Diagonal of the box around the positions in the odometry frame [m]."""
        return float(np.hypot(np.ptp(self.odometry.real), np.ptp(self.odometry.imag)))

    @property
    def variance(self) -> FloatArray:
        """Mean variance of the two coordinates of the observed positions, shape (K,) [m^2]."""
        return np.asarray(0.5 * np.sum(self.root**2, axis=(1, 2)))

    def thinned(self) -> Self:
        """Return some positions of each section of the path, so that no standstill dominates."""
        along = self.path - self.path[0]
        place = np.floor(along * (TUNED.places / max(float(along[-1]), 1e-9)))
        _, start, size = np.unique(place, return_index=True, return_counts=True)
        n, rank = np.repeat(size, size), np.arange(len(place)) - np.repeat(start, size)
        return self.rows((n <= TUNED.per_place)
                         | (rank * TUNED.per_place // n != (rank - 1) * TUNED.per_place // n))


class Given(NamedTuple):
    """What the angle is found from: M observed nodes, and what is assumed of all."""

    observed: Factors   # by the rows of their hidden nodes
    stamps: FloatArray  # [s]; only differences matter
    # the correlation of their errors is exp(-t / time) after t [s]; 0 for white noise. Errors with
    # different times are taken to be independent, as those of different receivers.
    times: FloatArray
    policy: AlignmentPolicy
    noise: OdometryNoise


def positions_along(poses: Poses, given: Given) -> Positions:
    """Return the positions of observed nodes in the order of the drive."""
    placed = given.observed.kind != FactorKind.HEADING
    observed, stamp, tau = (given.observed.rows(placed), given.stamps[placed], given.times[placed])
    noise = given.noise
    # by all columns, so that the order of the result does not depend on that of the input
    order = np.lexsort((tau, *observed.information.reshape(-1, 9).T, *observed.mean.T,
                        *observed.offset.T, stamp, observed.i))
    table = observed.rows(order)
    predicted = se2.compose(poses[table.i], table.offset)
    first = int(table.i[0])
    steps = np.diff(poses[first:table.i[-1] + 1], axis=0)
    length, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(se2.wrap(steps[:, 2]))
    walk = noise.sigma_heading_distance**2 * length + noise.sigma_heading_turn**2 * turn
    # the heading of a global pose is marginalised; that of a position has no information
    information = table.information.copy()
    information[:, 2, 2] += table.kind == FactorKind.POSITION
    axes = se2.rotation(table.mean[:, 2])
    covariance = axes @ np.linalg.inv(information)[:, :2, :2] @ np.swapaxes(axes, 1, 2)
    rows = table.i - first
    return Positions(
        odometry=predicted[:, 0] + 1j * predicted[:, 1],
        observed=table.mean[:, 0] + 1j * table.mean[:, 1],
        root=np.asarray(np.linalg.cholesky(covariance), dtype=np.float64),
        direction=np.exp(1j * predicted[:, 2]), node=table.i,
        path=np.append(0.0, np.cumsum(length))[rows], walk=np.append(0.0, np.cumsum(walk))[rows],
        stamp=stamp[order], correlation_time=tau[order])


@dataclass(frozen=True, slots=True)
class Consensus:
    """The motion that most positions agree on."""

    T_map_odom: FloatArray  # shape (3,) [m, m, rad]
    # standard deviation of the angle at the node, with the drift of odometry [rad]
    sigma_heading: float
    node: int  # hidden node at which the angle has the least variance
    walk: float  # variance of the heading by odometry up to the node [rad^2]
    # whether the mirror image of odometry fits better, as with a left-handed frame
    is_mirrored: bool
    is_certain: bool  # whether the angle is known well enough to align the graph


def consensus(positions: Positions, given: Given) -> Consensus | None:
    """Return the motion that most positions agree on; None if no two agree on an angle."""
    policy, noise = given.policy, given.noise
    # with that by odometry from the middle of the path, of a coordinate [m^2]
    middle = int(np.argmin(np.abs(positions.path - np.mean(positions.path))))
    far, along, walk = (np.abs(column - column[middle]) for column in (
        positions.odometry, positions.path, positions.walk))
    slip = noise.sigma_distance**2 + noise.sigma_lateral**2
    variance = positions.variance + (walk * far**2 / 6.0 + 0.5 * slip * along)
    inlier, cost = _inliers(positions.odometry, positions.observed, variance)
    n = int(np.count_nonzero(inlier))
    if n < 2:
        return None
    mirrored, cost_of_mirrored = _inliers(positions.odometry.conj(), positions.observed, variance)
    chosen, weight = positions.rows(inlier), 1.0 / variance[inlier]
    fitted = _fitted(weight[None], chosen.odometry, chosen.observed)
    z, shift, lever = complex(fitted[0][0]), fitted[1][0], fitted[2][0]
    if abs(z) < 1e-6:
        return None  # the rotation is undefined
    chi2 = float(np.sum(weight * np.abs(chosen.observed - z * chosen.odometry - shift)**2))
    inflation = max(1.0, chi2 / (2.0 * n - 4.0)) if n > 2 else 1.0
    variance_heading, best = _heading_variance(chosen, lever, z, noise)
    # of the rigid motion
    shift += (z - z / abs(z)) * np.average(chosen.odometry, weights=weight)
    sigma = float(np.sqrt(inflation * variance_heading))
    is_mirrored = bool(cost_of_mirrored < cost - TUNED.truncation
                       and np.mean(mirrored) >= TUNED.least_agreement)
    # only a third position could show that one of two is wrong
    of_two = n > 2 or (n == len(inlier) and abs(abs(z) - 1.0) <= 2.0 * float(
        np.hypot(sigma, TUNED.scale_of_two)))
    sigma_position = float(np.sqrt(inflation / np.mean(1.0 / chosen.variance)))
    sigmas = policy.baseline_in_sigmas * (1.0 if n > 2 else 2.0)
    # with a scale far from 1, odometry or positions do not follow the robot (spinning wheels, a
    # frozen receiver), and the angle is meaningless
    is_certain = (
        of_two and not is_mirrored and sigma <= policy.sigma_heading
        and chosen.baseline >= max(policy.minimum_baseline, sigmas * sigma_position)
        and 1.0 / TUNED.largest_scale <= abs(z) <= TUNED.largest_scale
        and n / len(inlier) >= TUNED.least_agreement - 1e-9)
    return Consensus(
        np.array([shift.real, shift.imag, np.angle(z)]), sigma, int(chosen.node[best]),
        float(chosen.walk[best]), is_mirrored, is_certain)


def _inliers(p: ComplexArray, q: ComplexArray, variance: FloatArray) -> tuple[BoolArray, float]:
    """
    Return which positions are inliers of the best motion, shape (K,), and its cost.

    That is minus twice the log likelihood of all positions, truncated for outliers.
    """
    # near the origin, as products of large coordinates would lose digits
    p, q = p - np.median(p.real) - 1j * np.median(p.imag), q - q[0]
    anchors = np.unique(np.linspace(0, len(p) - 1, TUNED.anchors).round().astype(np.int64))
    i, j = (anchors[index] for index in np.triu_indices(len(anchors), 1))
    length = np.abs(p[j] - p[i])
    # no short pairs; a quarter, as the inliers may all lie on a part of the path
    far = length >= max(0.25 * np.max(length, initial=0.0), 1e-9)
    i, j = i[far], j[far]
    z = (q[j] - q[i]) / (p[j] - p[i])
    likely = (np.abs(z) <= TUNED.largest_scale) & (np.abs(z) >= 1.0 / TUNED.largest_scale)
    i, j, z = i[likely], j[likely], z[likely]
    # without outliers the fit to all positions is the best hypothesis
    all_z, all_shift, _ = _fitted(1.0 / variance[None], p, q)
    z = np.append(all_z, z)
    shift = np.append(all_shift, 0.5 * (q[i] + q[j] - z[1:] * (p[i] + p[j])))
    inlier, cost = _scored(z, shift, p, q, variance)
    inlier = inlier[np.argsort(cost, kind='stable')[:TUNED.refined]]
    for _ in range(TUNED.iterations):
        before = inlier
        z, shift, _ = _fitted(before / variance, p, q)
        inlier, cost = _scored(z, shift, p, q, variance)
        if np.array_equal(before, inlier):
            break
    chosen = int(np.argmin(cost))
    return inlier[chosen], float(cost[chosen])


def _fitted(
    weight: FloatArray, p: ComplexArray, q: ComplexArray,
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """
    Return the least-squares z and s for each row of weights, shape (H, K), and levers.

    The levers, shape (H, K), are `w p / sum w |p|^2` with p centred [1/m].
    """
    total = np.maximum(np.sum(weight, axis=1), 1e-300)
    p_mean, q_mean = weight @ p / total, weight @ q / total
    p_off, q_off = p - p_mean[:, None], q - q_mean[:, None]
    spread = np.sum(weight * np.abs(p_off)**2, axis=1)
    lever = weight * p_off / np.maximum(spread, 1e-300)[:, None]
    z = np.sum(lever.conj() * q_off, axis=1)
    return z, q_mean - z * p_mean, lever


def _scored(
    z: ComplexArray, shift: ComplexArray, p: ComplexArray, q: ComplexArray, variance: FloatArray,
) -> tuple[BoolArray, FloatArray]:
    """
    Return the inliers of each of H motions, shape (H, K), and its cost, shape (H,).

    The cost is minus twice the log likelihood, truncated for outliers, with variances inflated to
    fit the residuals of the likely inliers.
    """
    n = len(p)
    energy = np.abs(q - z[:, None] * p - shift[:, None])**2 / variance
    rank = int(np.ceil(TUNED.least_agreement * n - 1e-9))
    # expected value at this rank of n draws of a chi2 with 2 degrees of freedom
    expected = -2.0 * np.log1p(-rank / (n + 1.0))
    inflation = np.partition(energy, rank - 1, axis=1)[:, rank - 1] / expected
    inflation = np.clip(inflation, 1.0, min(TUNED.largest_inflation, n))
    energy /= inflation[:, None]
    cost = np.sum(np.minimum(energy, TUNED.truncation), axis=1)
    cost += TUNED.price * n * np.log(inflation)
    return energy <= TUNED.truncation, np.asarray(cost)


def _heading_variance(
    positions: Positions, lever: ComplexArray, z: complex, noise: OdometryNoise,
) -> tuple[float, int]:
    """
    Return the least variance of the fitted angle along the drive, and the position where it is.

    An error e_k of position k, seen in the odometry frame, changes the angle by
    Im(sum conj(lever_k) e_k). The errors of the observed positions are white or correlated in
    time, whichever gives the larger variance. An error of odometry between two positions moves all
    positions after it, by a turn about the middle of the step and a shift. `lever` is
    w p / sum w |p|^2 with p centred [1/m]; z is rotation and scale of the fitted motion.
    """
    c = lever.conj() / z
    errors = np.einsum('kij,ki->kj', positions.root, np.column_stack((c.imag, c.real)))
    white = float(np.sum(errors**2))
    tau = positions.correlation_time
    # positions with different correlation times are those of different receivers
    alike = (tau[:, None] == tau) & (tau > 0.0) | np.eye(len(tau), dtype=np.bool_)
    apart = np.abs(positions.stamp[:, None] - positions.stamp) / np.maximum(tau, 1e-9)
    correlated = float(np.sum(errors @ errors.T * np.where(alike, np.exp(-apart), 0.0)))
    p = positions.odometry - positions.odometry[0]
    # derivative of the angle by a shift, and by a turn, of all positions after each step
    shifted = np.cumsum(lever.conj()[::-1])[::-1][1:]
    turned = np.cumsum((lever.conj() * p).real[::-1])[::-1][1:]
    turned = turned - (shifted * 0.5 * (p[1:] + p[:-1])).real
    length, walk, step = np.diff(positions.path), np.diff(positions.walk), np.diff(p)
    along = shifted * positions.direction[1:]
    slip = float(np.sum(
        length * (noise.sigma_distance**2 * along.imag**2 + noise.sigma_lateral**2 * along.real**2)
        + walk / 12.0 * (shifted * step).real**2))
    # the turns of odometry between position r and the others act on the angle at r and on the fit
    before = np.append(0.0, np.cumsum(walk * (1.0 - turned)**2))
    after = np.append(np.cumsum((walk * turned**2)[::-1])[::-1], 0.0)
    best = int(np.argmin(before + after))
    return max(white, correlated) + slip + float(before[best] + after[best]), best
