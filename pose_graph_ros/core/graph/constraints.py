# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of nodes, and the two types of constraints as struct of arrays: edges, observed nodes.

An *edge* leads from hidden node i to hidden node j and has the measured pose of j in i. An
*observed node* is a pose measured in the map; it constrains one hidden node. A position is an
observed node whose information on the heading and whose mean heading are zero, so its error lies
in map axes. A heading is an observed node whose information on the position is zero.

A *bias* is a hidden node that is not a pose but the time-correlated error of a source of
measurements, in units of its sigma. Edges of the kind `BIAS` lead to it. `factors` has the errors
of all kinds. Nothing in here is compiled, so that programs which read a file and work on arrays
need not load Numba.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from operator import attrgetter
from typing import Annotated, Any, NamedTuple, Self, TypeVar

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.saved_columns import Choices


class NodeKind(IntEnum):
    """What a hidden node is."""

    POSE = 0
    BIAS = 1        # time-correlated error of a source of measurements, of dimension 1 to 3
    LANDMARK = 2    # a point in the map, of dimension 2


class EdgeKind(IntEnum):
    """Where an edge comes from."""

    ODOMETRY = 0
    LOOP_CLOSURE = 1
    # leads to a bias j, from the pose i that was measured with it or from the next bias i; the
    # error is `F x_j + mean - x_i * offset` in map axes, F = diag(f_t, f_t, f_th)
    BIAS = 2
    TURN = 3    # change of the heading, as from a gyro, whose bias, if any, is the third node
    POINT = 4   # position of landmark j in the frame of i
    PRIOR = 5   # what marginalisation leaves of edges between poses; the error is that of odometry
    RANGE = 6   # distance of landmark j from a point of the robot i


class ObservedKind(IntEnum):
    """What was measured of an observed node; the error is the same for all kinds."""

    GLOBAL_POSE = 0
    POSITION = 1
    HEADING = 2
    PRIOR = 3   # what marginalisation leaves


class FactorType(NamedTuple):
    """What checks, files and pictures need to know of a kind of edges."""

    name: str
    i: tuple[NodeKind, ...]         # kinds of nodes that the edge may start from
    j: tuple[NodeKind, ...]
    k: tuple[NodeKind, ...] = ()    # of the third node, which may be missing
    # rows that the error has; mean and information are zero in the others
    rows: tuple[int, ...] = (0, 1, 2)
    bias: tuple[int, ...] = ()      # columns of `Edges.bias` that it uses
    # tag in g2o files, followed by i, j and, of the rows that it has, mean and upper triangle of
    # the information
    tag: str = ''

    @property
    def places(self) -> bool:
        """Whether its mean is a position of j in the frame of i."""
        return self.rows[:2] == (0, 1) and self.j != (NodeKind.BIAS,)


_POSE, _BIAS, _LANDMARK = (NodeKind.POSE,), (NodeKind.BIAS,), (NodeKind.LANDMARK,)
FACTORS = {
    EdgeKind.ODOMETRY: FactorType('odometry', _POSE, _POSE, tag='EDGE_SE2'),
    EdgeKind.LOOP_CLOSURE: FactorType('loop closure', _POSE, _POSE, tag='EDGE_SE2'),
    EdgeKind.BIAS: FactorType('bias', (*_POSE, *_BIAS), _BIAS, bias=(0, 1, 2, 3)),
    EdgeKind.TURN: FactorType('turn', _POSE, _POSE, _BIAS, rows=(2,), bias=(3,)),
    EdgeKind.POINT: FactorType('point', _POSE, _LANDMARK, rows=(0, 1), tag='EDGE_SE2_XY'),
    EdgeKind.PRIOR: FactorType('prior', _POSE, _POSE, tag='EDGE_SE2'),
    EdgeKind.RANGE: FactorType(
        'range', _POSE, _LANDMARK, rows=(0,), bias=(0, 1), tag='EDGE_RANGE_SE2_XY'),
}

KindArray = npt.NDArray[np.uint8]
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


