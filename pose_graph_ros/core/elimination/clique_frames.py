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
parent works with a linear model of that rotation, and `slip_error2` returns its error, in the
units of the squared linearization error of a constraint.

A prior is a clique without frontal nodes, of which `linearize_prior` writes the update matrix.
`graph.priors` has the equations.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import factors, pools, prior_rows, tables as tb
from pose_graph_ros.core.graph.pools import product, row_start, triangle_size


@kernel
def mean_turn(head, c):  # type: ignore[no-untyped-def]
    """Return the mean heading solution (DELTA) of a clique's separator [rad]."""
    total, members = 0.0, pools.separator(head, c)
    for v in members:
        total += tb.nodes(head)[v].delta[2]
    return total / len(members) if len(members) > 0 else 0.0


@kernel
def present_turn(head, c):  # type: ignore[no-untyped-def]
    """Return the angle of a clique's frame at the present estimate of its separator [rad]."""
    cliques = tb.cliques(head)
    if cliques[c].n_frontal == 0:
        phi = prior_rows.present_frame(head, c)
    elif cliques[c].anchored != 0:
        phi = 0.0
    else:
        phi = mean_turn(head, c) - cliques[c].turn_zero
    return phi if abs(phi) > 1e-12 else 0.0     # rounding


@kernel
def local_delta(f, px, py, cos, sin, phi):  # type: ignore[no-untyped-def]
    """Return the solution delta' of a node, by its row, in a clique's frame of angle phi."""
    x, y = f.reference[0] + f.delta[0] - px, f.reference[1] + f.delta[1] - py
    return (cos * x + sin * y + px - f.reference[0], cos * y - sin * x + py - f.reference[1],
            f.delta[2] - phi)


@kernel
def turned_update(head, c, phi, to):  # type: ignore[no-untyped-def]
    """
    Transform the update matrix of a clique from its frame, of angle phi, into map axes.

    The result, and 6 numbers of work space for each node behind it, are in `to`.
    """
    nodes, members, update = tb.nodes(head), pools.separator(head, c), pools.update_matrix(head, c)
    size, cos, sin = 3 * len(members), math.cos(phi), math.sin(phi)
    first = nodes[members[0]]
    px, py = first.pose[0], first.pose[1]
    # U m - u in local axes, with m of the module's docstring
    work = to[triangle_size(size, size):]
    shift, rest = work[:size], work[size:2 * size]
    for a in range(len(members)):
        f = nodes[members[a]]
        x, y = f.reference[0] - px, f.reference[1] - py
        shift[3 * a], shift[3 * a + 1] = cos * x + sin * y - x, cos * y - sin * x - y
        shift[3 * a + 2] = -phi
    product(update, size, shift, 1.0, rest)
    for i in range(size):
        to[row_start(i, size) + size] = -rest[i]
    rotated_triangle(update, len(members), cos, sin, to)


