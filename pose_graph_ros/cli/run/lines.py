# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers and lines as short JSON: rounded, relative, and without points that do not show."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray

TOLERANCE = 0.015
"""Distance between a line and the points that are left out [m]."""
_CHUNK = 512  # a point is kept in every so many, so that few rounds are needed
_STRETCH = 20 * _CHUNK  # number of points that are looked at together


def rounded(values: npt.ArrayLike, digits: int = 3) -> list[Any]:
    """
    Return values as a list for JSON, None for those that are not finite.

    Parameters
    ----------
    values : array_like, of any shape
    digits : int, after the point

    """
    array = np.round(np.asarray(values, dtype=np.float64), digits) + 0.0
    if np.all(np.isfinite(array)):
        return list(array.tolist())
    as_objects = array.astype(object)
    as_objects[~np.isfinite(array)] = None
    return list(as_objects.tolist())


def number(value: float | None, digits: int = 4) -> float | None:
    """
    Return a number with some significant digits; None if it is not finite.

    Parameters
    ----------
    value : float or None
    digits : int

    """
    return None if value is None or not math.isfinite(value) else float(f'{value:.{digits}g}')


def simplified(points: FloatArray, tolerance: float = TOLERANCE, most: int = 20_000) -> IntArray:
    """
    Return which points a line needs, shape (K,), increasing.

    This is the method of Douglas and Peucker, for all parts of a stretch at once. While more than
    `most` points are needed, those that are left are simplified again with twice the tolerance.

    Parameters
    ----------
    points : ndarray, shape (N, 2)
    tolerance : float, distance from the line up to which a point may be left out [m]
    most : int, at least 2

    """
    kept = _needed(points, tolerance)
    while len(kept) > most:
        tolerance = max(2.0 * tolerance, 1e-3)
        kept = kept[_needed(points[kept], tolerance)]
    return kept


def _needed(points: FloatArray, tolerance: float) -> IntArray:
    """Return which points a line needs, stretch by stretch, as memory grows with their length."""
    n = len(points)
    if n <= 2:
        return np.arange(n)
    return np.unique(np.concatenate([
        begin + _needed_in_stretch(points[begin:begin + _STRETCH + 1], tolerance)
        for begin in range(0, n - 1, _STRETCH)]))


def _needed_in_stretch(points: FloatArray, tolerance: float) -> IntArray:
    n = len(points)
    kept = np.unique(np.append(np.arange(0, n, _CHUNK), n - 1))
    while True:
        part = np.clip(np.searchsorted(kept, np.arange(n), side='right') - 1, 0, len(kept) - 2)
        far = _distances(points, points[kept][part], points[kept][part + 1])
        largest = np.maximum.reduceat(far, kept[:-1])
        candidates = np.flatnonzero((far > tolerance) & (far == largest[part]))
        _, first = np.unique(part[candidates], return_index=True)
        if len(first) == 0:
            return kept
        kept = np.union1d(kept, candidates[first])


def _distances(points: FloatArray, begin: FloatArray, end: FloatArray) -> FloatArray:
    """Return the distances of points from line segments, shape (N,)."""
    along = end - begin
    length2 = np.maximum(np.sum(along**2, axis=1), 1e-18)
    share = np.clip(np.sum((points - begin) * along, axis=1) / length2, 0.0, 1.0)
    return np.asarray(np.hypot(*(points - begin - share[:, None] * along).T))

