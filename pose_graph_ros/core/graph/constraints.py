# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of nodes, and the factors (constraints) as records.

A factor has one, two or three hidden nodes for ends. One with two ends, an *edge*, leads from node
i to node j and has the measured pose of j in i. One with a single end, an *observed node*, has a
pose of i that was measured in the map. A position is an observed node whose information on the
heading and whose mean heading are zero, so its error lies in map axes. A heading is one whose
information on the position is zero.

A *bias* is a hidden node that is not a pose but the time-correlated error of a source of
measurements, in units of its sigma. Edges of the kind `BIAS` lead to it. That of a gyroscope, and
what an odometry is calibrated by, bias of the yaw rate and error of the scale, is the third node
of its edges. `factors` has the errors of all kinds. Nothing in here is compiled, so that programs
which read a file and work on arrays need not load Numba.
"""

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray


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
    TURN = 3    # change of the heading, as from a gyro
    POINT = 4   # position of landmark j in the frame of i
    PRIOR = 5   # what marginalisation leaves of edges between poses; the error is that of odometry
    RANGE = 6   # distance of landmark j from a point of the robot i
    GLOBAL_POSE = 7
    POSITION = 8
    HEADING = 9
    NODE_PRIOR = 10     # what marginalisation leaves on a single node


class FactorType(NamedTuple):
    """What checks, files and pictures need to know of a kind of factors."""

    i: tuple[NodeKind, ...]         # kinds of nodes that it may start from
    j: tuple[NodeKind, ...] = ()    # none where it has one end
    k: tuple[NodeKind, ...] = ()    # of the third node, which may be missing
    # rows that the error has; mean and information are zero in the others
    rows: tuple[int, ...] = (0, 1, 2)
    constants: tuple[int, ...] = ()     # columns of `Factors.constants` that it uses
    # tag in g2o files of two ends, followed by i, j and, of its rows, which begin with x, mean and
    # upper triangle of the information
    tag: str = ''

    @property
    def places(self) -> bool:
        """Whether its mean is a position of j in the frame of i."""
        return self.rows[:2] == (0, 1) and self.j not in {(), (NodeKind.BIAS,)}


_POSE, _BIAS, _LANDMARK = (NodeKind.POSE,), (NodeKind.BIAS,), (NodeKind.LANDMARK,)
FACTORS = {
    FactorKind.ODOMETRY: FactorType(_POSE, _POSE, _BIAS, constants=(3,), tag='EDGE_SE2'),
    FactorKind.LOOP_CLOSURE: FactorType(_POSE, _POSE, tag='EDGE_SE2'),
    FactorKind.BIAS: FactorType((*_POSE, *_BIAS), _BIAS, constants=(0, 1, 2, 3)),
    FactorKind.TURN: FactorType(_POSE, _POSE, _BIAS, rows=(2,), constants=(3,)),
    FactorKind.POINT: FactorType(_POSE, _LANDMARK, rows=(0, 1), tag='EDGE_SE2_XY'),
    FactorKind.PRIOR: FactorType(_POSE, _POSE, tag='EDGE_SE2'),
    FactorKind.RANGE: FactorType(
        _POSE, _LANDMARK, rows=(0,), constants=(0, 1), tag='EDGE_RANGE_SE2_XY'),
    **{kind: FactorType(tuple(NodeKind), constants=(0, 1, 2))
       for kind in FactorKind if kind >= FactorKind.GLOBAL_POSE},
}
# tables by kind are in this order, as a kind is its number
assert list(FACTORS) == list(FactorKind)

_NO_ROWS, _NO_MATRICES = np.empty((0, 3)), np.empty((0, 3, 3))

# One factor, as it goes into a graph and comes out of it. The fields are in the order of the
# arguments of `Factors`, whose comments say what they are.
RECORD = np.dtype([
    ('i', 'i8'), ('j', 'i8'), ('mean', 'f8', (3,)), ('information', 'f8', (3, 3)), ('kind', 'i8'),
    ('weight', 'f8'), ('constants', 'f8', (4,)), ('k', 'i8')])
_INTEGERS = frozenset({'i', 'j', 'kind', 'k'})
_WITH_DEFAULTS = frozenset({'weight', 'constants', 'k'})    # for which a number will do
_AS_BYTES = np.dtype((np.void, RECORD.itemsize))    # NumPy takes rows six times as fast


class _Column:
    """A field of all records, as an attribute."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, table: 'Factors', owner: type) -> npt.NDArray[Any]:
        column: npt.NDArray[Any] = table.records[self._name]
        return column


