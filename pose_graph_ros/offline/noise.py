# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How noisy odometry and the sources of positions are, by all that a drive shows of both.

The factors are those with the largest likelihood that the engine finds as well. A factor of 1 that
is as likely, by a likelihood ratio, is kept, and all others are found again. The interval of a
factor is where the likelihood, with all others at their best, falls by `RISE`.

The likelihood knows what changes between measurements. It is blind to errors of a source that
last longer than the drive, and takes slower ones than it models for motion. So a source claims
less than before only as far as odometry, laid over its positions without any model of noise,
shows: there its errors are all that is left, slow ones too, and only as many pieces of the drive
as these can change in are independent. Less noise of odometry is proven with the upper end of
its interval. The path depends on ratios of noise: where a source keeps more than was found,
odometry keeps as much more.

How far what was held out is from a path shows in metres and in sigmas how good that is. Held out
are whole stretches of a drive (`stretch_length`): single measurements share their slow errors
with their neighbours, so that a path which follows these errors would look good.
"""

from collections.abc import Collection, Sequence
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.belief import learning
from pose_graph_ros.core.belief.learning import Minimum, Posterior, TURN, WAY
from pose_graph_ros.core.belief.rows import Records
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import GlobalPose, Position
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.quantities import Metres, StampNs
from pose_graph_ros.core.sources.source_report import estimate

# Rise of the negative logarithm of the likelihood at the ends of an interval of 95 %, and that
# which makes a factor of 1 unlikely enough to be changed (99 %).
RISE, CHANGE_RISE = 1.92, 3.31
# Sigmas of the logarithm of the variance of a source before it is seen: what claims are is found.
CLAIM_SPREAD = 3.0, 3.0
# Smallest step of an exponent of 2.
FINEST = 1.0 / 16.0
# An interval with a larger ratio of its ends says nothing.
WIDE = 10.0
# Smallest part of a variance that is what a source claims.
SMALLEST = 0.01
# Exponents of 2 of multiples of claimed variances.
MULTIPLES = -12.0, -8.0, -4.0, 0.0, 4.0, 8.0, 12.0
# Largest exponent of 2, from the best one, at which the end of an interval is looked for.
REACH = 6.0
# Steps in which it is looked for.
STEP = 0.25
# Axes of the source in a point.
WHITE, SLOW, TAU = 2, 3, 4
# What nothing is known of but odometry and one source.
ALL_UNKNOWN = learning.Known(learning.claimed(1), odometry=True, sources=(0,))
LEAST_POSITIONS = 20
# Time in which slow errors of a receiver change: satellites, ionosphere, reflections [s].
CHANGE = 300.0
# Probability that a variance is larger than the end of its interval.
TAIL = 0.025
# Time constants in a drive from which on these and their variance are known to a factor of `WIDE`.
KNOWN_FROM = 7.0


class Found(NamedTuple):
    """A variance in units of the claimed one, or a time constant [s]."""

    value: float
    # ends of the interval of 95 %; 0 or infinite where the data give no bound
    low: float
    high: float
    kept: bool  # whether the setting is as likely, and so stays

    @property
    def is_wide(self) -> bool:
        """Whether the data hardly tell."""
        return not self.high < WIDE * self.low

    def written(self, value: float) -> 'Found':
        """Return it with the value that is proven."""
        return self._replace(value=value, high=max(self.high, value), kept=value == 1.0)

    def proven(self, high: float) -> 'Found':
        """Return what is proven: more by the lower end, less by an upper one."""
        return self.written(max(self.low, 1.0) if self.value > 1.0
                            else max(self.value, min(high, 1.0)))


class Noise(NamedTuple):
    """What the positions of a source and odometry show together."""

    way: Found  # of odometry, see `OdometryErrors`
    turn: Found
    size: Found  # of the errors of the source
    tau: Found | None  # their time constant; None for white ones
    sigma: Metres  # median of what the source claims
    shown: float  # how large the variance of the source can be at most, in units of the claimed
    seconds: float  # from the first to the last position

    @property
    def proven(self) -> Found:
        """The size of the errors that a drive proves."""
        if self.tau is not None and (
                self.tau.is_wide or self.seconds < KNOWN_FROM * self.tau.value):
            return self.size.written(1.0)
        return self.size.written(max(self.size.value, min(max(self.size.high, self.shown), 1.0)))


def noise_of(parts: Parts, source: str, without: Collection[StampNs] = ()) -> Noise | None:
    """
    Return the noise by the positions of a source in an engine, but for some stamps [ns].

    None if there are too few positions.
    """
    if source not in parts.factors.sources:
        return None
    rows = parts.judge.fixes.path(source, without).copy()
    if len(rows) < LEAST_POSITIONS:
        return None
    # a factor on what is claimed is none on what the motion since the node adds
    known = parts.factors.sources[source].measured.values
    added = known['noise'][np.searchsorted(known['id'], rows['id']), 0]
    rows['slow'] = np.maximum(rows['slow'] - added, SMALLEST * rows['slow'])
    rows['noise'] = rows['slow'][:, None] * (1.0, 0.0, 1.0)
    rows['source'] = 0
    return fitted(rows)


def fitted(rows: Records) -> Noise:
    """Return the noise that makes measurements of one source the most likely."""
    used, known = np.zeros(len(rows)), ALL_UNKNOWN
    # claims may be wrong by more than the search goes: it begins with the best of some multiples
    posterior = Posterior(rows, used, known)
    multiple = min(MULTIPLES, key=lambda exponent: to_the_end(
        posterior.value(learning.moved(known.point, {WHITE: exponent}))))
    scaled = rows.copy()
    scaled['noise'] *= 2.0**multiple
    scaled['slow'] *= 2.0**multiple
    posterior = Posterior(
        scaled, used, known, spread=CLAIM_SPREAD, least_white=SMALLEST, finest=FINEST)
    likely = best = to_the_end(learning.most_likely(posterior))[-1]
    is_slow = best.point[SLOW] > learning.NO_SLOW
    kept: tuple[int, ...] = ()
    axes = (WAY, TURN) if is_slow else (WAY, TURN, WHITE)
    while len(kept) < len(axes):
        least, axis = min(
            (_at(posterior, best, axis, -multiple if axis == WHITE else 0.0, (*kept, axis)), axis)
            for axis in axes if axis not in kept)
        if least.value - likely.value > CHANGE_RISE:
            break
        best, kept = least, (*kept, axis)

    def found(axis: int, unit: float = 1.0) -> Found:
        if axis not in kept:
            return _interval(posterior, best, axis, kept, unit)
        each = _interval(posterior, likely, axis, (), unit)
        return Found(1.0, min(each.low, 1.0), max(each.high, 1.0), kept=True)
    if is_slow:
        # with the white part
        size = found(SLOW, 2.0**multiple * (1.0 + 2.0**(best.point[WHITE] - best.point[SLOW])))
        tau = found(TAU)
    else:
        size, tau = found(WHITE, 2.0**multiple), None
    seconds = 1e-9 * float(rows['stamp_ns'][-1] - rows['stamp_ns'][0])
    return Noise(found(WAY), found(TURN), size, tau, float(np.sqrt(np.median(rows['slow']))),
                 _shown(rows, seconds), seconds)


def _at(posterior: Posterior, best: Minimum, axis: int, exponent: float,
        fixed: Collection[int]) -> Minimum:
    """Return the minimum near a point with another exponent on an axis."""
    free = [other for other, at in enumerate(best.point)
            if other not in fixed and not (other >= SLOW and best.point[SLOW] == learning.NO_SLOW)]
    start = learning.moved(best.point, {axis: exponent})
    return to_the_end(learning.descend(posterior, [start], free))


def _interval(posterior: Posterior, best: Minimum, axis: int, kept: Collection[int],
              unit: float) -> Found:
    """Return the exponent on an axis with its interval, as a number of units."""
    ends = []
    for sign in (-1.0, 1.0):
        least, at = best, best.point[axis]
        for far in np.arange(STEP, REACH + 0.1, STEP).tolist():
            least = _at(posterior, least, axis, at + sign * far, (*kept, axis))
            if least.value - best.value > RISE:
                ends.append(unit * 2.0**least.point[axis])
                break
        else:
            ends.append(0.0 if sign < 0.0 else math.inf)
    low, high = ends
    return Found(unit * 2.0**best.point[axis], low, high, kept=False)


def _shown(rows: Records, seconds: float) -> float:
    """Return how large the variance of positions can be at most, in units of the claimed one."""
    headings = np.cumsum(rows['motion'][:, 2])
    before = np.concatenate(([0.0], headings[:-1]))
    here = np.cumsum((rows['motion'][:, 0] + 1j * rows['motion'][:, 1]) * np.exp(1j * before))
    here += (rows['offset'][:, 0] + 1j * rows['offset'][:, 1]) * np.exp(1j * headings)
    there = rows['mean'][:, 0] + 1j * rows['mean'][:, 1]
    here, there = here - np.mean(here), there - np.mean(there)
    errors = np.abs(there - here * np.exp(1j * np.angle(np.sum(np.conj(here) * there))))**2
    # two coordinates, without the three numbers by which odometry was laid there
    degrees = 2.0 * seconds / CHANGE - 3.0
    quantile = 2.0 * float(gammaincinv(0.5 * max(degrees, 0.0), TAIL))
    # the upper end of the interval of a variance from a mean of squared errors
    return math.inf if not quantile > 0.0 else degrees / quantile * float(
        np.mean(errors / (2.0 * rows['slow'])))


def proven_odometry(found: Collection[Noise]) -> tuple[Found, Found]:
    """Return the proven noise of odometry, of way and turn, as most of the drive shows it."""
    # by what the variances of sources that are proven are larger than those that were found
    excess = max(1.0, *(each.proven.value / each.size.value for each in found))
    most = max(found, key=lambda each: each.seconds)
    return most.way.proven(excess * most.way.high), most.turn.proven(excess * most.turn.high)


# --- what is held out

# Length of a stretch [s]; in time constants of the errors, and in periods of the source.
SHORTEST, IN_TAU, IN_PERIODS = 10.0, 2.0, 5.0
# Longest one, but for the periods [s]: over more, only the drift of odometry would count.
LONGEST = 60.0
# Least number of stretches that are held out together.
LEAST_STRETCHES = 2
# A measurement is wrong if it is so many times the median error away from all paths.
WRONG = 6.0
# What chance alone gives once in twenty times [standard deviations].
LEAST_GAIN = 1.64


class Errors(NamedTuple):
    """Errors of a path at K held-out positions."""

    stamps_ns: IntArray
    """Shape (K,) [ns]."""
    errors: FloatArray
    """Measured position minus that of the path, shape (K, 2) [m]."""
    covariances: FloatArray
    """What these should be, shape (K, 2, 2): of the path and of the measurements [m^2]."""

    @property
    def distances(self) -> FloatArray:
        """Shape (K,) [m]."""
        return np.asarray(np.hypot(self.errors[:, 0], self.errors[:, 1]))

    def rows(self, which: BoolArray | IntArray) -> 'Errors':
        """Return some of them."""
        columns: Any = (column[which] for column in self)
        return Errors(*columns)


class Summary(NamedTuple):
    """Statistics of held-out errors; NaN without any."""

    n: int
    rms: float
    """[m]"""
    median: float
    """[m]"""
    nees: float
    """Mean squared error of a coordinate in sigmas; 1 if covariances are right."""
    nlpd: float
    """Mean negative logarithm of the predicted density at what was measured."""
    correlation_time: float
    """Of the errors, by their autocorrelation [s]; 0 if there is none."""


def comparable(*of_paths: Sequence[Errors]) -> list[Errors]:
    """Return the errors of each path in all folds, by stamp, but for those far from all paths."""
    columns: Any = [map(np.concatenate, zip(*parts, strict=True)) for parts in of_paths]
    joined = [Errors(*each) for each in columns]
    joined = [each.rows(np.argsort(each.stamps_ns, kind='stable')) for each in joined]
    far = np.all([each.distances > WRONG * np.median(each.distances) for each in joined], axis=0)
    return [each.rows(~far) for each in joined]


def stretch_length(duration: float, period: float, tau: float, folds: int) -> float:
    """
    Return how long the stretches are that are held out [s].

    All times are in seconds: of the drive, between measurements, and the time constant of their
    errors, which is 0 if these are white.
    """
    wanted = max(SHORTEST, min(IN_TAU * tau, LONGEST), IN_PERIODS * period)
    return min(wanted, duration / (LEAST_STRETCHES * folds))


def is_in_part(stamp_ns: StampNs, start_ns: StampNs, stretch: float, part: int,
               parts: int) -> bool:
    """Tell whether a stamp lies in one of the stretches of a part, every `parts`-th of them."""
    return int((stamp_ns - start_ns) * 1e-9 / stretch) % parts == part


def errors_at(path: Trajectory, covariances: FloatArray, held_out: Sequence[Position | GlobalPose],
              factor: float) -> Errors:
    """
    Return the errors of a path at valid positions that it covers.

    Covariances are those of the path, shape (P, 3, 3), in map axes, NaN where they are unknown;
    those of what was held out are multiplied by a factor.
    """
    stamps = np.array([each.stamp_ns for each in held_out], dtype=np.int64)
    inside = np.flatnonzero(path.covers(stamps))
    stamps, chosen = stamps[inside], [held_out[k] for k in inside.tolist()]
    positions, levers = np.array([
        (each.position, each.lever_arm) if isinstance(each, Position)
        else (each.pose[:2], np.zeros(2)) for each in chosen]).reshape(-1, 2, 2).swapaxes(0, 1)
    poses = path.at(stamps)
    arms = se2.transform(poses, levers) - poses[:, :2]
    after = np.clip(np.searchsorted(path.stamps_ns, stamps), 1, max(len(path) - 1, 1))
    # between two hidden nodes the error is nearly that of the farther one of these
    jacobian = np.zeros((len(stamps), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -arms[:, 1], arms[:, 0]
    spread = jacobian @ covariances[np.minimum(after, len(path) - 1)] @ np.swapaxes(jacobian, 1, 2)
    own = factor * np.array([each.covariance[:2, :2] for each in chosen]).reshape(-1, 2, 2)
    return Errors(stamps, positions - poses[:, :2] - arms, spread + own)


def is_better(before: Errors, after: Errors, start_ns: int, stretch: float) -> bool:
    """
    Tell whether errors at the same positions have become smaller, by more than chance.

    What differs between stretches, which are independent, is chance (F. Wilcoxon's signed ranks).
    The squared errors are to be smaller, and the predicted density higher.
    """
    stretches = ((before.stamps_ns - start_ns) * 1e-9 / stretch).astype(np.int64)
    squares = _gain(before.distances**2 - after.distances**2, stretches)
    surprise = _gain(_surprises(before) - _surprises(after), stretches)
    return squares > LEAST_GAIN and (surprise > LEAST_GAIN or not np.any(
        np.isfinite(before.covariances)))  # of loop closures there is no density


def _gain(gains: FloatArray, stretches: IntArray) -> float:
    """Return the sum of signed ranks of the gains of stretches, in standard deviations."""
    usable = np.isfinite(gains)
    _, of = np.unique(stretches[usable], return_inverse=True)
    sums = np.bincount(of, gains[usable])
    ranks = np.argsort(np.argsort(np.abs(sums))) + 1.0
    return float(np.sum(ranks * np.sign(sums)) / np.sqrt(np.sum(ranks**2))) if len(of) > 0 else 0.0


def error_summary(of: Errors) -> Summary:
    """Return the statistics of errors."""
    if len(of.stamps_ns) == 0:
        return Summary(0, np.nan, np.nan, np.nan, np.nan, np.nan)
    squared = of.distances**2
    usable = np.all(np.isfinite(of.covariances), axis=(1, 2))
    errors, covariances = of.errors[usable], of.covariances[usable]
    nees = nlpd = np.nan
    if len(errors) > 0:
        nees = float(np.mean(_sigmas(errors, covariances))) / 2.0
        nlpd = float(np.mean(_surprises(of)[usable]))
    distinct = np.diff(of.stamps_ns, prepend=-1) > 0
    return Summary(len(squared), float(np.sqrt(np.mean(squared))), float(np.median(of.distances)),
                   nees, nlpd, estimate(of.stamps_ns[distinct], of.errors[distinct]).tau)


def _sigmas(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return squared errors in units of their covariances, shape (K,)."""
    return np.asarray(np.einsum('ki,ki->k', errors, np.linalg.solve(
        covariances, errors[:, :, None])[:, :, 0]))


def _surprises(of: Errors) -> FloatArray:
    """Return the negative logarithm of the density at each error, shape (K,); NaN without."""
    found, usable = np.full(len(of.errors), np.nan), np.all(np.isfinite(of.covariances), (1, 2))
    covariances = of.covariances[usable]
    found[usable] = 0.5 * (_sigmas(of.errors[usable], covariances)
                           + np.linalg.slogdet(covariances)[1]) + np.log(2.0 * np.pi)
    return found
