# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a prior adds to the front of its parent; `graph.priors` has the equations."""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.elimination.clique_frames import rotated_triangle
from pose_graph_ros.core.graph import factors, prior_rows, tables as tb
from pose_graph_ros.core.graph.pools import row_start


@kernel
def linearize(head, c, phi, to, work):  # type: ignore[no-untyped-def]
    """
    Write the matrix and the right-hand side of a prior, linearized at the present poses.

    They are in map axes.

    Parameters
    ----------
    c : int, row of the prior
    phi : float, turn of its frame [rad]
    to : ndarray, flat, receives 3k columns and the right-hand side, laid out by `pools.row_start`
    work : ndarray, work space of 12 numbers for each node

    """
    node_f, pool_i, pool_f = tb.node_f(head), tb.pool_i(head), tb.pool_f(head)
    row = tb.clique_i(head)[c]
    n, begin = 3 * row[tb.N_SEPARATOR], row[tb.NODES]
    update = pool_f[row[tb.VALUES]:]
    prior_rows.evaluate(head, c, phi, work)
    g, r, z = work[n:2 * n], work[2 * n:3 * n], work[3 * n:4 * n]
    prior_rows.product(head, c, r, z)
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
        rotated_triangle(to, row[tb.N_SEPARATOR], math.cos(phi), math.sin(phi), to)
    # the unknowns are the solutions of the nodes, not changes of them
    for i in range(n):
        g[i] = -to[row_start(i, n) + n]
    for i in range(n):
        at, x = row_start(i, n), node_f[pool_i[begin + i // 3], tb.DELTA + i % 3]
        g[i] += to[at + i] * x
        for k in range(i + 1, n):
            g[i] += to[at + k] * node_f[pool_i[begin + k // 3], tb.DELTA + k % 3]
            g[k] += to[at + k] * x
    for i in range(n):
        to[row_start(i, n) + n] = g[i]


@kernel
def linearization_error2(head, c, work):  # type: ignore[no-untyped-def]
    """
    Return the squared linearization error of a prior that turns with its nodes [sigma^2].

    Since it was linearized its frame has turned by beta against that of its parent, and positions
    in the frame have changed by D. The displacement then differs from its linear model by
    `w = ((1 - cos beta) + (beta - sin beta) S) p - beta S D`, p the positions, and gradients have
    turned: that of the nodes by beta, as in `clique_frames.interface_error2`, and that of the
    frame by `m g^T S D`. A large change of S D against p would falsify covariances in any case.

    Parameters
    ----------
    c : int, row of the prior; it has a parent
    work : ndarray, work space of 15 numbers for each node

    """
    row, pool_f = tb.clique_i(head)[c], tb.pool_f(head)
    n = 3 * row[tb.N_SEPARATOR]
    beta = clique_frames.frame_slip(head, c)
    prior_rows.evaluate(head, c, clique_frames.present_turn(head, c), work)
    g, r, w = work[n:2 * n], work[2 * n:3 * n], work[3 * n:4 * n]
    change = work[4 * n:5 * n]
    prior_rows.change_of_frame(head, c, r, change)
    if row[tb.ANCHORED] != 0:
        prior_rows.add_reference_arms(head, c, r)
    versine, lag = 1.0 - math.cos(beta), beta - math.sin(beta)
    of_nodes = of_frame = compliance = moved = arms = 0.0
    for i in range(0, n, 3):
        w[i] = versine * r[i + 1] + lag * r[i] - beta * change[i]
        w[i + 1] = -versine * r[i] + lag * r[i + 1] - beta * change[i + 1]
        w[i + 2] = 0.0
        k = row[tb.VALUES] + row_start(i, n) + i
        iso = 0.5 * (pool_f[k] + pool_f[row[tb.VALUES] + row_start(i + 1, n) + i + 1])
        heading = pool_f[row[tb.VALUES] + row_start(i + 2, n) + i + 2]
        if iso > 0.0:
            of_nodes += (g[i] ** 2 + g[i + 1] ** 2) / iso
        if heading > 0.0:
            compliance += 9.0 / (n * n * heading)
        of_frame += change[i] * g[i] + change[i + 1] * g[i + 1]
        moved += iso * (change[i] ** 2 + change[i + 1] ** 2)
        arms += heading + iso * (r[i] ** 2 + r[i + 1] ** 2)
    error2 = beta * beta * of_nodes + of_frame * of_frame * compliance
    if moved > factors.MUCH_LONGER * arms:
        error2 += moved / (arms + 1e-300)
    prior_rows.product(head, c, w, change)
    for i in range(n):
        error2 += w[i] * change[i]
    return max(error2, 0.0)