class Factors:
    """
    M factors, as records with views of their columns.

    Raises GraphUpdateError for a column of another shape, and for ends and kinds that are no
    integers.
    """

    __slots__ = ('records',)

    i = _Column()       # nodes that they start from, or that are observed
    j = _Column()       # nodes that they lead to; -1 for one end, in the map
    # measured poses of j in i, shape (M, 3) [m, m, rad]; with one end and of edges to a bias those
    # of i in the map, of ranges the distance (r, 0, 0)
    mean = _Column()
    # inverse covariances of the errors, shape (M, 3, 3), in the frames of the measured poses; of
    # edges to a bias in map axes; zero in rows that the error of the kind has not
    information = _Column()
    kind = _Column()
    weight = _Column()  # what the information is multiplied by: 0 removed, by default 1
    # what else the error depends on, shape (M, 4): with one end the offset (o_x, o_y, o_th, 0)
    # [m, m, rad], that is, motion by odometry since the node, then the lever arm; of edges to a
    # bias the offset in i and the factors of the bias, (o_x, o_y, f_t, f_th) [m, m, m, rad]; of a
    # range (o_x, o_y); of edges with a third node for how long its bias acts, negative for one
    # that the motion lacks, (0, 0, 0, f) [s]
    constants = _Column()
    k = _Column()       # third nodes; -1, the default, for none

    def __init__(self, i: npt.ArrayLike = (), j: npt.ArrayLike = (),
                 mean: npt.ArrayLike = _NO_ROWS, information: npt.ArrayLike = _NO_MATRICES,
                 kind: npt.ArrayLike = (), weight: npt.ArrayLike = 1.0,
                 constants: npt.ArrayLike = 0.0, k: npt.ArrayLike = -1) -> None:
        self.records = np.empty(len(np.atleast_1d(i)), RECORD)
        self.assign(i=i, j=j, mean=mean, information=information, kind=kind, weight=weight,
                    constants=constants, k=k)

    def assign(self, **columns: npt.ArrayLike) -> None:
        """Set columns; a single number will do for weight, constants and k."""
        for name, values in columns.items():
            column, array = self.records[name], np.asarray(values)
            if array.shape != column.shape and (array.ndim > 0 or name not in _WITH_DEFAULTS):
                raise GraphUpdateError(
                    f'Factors.{name}: expected shape {column.shape}, got {array.shape}')
            kinds, what = ('iu', 'integers') if name in _INTEGERS else ('iuf', 'numbers')
            if array.dtype.kind not in kinds and array.size > 0:
                raise GraphUpdateError(
                    f'Factors.{name}: expected {what}, got {array.dtype} {array.tolist()}')
            column[...] = array

    @classmethod
    def on(cls, node: npt.ArrayLike = (), offset: npt.ArrayLike | None = None,
           mean: npt.ArrayLike = _NO_ROWS, information: npt.ArrayLike = _NO_MATRICES,
           kind: npt.ArrayLike = (), weight: npt.ArrayLike = 1.0) -> 'Factors':
        """Return observed nodes; the offset is the identity by default."""
        node = np.asarray(node)
        table = cls(node, np.full(len(node), -1), mean, information, kind, weight)
        if offset is not None:
            table.constants[:, :3] = offset
        return table

    @classmethod
    def of(cls, records: npt.NDArray[Any]) -> 'Factors':
        """Return a table of records, which are not copied."""
        table = cls.__new__(cls)
        table.records = records
        return table

    def __len__(self) -> int:
        return len(self.records)

    @classmethod
    def joined(cls, tables: 'Sequence[Factors]') -> 'Factors':
        """Return one table with the rows of several, in order; a single one itself."""
        if len(tables) <= 1:
            return tables[0] if len(tables) == 1 else cls()
        return cls.of(np.concatenate([
            table.records.view(_AS_BYTES) for table in tables]).view(RECORD))

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All columns, in the order of the constructor's arguments."""
        return tuple(self.records[name] for name in RECORD.fields or ())

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
        """Return a table of some rows; of a slice it is a view."""
        if isinstance(index, slice):
            return Factors.of(self.records[index])
        return Factors.of(self.records.view(_AS_BYTES)[index].view(RECORD))

    def replaced(self, **columns: npt.ArrayLike) -> 'Factors':
        """Return the same factors with other columns; for a weight a single number will do."""
        table = Factors.of(self.records.copy())
        table.assign(**columns)
        return table

    def renumbered(self, number: Callable[[IntArray], IntArray]) -> 'Factors':
        """Return the same factors with other numbers for their nodes, e.g. rows for ids."""
        table = Factors.of(self.records.copy())
        for end in (table.i, table.j, table.k):
            present = end >= 0
            end[present] = number(end[present])
        return table


def full(triangles: FloatArray) -> FloatArray:
    """Return symmetric matrices, shape (M, 3, 3), from their upper triangles, shape (M, 6)."""
    return np.ascontiguousarray(triangles[:, (0, 1, 2, 1, 3, 4, 2, 4, 5)]).reshape(-1, 3, 3)


def upper(matrices: FloatArray) -> FloatArray:
    """Return upper triangles, (M, 6), row by row, of nearly symmetric matrices, (M, 3, 3)."""
    both = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return np.asarray(both[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)])
