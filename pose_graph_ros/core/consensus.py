# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The motion that most of the positions of a stretch of the drive agree on, and its sigma.

Points of the plane are complex numbers. Positions p_k in the odometry frame (where the antenna
was) and q_k in the map are related by q = z p + s. With both centred on their weighted means the
least squares of sum w_k |q_k - z p_k - s|^2 is z = sum w conj(p) q / sum w |p|^2. Its angle is
that of the rigid motion (the planar case of Horn 1987 and Umeyama 1991); its length is the scale,
1 but for wheels that are larger than believed or slip.

Wrong positions are kept out by consensus: pairs of positions make hypotheses, a truncated
quadratic of the residuals chooses among them, the closed form on the inliers refines the best.
Nothing is drawn at random, and positions are sorted first, so their order changes nothing.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import se2
from pose_graph_ros.core.constraints import ObservedKind, ObservedNodes
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.sources import OdometryNoise

BoolArray = npt.NDArray[np.bool_]
ComplexArray = npt.NDArray[np.complex128]

# At most the rest of the positions may be wrong.
LEAST_SHARE = 0.6
# Residuals beyond this are no noise: 0.25 % of a Gaussian in the plane [sigma^2].
TRUNCATION = 12.0
# Variances that senders claim may be too small, by as much as there are positions to tell, and by
# this at the most; the sigma then grows with the residuals.
LARGEST_INFLATION = 100.0
# But more outliers are likelier than that: the price of an inflation, for each position.
PRICE = 4.0
# No pair makes a hypothesis whose lengths differ by more than this factor.
LARGEST_SCALE = 2.0
# Bound the work: a fit takes so many positions at so many places along the path ...
PLACES, PER_PLACE = 25, 4
# ... and refines the best of the hypotheses that pairs of so many of them make.
ANCHORS, REFINED, ITERATIONS = 20, 6, 10
# Below this an angle is none.
LEAST_SCALE = 1e-6
# Keeps what has no weight or no baseline from a division by zero.
TINY = 1e-300


