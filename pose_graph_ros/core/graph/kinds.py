# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of nodes and constraints, and what files, pictures and checks need to know of them.

Their errors are in `factor_types`. Nothing in here is compiled, so that programs which read a file
and work on arrays need not load Numba.
"""

from enum import IntEnum
from typing import NamedTuple


class NodeKind(IntEnum):
    """What a hidden node is."""

    POSE = 0
    BIAS = 1
    """Time-correlated error of a source of measurements, of dimension 1 to 3."""
    LANDMARK = 2
    """A point in the map, of dimension 2."""


class EdgeKind(IntEnum):
    """Where an edge comes from."""

    ODOMETRY = 0
    LOOP_CLOSURE = 1
    BIAS = 2
    """
    Leads to a bias j, from the pose i that was measured with it or from the next bias i; the error
    is `F x_j + mean - x_i * offset` in map axes, F = diag(f_t, f_t, f_th).
    """
    TURN = 3
    """Change of the heading, as from a gyro, whose bias is the third node if there is one."""
    POINT = 4
    """Position of landmark j in the frame of i."""
    PRIOR = 5
    """What marginalisation leaves of edges between poses; the error is that of odometry."""
    RANGE = 6
    """Distance of landmark j from a point of the robot i."""


class ObservedKind(IntEnum):
    """What was measured of an observed node; the error is the same for all kinds."""

    GLOBAL_POSE = 0
    POSITION = 1
    HEADING = 2
    PRIOR = 3
    """What marginalisation leaves."""


class FactorType(NamedTuple):
    """What `constraints.check`, files and pictures need to know of a kind of edges."""

    name: str
    i: tuple[NodeKind, ...]
    """Kinds of nodes that the edge may start from."""
    j: tuple[NodeKind, ...]
    k: tuple[NodeKind, ...] = ()
    """Kinds of the third node, which may be missing."""
    rows: tuple[int, ...] = (0, 1, 2)
    """Rows that the error has; mean and information are zero in the others."""
    bias: tuple[int, ...] = ()
    """Columns of `Edges.bias` that it uses."""
    tag: str = ''
    """
    Tag in g2o files, followed by i, j and, of the rows that it has, mean and upper triangle of the
    information.
    """

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
