# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of errors under evo's names, and of normalised estimation errors squared (NEES)."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray

PROBABILITY = 0.95
"""Of the intervals of the NEES."""
LEAST_EIGENVALUE = 1e-9  # of a correlation matrix, as `covariance.defect` has it


@dataclass(frozen=True, slots=True)
class Statistics:
    """Of absolute values, in their unit; `sse`, the sum of squares, in its square."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float
    count: int


@dataclass(frozen=True, slots=True)
class Consistency:
    """
    The normalised estimation error squared of an estimate, averaged over its poses.

    Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation",
    section 5.4. The interval holds for independent errors. Those of one path are not independent,
    so that its true interval is wider.
    """

    mean: float
    expected: float
    """The mean if the covariances are right: the number of coordinates."""
    interval: tuple[float, float]
    """Of the mean, with 95 % probability, by chi-square, if all errors were independent."""
    within: float
    """Share of the poses whose NEES is below the 95 % quantile of chi-square."""
    count: int
    """Number of poses with a valid covariance."""


def summarize(errors: FloatArray) -> Statistics | None:
    """
    Return the statistics of absolute values, shape (N,); None if there is none.

    NaN is left out.
    """
    errors = errors[np.isfinite(errors)]
    if len(errors) == 0:
        return None
    sse = float(np.sum(np.square(errors)))
    return Statistics(
        float(np.sqrt(sse / len(errors))), float(np.mean(errors)), float(np.median(errors)),
        float(np.std(errors)), float(np.min(errors)), float(np.max(errors)), sse, len(errors))


def usable(covariances: FloatArray) -> BoolArray:
    """Return which matrices, shape (N, d, d), are finite and positive definite, shape (N,)."""
    diagonal = np.diagonal(covariances, axis1=1, axis2=2)
    good = np.all(np.isfinite(covariances), axis=(1, 2)) & np.all(diagonal > 0.0, axis=1)
    deviation = np.sqrt(diagonal[good])
    correlation = covariances[good] / deviation[:, :, None] / deviation[:, None, :]
    with np.errstate(invalid='ignore'):
        smallest = np.linalg.eigvalsh(np.clip(correlation, -2.0, 2.0))[:, 0]
    good[good] = smallest >= LEAST_EIGENVALUE
    return good


def normalized_squares(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """
    Return `e^T P^-1 e`, shape (N,); NaN where a covariance is invalid or an error unknown.

    Parameters
    ----------
    errors : ndarray, shape (N, d)
    covariances : ndarray, shape (N, d, d), in the axes of the errors

    """
    squares = np.full(len(errors), np.nan)
    good = usable(covariances)
    solved = np.linalg.solve(covariances[good], errors[good][:, :, None])[:, :, 0]
    squares[good] = np.sum(errors[good] * solved, axis=1)
    return squares


def consistency(squares: FloatArray, dimension: int) -> Consistency | None:
    """
    Return the consistency of normalised squared errors; None if there is none.

    Parameters
    ----------
    squares : ndarray, shape (N,), NaN is left out
    dimension : int, number of coordinates of an error

    """
    squares = squares[np.isfinite(squares)]
    count = len(squares)
    if count == 0:
        return None
    tail = 0.5 * (1.0 - PROBABILITY)
    low, high = (float(chi2.ppf(p, count * dimension)) / count for p in (tail, 1.0 - tail))
    return Consistency(
        float(np.mean(squares)), float(dimension), (low, high),
        float(np.mean(squares <= chi2.ppf(PROBABILITY, dimension))), count)