@dataclass(frozen=True, slots=True)
class Positions:
    """K positions in the order of the drive."""

    odometry: ComplexArray
    """In the odometry frame [m]."""
    observed: ComplexArray
    """In the map [m]."""
    root: FloatArray
    """Cholesky factors of the covariances in the map, shape (K, 2, 2) [m]."""
    direction: ComplexArray
    """Of the robot in the odometry frame, length 1."""
    node: IntArray
    """Hidden node that each belongs to."""
    path: FloatArray
    """Length of the path so far [m]."""
    walk: FloatArray
    """Variance of the heading that odometry has gathered so far [rad^2]."""
    stamp: FloatArray
    """[s]."""
    correlation_time: FloatArray
    """Of the error of the observed position [s]; 0 for white noise."""

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
        """Keep a few at each place: a robot that stands must not outvote its own drive."""
        along = self.path - self.path[0]
        place = np.floor(along * (PLACES / max(float(along[-1]), 1e-9)))
        _, start, size = np.unique(place, return_index=True, return_counts=True)
        n, rank = np.repeat(size, size), np.arange(len(place)) - np.repeat(start, size)
        return self.rows((n <= PER_PLACE)
                         | (rank * PER_PLACE // n != (rank - 1) * PER_PLACE // n))


class Lifetime(NamedTuple):
    """How long the errors of K positions live: they decay as exp(-t / time)."""

    stamps: FloatArray
    """Of the positions, shape (K,) [s]; only differences count."""
    time: float | FloatArray
    """
    Shape () or (K,) [s]; 0 for white noise. Positions of different times are taken for those of
    different receivers.
    """


def positions_along(
    poses: FloatArray, observed: ObservedNodes, noise: OdometryNoise,
    correlation: Lifetime | None,
) -> Positions:
    """
    Sort the observed nodes along the drive, and say how far odometry had come.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Of the hidden nodes, by odometry.
    observed : ObservedNodes
        K >= 1; of a global pose the position counts.
    noise : OdometryNoise
    correlation : Lifetime, optional
        Of their errors; None for white noise.

    """
    none = np.zeros(len(observed))
    stamp, time = (none, none) if correlation is None else correlation
    tau = np.broadcast_to(np.asarray(time, dtype=np.float64), (len(observed),))
    # by all that is told of a row: rows that are equal in all of it may change places
    order = np.lexsort((tau, *observed.information.reshape(-1, 9).T, *observed.mean.T,
                        *observed.offset.T, stamp, observed.node))
    table = observed.rows(order)
    predicted = se2.compose(poses[table.node], table.offset)
    first = int(table.node[0])
    steps = np.diff(poses[first:table.node[-1] + 1], axis=0)
    length, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(se2.wrap(steps[:, 2]))
    walk = noise.sigma_heading_distance**2 * length + noise.sigma_heading_turn**2 * turn
    # a position tells nothing of the heading, in a global pose it is marginalised
    information = table.information.copy()
    information[:, 2, 2] += table.kind == ObservedKind.POSITION
    axes = se2.rotation(table.mean[:, 2])
    covariance = axes @ np.linalg.inv(information)[:, :2, :2] @ np.swapaxes(axes, 1, 2)
    rows = table.node - first
    return Positions(
        odometry=_points(predicted), observed=_points(table.mean),
        root=np.asarray(np.linalg.cholesky(covariance), dtype=np.float64),
        direction=np.exp(1j * predicted[:, 2]), node=table.node,
        path=np.append(0.0, np.cumsum(length))[rows], walk=np.append(0.0, np.cumsum(walk))[rows],
        stamp=stamp[order], correlation_time=tau[order])


def _points(poses: FloatArray) -> ComplexArray:
    return np.asarray(poses[:, 0] + 1j * poses[:, 1])


@dataclass(frozen=True, slots=True)
class Consensus:
    """The motion that most positions agree on."""

    T_map_odom: FloatArray
    """Shape (3,) [m, m, rad]."""
    sigma_heading: float
    """Standard deviation of the angle at the node, odometry's drift included [rad]."""
    node: int
    """Hidden node at which the angle is known best; elsewhere odometry has drifted."""
    walk: float
    """Variance of the heading that odometry had gathered at the node [rad^2]."""
    baseline: float
    """Diagonal of the box around the inliers in the odometry frame [m]."""
    sigma_position: float
    """Of a position, by the mean of their weights, grown with the residuals [m]."""
    scale: float
    """Length of a motion in the map over its length by odometry."""
    count: int
    """Number of inliers."""
    share: float
    """Of the inliers in the positions."""
    cost: float
    """Minus twice the log likelihood of all positions, outliers truncated."""


def consensus(positions: Positions, noise: OdometryNoise) -> Consensus | None:
    """Return what most of the positions agree on; None if no two of them do."""
    variance = positions.variance + _drift(positions, noise)
    inlier, cost = _inliers(positions.odometry, positions.observed, variance)
    n = int(np.count_nonzero(inlier))
    if n < 2:
        return None
    chosen, weight = positions.rows(inlier), 1.0 / variance[inlier]
    p_mean = np.average(chosen.odometry, weights=weight)
    q_mean = np.average(chosen.observed, weights=weight)
    p, q = chosen.odometry - p_mean, chosen.observed - q_mean
    spread = float(np.sum(weight * np.abs(p)**2))
    z = complex(np.sum(weight * p.conj() * q)) / spread if spread > 0.0 else 0j
    if abs(z) < LEAST_SCALE:
        return None
    chi2 = float(np.sum(weight * np.abs(q - z * p)**2))
    inflation = max(1.0, chi2 / (2.0 * n - 4.0)) if n > 2 else 1.0
    variance_heading, best = _heading_variance(chosen, weight * p / spread, z, noise)
    shift = q_mean - z / abs(z) * p_mean
    return Consensus(
        T_map_odom=np.array([shift.real, shift.imag, np.angle(z)]),
        sigma_heading=float(np.sqrt(inflation * variance_heading)),
        node=int(chosen.node[best]), walk=float(chosen.walk[best]), baseline=chosen.baseline,
        sigma_position=float(np.sqrt(inflation / np.mean(1.0 / chosen.variance))),
        scale=abs(z), count=n, share=n / len(inlier), cost=cost)


def _drift(positions: Positions, noise: OdometryNoise) -> FloatArray:
    """Return the mean variance of the coordinates by odometry from the middle, (K,) [m^2]."""
    middle = int(np.argmin(np.abs(positions.path - np.mean(positions.path))))
    far, along, walk = (np.abs(column - column[middle]) for column in (
        positions.odometry, positions.path, positions.walk))
    slip = noise.sigma_distance**2 + noise.sigma_lateral**2
    return np.asarray(walk * far**2 / 6.0 + 0.5 * slip * along)


def mirrored(positions: Positions, found: Consensus, noise: OdometryNoise) -> bool:
    """Tell whether the mirror image of odometry fits better: something there is left-handed."""
    variance = positions.variance + _drift(positions, noise)
    inlier, cost = _inliers(positions.odometry.conj(), positions.observed, variance)
    return cost < found.cost - TRUNCATION and bool(np.mean(inlier) >= LEAST_SHARE)


def _inliers(
    p: ComplexArray, q: ComplexArray, variance: FloatArray,
) -> tuple[BoolArray, float]:
    """Return which positions agree best on one motion, shape (K,), and what that costs."""
    # far from the origin, products of coordinates would cancel
    p, q = p - np.median(p.real) - 1j * np.median(p.imag), q - q[0]
    anchors = np.unique(np.linspace(0, len(p) - 1, ANCHORS).round().astype(np.int64))
    i, j = (anchors[index] for index in np.triu_indices(len(anchors), 1))
    length = np.abs(p[j] - p[i])
    # short ones tell little; but the good ones may all be on three fifths of the way
    far = length >= max(0.25 * np.max(length, initial=0.0), 1e-9)
    i, j = i[far], j[far]
    z = (q[j] - q[i]) / (p[j] - p[i])
    likely = (np.abs(z) <= LARGEST_SCALE) & (np.abs(z) >= 1.0 / LARGEST_SCALE)
    i, j, z = i[likely], j[likely], z[likely]
    # where nothing is wrong, none is better than the fit to all
    all_z, all_shift = _fitted(1.0 / variance[None], p, q)
    z = np.append(all_z, z)
    shift = np.append(all_shift, 0.5 * (q[i] + q[j] - z[1:] * (p[i] + p[j])))
    found = _judged(z, shift, p, q, variance)
    best = np.argsort(found.cost, kind='stable')[:REFINED]
    found = _Judged(found.inlier[best], found.cost[best])
    for _ in range(ITERATIONS):
        before = found.inlier
        found = _judged(*_fitted(before / variance, p, q), p, q, variance)
        if np.array_equal(before, found.inlier):
            break
    chosen = int(np.argmin(found.cost))
    return found.inlier[chosen], float(found.cost[chosen])


def _fitted(
    weight: FloatArray, p: ComplexArray, q: ComplexArray,
) -> tuple[ComplexArray, ComplexArray]:
    """Return the least-squares z and s for each row of weights, shape (H, K)."""
    total = np.maximum(np.sum(weight, axis=1), TINY)
    p_mean, q_mean = weight @ p / total, weight @ q / total
    p_off, q_off = p - p_mean[:, None], q - q_mean[:, None]
    spread = np.sum(weight * np.abs(p_off)**2, axis=1)
    z = np.sum(weight * p_off.conj() * q_off, axis=1) / np.maximum(spread, TINY)
    return z, q_mean - z * p_mean


class _Judged(NamedTuple):
    """What H motions are worth."""

    inlier: BoolArray
    """Whose residual is noise, shape (H, K)."""
    cost: FloatArray
    """Minus twice the log likelihood, but for outliers no more than the truncation, (H,)."""


def _judged(
    z: ComplexArray, shift: ComplexArray, p: ComplexArray, q: ComplexArray, variance: FloatArray,
) -> _Judged:
    """Judge each motion with the variances as much larger as makes most residuals noise."""
    n = len(p)
    energy = np.abs(q - z[:, None] * p - shift[:, None])**2 / variance
    rank = int(np.ceil(LEAST_SHARE * n - 1e-9))
    # what is expected at this rank of n draws of a chi2 with 2 degrees of freedom
    expected = -2.0 * np.log1p(-rank / (n + 1.0))
    inflation = np.partition(energy, rank - 1, axis=1)[:, rank - 1] / expected
    inflation = np.clip(inflation, 1.0, min(LARGEST_INFLATION, n))
    energy /= inflation[:, None]
    cost = np.sum(np.minimum(energy, TRUNCATION), axis=1) + PRICE * n * np.log(inflation)
    return _Judged(energy <= TRUNCATION, np.asarray(cost))


def _heading_variance(
    positions: Positions, lever: ComplexArray, z: complex, noise: OdometryNoise,
) -> tuple[float, int]:
    """
    Return the variance of the fitted angle, and at which position it is that small.

    An error e_k of position k, seen in the odometry frame, changes the angle by
    Im(sum conj(lever_k) e_k). Errors of the fixes are white or decay with their correlation
    time, whichever is worse. Odometry's are steps between the positions, each of which moves all
    that follow: a turn about the middle of the step, and a shift.

    Parameters
    ----------
    positions : Positions
        The inliers.
    lever : ndarray, shape (K,)
        w p / sum w |p|^2 with p centred, complex [1/m].
    z : complex
        The fitted motion.
    noise : OdometryNoise

    """
    c = lever.conj() / z
    errors = np.einsum('kij,ki->kj', positions.root, np.column_stack((c.imag, c.real)))
    white = float(np.sum(errors**2))
    tau = positions.correlation_time
    # of different times are those of different receivers
    alike = (tau[:, None] == tau) & (tau > 0.0) | np.eye(len(tau), dtype=np.bool_)
    apart = np.abs(positions.stamp[:, None] - positions.stamp) / np.maximum(tau, 1e-9)
    correlated = float(np.sum(errors @ errors.T * np.where(alike, np.exp(-apart), 0.0)))
    p = positions.odometry - positions.odometry[0]
    # of each step: what all that follows makes of a shift, and of a turn
    shifted = np.cumsum(lever.conj()[::-1])[::-1][1:]
    turned = np.cumsum((lever.conj() * p).real[::-1])[::-1][1:]
    turned = turned - (shifted * 0.5 * (p[1:] + p[:-1])).real
    length, walk, step = np.diff(positions.path), np.diff(positions.walk), np.diff(p)
    along = shifted * positions.direction[1:]
    slip = float(np.sum(
        length * (noise.sigma_distance**2 * along.imag**2 + noise.sigma_lateral**2 * along.real**2)
        + walk / 12.0 * (shifted * step).real**2))
    # the angle at position r differs from the fitted one by the turns that the fit does not share
    before = np.append(0.0, np.cumsum(walk * (1.0 - turned)**2))
    after = np.append(np.cumsum((walk * turned**2)[::-1])[::-1], 0.0)
    best = int(np.argmin(before + after))
    return max(white, correlated) + slip + float(before[best] + after[best]), best
