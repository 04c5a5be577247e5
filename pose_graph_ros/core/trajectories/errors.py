# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Absolute and relative errors of a trajectory, with pairs of poses chosen as in evo.

The absolute error compares poses, the relative one the motions between two poses (R. Kuemmerle
et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27, 2009; J. Sturm et
al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012).
"""

from enum import Enum

import numpy as np

from pose_graph_ros.core.exceptions import TrajectoryError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.trajectories.association import Association
from pose_graph_ros.core.trajectories.sequence import Key

TOLERANCE = 0.1
"""Largest relative deviation from the wanted length of a pair among all pairs, as in evo."""
MOST_BY_ANGLE = 20_000  # of all pairs by angle there are as many as the square of this


class Unit(Enum):
    """Unit of the length of the motions whose errors are relative errors."""

    FRAMES = 'frames'
    METRES = 'metres'
    SECONDS = 'seconds'
    RADIANS = 'rad'


def absolute_errors(reference: FloatArray, estimate: FloatArray) -> FloatArray:
    """
    Return the difference of poses, shape (N, 3), in the axes of the map [m, m, rad].

    Parameters
    ----------
    reference, estimate : ndarray, shape (N, 3)

    """
    difference = estimate - reference
    difference[:, 2] = se2.wrap(difference[:, 2])
    return difference


def relative_errors(
    reference: FloatArray, estimate: FloatArray, i: IntArray, j: IntArray,
) -> FloatArray:
    """
    Return the motions of the reference from i to j, inverse, with those of the estimate.

    Parameters
    ----------
    reference, estimate : ndarray, shape (N, 3)
    i, j : ndarray, shape (K,), indices of poses

    Returns
    -------
    ndarray, shape (K, 3) [m, m, rad]

    """
    return se2.between(se2.between(reference[i], reference[j]),
                       se2.between(estimate[i], estimate[j]))


def choose_pairs(
    found: Association, delta: float, unit: Unit, *, all_pairs: bool = False,
    of_reference: bool = False,
) -> tuple[IntArray, IntArray]:
    """
    Return the indices of the first and the last poses of motions of a length.

    Parameters
    ----------
    delta : float, wanted length
    all_pairs : bool
        Whether motions may overlap: from each pose to the one whose distance is nearest to
        `delta`, if it differs by at most 10 %. By angle: from each pose to all whose heading
        differs by `delta`, to 10 %. Else a motion begins where the one before has ended, and
        ends with the first pose that is at least so far; the angle is what the path has turned.
    of_reference : bool, whether the reference has that length; else it is the estimate

    Returns
    -------
    i, j : ndarray, shape (K,), empty if there are none

    Raises
    ------
    TrajectoryError
        If `delta` is not positive, or no whole number of frames, or there are no stamps.

    """
    if not 0.0 < delta < np.inf or (unit is Unit.FRAMES and delta != int(delta)):
        what = 'whole number of frames' if unit is Unit.FRAMES else 'finite length'
        raise TrajectoryError(f'delta: expected a {what} above 0, got {delta:g}')
    poses = found.reference if of_reference else found.estimate
    if unit is Unit.FRAMES:
        step = int(delta)
        i = np.arange(0, max(len(found) - step, 0), 1 if all_pairs else step)
        return i, i + step
    if unit is Unit.RADIANS and all_pairs:
        return _pairs_by_heading(poses[:, 2], delta)
    progress = _progress(found, poses, unit)
    return (_all_pairs if all_pairs else _consecutive_pairs)(progress, delta)


def _progress(found: Association, poses: FloatArray, unit: Unit) -> FloatArray:
    """Return how far each pose is from the first, in a unit; never decreasing, shape (N,)."""
    if unit is Unit.SECONDS:
        if found.key is not Key.STAMP:
            raise TrajectoryError('pairs by seconds need stamps in both')
        return np.asarray((found.keys - found.keys[0]) * 1e-9)
    if unit is Unit.METRES:
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    else:
        steps = np.nan_to_num(np.abs(se2.wrap(np.diff(poses[:, 2]))))
    return np.append(0.0, np.cumsum(steps))


def _consecutive_pairs(progress: FloatArray, delta: float) -> tuple[IntArray, IntArray]:
    ends = [0]
    while (end := int(np.searchsorted(progress, progress[ends[-1]] + delta))) < len(progress):
        ends.append(end)
    indices = np.array(ends, dtype=np.int64)
    return indices[:-1], indices[1:]


def _all_pairs(progress: FloatArray, delta: float) -> tuple[IntArray, IntArray]:
    after = np.clip(np.searchsorted(progress, progress + delta), 0, len(progress) - 1)
    before = np.searchsorted(progress, progress[np.maximum(after - 1, 0)])
    short, long = (np.abs(progress[j] - progress - delta) for j in (before, after))
    j = np.where(short <= long, before, after)
    i = np.flatnonzero((np.minimum(short, long) <= TOLERANCE * delta) & (j > np.arange(len(j))))
    return i, j[i]


def _pairs_by_heading(headings: FloatArray, delta: float) -> tuple[IntArray, IntArray]:
    if len(headings) > MOST_BY_ANGLE:
        raise TrajectoryError(f'{len(headings)} poses have too many pairs by angle; take '
                              'consecutive ones')
    last = []
    for k, heading in enumerate(headings):
        turns = np.abs(se2.wrap(headings[k + 1:] - heading))
        last.append(k + 1 + np.flatnonzero(np.abs(turns - delta) <= TOLERANCE * delta))
    i = np.repeat(np.arange(len(headings)), [len(ends) for ends in last])
    return i, np.concatenate(last) if last else i
