# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Priors in the tables: cliques without frontal nodes.

What is left of a clique whose nodes and constraints have left the graph is its separator and its
update matrix. So a prior is a leaf of the tree, its update matrix is added to the front of
its parent like that of any child, and it turns with its separator as the frame of a clique does.
Its block in the pool has the update matrix (U, u), then the reference poses of its nodes, then the
energy at these, then r (`displacement`) at the last linearization, and r as it was when the update
began that has linearized it. `priors` has the equations.

A prior that no clique is the parent of is *loose*: it is new, or all cliques were removed. Its
nodes are touched, so the next step takes it in.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import pools, tables as tb, transaction_log
from pose_graph_ros.core.graph.factors import wrap
from pose_graph_ros.core.graph.kinds import NodeKind
from pose_graph_ros.core.graph.normal_equations import weakest_of
from pose_graph_ros.core.graph.pools import row_start, triangle_size

# Parent of a prior that this update has removed.
REMOVED = -2
_POSE = int(NodeKind.POSE)


@kernel
def is_prior(head, c):  # type: ignore[no-untyped-def]
    """Tell whether a row of the cliques is a prior of the graph."""
    row = tb.clique_i(head)[c]
    return row[tb.N_FRONTAL] == 0 and row[tb.PARENT] != REMOVED


@kernel
def _references(row):  # type: ignore[no-untyped-def]
    """Return where in pool_f the reference poses of a prior begin, given its row."""
    n = 3 * row[tb.N_SEPARATOR]
    return row[tb.VALUES] + triangle_size(n, n)


@kernel
def turns(head, c):  # type: ignore[no-untyped-def]
    """Tell whether a prior has a frame that turns with its nodes; see `priors.turns`."""
    node_i, pool_i, row = tb.node_i(head), tb.pool_i(head), tb.clique_i(head)[c]
    if row[tb.ANCHORED] == 0:
        return True
    for k in range(row[tb.NODES], row[tb.NODES] + row[tb.N_SEPARATOR]):
        if node_i[pool_i[k], tb.NODE_TYPE] != _POSE:
            return False
    return row[tb.N_SEPARATOR] > 1


@kernel
def mean_turn(head, c):  # type: ignore[no-untyped-def]
    """Return the mean turn of the nodes of a prior from their references [rad]."""
    node_f, pool_i, row = tb.node_f(head), tb.pool_i(head), tb.clique_i(head)[c]
    reference = tb.pool_f(head)[_references(row):]
    begin, n = row[tb.NODES], row[tb.N_SEPARATOR]
    first = wrap(node_f[pool_i[begin], tb.POSE + 2] - reference[2])
    total = 0.0
    for k in range(1, n):
        turn = node_f[pool_i[begin + k], tb.POSE + 2] - reference[3 * k + 2]
        total += wrap(turn - first)
    return first + total / n


@kernel
def displacement(head, c, phi, d, r):  # type: ignore[no-untyped-def]
    """
    Write the displacement d of the nodes of a prior, and its derivative r by -phi.

    Parameters
    ----------
    c : int, row of the prior
    phi : float, turn of its frame [rad], from `present_frame`
    d, r : ndarray, shape (3k,), output; r is zero if the prior does not turn

    """
    node_f, pool_i, row = tb.node_f(head), tb.pool_i(head), tb.clique_i(head)[c]
    reference = tb.pool_f(head)[_references(row):]
    begin, n = row[tb.NODES], row[tb.N_SEPARATOR]
    if not turns(head, c):
        for k in range(n):
            f, i = node_f[pool_i[begin + k]], 3 * k
            d[i], d[i + 1] = f[tb.POSE] - reference[i], f[tb.POSE + 1] - reference[i + 1]
            d[i + 2] = wrap(f[tb.POSE + 2] - reference[i + 2])
            r[i] = r[i + 1] = r[i + 2] = 0.0
        return
    cos, sin = math.cos(phi), math.sin(phi)
    first = node_f[pool_i[begin]]
    turn = wrap(first[tb.POSE + 2] - reference[2])
    anchored = row[tb.ANCHORED] != 0
    # the point about which it turns, and how much of a rigid turn about it is displacement
    px = reference[0] if anchored else first[tb.POSE]
    py = reference[1] if anchored else first[tb.POSE + 1]
    tangent = 1.0 if anchored else 0.0
    for k in range(n):
        f, i = node_f[pool_i[begin + k]], 3 * k
        dx, dy = f[tb.POSE] - px, f[tb.POSE + 1] - py
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        rx, ry = reference[i] - reference[0], reference[i + 1] - reference[1]
        d[i], d[i + 1] = x - rx - tangent * phi * ry, y - ry + tangent * phi * rx
        d[i + 2] = (turn - (1.0 - tangent) * phi
                    + wrap(f[tb.POSE + 2] - reference[i + 2] - turn))
        r[i], r[i + 1], r[i + 2] = tangent * ry - y, x - tangent * rx, 1.0 - tangent


