# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures along a path: true ones where it comes by again, and false ones.

Place recognition is wrong in two ways. A single image looks like one of anywhere. And a whole
stretch is taken for another one that looks like it, such as an aisle of a hall for the next, which
gives a group of closures that agree with one another.
"""

import numpy as np
from scipy.spatial import KDTree

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Poses
from pose_graph_ros.offline.simulation.motion import Motion
from pose_graph_ros.offline.simulation.sensors import Measured
from pose_graph_ros.offline.simulation.settings import Closures

TRIES, TRIED = 10_000, 8
"""Pairs of places that are tried for so many groups; a short drive has none that look alike."""


def revisits(
    generator: np.random.Generator, path: Motion, places: IntArray, closures: Closures,
) -> tuple[IntArray, IntArray]:
    """
    Return the earlier and the later pose of true closures, shape (L,) each, as numbers of places.
    """
    poses, stamps = path.truth.poses[places], path.truth.stamps_ns[places]
    pairs = KDTree(poses[:, :2]).query_pairs(closures.radius, output_type='ndarray')
    old, new = np.sort(pairs, axis=1).T
    good = (
        (stamps[new] - stamps[old] > closures.min_time_s * 1e9)
        & (path.distance[places[new]] - path.distance[places[old]] > closures.min_distance)
        & (np.abs(se2.wrap(poses[new, 2] - poses[old, 2])) < closures.angle))
    old, new = old[good], new[good]
    # one random pair of each stretch of the path
    order = generator.permutation(len(new))
    _, first = np.unique(
        path.distance[places[new[order]]] // closures.spacing, return_index=True)
    return old[order[first]], new[order[first]]


def measured(
    generator: np.random.Generator, old: Poses, new: Poses, closures: Closures,
) -> FloatArray:
    """Return what true closures measure: the later pose in the earlier one, with noise."""
    noise = generator.normal(0.0, closures.sigmas, (len(new), 3))
    return se2.compose(se2.between(old, new), noise)


def false_pairs(
    generator: np.random.Generator, path: Motion, sizes: list[int], closures: Closures,
) -> tuple[IntArray, IntArray]:
    """
    Return the ends of false closures, shape (F, 2), and the number of the group of each, (F,).

    There are fewer groups than asked where the path has too few places that are apart and driven
    in the same direction.
    """
    false = closures.false
    begin = max(1, int(np.searchsorted(
        path.truth.stamps_ns, path.truth.stamps_ns[0] + round(false.from_s * 1e9))))
    stretch = max(sizes, default=1) * false.spacing
    last = int(np.searchsorted(path.distance, path.distance[-1] - stretch))
    first = int(np.searchsorted(
        path.truth.stamps_ns, path.truth.stamps_ns[0] + round(closures.first_s * 1e9)))
    pairs, groups, k = list[tuple[int, int]](), list[int](), 0
    for _ in range(TRIES * -(-len(sizes) // TRIED) if last > begin else 0):
        if k == len(sizes):
            break
        new = int(generator.integers(begin, last))
        old = int(generator.integers(0, new))
        along = false.spacing * np.arange(sizes[k])
        at = np.searchsorted(path.distance, path.distance[[old, new]][:, None] + along)
        places = path.truth.poses[at]
        away = np.hypot(*np.moveaxis(places[1] - places[0], -1, 0)[:2])
        alike = np.abs(se2.wrap(places[1, :, 2] - places[0, :, 2])) < closures.angle
        if np.all(away > false.min_distance) and np.all(alike) and first <= at[0, 0] and (
                at[0, -1] < at[1, 0]):
            pairs += list(zip(*at.tolist(), strict=True))
            groups += [k] * sizes[k]
            k += 1
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), np.array(groups, dtype=np.int64)


def false_poses(
    generator: np.random.Generator, path: Motion, pairs: IntArray, groups: IntArray,
    closures: Closures,
) -> FloatArray:
    """
    Return what false closures measure, shape (F, 3): nearly one place.

    Those of a group agree with each other as true ones would, unless they are `loose`.

    Parameters
    ----------
    generator : numpy.random.Generator
    path : Motion
    pairs : ndarray, shape (F, 2), indices of poses
    groups : ndarray, shape (F,), numbers of the groups, in order
    closures : Closures

    """
    looks = generator.normal(
        0.0, (0.5 * closures.radius, 0.25 * closures.radius, 0.05), (len(pairs), 3))
    if closures.false.loose:
        return np.asarray(looks)
    _, first, group = np.unique(groups, return_index=True, return_inverse=True)
    old, new = path.truth.poses[pairs].transpose(1, 0, 2)
    # both stretches are laid upon one another at the first closure of the group
    lead = first[group]
    moved = se2.compose(se2.inverse(se2.between(old[lead], old)), looks[lead])
    return se2.compose(se2.compose(moved, se2.between(new[lead], new)),
                       generator.normal(0.0, closures.sigmas, (len(pairs), 3)))


def with_false(
    generator: np.random.Generator, path: Motion, closures: Closures, ends: IntArray,
    poses: FloatArray,
) -> tuple[Measured, int]:
    """
    Return true closures and false ones by their later ends, and how many groups are missing.

    In: the stamps of the true ones, shape (L, 2), and the measured poses, shape (L, 3).
    """
    sizes = closures.false.sizes(len(ends))
    pairs, groups = false_pairs(generator, path, sizes, closures)
    false = false_poses(generator, path, pairs, groups, closures)
    every = Measured(np.concatenate((ends, path.truth.stamps_ns[pairs])),
                     np.concatenate((poses, false)), np.append(np.full(len(ends), -1), groups))
    return (every.rows(np.argsort(every.later_ns, kind='stable')),
            len(sizes) - len(np.unique(groups)))
