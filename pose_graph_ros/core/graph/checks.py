# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which ids are in use, and checks of all that goes into a graph; they raise GraphUpdateError."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.covariance import scaled
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, FACTORS, Factors, NodeKind, RECORD
from pose_graph_ros.core.graph.graph_update import GraphUpdate

# How far, with its diagonal scaled to 1, the smallest eigenvalue of an information matrix may be
# below zero and its triangles may differ, because files print few digits.
SEMIDEFINITE_TOLERANCE = 1e-5


class RowError(GraphUpdateError):
    """A row of a table is invalid."""

    def __init__(self, reason: str, row: int, value: object) -> None:
        super().__init__(f'{reason}; row {row}: {value}')
        self.row = row


class Ids(NamedTuple):
    """Which permanent ids of nodes or factors are in use."""

    end: int                            # id of the next new row
    present: IntArray | None = None     # by row, ascending; None where they are 0..end - 1

    def rows(self, ids: npt.ArrayLike) -> IntArray:
        """Return the row of each id, in the shape of `ids`, -1 where it is in none."""
        wanted = np.asarray(ids, dtype=np.int64)
        if self.present is None:
            return np.where((wanted >= 0) & (wanted < self.end), wanted, -1)
        if len(self.present) == 0:
            return np.full(wanted.shape, -1)
        rows = np.minimum(np.searchsorted(self.present, wanted), len(self.present) - 1)
        return np.where(self.present[rows] == wanted, rows, -1)

    def known(self, ids: npt.ArrayLike, what: str) -> IntArray:
        """Return the row of each id; raise ValueError where it is in none."""
        rows = self.rows(ids)
        if np.any(rows < 0):
            gone = np.asarray(ids)[rows < 0].flat[0]
            raise ValueError(f'{what} {gone} is not in the graph')
        return rows

    def extended(self, n: int) -> 'Ids':
        """Return the ids with n more rows."""
        if self.present is None:
            return Ids(self.end + n)
        return Ids(self.end + n, np.append(self.present, self.end + np.arange(n)))


# --- tables of factors ----------------------------------------------------------------------

def check(table: Factors, kind: npt.NDArray[Any], dimension: IntArray | None = None,
          nodes: Ids | None = None) -> None:
    """
    Raise for invalid factors, with the row, what was expected and the value.

    Invalid are wrong kinds or nodes, negative weights, a factor from a node to itself, a
    node of a kind that the kind of factor does not have for this end, numbers that are not finite,
    numbers in rows that an error has not, an information matrix that is zero, not symmetric or not
    positive semidefinite. `kind` has the `NodeKind` of the hidden nodes, by row; by default
    `dimension` is 2 for landmarks and 3 for others, and ids are rows.
    """
    ids = Ids(len(kind)) if nodes is None else nodes
    for key, column in zip(RECORD.fields or (), table.columns, strict=True):
        _refuse_rows(~np.isfinite(column), f'Factors.{key} is not finite', column)
    for end, least in ((table.i, 0), (table.j, -1), (table.k, -1)):
        _refuse_rows((end < least) | (end >= ids.end),
                     f'Factors: expected a hidden node in 0..{ids.end - 1}', end)
        gone = np.flatnonzero((ids.rows(end) < 0) & (end >= 0))
        if len(gone) > 0:
            raise GraphUpdateError(
                f'Factors: hidden node {end[gone[0]]} has left the graph; row {gone[0]}')
    _refuse_rows(~np.isin(table.kind, tuple(FACTORS)), 'Factors.kind is none of '
                 f'{", ".join(each.name for each in FACTORS)}', table.kind)
    _refuse_rows(table.weight < 0.0, 'Factors.weight is negative', table.weight)
    if dimension is None:
        dimension = np.where(kind == NodeKind.LANDMARK, 2, 3)
    _refuse_rows(table.i == table.j, 'Factors: an edge leads from a node to itself', table.i)
    _check_ends(table, kind, ids)
    rows = np.array([np.isin(range(3), factor.rows) for factor in FACTORS.values()])
    missing = ~rows[table.kind]
    _refuse_rows(missing & (table.mean != 0.0),
                 'Factors.mean: expected 0 in rows that the error has not', table.mean)
    _refuse_rows((table.kind == FactorKind.ODOMETRY) & (table.k >= 0) & (
        dimension[ids.rows(table.k)] < 2), 'Factors.k: expected a bias of two coordinates for an '
        'edge of odometry', table.k)
    # of one on a bias, or on a single node, the rows that the node has
    of_i = dimension[ids.rows(table.i)]
    of_j = np.where(table.j >= 0, dimension[ids.rows(table.j)], of_i)
    has_few = (table.kind == FactorKind.BIAS) | (table.j < 0)
    missing = missing | (np.arange(3) >= np.where(has_few, np.minimum(of_i, of_j), 3)[:, None])
    matrix = table.information
    diagonal, correlation = np.diagonal(matrix, axis1=1, axis2=2), scaled(matrix)
    _refuse_rows(missing & (diagonal != 0.0), 'Factors.information: expected 0 in rows that the '
                 'error or the node has not', diagonal)
    skew = np.max(np.abs(correlation - np.swapaxes(correlation, 1, 2)), axis=(1, 2), initial=0.0)
    _refuse_rows(skew > SEMIDEFINITE_TOLERANCE, 'Factors.information is not symmetric', matrix)
    semidefinite = np.all(diagonal >= 0.0, axis=1) & are_definite(matrix, SEMIDEFINITE_TOLERANCE)
    _refuse_rows(~semidefinite | ~np.any(matrix, axis=(1, 2)),
                 'Factors.information is not positive semidefinite, or zero', matrix)