def _filled(size: int, value: float, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    column = np.empty(size, dtype)
    column.fill(value)  # np.full takes three times as long for short arrays
    return column


@dataclass(frozen=True, slots=True)
class Edges(_Table):
    """M directed edges; raises GraphUpdateError for ends and kinds that are no integers."""

    i: IntArray     # nodes that they start from
    j: IntArray     # nodes that they lead to
    # measured poses of j in i, shape (M, 3) [m, m, rad]; of edges to a bias those of i in the map,
    # of ranges the distance (r, 0, 0)
    mean: FloatArray
    # inverse covariances of the errors (3.48), shape (M, 3, 3), in the frames of the measured
    # poses; of edges to a bias in map axes; zero in rows that the error of the kind has not
    information: FloatArray
    kind: KindArray
    weight: FloatArray  # factors on the information: 0 removed, by default 1
    # measured offset in i and factors of the bias, (o_x, o_y, f_t, f_th), shape (M, 4)
    # [m, m, m, rad]: of edges to a bias, of a range (o_x, o_y), of a turn f_th, the duration [s]
    bias: FloatArray
    k: IntArray     # third nodes: of turns the bias; -1, the default, for none

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
        _set(self, 'weight', _filled(len(i), 1.0, _FLOAT) if weight is None else _numbers(weight))
        _set(self, 'bias', np.zeros((len(i), 4)) if bias is None else _numbers(bias))
        _set(self, 'k', _filled(len(i), -1, _INT) if k is None else _integers(k, _INT))

    def __len__(self) -> int:
        return len(self.i)


@dataclass(frozen=True, slots=True)
class ObservedNodes(_Table):
    """K observed nodes, each with one constraint; raises GraphUpdateError as `Edges`."""

    node: IntArray  # hidden nodes that are observed
    # poses of the observed frames in the hidden nodes, shape (K, 3) [m, m, rad]: motion by
    # odometry since the hidden node, then the lever arm; the identity, which is the default, makes
    # the error that of (3.52)
    offset: FloatArray
    mean: FloatArray    # observed poses in the map, shape (K, 3) [m, m, rad]
    # inverse covariances of the errors (3.52), shape (K, 3, 3), in the observed frames
    information: FloatArray
    kind: KindArray
    weight: FloatArray  # factors on the information: 0 removed, by default 1

    def __init__(
        self, node: npt.ArrayLike = (), offset: npt.ArrayLike | None = None,
        mean: npt.ArrayLike = _NO_ROWS, information: npt.ArrayLike = _NO_MATRICES,
        kind: npt.ArrayLike = (), weight: npt.ArrayLike | None = None,
    ) -> None:
        node = _integers(node, _INT)
        n = len(node)
        _set(self, 'node', node)
        _set(self, 'offset', np.zeros((n, 3)) if offset is None else _numbers(offset))
        _set(self, 'mean', _numbers(mean))
        _set(self, 'information', _numbers(information))
        _set(self, 'kind', _integers(kind, _KIND))
        _set(self, 'weight', _filled(n, 1.0, _FLOAT) if weight is None else _numbers(weight))

    def __len__(self) -> int:
        return len(self.node)

    @property
    def as_edges(self) -> Edges:
        """The same as edges to the map, -1, whose column `bias` begins with the offset."""
        n = len(self)
        bias = np.zeros((n, 4))
        bias[:, :3] = self.offset
        return Edges(self.node, _filled(n, -1, _INT), self.mean, self.information, self.kind,
                     self.weight, bias)

    def weighted(self, weight: float) -> 'ObservedNodes':
        """Return the same observed nodes with another weight."""
        return replace(self, weight=np.full(len(self), weight))


_COLUMNS: dict[type, Any] = {
    table: attrgetter(*(item.name for item in fields(table))) for table in (Edges, ObservedNodes)}


def full(triangles: FloatArray) -> FloatArray:
    """Return symmetric matrices, shape (M, 3, 3), from their upper triangles, shape (M, 6)."""
    return np.ascontiguousarray(triangles[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)]).reshape(-1, 3, 3)


def upper(matrices: FloatArray) -> FloatArray:
    """Return upper triangles, (M, 6), row by row, of nearly symmetric matrices, (M, 3, 3)."""
    both = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return np.asarray(both[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)])
