# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Clique frames: a clique rotates with its separator, so that its linear model stays valid.

A loop closure rotates a long part of a graph about one of its nodes. The relative poses within
that part do not change, but its linear models, made in map axes before the rotation, are wrong
after it. So each clique has a frame of its own. The frame coincides with the map when the clique
is eliminated and turns with the separator afterwards; the clique's rows of R and its update matrix
are equations in that frame. This is exact as long as all constraints at and below the clique are
relative, because a rigid motion does not change those. A clique is *anchored* if a node at or
below it is fixed, observed or connected to a bias; its frame remains the map.

With phi the angle of the frame and P a point in it, local coordinates are an affine function of
map coordinates, and so of the unknowns delta:

    x' = R_phi^T (x - P) + P,   th' = th - phi,      delta' = M delta + m,
    M = diag(R_phi^T, 1),       m = (R_phi^T (x_ref - P) + P - x_ref, -phi)

phi is the mean rotation of the separator since the elimination. P may be any point, because a
translation changes no linear model.

`TURN_SEEN` is the angle of the frame when the update matrix was added to the parent's front. The
*slip* beta is by how much the frame has turned relative to the parent's frame since then. The
parent works with a linear model of that rotation, and `interface_error2` returns its error, in the
units of the squared linearization error of a constraint.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import prior_rows, tables as tb
from pose_graph_ros.core.graph.pools import row_start, triangle_size

# Angles of a frame below this are set to zero [rad].
LEAST_TURN = 1e-12


@kernel
def mean_turn(head, c):  # type: ignore[no-untyped-def]
    """Return the mean heading solution (DELTA) of a clique's separator [rad]."""
    clique_i, pool_i, node_f = tb.clique_i(head), tb.pool_i(head), tb.node_f(head)
    row = clique_i[c]
    begin, n = row[tb.NODES] + row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
    total = 0.0
    for k in range(begin, begin + n):
        total += node_f[pool_i[k], tb.DELTA + 2]
    return total / n if n > 0 else 0.0


@kernel
def present_turn(head, c):  # type: ignore[no-untyped-def]
    """Return the angle of a clique's frame at the present estimate of its separator [rad]."""
    clique_i, clique_f = tb.clique_i(head), tb.clique_f(head)
    if clique_i[c, tb.N_FRONTAL] == 0:
        phi = prior_rows.present_frame(head, c)
    elif clique_i[c, tb.ANCHORED] != 0:
        phi = 0.0
    else:
        phi = mean_turn(head, c) - clique_f[c, tb.TURN_ZERO]
    return phi if abs(phi) > LEAST_TURN else 0.0


@kernel
def local_delta(f, px, py, cos, sin, phi):  # type: ignore[no-untyped-def]
    """
    Return the solution delta' of a node in a clique's frame.

    Parameters
    ----------
    f : ndarray, row of the node in `node_f`
    px, py : float, point P in the map [m]
    cos, sin, phi : float, angle of the frame [rad], with its cosine and sine

    """
    x, y = f[tb.REF] + f[tb.DELTA] - px, f[tb.REF + 1] + f[tb.DELTA + 1] - py
    return (cos * x + sin * y + px - f[tb.REF], cos * y - sin * x + py - f[tb.REF + 1],
            f[tb.DELTA + 2] - phi)


@kernel
def map_delta(f, x, y, px, py, cos, sin):  # type: ignore[no-untyped-def]
    """
    Return the position part of a node's solution in map axes, the inverse of `local_delta`.

    Parameters
    ----------
    f : ndarray, row of the node in `node_f`
    x, y : float, position part of delta' [m]
    px, py, cos, sin : float, as for `local_delta`

    """
    x, y = x + f[tb.REF] - px, y + f[tb.REF + 1] - py
    return cos * x - sin * y + px - f[tb.REF], sin * x + cos * y + py - f[tb.REF + 1]


