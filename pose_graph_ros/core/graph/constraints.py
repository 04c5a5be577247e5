# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of nodes, and the factors (constraints) as struct of arrays.

A factor has one, two or three hidden nodes for ends. One with two ends, an *edge*, leads from node
i to node j and has the measured pose of j in i. One with a single end, an *observed node*, has a
pose of i that was measured in the map. A position is an observed node whose information on the
heading and whose mean heading are zero, so its error lies in map axes. A heading is one whose
information on the position is zero.

A *bias* is a hidden node that is not a pose but the time-correlated error of a source of
measurements, in units of its sigma. Edges of the kind `BIAS` lead to it. `factors` has the errors
of all kinds. Nothing in here is compiled, so that programs which read a file and work on arrays
need not load Numba.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from operator import attrgetter
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.saved_columns import Choices, Column, Integers, Numbers, Rows3, Rows4


class NodeKind(IntEnum):
    """What a hidden node is."""

    POSE = 0
    BIAS = 1        # time-correlated error of a source of measurements, of dimension 1 to 3
    LANDMARK = 2    # a point in the map, of dimension 2


class FactorKind(IntEnum):
    """What was measured; the kinds from GLOBAL_POSE on have one end, and the same error."""

    ODOMETRY = 0
    LOOP_CLOSURE = 1
    # leads to a bias j, from the pose i that was measured with it or from the next bias i; the
    # error is `F x_j + mean - x_i * offset` in map axes, F = diag(f_t, f_t, f_th)
    BIAS = 2
    TURN = 3    # change of the heading, as from a gyro, whose bias, if any, is the third node
    POINT = 4   # position of landmark j in the frame of i
    PRIOR = 5   # what marginalisation leaves of edges between poses; the error is that of odometry
    RANGE = 6   # distance of landmark j from a point of the robot i
    GLOBAL_POSE = 7
    POSITION = 8
    HEADING = 9
    NODE_PRIOR = 10     # what marginalisation leaves on a single node


class FactorType(NamedTuple):
    """What checks, files and pictures need to know of a kind of factors."""

    name: str
    i: tuple[NodeKind, ...]         # kinds of nodes that it may start from
    j: tuple[NodeKind, ...] = ()    # none where it has one end
    k: tuple[NodeKind, ...] = ()    # of the third node, which may be missing
    # rows that the error has; mean and information are zero in the others
    rows: tuple[int, ...] = (0, 1, 2)
    constants: tuple[int, ...] = ()     # columns of `Factors.constants` that it uses
    # tag in g2o files, followed by i, j and, of the rows that it has, mean and upper triangle of
    # the information
    tag: str = ''

    @property
    def places(self) -> bool:
        """Whether its mean is a position of j in the frame of i."""
        return self.rows[:2] == (0, 1) and self.j not in {(), (NodeKind.BIAS,)}


_POSE, _BIAS, _LANDMARK = (NodeKind.POSE,), (NodeKind.BIAS,), (NodeKind.LANDMARK,)
FACTORS = {
    FactorKind.ODOMETRY: FactorType('odometry', _POSE, _POSE, tag='EDGE_SE2'),
    FactorKind.LOOP_CLOSURE: FactorType('loop closure', _POSE, _POSE, tag='EDGE_SE2'),
    FactorKind.BIAS: FactorType('bias', (*_POSE, *_BIAS), _BIAS, constants=(0, 1, 2, 3)),
    FactorKind.TURN: FactorType('turn', _POSE, _POSE, _BIAS, rows=(2,), constants=(3,)),
    FactorKind.POINT: FactorType('point', _POSE, _LANDMARK, rows=(0, 1), tag='EDGE_SE2_XY'),
    FactorKind.PRIOR: FactorType('prior', _POSE, _POSE, tag='EDGE_SE2'),
    FactorKind.RANGE: FactorType(
        'range', _POSE, _LANDMARK, rows=(0,), constants=(0, 1), tag='EDGE_RANGE_SE2_XY'),
    **{kind: FactorType(kind.name.lower().replace('_', ' '), tuple(NodeKind), constants=(0, 1, 2))
       for kind in FactorKind if kind >= FactorKind.GLOBAL_POSE},
}

KindArray = npt.NDArray[np.uint8]
FactorKinds = Annotated[IntArray, Choices(FactorKind)]