@kernel
def keep_linearization(head, c, r):  # type: ignore[no-untyped-def]
    """
    Remember where a prior was linearized; a rollback restores the last linearization.

    Parameters
    ----------
    c : int, row of the prior
    r : ndarray, shape (3k,), from `displacement`

    """
    row, pool_f = tb.clique_i(head)[c], tb.pool_f(head)
    n = 3 * row[tb.N_SEPARATOR]
    at = _references(row) + n + 1
    transaction_log.log_clique(head, c)
    if row[tb.VALUES_BORN] != head[tb.UPDATE]:
        row[tb.VALUES_BORN] = head[tb.UPDATE]
        for k in range(at, at + n):
            pool_f[k + n] = pool_f[k]
    for k in range(n):
        pool_f[at + k] = r[k]


@kernel
def change_of_frame(head, c, r, out):  # type: ignore[no-untyped-def]
    """
    Write the change of r since a prior was linearized: S times that of the relative positions.

    Parameters
    ----------
    c : int, row of the prior
    r, out : ndarray, shape (3k,); r is the present one

    """
    row, pool_f = tb.clique_i(head)[c], tb.pool_f(head)
    n = 3 * row[tb.N_SEPARATOR]
    at = _references(row) + n + 1
    for k in range(n):
        out[k] = r[k] - pool_f[at + k]


@kernel
def add_reference_arms(head, c, r):  # type: ignore[no-untyped-def]
    """
    Make r of an anchored prior the derivative of the coordinates in its frame by -phi.

    Parameters
    ----------
    c : int, row of the prior
    r : ndarray, shape (3k,), from `displacement`

    """
    row = tb.clique_i(head)[c]
    reference = tb.pool_f(head)[_references(row):]
    for i in range(0, 3 * row[tb.N_SEPARATOR], 3):
        r[i] -= reference[i + 1] - reference[1]
        r[i + 1] += reference[i] - reference[0]


@kernel
def product(head, c, x, out):  # type: ignore[no-untyped-def]
    """
    Write U x.

    Parameters
    ----------
    c : int, row of the prior
    x, out : ndarray, shape (3k,)

    """
    row, pool_f = tb.clique_i(head)[c], tb.pool_f(head)
    n = 3 * row[tb.N_SEPARATOR]
    out[:n] = 0.0
    for i in range(n):
        u = pool_f[row[tb.VALUES] + row_start(i, n):]
        total = u[i] * x[i]
        for k in range(i + 1, n):
            total += u[k] * x[k]
            out[k] += u[k] * x[i]
        out[i] += total


@kernel
def evaluate(head, c, phi, work):  # type: ignore[no-untyped-def]
    """
    Return the energy of a prior at the present poses.

    Parameters
    ----------
    c : int, row of the prior
    phi : float, turn of its frame [rad], from `present_frame`
    work : ndarray, work space of 9 numbers for each node
        Receives the displacement d, half the gradient U d - u in the frame, and r.

    """
    row, pool_f = tb.clique_i(head)[c], tb.pool_f(head)
    n = 3 * row[tb.N_SEPARATOR]
    d, g, r = work[:n], work[n:2 * n], work[2 * n:3 * n]
    displacement(head, c, phi, d, r)
    product(head, c, d, g)
    energy = pool_f[_references(row) + n]
    for i in range(n):
        u = pool_f[row[tb.VALUES] + row_start(i, n) + n]
        energy += d[i] * (g[i] - 2.0 * u)
        g[i] -= u
    return energy


