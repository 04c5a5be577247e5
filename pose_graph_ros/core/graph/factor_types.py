# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The types of constraints (factors), each defined here and nowhere else.

`kinds.FACTORS` says which nodes a kind of edge has for ends, which rows its error has, and its tag
in g2o files. `error` has the errors with their Jacobians; `factors` derives from it what solvers
need. Numbers in parentheses are equations of C. Merfels, "Sensor fusion for localization of
automated vehicles", section 3.4.6. A node is x = (t, th), its theta wrapped; R_i and R_z are the
rotations (3.47) of node i and of the measured pose z = (t_z, th_z), o an offset in node i. With
F = diag(f_t, f_t, f_th) and `d = f_t t_j - t_i` the errors are

    odometry, loop closure (3.48)    e = (R_z^T (R_i^T d - t_z), wrap(th_j - th_i - th_z)), F = 1
    bias j of a measurement at i     e = (d + t_z - R_i o, wrap(f_th th_j - th_i + th_z))
    turn (integrated yaw rate)       e_th = wrap(th_j - th_i - th_z + f_th b), b the bias k [rad/s]
    point (landmark j seen from i)   e_t = R_i^T d - t_z
    range (landmark j, antenna o)    e_x = |d - R_i o| - r
    observed node (3.52), F = 0      e = -(R_z^T (t_i + R_i o - t_z), wrap(th_i + th_o - th_z))

A row that a type has not is given no information: a point is an edge without a heading, a turn one
without a position. All of them are, turned into map axes by the rotation R of their *frame*,

    R e_t' = d - S a dth_i + constant,    e_th' = f_th dth_j - dth_i + f_th b + constant

for small changes, S = ((0, -1), (1, 0)). Frame and *arm* a are all that a type says of its
Jacobians; with them `R e_t = d + constant`. Of the heading of i only the rotation by th_i enters,
which is given as (c, s).
"""

import math
from typing import Any

import numpy.typing as npt

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.kinds import EdgeKind

# Numbers of the definitions: kinds of edges, then observed nodes.
ODOMETRY, BIAS, TURN, PRIOR, RANGE = (int(kind) for kind in (
    EdgeKind.ODOMETRY, EdgeKind.BIAS, EdgeKind.TURN, EdgeKind.PRIOR, EdgeKind.RANGE))
OBSERVED = len(EdgeKind)


@kernel(forceinline=True)
def is_relative(kind):  # type: ignore[no-untyped-def]
    """Tell whether an error lies in the frame of the pose that was measured from node i."""
    return kind < BIAS or TURN < kind < RANGE


@kernel(forceinline=True)
def frame_moves(kind):  # type: ignore[no-untyped-def]
    """Tell whether the frame of an error moves with the nodes, so that it is linearized."""
    return is_relative(kind) or kind == RANGE


@kernel(forceinline=True)
def anchors(kind):  # type: ignore[no-untyped-def]
    """Tell whether axes of an edge's errors or unknowns do not turn with its clique."""
    return kind >= BIAS and kind != PRIOR


@kernel(forceinline=True)
def is_plain(row):  # type: ignore[no-untyped-def]
    """
    Tell whether an edge, given as its row of edge_i, has the error of odometry.

    Nearly all edges have it. What is derived from errors is compiled into its callers, once for
    the constant ODOMETRY and once for all kinds: this takes a fifth less time.
    """
    return row[tb.EDGE_KIND] < BIAS


