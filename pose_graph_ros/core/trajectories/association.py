# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Find the poses of two trajectories that belong together.

By stamps this is what evo does: each pose of the trajectory with fewer poses gets the nearest one
of the other, if that is near enough.
"""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.exceptions import TrajectoryError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.trajectories.sequence import Key, PoseSequence

MAX_DIFFERENCE_NS = 10_000_000
"""Default of the largest difference of stamps, as in evo [ns]."""


@dataclass(frozen=True, slots=True)
class Association:
    """Poses of a reference and of an estimate that belong together, in order."""

    keys: IntArray
    """Stamps [ns], ids or indices, shape (N,): of the estimate, with the offset."""
    reference: FloatArray
    """Poses, shape (N, 3) [m, m, rad]."""
    estimate: FloatArray
    """Poses, shape (N, 3) [m, m, rad]."""
    covariances: FloatArray | None
    """Of the poses of the estimate, shape (N, 3, 3)."""
    key: Key
    """By what the poses were found."""

    def __len__(self) -> int:
        return len(self.keys)


def associate(
    reference: PoseSequence, estimate: PoseSequence,
    max_difference_ns: int = MAX_DIFFERENCE_NS, offset_ns: int = 0, *, interpolate: bool = False,
) -> Association:
    """
    Return the poses that belong together.

    Stamps belong together by `nearest`, ids if they are equal. Otherwise poses belong together in
    their order, which needs equally many.

    Parameters
    ----------
    max_difference_ns : int, largest difference of stamps [ns]
    offset_ns : int, added to the stamps of the estimate [ns]
    interpolate : bool
        Whether the trajectory with more poses is interpolated at the stamps of the other, as evo's
        `interpolation`: the same poses are associated. Covariances are not interpolated.

    Raises
    ------
    TrajectoryError
        If no poses belong together.

    """
    if reference.key is not estimate.key or reference.key is Key.INDEX:
        return _by_order(reference, estimate)
    if reference.key is Key.ID:
        _, i, j = np.intersect1d(reference.keys, estimate.keys, return_indices=True)
        if len(i) == 0:
            raise TrajectoryError('no vertex has the same id in both')
        return _chosen(reference, estimate, i, j, estimate.keys)
    return _by_stamp(reference, estimate, max_difference_ns, offset_ns, interpolate=interpolate)


def nearest(fewer: IntArray, more: IntArray, max_difference: int) -> tuple[IntArray, IntArray]:
    """
    Return which of some stamps have another one near them, and the nearest of these.

    Of two that are equally near the earlier one is taken; one may be the nearest of several.

    Parameters
    ----------
    fewer, more : ndarray, shape (N,) and (M,), increasing [ns]
    max_difference : int, largest difference [ns]

    Returns
    -------
    i, j : ndarray, shape (K,), indices into `fewer` and `more`

    """
    if len(fewer) == 0 or len(more) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    after = np.clip(np.searchsorted(more, fewer), 0, len(more) - 1)
    before = np.maximum(after - 1, 0)
    chosen = np.where(np.abs(fewer - more[before]) <= np.abs(more[after] - fewer), before, after)
    i = np.flatnonzero(np.abs(more[chosen] - fewer) <= max_difference)
    return i, chosen[i]


def _by_order(reference: PoseSequence, estimate: PoseSequence) -> Association:
    if len(reference) != len(estimate):
        raise TrajectoryError(
            f'they have {len(reference)} and {len(estimate)} poses, by {reference.key.value} and '
            f'by {estimate.key.value}; without stamps in both, they must have equally many')
    everything = np.arange(len(reference))
    return Association(everything, reference.poses, estimate.poses, estimate.covariances,
                       Key.INDEX)


def _by_stamp(
    reference: PoseSequence, estimate: PoseSequence, max_difference_ns: int, offset_ns: int,
    *, interpolate: bool,
) -> Association:
    stamps = estimate.keys + offset_ns
    # with equally many, the estimate's are looked up, which is evo's choice
    if len(stamps) > len(reference):
        i, j = nearest(reference.keys, stamps, max_difference_ns)
    else:
        j, i = nearest(stamps, reference.keys, max_difference_ns)
    if len(i) == 0:
        raise TrajectoryError(_why_none(reference.keys, stamps, max_difference_ns))
    found = _chosen(reference, estimate, i, j, stamps)
    if not interpolate:
        return found
    if len(stamps) > len(reference):
        at = np.clip(reference.keys[i], stamps[0], stamps[-1]) - offset_ns
        return Association(at + offset_ns, found.reference, estimate.path.at(at),
                           found.covariances, Key.STAMP)
    at = np.clip(stamps[j], reference.keys[0], reference.keys[-1])
    return Association(stamps[j], reference.path.at(at), found.estimate, found.covariances,
                       Key.STAMP)


def _chosen(
    reference: PoseSequence, estimate: PoseSequence, i: IntArray, j: IntArray, keys: IntArray,
) -> Association:
    covariances = None if estimate.covariances is None else estimate.covariances[j]
    return Association(
        keys[j], reference.poses[i], estimate.poses[j], covariances, reference.key)


def _why_none(reference: IntArray, estimate: IntArray, max_difference_ns: int) -> str:
    limit = f'no stamps are within {max_difference_ns * 1e-9:g} s of each other'
    if len(reference) == 0 or len(estimate) == 0:
        return f'{limit}: one has no poses'
    if reference[0] > estimate[-1] or estimate[0] > reference[-1]:
        spans = ' and '.join(f'{stamps[0] * 1e-9:.3f} to {stamps[-1] * 1e-9:.3f} s'
                             for stamps in (reference, estimate))
        return f'{limit}: they cover {spans}'
    i, j = nearest(estimate, reference, np.iinfo(np.int64).max)
    least = np.min(np.abs(estimate[i] - reference[j])) * 1e-9
    return f'{limit}: the nearest two differ by {least:.3g} s'
