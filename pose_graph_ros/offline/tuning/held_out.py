# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How far what was held out is from a path, in metres and in sigmas.

Held out are whole stretches of a drive (`fold_of`): single measurements share their slow errors
with their neighbours, so that a path which follows these errors would look good.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import GlobalPose, Position
from pose_graph_ros.core.sources.source_report import estimate

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

    All times are in seconds: of the drive, between measurements, and the time constant of their
    errors, which is 0 if these are white.
    """
    wanted = max(SHORTEST, min(IN_TAU * tau, LONGEST), IN_PERIODS * period)
    return min(wanted, duration / (LEAST_STRETCHES * folds))


def fold_of(stamps_ns: IntArray, start_ns: int, stretch: float, folds: int) -> IntArray:
    """Return in which fold measurements are held out, (M,); the first begins at `start_ns`."""
    return np.asarray(((stamps_ns - start_ns) * 1e-9 / stretch).astype(np.int64) % folds)


def errors_at(
    path: Trajectory, covariances: FloatArray, held_out: Sequence[Position | GlobalPose],
    factor: float,
) -> Errors:
    """
    Return the errors of a path at valid positions that it covers.

    Covariances are those of the path, shape (P, 3, 3), in map axes, NaN where they are unknown;
    those of what was held out are multiplied by a factor.
    """
    stamps = np.array([each.stamp_ns for each in held_out], dtype=np.int64)
    chosen = [held_out[k] for k in np.flatnonzero(path.covers(stamps)).tolist()]
    if len(chosen) == 0:
        return NO_ERRORS
    stamps = np.array([each.stamp_ns for each in chosen], dtype=np.int64)
    positions, levers = (np.array(column) for column in zip(*(
        (each.position, each.lever_arm) if isinstance(each, Position)
        else (each.pose[:2], np.zeros(2)) for each in chosen), strict=True))
    poses = path.at(stamps)
    arms = se2.transform(poses, levers) - poses[:, :2]
    after = np.clip(np.searchsorted(path.stamps_ns, stamps), 1, max(len(path) - 1, 1))
    # between two hidden nodes the error is nearly that of the farther one of these
    jacobian = np.zeros((len(stamps), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -arms[:, 1], arms[:, 0]
    spread = jacobian @ covariances[np.minimum(after, len(path) - 1)] @ np.swapaxes(jacobian, 1, 2)
    own = factor * np.array([each.covariance[:2, :2] for each in chosen])
    return Errors(stamps, positions - poses[:, :2] - arms, spread + own)


def wrong(parts: Sequence[Errors]) -> BoolArray:
    """Return which positions are far from all paths, shape (K,); the same ones in all parts."""
    far = [each.distances > WRONG * np.median(each.distances) for each in parts]
    return np.asarray(np.all(far, axis=0))


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