def _check_ends(factors: Factors, kind: npt.NDArray[Any], ids: Ids) -> None:
    """Raise if a factor has a node of the wrong kind for an end, or lacks one."""
    for each, factor in FACTORS.items():
        rows = factors.kind == each
        for end, allowed in (('i', factor.i), ('j', factor.j), ('k', factor.k)
                             ) if np.any(rows) else ():
            node = getattr(factors, end)
            wrong = rows & np.where(
                node >= 0, ~np.isin(kind[ids.rows(node)], allowed), end == 'j' and allowed != ())
            expected = ' or '.join(item.name.lower() for item in allowed) or 'none'
            _refuse_rows(wrong, f'Factors.{end}: expected a factor of kind {each.name} to have '
                         f'{expected} for this end', node)


def are_definite(information: FloatArray, tolerance: float = -1e-9) -> BoolArray:
    """
    Tell which matrices, shape (M, 3, 3), are clearly positive definite, whatever their unit.

    That is, with the diagonal scaled to 1 their eigenvalues plus the tolerance are.
    """
    correlation = scaled(information)
    a, b, c = correlation[:, 0, 1], correlation[:, 0, 2], correlation[:, 1, 2]
    x, y, z = np.diagonal(correlation, axis1=1, axis2=2).T + tolerance
    # the leading minors
    minor = x * y - a * a
    determinant = z * minor + 2.0 * a * b * c - y * b * b - x * c * c
    return np.asarray((x > 0.0) & (minor > 0.0) & (determinant > 0.0))


def _refuse_rows(bad: BoolArray, reason: str, values: npt.NDArray[np.generic]) -> None:
    """Raise with the first bad row, if there is one."""
    if np.any(bad):
        row = int(np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))[0])
        raise RowError(reason, row, values[row].tolist())


# --- other parts of an update -------------------------------------------------------------------

def checked_poses(name: str, poses: FloatArray) -> FloatArray:
    """Return poses of a part of an update as an array of floats."""
    array = np.asarray(poses, dtype=np.float64)
    has_shape = array.ndim == 2 and array.shape[1:] == (3,)
    if not has_shape or not np.all(np.isfinite(array)):
        raise GraphUpdateError(
            f'{name}: expected finite poses, shape (N, 3), got shape {array.shape}'
            + ' with numbers that are not finite' * has_shape)
    return array


def new_nodes(update: GraphUpdate) -> tuple[FloatArray, npt.NDArray[np.uint8]]:
    """
    Return values, shape (N, 3), and types of new nodes.

    A type is the `NodeKind`, plus 4 for each coordinate that the node has less than 3. Those of
    one kind alone are returned as they are.
    """
    hidden, _, biases, dimensions, landmarks = update[:5]
    n = len(biases)
    if len(landmarks) == len(dimensions) == 0:
        if n == 0:
            return hidden, np.zeros(len(hidden), np.uint8)
        if len(hidden) == 0:
            return biases, np.full(n, int(NodeKind.BIAS), np.uint8)
    hidden, biases = checked_poses('hidden', hidden), checked_poses('biases', biases)
    points = np.asarray(landmarks, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise GraphUpdateError(f'landmarks: expected shape (L, 2), got {points.shape}')
    given = np.asarray(dimensions if len(dimensions) > 0 else np.full(n, 3))
    if given.shape != (n,) or not np.all(np.isin(given, (1, 2, 3))):
        raise GraphUpdateError(
            f'dimensions: expected 1, 2 or 3 for each of {n} biases, got {given.tolist()}')
    dimension = np.concatenate((
        np.full(len(hidden), 3), given, np.full(len(points), 2))).astype(np.uint8)
    values = np.concatenate((hidden, biases, np.pad(points, ((0, 0), (0, 1)))))
    kind = np.repeat(np.array(list(NodeKind), np.uint8), (len(hidden), n, len(points)))
    return np.where(np.arange(3) < dimension[:, None], values, 0.0), kind + 4 * (3 - dimension)


def check_ids(name: str, ids: Collection[int], what: str, known: Ids) -> None:
    """Raise unless all ids are in use."""
    if len(ids) == 0:
        return
    array = np.array(list(ids))
    wrong = ((array < 0) | (array >= known.end) if array.dtype.kind in 'iu'
             else np.ones(len(array), dtype=bool))
    if np.any(wrong):
        raise GraphUpdateError(
            f'{name}: expected {what}s in 0..{known.end - 1}, got {array[wrong][0]}')
    if known.present is not None and np.any(gone := known.rows(array) < 0):
        raise GraphUpdateError(f'{name}: {what} {array[gone][0]} has left the graph')


def check_weights(weights: Mapping[int, float]) -> None:
    """Raise unless new weights are valid."""
    for number, weight in weights.items():
        if not 0.0 <= weight < np.inf:
            raise GraphUpdateError(f'weigh: expected a finite weight that is not negative, got '
                                   f'{weight} for number {number}')