# The constructor of the frozen table sets columns by this.
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
class Factors:
    """M factors; raises GraphUpdateError for ends and kinds that are no integers."""

    i: Integers     # nodes that they start from, or that are observed
    j: Integers     # nodes that they lead to; -1 for one end, in the map
    # measured poses of j in i, shape (M, 3) [m, m, rad]; with one end and of edges to a bias those
    # of i in the map, of ranges the distance (r, 0, 0)
    mean: Rows3
    # inverse covariances of the errors, shape (M, 3, 3), in the frames of the measured poses; of
    # edges to a bias in map axes; zero in rows that the error of the kind has not
    information: Annotated[FloatArray, Column(float, (3, 3))]
    kind: Annotated[KindArray, Choices(FactorKind)]
    weight: Numbers  # what the information is multiplied by: 0 removed, by default 1
    # what else the error depends on, shape (M, 4): with one end the offset (o_x, o_y, o_th, 0)
    # [m, m, rad], that is, motion by odometry since the node, then the lever arm; of edges to a
    # bias the offset in i and the factors of the bias, (o_x, o_y, f_t, f_th) [m, m, m, rad]; of a
    # range (o_x, o_y), of a turn f_th, the duration [s]
    constants: Rows4
    k: Integers     # third nodes: of turns the bias; -1, the default, for none

    def __init__(
        self, i: npt.ArrayLike = (), j: npt.ArrayLike = (), mean: npt.ArrayLike = _NO_ROWS,
        information: npt.ArrayLike = _NO_MATRICES, kind: npt.ArrayLike = (),
        weight: npt.ArrayLike | None = None, constants: npt.ArrayLike | None = None,
        k: npt.ArrayLike | None = None,
    ) -> None:
        i = _integers(i, _INT)
        n = len(i)
        _set(self, 'i', i)
        _set(self, 'j', _integers(j, _INT))
        _set(self, 'mean', _numbers(mean))
        _set(self, 'information', _numbers(information))
        _set(self, 'kind', _integers(kind, _KIND))
        _set(self, 'weight', _filled(n, 1.0, _FLOAT) if weight is None else _numbers(weight))
        _set(self, 'constants', np.zeros((n, 4)) if constants is None else _numbers(constants))
        _set(self, 'k', _filled(n, -1, _INT) if k is None else _integers(k, _INT))

    @classmethod
    def on(
        cls, node: npt.ArrayLike = (), offset: npt.ArrayLike | None = None,
        mean: npt.ArrayLike = _NO_ROWS, information: npt.ArrayLike = _NO_MATRICES,
        kind: npt.ArrayLike = (), weight: npt.ArrayLike | None = None,
    ) -> 'Factors':
        """Return observed nodes; the offset is the identity by default."""
        node = _integers(node, _INT)
        constants = np.zeros((len(node), 4))
        if offset is not None:
            constants[:, :3] = offset
        return cls(node, _filled(len(node), -1, _INT), mean, information, kind, weight, constants)

    def __len__(self) -> int:
        return len(self.i)

    @classmethod
    def joined(cls, tables: 'Sequence[Factors]') -> 'Factors':
        """Return one table with the rows of several, in order."""
        if len(tables) == 0:
            return cls()
        return cls(*map(np.concatenate, zip(*(table.columns for table in tables), strict=True)))

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All columns, in the order of the constructor's arguments."""
        columns: tuple[npt.NDArray[Any], ...] = _COLUMNS(self)
        return columns

    @property
    def offset(self) -> FloatArray:
        """Offsets of observed nodes, shape (M, 3) [m, m, rad]."""
        return self.constants[:, :3]

    @property
    def edges(self) -> 'Factors':
        """Those between nodes."""
        return self.rows(self.j >= 0)

    @property
    def observed(self) -> 'Factors':
        """Those with one end."""
        return self.rows(self.j < 0)

    @property
    def weighted_information(self) -> FloatArray:
        """Information times weight, shape (M, 3, 3)."""
        return np.asarray(self.weight[:, None, None] * self.information)

    def rows(self, index: IntArray | BoolArray | slice) -> 'Factors':
        """Return a table of some rows."""
        return Factors(*(column[index] for column in self.columns))

    def weighted(self, weight: npt.ArrayLike) -> 'Factors':
        """Return the same factors with other weights, or all with the same one."""
        return replace(self, weight=np.broadcast_to(weight, (len(self),)).astype(np.float64))

    def renumbered(self, number: Callable[[IntArray], IntArray]) -> 'Factors':
        """Return the same factors with other numbers for their nodes, e.g. rows for ids."""
        def of(end: IntArray) -> IntArray:
            present = end >= 0
            if np.all(present):
                return number(end)
            changed = end.copy()
            changed[present] = number(end[present])
            return changed

        return replace(self, i=number(self.i), j=of(self.j), k=of(self.k))


_COLUMNS = attrgetter(*(item.name for item in fields(Factors)))


def full(triangles: FloatArray) -> FloatArray:
    """Return symmetric matrices, shape (M, 3, 3), from their upper triangles, shape (M, 6)."""
    return np.ascontiguousarray(triangles[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)]).reshape(-1, 3, 3)


def upper(matrices: FloatArray) -> FloatArray:
    """Return upper triangles, (M, 6), row by row, of nearly symmetric matrices, (M, 3, 3)."""
    both = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return np.asarray(both[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)])