def type_of(kind: npt.NDArray[Any], dimension: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """
    Return the NODE_TYPE of nodes.

    Parameters
    ----------
    kind, dimension : ndarray of int, shape (N,), `NodeKind`, and numbers of coordinates

    """
    return kind + 4 * (3 - dimension)


@kernel
def dimension_of(row):  # type: ignore[no-untyped-def]
    """Return the number of coordinates of a node, given as its row of node_i."""
    return 3 - (row[tb.NODE_TYPE] >> 2)


@kernel
def prepare(f, kind):  # type: ignore[no-untyped-def]
    """
    Set what a row of `edge_f` needs of its mean: `R_z^T t_z`.

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED

    """
    if is_relative(kind):
        c, s = math.cos(f[tb.MEAN + 2]), math.sin(f[tb.MEAN + 2])
        f[tb.OWN] = c * f[tb.MEAN] + s * f[tb.MEAN + 1]
        f[tb.OWN + 1] = c * f[tb.MEAN + 1] - s * f[tb.MEAN]


@kernel(forceinline=True)
def rotation(f, kind, heading):  # type: ignore[no-untyped-def]
    """
    Return cosine and sine of what an error needs of the heading of i: th_i + th_z or th_i.

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED
    heading : float, th_i [rad]

    """
    if is_relative(kind):
        heading += f[tb.MEAN + 2]
    elif f[tb.OFFSET] == 0.0 and f[tb.OFFSET + 1] == 0.0:
        return 1.0, 0.0     # no arm
    return math.cos(heading), math.sin(heading)


@kernel(forceinline=True)
def factors_of_end(f, kind):  # type: ignore[no-untyped-def]
    """
    Return f_t and f_th of node j.

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED

    """
    if kind == BIAS:
        return f[tb.FACTOR_T], f[tb.FACTOR_TH]
    return (1.0, 1.0) if kind < OBSERVED else (0.0, 0.0)


@kernel(forceinline=True)
def heading_offset(f, kind):  # type: ignore[no-untyped-def]
    """
    Return the constant part of the heading's error [rad].

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED

    """
    if kind == BIAS:
        return f[tb.MEAN + 2]
    return -f[tb.MEAN + 2] if kind < OBSERVED else f[tb.MEAN + 2] - f[tb.OFFSET + 2]


@kernel(forceinline=True)
def frame(f, kind):  # type: ignore[no-untyped-def]
    """
    Return cosine and sine of the frame at the linearization.

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED

    """
    if frame_moves(kind):
        return f[tb.LIN_COS], f[tb.LIN_SIN]
    if kind < OBSERVED or f[tb.MEAN + 2] == 0.0:
        return 1.0, 0.0
    return math.cos(f[tb.MEAN + 2]), math.sin(f[tb.MEAN + 2])


@kernel(forceinline=True)
def constant(f, kind, c, s, ax, ay):  # type: ignore[no-untyped-def]
    """
    Return `R e_t - d`, in map axes.

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED
    c, s, ax, ay : float, cosine and sine of the frame R, and arm a [m]

    """
    if is_relative(kind):
        return s * f[tb.OWN + 1] - c * f[tb.OWN], -s * f[tb.OWN] - c * f[tb.OWN + 1]
    if kind == RANGE:
        return -ax - c * f[tb.MEAN], -ay - s * f[tb.MEAN]
    return f[tb.MEAN] - ax, f[tb.MEAN + 1] - ay


@kernel(forceinline=True)
def relative_error(f, x, y):  # type: ignore[no-untyped-def]
    """
    Return e_t of a relative error.

    Parameters
    ----------
    f : ndarray, row of the constraint
    x, y : float, d in the axes of its frame [m]

    """
    return x - f[tb.OWN], y - f[tb.OWN + 1]


@kernel(forceinline=True)
def error(f, kind, dx, dy, c, s):  # type: ignore[no-untyped-def]
    """
    Return the error e_t, cosine and sine of its frame, and its arm a.

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED
    dx, dy : float, `f_t t_j - t_i` [m]
    c, s : float, from `rotation`

    """
    if is_relative(kind):
        ex, ey = relative_error(f, c * dx + s * dy, c * dy - s * dx)
        return ex, ey, c, s, dx, dy
    ox, oy = f[tb.OFFSET], f[tb.OFFSET + 1]
    ax, ay = c * ox - s * oy, s * ox + c * oy
    c, s = 1.0, 0.0
    if kind == RANGE:
        vx, vy = dx - ax, dy - ay
        length = math.sqrt(vx * vx + vy * vy)
        if length > 0.0:
            c, s = vx / length, vy / length
    elif kind == OBSERVED and f[tb.MEAN + 2] != 0.0:
        c, s = math.cos(f[tb.MEAN + 2]), math.sin(f[tb.MEAN + 2])
    kx, ky = constant(f, kind, c, s, ax, ay)
    ex, ey = dx + kx, dy + ky
    return c * ex + s * ey, c * ey - s * ex, c, s, ax, ay
