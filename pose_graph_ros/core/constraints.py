# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The two kinds of constraints, as struct of arrays: edges and observed nodes.

An *edge* is directed from hidden node i to hidden node j and carries the measured pose of j in i.
An *observed node* is a pose measured from outside; its constraint ties it to one hidden node. A
position is an observed node whose information on the heading is zero, and whose mean heading is
zero, so that its error lies in the axes of the map; a heading is one whose information on the
position is zero.

A *bias* is a hidden node that is no pose but what a source of measurements is off for a while, in
units of its sigma. Edges of a kind of their own lead to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.se2 import FloatArray, IntArray

KindArray = npt.NDArray[np.uint8]

# With its diagonal scaled to 1, the smallest eigenvalue of an information matrix may be this much
# below zero and its triangles may differ by this much: files print few digits.
SEMIDEFINITE_TOLERANCE = 1e-5


class EdgeKind(IntEnum):
    """Where an edge comes from."""

    ODOMETRY = 0
    LOOP_CLOSURE = 1
    BIAS = 2
    """
    Leads to a bias j, from the pose i that was measured with it, or from the next bias i: the
    error is `F x_j + mean - x_i * offset` in map axes, F = diag(f_t, f_t, f_th).
    """


class ObservedKind(IntEnum):
    """What an observed node tells."""

    GLOBAL_POSE = 0
    POSITION = 1
    HEADING = 2


@dataclass(frozen=True, slots=True)
class _Table:
    """Columns of equal length; `joined` and `rows` work on all of them."""

    @classmethod
    def joined(cls, tables: Sequence[Self]) -> Self:
        """Return the rows of all tables, in order."""
        if len(tables) == 0:
            return cls()
        return cls(*(np.concatenate([getattr(table, item.name) for table in tables])
                     for item in fields(cls)))

    @property
    def weighted_information(self) -> FloatArray:
        """Information times weight, shape (M, 3, 3)."""
        information, weight = getattr(self, 'information'), getattr(self, 'weight')  # noqa: B009
        return np.asarray(weight[:, None, None] * information)

    def rows(self, index: IntArray | npt.NDArray[np.bool_] | slice) -> Self:
        """Return the chosen rows."""
        return type(self)(*(getattr(self, item.name)[index] for item in fields(self)))


# the tables are frozen, but in their constructors
_set = object.__setattr__


def _empty(*shape: int) -> FloatArray:
    return np.empty((0, *shape))


_FLOAT, _INT, _KIND = (np.dtype(kind) for kind in (np.float64, np.int64, np.uint8))


def _numbers(values: npt.ArrayLike) -> FloatArray:
    """Return an array of numbers."""
    if type(values) is np.ndarray and values.dtype is _FLOAT:
        return values   # as nearly always, and in a third of the time
    return np.asarray(values, dtype=_FLOAT)