@kernel
def present_frame(head, c):  # type: ignore[no-untyped-def]
    """Return the turn of the frame of a prior [rad], which is 0 if it does not turn."""
    return mean_turn(head, c) if turns(head, c) else 0.0


@kernel
def gradient(head, c, work):  # type: ignore[no-untyped-def]
    """
    Return the energy of a prior, with half its gradient in map axes.

    Parameters
    ----------
    c : int, row of the prior
    work : ndarray, work space of 9 numbers for each node; the gradient is `work[3k:6k]`

    """
    phi = present_frame(head, c)
    energy = evaluate(head, c, phi, work)
    n = 3 * tb.clique_i(head)[c, tb.N_SEPARATOR]
    g, r = work[n:2 * n], work[2 * n:3 * n]
    turned = 0.0
    for i in range(n):
        turned += g[i] * r[i]
    cos, sin = math.cos(phi), math.sin(phi)
    for i in range(0, n, 3):
        x, y = g[i], g[i + 1]
        g[i], g[i + 1] = cos * x - sin * y, sin * x + cos * y
        g[i + 2] -= 3.0 * turned / n
    return energy


@kernel
def update_energy(head, c):  # type: ignore[no-untyped-def]
    """Set the energy of a prior to that at the present poses, and correct chi2 by the change."""
    clique_f, scalars = tb.clique_f(head), tb.scalars(head)
    energy = evaluate(head, c, present_frame(head, c), tb.work_f(head))
    scalars[tb.CHI2] += energy - clique_f[c, tb.PRIOR_ENERGY]
    clique_f[c, tb.PRIOR_ENERGY] = energy


@kernel
def add_energies(head):  # type: ignore[no-untyped-def]
    """Evaluate all priors at the present poses and add their energies to chi2."""
    clique_f = tb.clique_f(head)
    for c in range(head[tb.N_CLIQUES] if head[tb.N_PRIORS] > 0 else 0):
        if is_prior(head, c):
            clique_f[c, tb.PRIOR_ENERGY] = 0.0
            update_energy(head, c)


@kernel
def diagonal(head, c, k):  # type: ignore[no-untyped-def]
    """
    Return the mean information of a prior on the position of a node, and that on its heading.

    Parameters
    ----------
    c : int, row of the prior
    k : int, place of the node in it

    """
    row, pool_f = tb.clique_i(head)[c], tb.pool_f(head)
    n, i, at = 3 * row[tb.N_SEPARATOR], 3 * k, row[tb.VALUES]
    position = pool_f[at + row_start(i, n) + i] + pool_f[at + row_start(i + 1, n) + i + 1]
    return 0.5 * position, pool_f[at + row_start(i + 2, n) + i + 2]


@kernel
def weakest(head, c, v):  # type: ignore[no-untyped-def]
    """
    Return the information of a prior on a node in its weakest direction.

    Parameters
    ----------
    c : int, row of the prior
    v : int, node; zeros if it is none of the prior's

    """
    row, pool_f, pool_i = tb.clique_i(head)[c], tb.pool_f(head), tb.pool_i(head)
    n = 3 * row[tb.N_SEPARATOR]
    for k in range(row[tb.N_SEPARATOR]):
        if pool_i[row[tb.NODES] + k] == v:
            i, at = 3 * k, row[tb.VALUES]
            x, y, th = (at + row_start(i, n) + i, at + row_start(i + 1, n) + i,
                        at + row_start(i + 2, n) + i)
            return weakest_of(pool_f[x], pool_f[x + 1], pool_f[x + 2], pool_f[y + 1],
                              pool_f[y + 2], pool_f[th + 2])
    return 0.0, 0.0