@kernel
def turned_update(update, n, nodes, node_f, phi, to):  # type: ignore[no-untyped-def]
    """
    Transform an update matrix and its right-hand side from a clique's frame into map axes.

    Parameters
    ----------
    update : ndarray, flat, 3n columns and the right-hand side, laid out by `pools.row_start`
    n : int, number of separator nodes
    nodes : ndarray of int32, shape (n,), separator nodes
    node_f : ndarray, table of the nodes
    phi : float, angle of the clique's frame [rad]
    to : ndarray, flat, receives the result, laid out as `update`

    """
    size = 3 * n
    cos, sin = math.cos(phi), math.sin(phi)
    first = node_f[nodes[0]]
    px, py = first[tb.POSE], first[tb.POSE + 1]
    for a in range(n):
        r0, r1, r2 = (row_start(3 * a, size), row_start(3 * a + 1, size),
                      row_start(3 * a + 2, size))
        # u - U m in local axes, with m of the module's docstring
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
        to[r0 + size], to[r1 + size], to[r2 + size] = u0, u1, u2
    rotated_triangle(update, n, cos, sin, to)


@kernel
def rotated_triangle(update, n, cos, sin, to):  # type: ignore[no-untyped-def]
    """
    Rotate the axes of an update matrix, and of a right-hand side in place.

    Parameters
    ----------
    update : ndarray, flat, 3n columns, laid out by `pools.row_start`
    n : int, number of nodes
    cos, sin : float, of the angle of the present axes in the new ones
    to : ndarray, flat, laid out as `update` or `update` itself
        Receives the matrix, and has the right-hand side.

    """
    size = 3 * n
    for a in range(n):
        r0, r1, r2 = (row_start(3 * a, size), row_start(3 * a + 1, size),
                      row_start(3 * a + 2, size))
        x, y = to[r0 + size], to[r1 + size]
        to[r0 + size], to[r1 + size] = cos * x - sin * y, sin * x + cos * y
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
    """Return a clique's slip [rad], which is 0 if it does not turn or has no parent."""
    clique_i, clique_f = tb.clique_i(head), tb.clique_f(head)
    f, parent = clique_f[c], clique_i[c, tb.PARENT]
    if parent < 0 or (clique_i[c, tb.ANCHORED] != 0 and clique_i[c, tb.N_FRONTAL] > 0):
        return 0.0
    return present_turn(head, c) - f[tb.TURN_SEEN] - present_turn(head, parent)


@kernel
def interface_error2(head, c, beta, work):  # type: ignore[no-untyped-def]
    """
    Return the squared error [sigma^2] of the parent's linear model of a slip.

    An infinitesimal rotation is in the null space of the update matrix U. Of a rotation of the
    local coordinates v by beta this leaves `w = ((1 - cos beta) + (beta - sin beta) S) v`, with
    S = ((0, -1), (1, 0)), and the error w^T U w. The gradient g = U delta' - u has rotated by beta
    as well, which adds beta^2 g^T U^-1 g, approximated by the diagonal of U.

    Parameters
    ----------
    c : int, row of the clique; it has a parent
    beta : float, slip [rad]
    work : ndarray, work space of 9 numbers for each separator node

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
    w, local, gradient = work[:3 * n], work[3 * n:6 * n], work[6 * n:9 * n]
    for a in range(n):
        f = node_f[nodes[a]]
        x, y, th = local_delta(f, px, py, cos, sin, phi)
        local[3 * a], local[3 * a + 1], local[3 * a + 2] = x, y, th
        x, y = x + f[tb.REF] - px, y + f[tb.REF + 1] - py
        w[3 * a], w[3 * a + 1] = versine * x - lag * y, versine * y + lag * x
        w[3 * a + 2] = 0.0
    error2 = 0.0
    for i in range(size):
        gradient[i] = -update[row_start(i, size) + size]
    for i in range(size):
        r = update[row_start(i, size):]
        error2 += w[i] * w[i] * r[i]
        gradient[i] += r[i] * local[i]
        for k in range(i + 1, size):
            error2 += 2.0 * w[i] * w[k] * r[k]
            gradient[i] += r[k] * local[k]
            gradient[k] += r[k] * local[i]
    turned = 0.0
    for i in range(0, size, 3):
        scale = update[row_start(i, size) + i] + update[row_start(i + 1, size) + i + 1]
        if scale > 0.0:
            turned += 2.0 * (gradient[i] ** 2 + gradient[i + 1] ** 2) / scale
    return max(error2, 0.0) + beta * beta * turned