@kernel
def rotated_triangle(update, n, cos, sin, to):  # type: ignore[no-untyped-def]
    """Rotate the axes of an update matrix, and of a right-hand side in place."""
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
def linearize_prior(head, c, phi, to, work):  # type: ignore[no-untyped-def]
    """
    Write the matrix and right-hand side of a prior whose frame has turned by phi, in map axes.

    They are linearized at the present poses. Work space is 12 numbers for each node.
    """
    nodes, members, update = tb.nodes(head), pools.separator(head, c), pools.update_matrix(head, c)
    n = 3 * len(members)
    prior_rows.evaluate(head, c, phi, work)
    g, r, z = work[n:2 * n], work[2 * n:3 * n], work[3 * n:4 * n]
    product(update, n, r, 0.0, z)
    prior_rows.keep_linearization(head, c, r)
    turned = stiff = 0.0
    for i in range(n):
        turned += g[i] * r[i]
        stiff += z[i] * r[i]
    # P^T U P and P^T g, with P = I - r m^T, m = 3 / n at the headings
    share = 3.0 / n
    for i in range(n):
        at = row_start(i, n)
        of_i = share if i % 3 == 2 else 0.0
        for k in range(i, n):
            of_k = share if k % 3 == 2 else 0.0
            to[at + k] = update[at + k] - z[i] * of_k - of_i * z[k] + stiff * of_i * of_k
        to[at + n] = g[i] - of_i * turned
    if phi != 0.0:
        rotated_triangle(to, len(members), math.cos(phi), math.sin(phi), to)
    # the unknowns are the solutions of the nodes, not changes of them
    for i in range(n):
        z[i] = nodes[members[i // 3]].delta[i % 3]
    product(to, n, z, 1.0, g)
    for i in range(n):
        to[row_start(i, n) + n] = g[i]


@kernel
def slip_error2(head, c, work):  # type: ignore[no-untyped-def]
    """
    Return the squared error [sigma^2] of the parent's linear model of a clique's slip beta [rad].

    An infinitesimal rotation is in the null space of the update matrix U. Of a rotation of the
    local coordinates p by beta this leaves `w = ((1 - cos beta) + (beta - sin beta) S) p`, with
    S = ((0, -1), (1, 0)), and the error w^T U w. The gradient g = U delta' - u has rotated by beta
    as well, which adds beta^2 g^T U^-1 g, approximated by the diagonal of U.

    Of a prior, positions in its frame have changed by D since it was linearized. That adds
    `-beta S D` to w, and `m g^T S D` to the gradient of the frame. A large change of S D against p
    would falsify covariances in any case. Work space is 15 numbers for each separator node.
    """
    nodes, members, update = tb.nodes(head), pools.separator(head, c), pools.update_matrix(head, c)
    row, n = tb.cliques(head)[c], 3 * len(members)
    beta, phi = 0.0, present_turn(head, c)
    if row.parent >= 0 and (row.anchored == 0 or row.n_frontal == 0):   # else it does not slip
        beta = phi - row.turn_seen - present_turn(head, row.parent)
    d, g, r = work[:n], work[n:2 * n], work[2 * n:3 * n]    # r is S p
    w, change = work[3 * n:4 * n], work[4 * n:5 * n]
    if row.n_frontal == 0:
        prior_rows.evaluate(head, c, phi, work)
        # the reference poses, the energy, and r at the linearization: what of it changed is S D
        reference = update[triangle_size(n, n):]
        for i in range(n):
            change[i] = r[i] - reference[n + 1 + i]
        if row.anchored != 0:   # make r the derivative of the coordinates in its frame by -phi
            for i in range(0, n, 3):
                r[i] -= reference[i + 1] - reference[1]
                r[i + 1] += reference[i] - reference[0]
    else:
        change[:] = 0.0
        cos, sin, first = math.cos(phi), math.sin(phi), nodes[members[0]]
        px, py = first.pose[0], first.pose[1]
        for a in range(len(members)):
            f, i = nodes[members[a]], 3 * a
            d[i], d[i + 1], d[i + 2] = local_delta(f, px, py, cos, sin, phi)
            r[i], r[i + 1] = py - d[i + 1] - f.reference[1], d[i] + f.reference[0] - px
        product(update, n, d, 1.0, g)
    versine, lag = 1.0 - math.cos(beta), beta - math.sin(beta)
    of_nodes = of_frame = compliance = moved = arms = error2 = 0.0
    for i in range(0, n, 3):
        w[i] = versine * r[i + 1] + lag * r[i] - beta * change[i]
        w[i + 1] = -versine * r[i] + lag * r[i + 1] - beta * change[i + 1]
        w[i + 2] = 0.0
        iso, heading = prior_rows.diagonal(head, c, i // 3)
        if iso > 0.0:
            of_nodes += (g[i] ** 2 + g[i + 1] ** 2) / iso
        if heading > 0.0:
            compliance += 9.0 / (n * n * heading)
        of_frame += change[i] * g[i] + change[i + 1] * g[i + 1]
        moved += iso * (change[i] ** 2 + change[i + 1] ** 2)
        arms += heading + iso * (r[i] ** 2 + r[i + 1] ** 2)
    product(update, n, w, 0.0, d)
    for i in range(n):
        error2 += w[i] * d[i]
    error2 = max(error2, 0.0) + beta * beta * of_nodes + of_frame * of_frame * compliance
    return error2 + (moved / (arms + 1e-300) if moved > factors.MUCH_LONGER * arms else 0.0)
