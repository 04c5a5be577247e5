# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Cliques that turn as a whole.

A loop closure swings a long part of a graph about a joint. Within that part nothing changes, yet
every linear model in it, made in map axes before the swing, is wrong after it. So each clique has
a frame of its own, which is the map when the clique is eliminated and turns with its separator
afterwards: its rows of R, and its update matrix, are equations in that frame. This is exact as
long as the constraints below are relative ones, which a rigid motion does not change: a clique
below which a node is fixed, observed or tied to a bias is *anchored*, and its frame stays the map.

With phi the angle of the frame and P a point in it, local coordinates are an affine function of
the map's, and so of the unknowns delta:

    x' = R_phi^T (x - P) + P,   th' = th - phi,      delta' = M delta + m,
    M = diag(R_phi^T, 1),       m = (R_phi^T (x_ref - P) + P - x_ref, -phi)

phi is the mean turn of the separator since the elimination. Where it stands does not matter: any
P will do, as translations change nothing at all.

A parent was handed the update matrix with the angle that the frame had then (`TURN_SEEN`). If the
frame has turned against that of the parent since, by beta, the parent works with a linear model
of that turn. `interface_error2` says by how much that is wrong, in the units of the squared
linearization error of a constraint.
"""

import math

from pose_graph_ros.core import tables as tb
from pose_graph_ros.core.cholesky import row_start, triangle_size
from pose_graph_ros.core.jit import kernel

# A smaller turn is none [rad].
LEAST_TURN = 1e-12


@kernel
def mean_turn(head, c):  # type: ignore[no-untyped-def]
    """Return the mean solution of the headings of a clique's separator."""
    clique_i, pool_i, node_f = tb.clique_i(head), tb.pool_i(head), tb.node_f(head)
    row = clique_i[c]
    begin, n = row[tb.NODES] + row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
    total = 0.0
    for k in range(begin, begin + n):
        total += node_f[pool_i[k], tb.DELTA + 2]
    return total / n if n > 0 else 0.0


@kernel
def present_turn(head, c):  # type: ignore[no-untyped-def]
    """Return the angle of a clique's frame at the present estimate of its separator."""
    clique_i, clique_f = tb.clique_i(head), tb.clique_f(head)
    if clique_i[c, tb.ANCHORED] != 0:
        return 0.0
    phi = mean_turn(head, c) - clique_f[c, tb.TURN_ZERO]
    return phi if abs(phi) > LEAST_TURN else 0.0


@kernel
def local_delta(f, px, py, cos, sin, phi):  # type: ignore[no-untyped-def]
    """Return the solution of a node, given as its row, in a frame of angle phi about P."""
    x, y = f[tb.REF] + f[tb.DELTA] - px, f[tb.REF + 1] + f[tb.DELTA + 1] - py
    return (cos * x + sin * y + px - f[tb.REF], cos * y - sin * x + py - f[tb.REF + 1],
            f[tb.DELTA + 2] - phi)


@kernel
def map_delta(f, x, y, px, py, cos, sin):  # type: ignore[no-untyped-def]
    """Return the solution of a position in the map; the inverse of `local_delta`."""
    x, y = x + f[tb.REF] - px, y + f[tb.REF + 1] - py
    return cos * x - sin * y + px - f[tb.REF], sin * x + cos * y + py - f[tb.REF + 1]


