# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How far what was held out is from a path, in metres and in sigmas.

Held out are whole stretches of a drive (`fold_of`): single measurements share their slow errors
with their neighbours, so that a path which follows these errors would look good.

From the most likely noise to what a drive proves: nothing is written that is surer than that.

The likelihood knows what changes between measurements. It is blind to errors of a source that
last longer than the drive, and takes slower ones than it models for motion. So a source claims
less than before only as far as odometry, laid over its positions without any model of noise,
shows: there its errors are all that is left, slow ones too, and only as many pieces of the drive
as these can change in are independent. Less noise of odometry is written with the upper end of
its interval. The path depends on ratios of noise: where a source keeps more than was found,
odometry keeps as much more.
"""

from collections.abc import Mapping, Sequence
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.quantities import Seconds
from pose_graph_ros.core.sources.source_report import estimate
from pose_graph_ros.offline.tuning import likelihood as lk
from pose_graph_ros.offline.tuning.drive_rows import DriveRows, Measured
from pose_graph_ros.offline.tuning.fit import Fit, Found, WIDE
from pose_graph_ros.offline.tuning.likelihood import Role

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
# Time in which slow errors of a receiver change: satellites, ionosphere, reflections [s].
SLOW = 300.0
# Probability that a variance is larger than the end of its interval.
TAIL = 0.025


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


NO_ERRORS = Errors(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))


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


def joined(parts: Sequence[Errors]) -> Errors:
    """Return the errors of several folds, by stamp."""
    columns: Any = map(np.concatenate, zip(*parts, strict=True))
    together = Errors(*columns)
    return together.rows(np.argsort(together.stamps_ns, kind='stable'))


def stretch_length(duration: float, period: float, tau: float, folds: int) -> float:
    """
    Return how long the stretches are that are held out [s].

    Parameters
    ----------
    duration, period, tau : float
        Of the drive, between measurements, and time constant of their errors, 0 if white [s].
    folds : int

    """
    wanted = max(SHORTEST, min(IN_TAU * tau, LONGEST), IN_PERIODS * period)
    return min(wanted, duration / (LEAST_STRETCHES * folds))


def fold_of(stamps_ns: IntArray, start_ns: int, stretch: float, folds: int) -> IntArray:
    """
    Return in which fold measurements are held out, shape (M,).

    Parameters
    ----------
    stamps_ns : ndarray, shape (M,) [ns]
    start_ns, stretch : begin [ns] and length [s] of the first stretch
    folds : int

    """
    return np.asarray(((stamps_ns - start_ns) * 1e-9 / stretch).astype(np.int64) % folds)


def errors_at(
    path: Trajectory, covariances: FloatArray, held_out: Measured, factor: float,
) -> Errors:
    """
    Return the errors of a path at positions that it covers.

    Parameters
    ----------
    path : Trajectory, P poses
    covariances : ndarray, shape (P, 3, 3), in map axes; NaN where they are unknown
    held_out : Measured
    factor : float, on the covariances of what was held out

    """
    usable = path.covers(held_out.stamps_ns) & (held_out.values[:, lk.XX - lk.X] > 0.0)
    stamps, values = held_out.stamps_ns[usable], held_out.values[usable]
    poses = path.at(stamps)
    arms = se2.transform(poses, values[:, 5:7]) - poses[:, :2]
    errors = values[:, :2] - poses[:, :2] - arms
    after = np.clip(np.searchsorted(path.stamps_ns, stamps), 1, max(len(path) - 1, 1))
    # between two hidden nodes the error is nearly that of the farther one of these
    jacobian = np.zeros((len(stamps), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -arms[:, 1], arms[:, 0]
    spread = jacobian @ covariances[np.minimum(after, len(path) - 1)] @ np.swapaxes(jacobian, 1, 2)
    own = values[:, [2, 3, 3, 4]].reshape(-1, 2, 2) * factor
    return Errors(stamps, errors, spread + own)


def wrong(parts: Sequence[Errors]) -> BoolArray:
    """Return which positions are far from all paths, shape (K,); the same ones in all parts."""
    far = [each.distances > WRONG * np.median(each.distances) for each in parts]
    return np.asarray(np.all(far, axis=0))


def is_better(before: Errors, after: Errors, start_ns: int, stretch: float) -> bool:
    """
    Tell whether errors at the same positions have become smaller, by more than chance.

    What differs between stretches, which are independent, is chance (F. Wilcoxon's signed ranks).
    The squared errors are to be smaller, and the predicted density higher.

    Parameters
    ----------
    start_ns, stretch : begin [ns] and length [s] of the first stretch

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


def summary(of: Errors) -> Summary:
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
    return Summary(
        len(squared), float(np.sqrt(np.mean(squared))), float(np.median(of.distances)), nees,
        nlpd, estimate(of.stamps_ns[distinct], of.errors[distinct]).tau)


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


def largest_ratio(squares: float, degrees: float) -> float:
    """Return the upper end of the interval of a variance from a mean of squared errors."""
    if degrees <= 0.0:
        return math.inf
    quantile = 2.0 * float(gammaincinv(0.5 * degrees, TAIL))
    return squares * degrees / quantile if quantile > 0.0 else math.inf


def shown_variances(rows: DriveRows, count: int) -> list[float]:
    """Return how large the variances of sources can be at most, in units of those they claim."""
    steps = rows.rows[:, :3]
    headings = np.cumsum(steps[:, 2])
    before = np.concatenate(([0.0], headings[:-1]))
    path = np.cumsum((steps[:, 0] + 1j * steps[:, 1]) * np.exp(1j * before))
    path += (rows.rows[:, lk.ARM_X] + 1j * rows.rows[:, lk.ARM_Y]) * np.exp(1j * headings)
    shown = []
    for k in range(count):
        own = (rows.source == k) & (rows.rows[:, lk.XX] > 0.0)
        if np.sum(own) < 2:
            shown.append(math.inf)
            continue
        there = rows.rows[own, lk.X] + 1j * rows.rows[own, lk.Y]
        here, there = path[own] - np.mean(path[own]), there - np.mean(there)
        turn = np.angle(np.sum(np.conj(here) * there))
        errors = np.abs(there - here * np.exp(1j * turn))**2
        claimed = rows.rows[own, lk.XX] + rows.rows[own, lk.YY]
        # two coordinates, without the three numbers by which odometry was laid there
        pieces = float(np.ptp(rows.seconds[own])) / SLOW
        shown.append(largest_ratio(float(np.mean(errors / claimed)), 2.0 * pieces - 3.0))
    return shown


def proven(fits: Mapping[str, Fit], shown: Sequence[float], duration: Seconds) -> dict[str, Fit]:
    """Return fits, that with the sources first, with the values that the data prove."""
    every = [each for fit in fits.values() for each in fit.found]
    known = {each.parameter.index for each in every if each.parameter.role is Role.TAU
             and not each.is_wide and _is_known(duration / each.value)}
    written: dict[tuple[Role, int], Found] = {}
    excess = 1.0
    for each in every:
        role, index, setting = each.parameter.role, each.parameter.index, each.parameter.setting
        if role is Role.CLOSURE:
            # their constraints share noise of odometry up to the hidden nodes
            value = max(each.value, setting)
            excess = max(excess, value / each.value)
        elif role in (Role.WHITE, Role.CORRELATED, Role.HEADING):
            is_known = role is not Role.CORRELATED or index in known
            value = _safe(each, max(each.high, shown[index])) if is_known else setting
            excess = max(excess, math.sqrt(value / each.value))
        elif role is Role.ODOMETRY or index not in known:
            continue
        else:
            value = each.value
        written[role, index] = _written(each, value)

    def result(each: Found) -> Found | None:
        if each.parameter.role is Role.ODOMETRY:
            # slow errors of sources look like more noise of it, so less than that is proven, too
            setting = each.parameter.setting
            return _written(each, max(each.low, setting) if each.value > setting else _safe(
                each, excess * each.high))
        return written.get((each.parameter.role, each.parameter.index))
    return {name: fit._replace(found=tuple(filter(None, map(result, fit.found))))
            for name, fit in fits.items()}


def _is_known(degrees: float) -> bool:
    """Tell whether so many independent errors give a variance to a factor of `WIDE`."""
    ends = gammaincinv(0.5 * degrees, np.array((TAIL, 1.0 - TAIL)))
    return bool(ends[1] < WIDE * ends[0])


def _safe(each: Found, high: float) -> float:
    """Return the most likely value; of less noise than before the upper end."""
    setting = each.parameter.setting
    return each.value if each.value >= setting else min(high, setting)


def _written(each: Found, value: float) -> Found:
    return each._replace(value=value, high=max(each.high, value),
                         kept=value == each.parameter.setting)