def _integers(values: npt.ArrayLike, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return an array of integers; nothing is rounded to one."""
    if type(values) is np.ndarray and values.dtype is dtype:
        return values
    array = np.asarray(values)
    if array.size > 0 and array.dtype.kind not in 'iu':
        raise GraphUpdateError(f'expected integers, got {array.dtype} {array.tolist()}')
    return array.astype(dtype, copy=False)


def _weights(weight: npt.ArrayLike | None, size: int) -> FloatArray:
    if weight is not None:
        return _numbers(weight)
    ones = np.empty(size)
    ones.fill(1.0)  # np.ones takes three times as long for a few
    return ones


@dataclass(frozen=True, slots=True)
class Edges(_Table):
    """M directed edges."""

    i: IntArray
    """Node that the edge starts from, shape (M,)."""
    j: IntArray
    """Node that it leads to, shape (M,)."""
    mean: FloatArray
    """Measured pose of j in i, shape (M, 3) [m, m, rad]; to a bias: that of i in the map."""
    information: FloatArray
    """
    Inverse covariance of the error (3.48), in the frame of the measured pose, (M, 3, 3); to a
    bias: in map axes.
    """
    kind: KindArray
    """`EdgeKind`, shape (M,)."""
    weight: FloatArray
    """Factor on the information, shape (M,); 0 for an edge that has been removed."""
    bias: FloatArray
    """
    Offset in i that was measured, and factors of the bias, `(o_x, o_y, f_t, f_th)`, shape (M, 4)
    [m, m, m, rad]; means nothing but for edges to a bias.
    """

    def __init__(  # noqa: PLR0917  the columns
        self, i: npt.ArrayLike = (), j: npt.ArrayLike = (),
        mean: npt.ArrayLike | None = None, information: npt.ArrayLike | None = None,
        kind: npt.ArrayLike = (), weight: npt.ArrayLike | None = None,
        bias: npt.ArrayLike | None = None,
    ) -> None:
        i = _integers(i, _INT)
        _set(self, 'i', i)
        _set(self, 'j', _integers(j, _INT))
        _set(self, 'mean', _numbers(_empty(3) if mean is None else mean))
        _set(self, 'information', _numbers(_empty(3, 3) if information is None else information))
        _set(self, 'kind', _integers(kind, _KIND))
        _set(self, 'weight', _weights(weight, len(i)))
        _set(self, 'bias', np.zeros((len(i), 4)) if bias is None else _numbers(bias))

    def __len__(self) -> int:
        return len(self.i)

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All columns, in their order."""
        return self.i, self.j, self.mean, self.information, self.kind, self.weight, self.bias


@dataclass(frozen=True, slots=True)
class ObservedNodes(_Table):
    """K observed nodes, each with its one constraint."""

    node: IntArray
    """Hidden node that is observed, shape (K,)."""
    offset: FloatArray
    """
    Pose of the observed frame in the hidden node, shape (K, 3) [m, m, rad]: motion by odometry
    since the hidden node, then the lever arm. The identity makes the error that of (3.52).
    """
    mean: FloatArray
    """Observed pose in the map, shape (K, 3) [m, m, rad]."""
    information: FloatArray
    """Inverse covariance of the error (3.52), in the frame of the observed pose, (K, 3, 3)."""
    kind: KindArray
    """`ObservedKind`, shape (K,)."""
    weight: FloatArray
    """Factor on the information, shape (K,); 0 for one that has been removed."""

    def __init__(  # noqa: PLR0917  the columns
        self, node: npt.ArrayLike = (), offset: npt.ArrayLike | None = None,
        mean: npt.ArrayLike | None = None, information: npt.ArrayLike | None = None,
        kind: npt.ArrayLike = (), weight: npt.ArrayLike | None = None,
    ) -> None:
        node = _integers(node, _INT)
        _set(self, 'node', node)
        _set(self, 'offset', _numbers(np.zeros((len(node), 3)) if offset is None else offset))
        _set(self, 'mean', _numbers(_empty(3) if mean is None else mean))
        _set(self, 'information', _numbers(_empty(3, 3) if information is None else information))
        _set(self, 'kind', _integers(kind, _KIND))
        _set(self, 'weight', _weights(weight, len(node)))

    def __len__(self) -> int:
        return len(self.node)

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All columns, in their order."""
        return self.node, self.offset, self.mean, self.information, self.kind, self.weight


_FULL: IntArray = np.array((0, 1, 2, 1, 3, 4, 2, 4, 5))


def full(triangles: FloatArray) -> FloatArray:
    """Return symmetric matrices, shape (M, 3, 3), from their upper triangles, shape (M, 6)."""
    return triangles[:, _FULL].reshape(-1, 3, 3)


def upper(matrices: FloatArray) -> FloatArray:
    """Return upper triangles, (M, 6), row by row, of nearly symmetric matrices, (M, 3, 3)."""
    both = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return np.asarray(both[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)])


_TAILS: dict[str, tuple[int, ...]] = {
    'mean': (3,), 'offset': (3,), 'information': (3, 3), 'bias': (4,)}
_COLUMNS = {table: [(item.name, _TAILS.get(item.name, ())) for item in fields(table)]
            for table in (Edges, ObservedNodes)}


def _check_shapes(table: Edges | ObservedNodes) -> None:
    """Refuse columns of other lengths and shapes than they should have."""
    size = len(table)
    for name, tail in _COLUMNS[type(table)]:
        shape = getattr(table, name).shape
        if shape != (size, *tail):
            raise GraphUpdateError(
                f'{type(table).__name__}.{name}: expected shape {(size, *tail)}, got {shape}')


def check(table: Edges | ObservedNodes, is_bias: npt.NDArray[np.bool_]) -> None:
    """
    Raise unless the rows are sound constraints.

    Parameters
    ----------
    table : Edges or ObservedNodes
    is_bias : ndarray of bool, shape (N,)
        Which of the hidden nodes, which may be the ends, are biases.

    Raises
    ------
    GraphUpdateError
        Says which row, what was expected and what came: shapes, node indices, an edge from a
        node to itself, an edge to a bias that is not of that kind, or the other way round,
        numbers that are not finite, an information matrix that is not symmetric or not positive
        semidefinite.

    """
    _check_shapes(table)
    name, n_nodes = type(table).__name__, len(is_bias)
    for item in fields(table):
        column = getattr(table, item.name)
        _refuse_rows(~np.isfinite(column), f'{name}.{item.name} is not finite', column)
    ends = (table.i, table.j) if isinstance(table, Edges) else (table.node,)
    for end in ends:
        _refuse_rows((end < 0) | (end >= n_nodes),
                     f'{name}: expected a hidden node in 0..{n_nodes - 1}', end)
    kinds = EdgeKind if isinstance(table, Edges) else ObservedKind
    _refuse_rows(table.kind >= len(kinds), f'{name}.kind is no {kinds.__name__}', table.kind)
    _refuse_rows(table.weight < 0.0, f'{name}.weight is negative', table.weight)
    if isinstance(table, Edges):
        _refuse_rows(table.i == table.j, f'{name}: an edge leads from a node to itself', table.i)
        to_bias = table.kind == EdgeKind.BIAS
        _refuse_rows(to_bias & ~is_bias[table.j],
                     f'{name}: expected an edge of kind BIAS to lead to a bias', table.j)
        _refuse_rows(~to_bias & (is_bias[table.i] | is_bias[table.j]),
                     f'{name}: an edge of another kind than BIAS has a bias for an end',
                     np.column_stack((table.i, table.j)))
    _check_information(f'{name}.information', table.information)


def _check_information(name: str, matrix: FloatArray) -> None:
    """Refuse what is not symmetric and positive semidefinite, whatever units its rows have."""
    diagonal = np.diagonal(matrix, axis1=1, axis2=2)
    root = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    with np.errstate(over='ignore'):
        scaled = matrix / root[:, :, None] / root[:, None, :]
    # a correlation beyond 1 is none; how far beyond does not matter, and might overflow
    scaled = np.clip(scaled, -2.0, 2.0)
    skew = np.max(np.abs(scaled - np.swapaxes(scaled, 1, 2)), axis=(1, 2), initial=0.0)
    _refuse_rows(skew > SEMIDEFINITE_TOLERANCE, f'{name} is not symmetric', matrix)
    smallest = np.min(np.linalg.eigvalsh(scaled), axis=-1, initial=np.inf)
    negative = np.any(diagonal < 0.0, axis=-1) | (smallest < -SEMIDEFINITE_TOLERANCE)
    _refuse_rows(negative | ~np.any(matrix, axis=(1, 2)),
                 f'{name} is not positive semidefinite, or zero', matrix)


def _refuse_rows(
    bad: npt.NDArray[np.bool_], reason: str, values: npt.NDArray[np.generic],
) -> None:
    """Raise GraphUpdateError naming the first bad row, if there is one."""
    if np.any(bad):
        row = int(np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))[0])
        raise GraphUpdateError(f'{reason}; row {row}: {values[row].tolist()}')
