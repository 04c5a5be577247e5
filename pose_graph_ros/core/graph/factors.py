# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What solvers need of constraints, derived from the errors in `factor_types` for all types alike.

These are the linearization of a constraint, its linearization error, its energy and gradient, and
what it adds to a front. The unknown of a node is its pose minus a constant reference, delta =
x - x_ref, in map axes. Translation and heading are added as plain numbers, so every constraint may
be linearized at a point of its own. Symbols are those of `factor_types`; a bar marks values at the
linearization point. In map axes an error is

    e' = h + F delta_j - T delta_i,    T = ((1, 0, -a_y), (0, 1, a_x), (0, 0, 1)) at a_bar
    h_t = f_t x_ref_j - x_ref_i + constant + S a_bar delta_bar_th,   h_th constant

(and delta_k enters e_th' by f_th if there is a third node), and its information is turned by
R_bar likewise. The residual of the linear model,

    r = e - R_bar^T e',

depends only on the change of the heading since the linearization and on the present d; unless
positions enter an error otherwise than by d, as they do that of a range, it is the difference that
the heading makes to `error`. The Jacobians change as well: the direction of the weighted error W e
rotates, which changes the gradient by the relative change c of the Jacobian times W e. The squared
linearization error, `r^T W r + c^2 e^T W e` [sigma^2], decides what is linearized again (fluid
relinearization, M. Kaess et al., "iSAM2", IJRR 2012, with whitened errors). Its sum over all
constraints is about the distance of chi2 from its minimum.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel, NUMBERS
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.factor_types import (
    BIAS,
    constant,
    error,
    factors_of_end,
    frame,
    frame_moves,
    heading_offset,
    is_plain,
    is_relative,
    OBSERVED,
    ODOMETRY,
    relative_error,
    rotation,
)

# Smallest squared linearization error for which a constraint is linearized again, as a fraction of
# `SmootherConfig.budget_share`.
LEAST_FRACTION = 0.01
# Squared relative change of the arm of a Jacobian above which it is added to the squared
# linearization error whatever the energy.
MUCH_LONGER = 1e-4
# Angle of a clique's frame, with its cosine and sine.
NO_TURN = (0.0, 1.0, 0.0)


@kernel
def wrap(angle):  # type: ignore[no-untyped-def]
    """Return the angle in [-pi, pi), as `se2.wrap` does."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped if wrapped < math.pi else -math.pi


@kernel
def refer_to_pose(f):  # type: ignore[no-untyped-def]
    """Set the reference of a node, given as its row of node_f, to its pose."""
    for k in range(3):
        f[tb.REF + k] = f[tb.POSE + k]
        f[tb.DELTA + k] = f[tb.SEEN + k] = 0.0
    f[tb.CHECKED_TURN] = 0.0


@kernel(forceinline=True)
def model(f, kind, start, end, third):  # type: ignore[no-untyped-def]
    """
    Return the error of a constraint, the cosine and sine of its frame, and its arm.

    Parameters
    ----------
    f : ndarray, row of the constraint
    kind : int, `EdgeKind` or OBSERVED
    start, end : ndarray, rows of its nodes in node_f; those of an observed node are the same
    third : float, first coordinate of the third node times its factor, 0 without one

    """
    ft, fth = factors_of_end(f, kind)
    c, s = rotation(f, kind, start[tb.POSE + 2])
    ex, ey, c, s, ax, ay = error(
        f, kind, ft * end[tb.POSE] - start[tb.POSE], ft * end[tb.POSE + 1] - start[tb.POSE + 1],
        c, s)
    eth = fth * end[tb.POSE + 2] - start[tb.POSE + 2] + heading_offset(f, kind) + third
    return ex, ey, wrap(eth), c, s, ax, ay


@kernel(forceinline=True)
def _linearize(f, kind, start, end, pose_k, delta_k):  # type: ignore[no-untyped-def]
    """Linearize a constraint; the last two are f_th times POSE and DELTA of the third node."""
    _, _, eth, c, s, ax, ay = model(f, kind, start, end, pose_k)
    _, fth = factors_of_end(f, kind)
    if frame_moves(kind):
        f[tb.LIN_COS], f[tb.LIN_SIN] = c, s
    f[tb.LIN_ARM], f[tb.LIN_ARM + 1], f[tb.LIN_TH] = ax, ay, start[tb.DELTA + 2]
    f[tb.LIN_K] = eth - (fth * end[tb.DELTA + 2] - start[tb.DELTA + 2] + delta_k)


@kernel(forceinline=True)
def _versine_and_sine(turn):  # type: ignore[no-untyped-def]
    """Return cosine minus 1 and sine of an angle, which is small as a rule."""
    if abs(turn) < 0.1:
        # cos - 1 and sin by their series, exact to rounding
        square = turn * turn
        versine = -square * (0.5 - square * (1 / 24 - square * (1 / 720 - square * (
            1 / 40320 - square / 3628800))))
        sine = turn * (1.0 - square * (1 / 6 - square * (1 / 120 - square * (
            1 / 5040 - square * (1 / 362880 - square / 39916800)))))
        return versine, sine
    return math.cos(turn) - 1.0, math.sin(turn)


@kernel(forceinline=True)
def _check(f, kind, start, end, delta_k, clique_turn):  # type: ignore[no-untyped-def]
    """Set the squared linearization error and the energy, as for `check_edge`."""
    phi, cos, sin = clique_turn
    ft, fth = factors_of_end(f, kind)
    dx, dy = ft * end[tb.POSE] - start[tb.POSE], ft * end[tb.POSE + 1] - start[tb.POSE + 1]
    if phi != 0.0:
        dx, dy = cos * dx + sin * dy, cos * dy - sin * dx
    th = start[tb.DELTA + 2]
    turn = th - phi - f[tb.LIN_TH]
    # S a_bar turn, and the linear model, in the axes of the error
    c_bar, s_bar = frame(f, kind)
    bx, by = f[tb.LIN_ARM], f[tb.LIN_ARM + 1]
    gx, gy = c_bar * bx + s_bar * by, c_bar * by - s_bar * bx
    turned = turn * turn
    if is_relative(kind):
        # d in the axes of the linearized frame, and by how much the turn changes it
        qx, qy = c_bar * dx + s_bar * dy, c_bar * dy - s_bar * dx
        versine, sine = _versine_and_sine(turn)
        px, py = versine * qx + sine * qy, versine * qy - sine * qx
        ex, ey = relative_error(f, qx + px, qy + py)
        rx, ry = px - gy * turn, py + gx * turn
    else:   # its clique is anchored, so phi is zero
        c, s = rotation(f, kind, start[tb.POSE + 2])
        kx, ky = constant(f, kind, c_bar, s_bar, bx, by)
        lx = c_bar * (dx + kx) + s_bar * (dy + ky)
        ly = c_bar * (dy + ky) - s_bar * (dx + kx)
        if bx == 0.0 and by == 0.0:
            turned = 0.0
        ex, ey, c, s, _, _ = error(f, kind, dx, dy, c, s)
        rx, ry = ex - lx - gy * turn, ey - ly + gx * turn
        turned += (c - c_bar) ** 2 + (s - s_bar) ** 2
    linear = f[tb.LIN_K] + fth * end[tb.DELTA + 2] - th + delta_k
    eth = wrap(linear)
    if kind == BIAS:    # a factor times a heading that is wrapped
        eth = wrap(fth * end[tb.POSE + 2] - start[tb.POSE + 2] + heading_offset(f, kind))
    rth = eth - linear
    if abs(rth) < 1.0:
        rth = 0.0  # rounding of the wrap; at a jump it is a multiple of 2 pi
    w = f[tb.WEIGHT]
    energy = w * _form(f, ex, ey, eth)
    f[tb.ENERGY] = energy
    if not is_relative(kind):
        f[tb.ERROR2] = w * _form(f, rx, ry, rth) + turned * energy
        return
    # the arm has changed, too; a large change would falsify the covariances even where the energy
    # is zero
    iso = 0.5 * (f[tb.INFO] + f[tb.INFO + 3])
    longer = (ex + f[tb.OWN] - gx) ** 2 + (ey + f[tb.OWN + 1] - gy) ** 2
    longer *= iso / (f[tb.INFO + 5] + iso * (gx * gx + gy * gy) + 1e-300)
    f[tb.ERROR2] = w * _form(f, rx, ry, rth) + (turned + longer) * energy + (
        longer if longer > MUCH_LONGER else 0.0)


@kernel(forceinline=True)
def third(head, e, column):  # type: ignore[no-untyped-def]
    """
    Return the factor of the third node of an edge times one of its numbers, 0 without one.

    Parameters
    ----------
    e : int
    column : int, POSE or DELTA

    """
    k = tb.edge_i(head)[e, tb.END_K]
    return tb.edge_f(head)[e, tb.FACTOR_TH] * tb.node_f(head)[k, column] if k >= 0 else 0.0


@kernel
def linearize_edge(head, e):  # type: ignore[no-untyped-def]
    """Linearize an edge at the present estimate; the caller has logged its row."""
    node_f, row, f = tb.node_f(head), tb.edge_i(head)[e], tb.edge_f(head)[e]
    kind, start, end = row[tb.EDGE_KIND], node_f[row[tb.END_I]], node_f[row[tb.END_J]]
    if is_plain(row):
        _linearize(f, ODOMETRY, start, end, 0.0, 0.0)
    else:
        _linearize(f, kind, start, end, third(head, e, tb.POSE), third(head, e, tb.DELTA))


@kernel
def check_edge(head, e, clique_turn):  # type: ignore[no-untyped-def]
    """
    Set the squared linearization error and the energy of an edge; the caller has logged them.

    Parameters
    ----------
    e : int
    clique_turn : tuple of float
        Turn of its clique's frame since the linearization [rad], see `clique_frames`, with its
        cosine and sine; `NO_TURN` at the linearization and in anchored cliques.

    """
    node_f, row, f = tb.node_f(head), tb.edge_i(head)[e], tb.edge_f(head)[e]
    kind, start, end = row[tb.EDGE_KIND], node_f[row[tb.END_I]], node_f[row[tb.END_J]]
    if is_plain(row):
        _check(f, ODOMETRY, start, end, 0.0, clique_turn)
    else:
        _check(f, kind, start, end, third(head, e, tb.DELTA), clique_turn)


@kernel
def linearize_observed(head, k):  # type: ignore[no-untyped-def]
    """Linearize an observed node at the present estimate; the caller has logged its row."""
    node = tb.node_f(head)[tb.observed_i(head)[k, tb.OBS_NODE]]
    _linearize(tb.observed_f(head)[k], OBSERVED, node, node, 0.0, 0.0)


@kernel
def check_observed(head, k):  # type: ignore[no-untyped-def]
    """Set squared linearization error and energy of an observed node; the caller has logged it."""
    node = tb.node_f(head)[tb.observed_i(head)[k, tb.OBS_NODE]]
    _check(tb.observed_f(head)[k], OBSERVED, node, node, 0.0, NO_TURN)


@kernel(forceinline=True)
def _form(f, x, y, th):  # type: ignore[no-untyped-def]
    """Return e^T information e."""
    i = tb.INFO
    return (x * (f[i] * x + 2.0 * (f[i + 1] * y + f[i + 2] * th))
            + y * (f[i + 3] * y + 2.0 * f[i + 4] * th) + th * f[i + 5] * th)


@kernel(signature=(tb.HEAD, NUMBERS, NUMBERS))
def energies(head, edges, observed):  # type: ignore[no-untyped-def]
    """
    Write the unweighted energies of all constraints at the present poses.

    Parameters
    ----------
    edges, observed : ndarray, shapes (M,) and (K,), output [sigma^2]

    """
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    edge_i, observed_i = tb.edge_i(head), tb.observed_i(head)
    for e in range(head[tb.N_EDGES]):
        row = edge_i[e]
        ex, ey, eth, _, _, _, _ = model(
            edge_f[e], row[tb.EDGE_KIND], node_f[row[tb.END_I]], node_f[row[tb.END_J]],
            third(head, e, tb.POSE))
        edges[e] = _form(edge_f[e], ex, ey, eth)
    for k in range(head[tb.N_OBSERVED]):
        node = node_f[observed_i[k, tb.OBS_NODE]]
        ex, ey, eth, _, _, _, _ = model(observed_f[k], OBSERVED, node, node, 0.0)
        observed[k] = _form(observed_f[k], ex, ey, eth)