@kernel
def turned_update(update, n, nodes, node_f, phi, to):  # type: ignore[no-untyped-def]
    """
    Write an update matrix, with its right-hand side, in map axes.

    Parameters
    ----------
    update : ndarray, flat
        Upper triangle of 3n columns and the right-hand side, as `cholesky.row_start` tells.
    n : int
        Number of separator nodes.
    nodes : ndarray of int32, shape (n,)
    phi : float
        Angle of the frame that it is given in.
    to : ndarray, flat
        As `update`.

    """
    size = 3 * n
    cos, sin = math.cos(phi), math.sin(phi)
    first = node_f[nodes[0]]
    px, py = first[tb.POSE], first[tb.POSE + 1]
    for a in range(n):
        r0, r1, r2 = (row_start(3 * a, size), row_start(3 * a + 1, size),
                      row_start(3 * a + 2, size))
        # u - U m, in local axes; m of each node is its local reference minus its reference
        u0, u1, u2 = update[r0 + size], update[r1 + size], update[r2 + size]
        for b in range(n):
            f = node_f[nodes[b]]
            x, y = f[tb.REF] - px, f[tb.REF + 1] - py
            mx, my = cos * x + sin * y - x, cos * y - sin * x - y
            if b < a:
                p = row_start(3 * b, size) + 3 * a
                q = p + size - 3 * b
                r = q + size - 3 * b - 1
                u0 -= update[p] * mx + update[q] * my - update[r] * phi
                u1 -= update[p + 1] * mx + update[q + 1] * my - update[r + 1] * phi
                u2 -= update[p + 2] * mx + update[q + 2] * my - update[r + 2] * phi
            elif b == a:
                q = 3 * a
                u0 -= update[r0 + q] * mx + update[r0 + q + 1] * my - update[r0 + q + 2] * phi
                u1 -= update[r0 + q + 1] * mx + update[r1 + q + 1] * my - update[r1 + q + 2] * phi
                u2 -= update[r0 + q + 2] * mx + update[r1 + q + 2] * my - update[r2 + q + 2] * phi
            else:
                q = 3 * b
                u0 -= update[r0 + q] * mx + update[r0 + q + 1] * my - update[r0 + q + 2] * phi
                u1 -= update[r1 + q] * mx + update[r1 + q + 1] * my - update[r1 + q + 2] * phi
                u2 -= update[r2 + q] * mx + update[r2 + q + 1] * my - update[r2 + q + 2] * phi
        to[r0 + size], to[r1 + size] = cos * u0 - sin * u1, sin * u0 + cos * u1
        to[r2 + size] = u2
        q = 3 * a
        xx, xy, yy = update[r0 + q], update[r0 + q + 1], update[r1 + q + 1]
        xt, yt = update[r0 + q + 2], update[r1 + q + 2]
        cc, ss, cs = cos * cos, sin * sin, cos * sin
        to[r0 + q] = cc * xx - 2.0 * cs * xy + ss * yy
        to[r0 + q + 1] = cs * (xx - yy) + (cc - ss) * xy
        to[r1 + q + 1] = ss * xx + 2.0 * cs * xy + cc * yy
        to[r0 + q + 2], to[r1 + q + 2] = cos * xt - sin * yt, sin * xt + cos * yt
        to[r2 + q + 2] = update[r2 + q + 2]
        for q in range(3 * (a + 1), size, 3):
            for m in range(3):
                x, y = update[r0 + q + m], update[r1 + q + m]
                to[r0 + q + m], to[r1 + q + m] = cos * x - sin * y, sin * x + cos * y
                to[r2 + q + m] = update[r2 + q + m]
            for r in (r0, r1, r2):
                x, y = to[r + q], to[r + q + 1]
                to[r + q], to[r + q + 1] = cos * x - sin * y, sin * x + cos * y


@kernel
def frame_slip(head, c):  # type: ignore[no-untyped-def]
    """Return the turn of a clique's frame against its parent's since the parent was eliminated."""
    clique_i, clique_f = tb.clique_i(head), tb.clique_f(head)
    f, parent = clique_f[c], clique_i[c, tb.PARENT]
    if clique_i[c, tb.ANCHORED] != 0 or parent < 0:
        return 0.0
    return present_turn(head, c) - f[tb.TURN_SEEN] - present_turn(head, parent)


@kernel
def interface_error2(head, c, beta, work):  # type: ignore[no-untyped-def]
    """
    Return the squared error of the parent's linear model of a slip beta, in units of sigma.

    The update matrix U does not feel an infinitesimal turn, so of the turn by beta of the local
    coordinates v it only feels `w = ((1 - cos beta) + (beta - sin beta) S) v`; and its force
    g = U delta' - u has turned as well.
    """
    clique_i = tb.clique_i(head)
    pool_i, pool_f, node_f = tb.pool_i(head), tb.pool_f(head), tb.node_f(head)
    row = clique_i[c]
    n_frontal, n = row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
    nodes = pool_i[row[tb.NODES] + n_frontal:row[tb.NODES] + n_frontal + n]
    size = 3 * n
    update = pool_f[row[tb.VALUES] + triangle_size(3 * n_frontal, 3 * (n_frontal + n)):]
    phi = present_turn(head, c)
    cos, sin = math.cos(phi), math.sin(phi)
    first = node_f[nodes[0]]
    px, py = first[tb.POSE], first[tb.POSE + 1]
    versine, lag = 1.0 - math.cos(beta), beta - math.sin(beta)
    w, local, force = work[:3 * n], work[3 * n:6 * n], work[6 * n:9 * n]
    for a in range(n):
        f = node_f[nodes[a]]
        x, y, th = local_delta(f, px, py, cos, sin, phi)
        local[3 * a], local[3 * a + 1], local[3 * a + 2] = x, y, th
        x, y = x + f[tb.REF] - px, y + f[tb.REF + 1] - py
        w[3 * a], w[3 * a + 1] = versine * x - lag * y, versine * y + lag * x
        w[3 * a + 2] = 0.0
    error2 = 0.0
    for i in range(size):
        force[i] = -update[row_start(i, size) + size]
    for i in range(size):
        r = update[row_start(i, size):]
        error2 += w[i] * w[i] * r[i]
        force[i] += r[i] * local[i]
        for k in range(i + 1, size):
            error2 += 2.0 * w[i] * w[k] * r[k]
            force[i] += r[k] * local[k]
            force[k] += r[k] * local[i]
    turned = 0.0
    for i in range(0, size, 3):
        stiff = update[row_start(i, size) + i] + update[row_start(i + 1, size) + i + 1]
        if stiff > 0.0:
            turned += 2.0 * (force[i] ** 2 + force[i + 1] ** 2) / stiff
    return max(error2, 0.0) + beta * beta * turned
