# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The two types of constraints, as struct of arrays: edges and observed nodes.

An *edge* leads from hidden node i to hidden node j and has the measured pose of j in i. An
*observed node* is a pose measured in the map; it constrains one hidden node. A position is an
observed node whose information on the heading and whose mean heading are zero, so its error lies
in map axes. A heading is an observed node whose information on the position is zero.

A *bias* is a hidden node that is not a pose but the time-correlated error of a source of
measurements, in units of its sigma. Edges of the kind `BIAS` lead to it. `factor_types` has all
kinds of edges, with their errors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Annotated, Any, Self, TypeVar

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.ids import Ids
from pose_graph_ros.core.graph.kinds import EdgeKind, FACTORS, NodeKind, ObservedKind
from pose_graph_ros.core.saved_columns import Choices

__all__ = [
    'SEMIDEFINITE_TOLERANCE',
    'Constraints',
    'EdgeKind',
    'EdgeKinds',
    'Edges',
    'KindArray',
    'NodeKind',
    'ObservedKind',
    'ObservedKinds',
    'ObservedNodes',
    'check',
    'full',
    'upper',
]

KindArray = npt.NDArray[np.uint8]

# How far, with its diagonal scaled to 1, the smallest eigenvalue of an information matrix may be
# below zero and its triangles may differ, because files print few digits.
SEMIDEFINITE_TOLERANCE = 1e-5
# Minors of such a matrix above which it is positive definite without computing eigenvalues.
_MINOR, _ROUNDING = 1e-9, 1e-12


EdgeKinds = Annotated[IntArray, Choices(EdgeKind)]
ObservedKinds = Annotated[IntArray, Choices(ObservedKind)]


@dataclass(frozen=True, slots=True)
class _Table:
    """A table of constraints: columns of equal length."""

    @classmethod
    def joined(cls, tables: Sequence[Self]) -> Self:
        """Return one table with the rows of several, in order."""
        if len(tables) == 0:
            return cls()
        return cls(*map(np.concatenate, zip(*(table.columns for table in tables), strict=True)))

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All columns, in the order of the constructor's arguments."""
        columns: tuple[npt.NDArray[Any], ...] = _COLUMNS[type(self)](self)
        return columns

    @property
    def weighted_information(self) -> FloatArray:
        """Information times weight, shape (M, 3, 3)."""
        information, weight = getattr(self, 'information'), getattr(self, 'weight')  # noqa: B009
        return np.asarray(weight[:, None, None] * information)

    def rows(self, index: IntArray | BoolArray | slice) -> Self:
        """Return a table of some rows."""
        return type(self)(*(column[index] for column in self.columns))

    def renumbered(self, number: Callable[[IntArray], IntArray]) -> Self:
        """Return the same constraints with other numbers for their nodes, e.g. rows for ids."""
        changed = {name: number(getattr(self, name))
                   for name in ('i', 'j', 'node') if hasattr(self, name)}
        third: IntArray | None = getattr(self, 'k', None)
        if third is not None and np.any(third >= 0):
            changed['k'] = third.copy()
            changed['k'][third >= 0] = number(third[third >= 0])
        return replace(self, **changed)


Constraints = TypeVar('Constraints', bound=_Table)

# The constructors of the frozen tables set columns by this.
_set = object.__setattr__


_NO_ROWS, _NO_MATRICES = np.empty((0, 3)), np.empty((0, 3, 3))
_FLOAT, _INT, _KIND = (np.dtype(kind) for kind in (np.float64, np.int64, np.uint8))


def _numbers(values: npt.ArrayLike) -> FloatArray:
    """Return an array of floats."""
    if type(values) is np.ndarray and values.dtype is _FLOAT:
        return values   # the usual case, in a third of the time
    return np.asarray(values, dtype=_FLOAT)


