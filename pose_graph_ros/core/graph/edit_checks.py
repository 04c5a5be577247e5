# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of the parts of a `GraphUpdate` that are not tables of constraints."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import check_information
from pose_graph_ros.core.graph.factor_types import type_of
from pose_graph_ros.core.graph.ids import Ids
from pose_graph_ros.core.graph.kinds import NodeKind


def checked_poses(name: str, poses: FloatArray) -> FloatArray:
    """
    Return poses as an array of floats; raise GraphUpdateError if they are invalid.

    Parameters
    ----------
    name : str, name of the part of the update
    poses : ndarray, shape (N, 3)

    """
    array = np.asarray(poses, dtype=np.float64)
    has_shape = array.ndim == 2 and array.shape[1:] == (3,)
    if not has_shape or not np.all(np.isfinite(array)):
        raise GraphUpdateError(
            f'{name}: expected finite poses, shape (N, 3), got shape {array.shape}'
            + ' with numbers that are not finite' * has_shape)
    return array


# Types of some new biases, to save making them.
_BIASES = np.full(64, NodeKind.BIAS, np.uint8)


def other_nodes(
    biases: FloatArray, dimensions: Sequence[int], landmarks: FloatArray,
) -> tuple[npt.NDArray[Any], ...]:
    """
    Return values, shape (S + L, 3), and types of new nodes that are no poses.

    Parameters
    ----------
    biases, dimensions, landmarks : as in `GraphUpdate`

    """
    n = len(biases)
    if len(landmarks) == len(dimensions) == 0 and n <= len(_BIASES):
        return biases, _BIASES[:n]
    biases, points = checked_poses('biases', biases), np.asarray(landmarks, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise GraphUpdateError(f'landmarks: expected shape (L, 2), got {points.shape}')
    given = np.asarray(dimensions if len(dimensions) > 0 else np.full(n, 3))
    if given.shape != (n,) or not np.all(np.isin(given, (1, 2, 3))):
        raise GraphUpdateError(
            f'dimensions: expected 1, 2 or 3 for each of {n} biases, got {given.tolist()}')
    dimension = np.concatenate((given, np.full(len(points), 2))).astype(np.uint8)
    values = np.concatenate((biases, np.pad(points, ((0, 0), (0, 1)))))
    kind = np.repeat(np.array((NodeKind.BIAS, NodeKind.LANDMARK), np.uint8), (n, len(points)))
    return (np.where(np.arange(3) < dimension[:, None], values, 0.0),
            type_of(kind, dimension))


def integers(numbers: Collection[int]) -> IntArray:
    """Return integers as an array."""
    return np.fromiter(numbers, np.int64, len(numbers))


def values(weights: Mapping[int, float]) -> FloatArray:
    """Return weights as an array."""
    return np.fromiter(weights.values(), np.float64, len(weights))


def check_ids(name: str, ids: Collection[int], what: str, known: Ids) -> None:
    """
    Raise GraphUpdateError unless all ids are in use.

    Parameters
    ----------
    name, what : str, name of the part of the update, and what has the ids
    ids : collection of int
    known : Ids, with those of the new rows

    """
    if len(ids) == 0:
        return
    array, end = np.array(list(ids)), known.end
    if array.dtype.kind not in 'iu' or not 0 <= array.min() <= array.max() < end:
        # looks for the first one, and lets integers of other types pass
        for number in ids:
            if not (isinstance(number, int | np.integer) and 0 <= number < end):
                raise GraphUpdateError(f'{name}: expected {what}s in 0..{end - 1}, got {number}')
    if known.present is not None:
        gone = known.rows(array) < 0
        if np.any(gone):
            raise GraphUpdateError(f'{name}: {what} {array[gone][0]} has left the graph')


def check_measured(means: FloatArray, informations: FloatArray, n: int) -> None:
    """Raise GraphUpdateError unless these are means and informations of n edges."""
    shapes = means.shape, informations.shape
    if shapes != ((n, 3), (n, 3, 3)):
        raise GraphUpdateError(f'measure_edges: expected the shapes {(n, 3)} and {(n, 3, 3)}, '
                               f'got {shapes[0]} and {shapes[1]}')
    if not np.all(np.isfinite(means)):
        raise GraphUpdateError('measure_edges: expected finite means')
    check_information('measure_edges', informations)


def check_weights(name: str, weights: Mapping[int, float], what: str, known: Ids) -> None:
    """
    Raise GraphUpdateError unless ids and weights are valid.

    Parameters
    ----------
    name, what : str, as for `check_ids`
    weights : mapping of int to float, by id
    known : Ids

    """
    check_ids(name, weights, what, known)
    numbers = values(weights)
    if not np.all(np.isfinite(numbers) & (numbers >= 0.0)):
        number, weight = next(item for item in weights.items() if not 0.0 <= item[1] < np.inf)
        raise GraphUpdateError(
            f'{name}: expected a finite weight that is not negative, got {weight} '
            f'for number {number}')