@kernel
def start(head, c, anchored):  # type: ignore[no-untyped-def]
    """
    Initialise the row of a prior whose nodes and numbers are written; add its energy to chi2.

    Parameters
    ----------
    c : int, row of the prior
    anchored : bool

    """
    node_f, pool_i = tb.node_f(head), tb.pool_i(head)
    row, f = tb.clique_i(head)[c], tb.clique_f(head)[c]
    row[tb.ANCHORED] = 1 if anchored else 0
    f[tb.TURN_SEEN] = f[tb.DRIFT] = f[tb.PRIOR_ENERGY] = 0.0
    scale, first = 0.0, node_f[pool_i[row[tb.NODES]]]
    for k in range(1, row[tb.N_SEPARATOR]):
        node = node_f[pool_i[row[tb.NODES] + k]]
        position, _ = diagonal(head, c, k)
        scale += 2.0 * position * ((node[tb.POSE] - first[tb.POSE]) ** 2
                                   + (node[tb.POSE + 1] - first[tb.POSE + 1]) ** 2)
    f[tb.SLIP_SCALE] = 0.25 * scale
    update_energy(head, c)


@kernel
def make_loose(head, c):  # type: ignore[no-untyped-def]
    """Put a prior into the list of those without a parent."""
    row = tb.clique_i(head)[c]
    row[tb.PARENT], row[tb.SIBLING] = -1, head[tb.LOOSE]
    head[tb.LOOSE] = c


@kernel(allocates=True)
def remove_cliques(head):  # type: ignore[no-untyped-def]
    """Remove all cliques but the priors, which become loose and take the first rows."""
    clique_i, clique_f = tb.clique_i(head), tb.clique_f(head)
    pool_f, pool_i = tb.pool_f(head), tb.pool_i(head)
    n_priors, n_nodes, n_values = 0, 0, 0
    if head[tb.N_PRIORS] > 0:
        for c in range(head[tb.N_CLIQUES]):
            if is_prior(head, c):
                n_priors += 1
                n_nodes += clique_i[c, tb.N_SEPARATOR]
                n_values += pools.n_values(0, clique_i[c, tb.N_SEPARATOR])
    separators, anchored = np.empty(n_priors, np.int64), np.empty(n_priors, np.int64)
    energy, scale = np.empty(n_priors), np.empty(n_priors)
    nodes, values = np.empty(n_nodes, np.int32), np.empty(n_values)
    k = n_nodes = n_values = 0
    for c in range(head[tb.N_CLIQUES] if n_priors > 0 else 0):
        if is_prior(head, c):
            row = clique_i[c]
            separators[k], anchored[k] = row[tb.N_SEPARATOR], row[tb.ANCHORED]
            energy[k], scale[k] = clique_f[c, tb.PRIOR_ENERGY], clique_f[c, tb.SLIP_SCALE]
            for m in range(separators[k]):
                nodes[n_nodes + m] = pool_i[row[tb.NODES] + m]
            n_nodes += separators[k]
            size = pools.n_values(0, separators[k])
            for m in range(size):
                values[n_values + m] = pool_f[row[tb.VALUES] + m]
            n_values += size
            k += 1
    head[tb.N_CLIQUES] = head[tb.POOL_F_END] = head[tb.POOL_I_END] = 0
    head[tb.FREE_CLIQUE] = head[tb.LOOSE] = -1
    head[tb.FREE_F:] = -1
    head[tb.N_PRIORS] = head[tb.N_FREED] = 0
    end = head[tb.LOG_I_END]
    n_nodes = n_values = 0
    for k in range(n_priors):
        c = transaction_log.take_clique(head, 0, separators[k])
        row, f = clique_i[c], clique_f[c]
        for m in range(separators[k]):
            pool_i[row[tb.NODES] + m] = nodes[n_nodes + m]
        n_nodes += separators[k]
        size = pools.n_values(0, separators[k])
        for m in range(size):
            pool_f[row[tb.VALUES] + m] = values[n_values + m]
        n_values += size
        row[tb.ANCHORED] = anchored[k]
        f[tb.TURN_SEEN] = f[tb.DRIFT] = 0.0
        f[tb.PRIOR_ENERGY], f[tb.SLIP_SCALE] = energy[k], scale[k]
        make_loose(head, c)
    head[tb.LOG_I_END] = end    # nothing of this can be rolled back


@kernel(allocates=True)
def all_priors(head):  # type: ignore[no-untyped-def]
    """Return the rows of all priors, ascending."""
    found = np.empty(head[tb.N_PRIORS], np.int32)
    n = 0
    for c in range(head[tb.N_CLIQUES] if len(found) > 0 else 0):
        if is_prior(head, c):
            found[n] = c
            n += 1
    return found[:n]