def _integers(values: npt.ArrayLike, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return an array of integers; raise for numbers of another type instead of rounding them."""
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
    ones.fill(1.0)  # np.ones takes three times as long for short arrays
    return ones


def _no_nodes(size: int) -> IntArray:
    none = np.empty(size, dtype=_INT)
    none.fill(-1)
    return none


@dataclass(frozen=True, slots=True)
class Edges(_Table):
    """
    M directed edges.

    Parameters
    ----------
    i, j : array_like of int, shape (M,), nodes that the edges start from and lead to
    mean : array_like, shape (M, 3)
        Measured poses of j in i [m, m, rad]; of edges to a bias those of i in the map, of ranges
        the distance (r, 0, 0).
    information : array_like, shape (M, 3, 3)
        Inverse covariances of the errors (3.48), in the frames of the measured poses; of edges to
        a bias in map axes. It is zero in rows that the error of the kind has not.
    kind : array_like of int, shape (M,), `EdgeKind`
    weight : array_like, shape (M,), optional, factors on the information: 0 removed, default 1
    bias : array_like, shape (M, 4), optional
        Measured offset in i and factors of the bias, `(o_x, o_y, f_t, f_th)` [m, m, m, rad]; used
        for edges to a bias, of a range (o_x, o_y), of a turn f_th, the duration [s].
    k : array_like of int, shape (M,), optional, third nodes: of turns the bias; -1, the default

    """

    i: IntArray
    j: IntArray
    mean: FloatArray
    information: FloatArray
    kind: KindArray
    weight: FloatArray
    bias: FloatArray
    k: IntArray

    def __init__(
        self, i: npt.ArrayLike = (), j: npt.ArrayLike = (), mean: npt.ArrayLike = _NO_ROWS,
        information: npt.ArrayLike = _NO_MATRICES, kind: npt.ArrayLike = (),
        weight: npt.ArrayLike | None = None, bias: npt.ArrayLike | None = None,
        k: npt.ArrayLike | None = None,
    ) -> None:
        i = _integers(i, _INT)
        _set(self, 'i', i)
        _set(self, 'j', _integers(j, _INT))
        _set(self, 'mean', _numbers(mean))
        _set(self, 'information', _numbers(information))
        _set(self, 'kind', _integers(kind, _KIND))
        _set(self, 'weight', _weights(weight, len(i)))
        _set(self, 'bias', np.zeros((len(i), 4)) if bias is None else _numbers(bias))
        _set(self, 'k', _no_nodes(len(i)) if k is None else _integers(k, _INT))

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, slots=True)
class ObservedNodes(_Table):
    """
    K observed nodes, each with one constraint.

    Parameters
    ----------
    node : array_like of int, shape (K,), hidden nodes that are observed
    offset : array_like, shape (K, 3), optional
        Poses of the observed frames in the hidden nodes [m, m, rad]: motion by odometry since the
        hidden node, then the lever arm. The identity, which is the default, makes the error that
        of (3.52).
    mean : array_like, shape (K, 3), observed poses in the map [m, m, rad]
    information : array_like, shape (K, 3, 3)
        Inverse covariances of the errors (3.52), in the frames of the observed poses.
    kind : array_like of int, shape (K,), `ObservedKind`
    weight : array_like, shape (K,), optional, factors on the information: 0 removed, default 1

    """

    node: IntArray
    offset: FloatArray
    mean: FloatArray
    information: FloatArray
    kind: KindArray
    weight: FloatArray

    def __init__(
        self, node: npt.ArrayLike = (), offset: npt.ArrayLike | None = None,
        mean: npt.ArrayLike = _NO_ROWS, information: npt.ArrayLike = _NO_MATRICES,
        kind: npt.ArrayLike = (), weight: npt.ArrayLike | None = None,
    ) -> None:
        node = _integers(node, _INT)
        _set(self, 'node', node)
        _set(self, 'offset', _numbers(np.zeros((len(node), 3)) if offset is None else offset))
        _set(self, 'mean', _numbers(mean))
        _set(self, 'information', _numbers(information))
        _set(self, 'kind', _integers(kind, _KIND))
        _set(self, 'weight', _weights(weight, len(node)))

    def __len__(self) -> int:
        return len(self.node)

    def weighted(self, weight: float) -> 'ObservedNodes':
        """Return the same observed nodes with another weight."""
        return ObservedNodes(self.node, self.offset, self.mean, self.information, self.kind,
                             np.full(len(self), weight))


_FULL: IntArray = np.array((0, 1, 2, 1, 3, 4, 2, 4, 5))


def full(triangles: FloatArray) -> FloatArray:
    """Return symmetric matrices, shape (M, 3, 3), from their upper triangles, shape (M, 6)."""
    return np.ascontiguousarray(triangles[:, _FULL]).reshape(-1, 3, 3)


def upper(matrices: FloatArray) -> FloatArray:
    """Return upper triangles, (M, 6), row by row, of nearly symmetric matrices, (M, 3, 3)."""
    both = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return np.asarray(both[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)])


_COLUMNS: dict[type, Any] = {
    table: attrgetter(*(item.name for item in fields(table))) for table in (Edges, ObservedNodes)}
# Shapes of the rows of columns that are not of numbers.
_ROW_SHAPES = {'mean': (3,), 'offset': (3,), 'information': (3, 3), 'bias': (4,)}


def check(
    table: Edges | ObservedNodes, kind: npt.NDArray[Any], dimension: IntArray | None = None,
    nodes: Ids | None = None,
) -> None:
    """
    Raise GraphUpdateError for invalid constraints, with the row, what was expected and the value.

    Invalid are wrong shapes, kinds or nodes, negative weights, an edge from a node to itself, a
    node of a kind that the kind of edge does not have for this end, numbers that are not finite,
    numbers in rows that an error has not, an information matrix that is zero, not symmetric or not
    positive semidefinite.

    Parameters
    ----------
    table : Edges or ObservedNodes
    kind : ndarray, shape (N,), `NodeKind` of the hidden nodes, by row
    dimension : ndarray of int, shape (N,), optional, by default 2 for landmarks, 3 for others
    nodes : Ids, optional, of the hidden nodes; by default they are the rows

    """
    name, ids = type(table).__name__, Ids(len(kind)) if nodes is None else nodes
    columns = {item.name: getattr(table, item.name) for item in fields(table)}
    for key, column in columns.items():
        expected = (len(table), *_ROW_SHAPES.get(key, ()))
        if column.shape != expected:
            raise GraphUpdateError(
                f'{name}.{key}: expected shape {expected}, got {column.shape}')
    for key, column in columns.items():
        _refuse_rows(~np.isfinite(column), f'{name}.{key} is not finite', column)
    ends = ((table.i, table.j, table.k[table.k != -1])
            if isinstance(table, Edges) else (table.node,))
    for end in ends:
        _refuse_rows((end < 0) | (end >= ids.end),
                     f'{name}: expected a hidden node in 0..{ids.end - 1}', end)
        gone = np.flatnonzero(ids.rows(end) < 0)
        if len(gone) > 0:
            raise GraphUpdateError(
                f'{name}: hidden node {end[gone[0]]} has left the graph; row {gone[0]}')
    known = tuple(FACTORS) if isinstance(table, Edges) else tuple(ObservedKind)
    _refuse_rows(~np.isin(table.kind, known),
                 f'{name}.kind is none of {", ".join(each.name for each in known)}', table.kind)
    _refuse_rows(table.weight < 0.0, f'{name}.weight is negative', table.weight)
    if dimension is None:
        dimension = np.where(kind == NodeKind.LANDMARK, 2, 3)
    if isinstance(table, Edges):
        _refuse_rows(table.i == table.j, f'{name}: an edge leads from a node to itself', table.i)
        _check_ends(table, kind, ids)
        rows = np.array([np.isin(range(3), factor.rows) for factor in FACTORS.values()])
        missing = ~rows[table.kind]
        _refuse_rows(missing & (table.mean != 0.0),
                     f'{name}.mean: expected 0 in rows that the error has not', table.mean)
        least = np.where(table.kind == EdgeKind.BIAS, np.minimum(
            dimension[ids.rows(table.i)], dimension[ids.rows(table.j)]), 3)
    else:
        least, missing = dimension[ids.rows(table.node)], np.zeros((len(table), 3), dtype=bool)
    missing = missing | (np.arange(3) >= least[:, None])
    diagonal = np.diagonal(table.information, axis1=1, axis2=2)
    _refuse_rows(missing & (diagonal != 0.0), f'{name}.information: expected 0 in rows that the '
                 'error or the node has not', diagonal)
    check_information(f'{name}.information', table.information)


def _check_ends(edges: Edges, kind: npt.NDArray[Any], ids: Ids) -> None:
    """Raise GraphUpdateError if an edge has a node of the wrong kind for an end."""
    for each, factor in FACTORS.items():
        rows = edges.kind == each
        for end, allowed in (('i', factor.i), ('j', factor.j), ('k', factor.k)):
            node = getattr(edges, end)
            wrong = rows & (node >= 0) & ~np.isin(kind[ids.rows(node)], allowed)
            expected = ' or '.join(item.name.lower() for item in allowed) or 'none'
            _refuse_rows(wrong, f'Edges.{end}: expected an edge of kind {each.name} to have '
                         f'{expected} for this end', node)


def check_information(name: str, matrix: FloatArray) -> None:
    """Raise unless matrices are symmetric and positive semidefinite, whatever units they have."""
    diagonal, scaled = np.diagonal(matrix, axis1=1, axis2=2), _scaled(matrix)
    skew = np.max(np.abs(scaled - np.swapaxes(scaled, 1, 2)), axis=(1, 2), initial=0.0)
    _refuse_rows(skew > SEMIDEFINITE_TOLERANCE, f'{name} is not symmetric', matrix)
    smallest = np.zeros(len(matrix))
    doubtful = ~_are_definite(scaled)
    smallest[doubtful] = np.min(
        np.linalg.eigvalsh(scaled[doubtful]), axis=-1, initial=np.inf)
    negative = np.any(diagonal < 0.0, axis=-1) | (smallest < -SEMIDEFINITE_TOLERANCE)
    _refuse_rows(negative | ~np.any(matrix, axis=(1, 2)),
                 f'{name} is not positive semidefinite, or zero', matrix)


def are_definite(information: FloatArray) -> BoolArray:
    """Tell which matrices, shape (M, 3, 3), are clearly positive definite, whatever their unit."""
    return _are_definite(_scaled(information))


def _scaled(matrix: FloatArray) -> FloatArray:
    """Return matrices with 1 in place of each positive number on the diagonal."""
    diagonal = np.diagonal(matrix, axis1=1, axis2=2)
    root = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    with np.errstate(over='ignore'):
        scaled = matrix / root[:, :, None] / root[:, None, :]
    # correlations beyond 1 are invalid however large they are, and might overflow
    return np.clip(scaled, -2.0, 2.0)


def _are_definite(scaled: FloatArray) -> BoolArray:
    """Tell for which matrices with 1 on the diagonal the leading minors are clearly positive."""
    a, b, c = scaled[:, 0, 1], scaled[:, 0, 2], scaled[:, 1, 2]
    diagonal = np.diagonal(scaled, axis1=1, axis2=2)
    determinant = 1.0 + 2.0 * a * b * c - a * a - b * b - c * c
    return np.asarray(np.all(np.abs(diagonal - 1.0) < _ROUNDING, axis=1)
                      & (1.0 - a * a > _MINOR) & (determinant > _MINOR))


def _refuse_rows(
    bad: BoolArray, reason: str, values: npt.NDArray[np.generic],
) -> None:
    """Raise GraphUpdateError with the first bad row, if there is one."""
    if np.any(bad):
        row = int(np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))[0])
        raise GraphUpdateError(f'{reason}; row {row}: {values[row].tolist()}')
