# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Priors in the tables: cliques without frontal nodes; how they are added and removed.

What is left of a clique whose nodes and constraints have left the graph is its separator and its
update matrix. So a prior is a leaf of the tree, its update matrix is added to the front of
its parent like that of any child, and it turns with its separator as the frame of a clique does.
Its block in the pool has the update matrix (U, u), then the reference poses of its nodes, then the
energy at these, then r (`evaluate`) at the last linearization, and r as it was when the update
began that has linearized it. `priors` has the equations.

A prior that no clique is the parent of is *loose*: it is new, or all cliques were removed. Its
nodes are touched, so the next step takes it in.
"""

from collections.abc import Sequence
import math

import numpy as np

from pose_graph_ros.core.compiled.jit import FLAG, INTEGERS, kernel, NUMBERS
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph import pools, tables as tb, transaction_log
from pose_graph_ros.core.graph.constraints import NodeKind
from pose_graph_ros.core.graph.factors import wrap
from pose_graph_ros.core.graph.normal_equations import weakest as weakest_of
from pose_graph_ros.core.graph.pools import product, row_start, triangle_size
from pose_graph_ros.core.graph.priors import packed, Prior, unpacked
from pose_graph_ros.core.graph.rows import add_to_scale, touch
from pose_graph_ros.core.graph.transaction_log import copied

# Parent of a prior that this update has removed.
REMOVED = -2


@kernel
def is_prior(head, c):  # type: ignore[no-untyped-def]
    """Tell whether a row of the cliques is a prior of the graph."""
    row = tb.cliques(head)[c]
    return row.n_frontal == 0 and row.parent != REMOVED


@kernel
def turns(head, c):  # type: ignore[no-untyped-def]
    """Tell whether a prior has a frame that turns with its nodes; see `priors.turns`."""
    if tb.cliques(head)[c].anchored == 0:
        return True
    for v in pools.separator(head, c):
        if tb.nodes(head)[v].kind != NodeKind.POSE:
            return False
    return len(pools.separator(head, c)) > 1


@kernel
def present_frame(head, c):  # type: ignore[no-untyped-def]
    """Return the mean turn of the nodes of a prior [rad], which is 0 if it does not turn."""
    if not turns(head, c):
        return 0.0
    nodes, members = tb.nodes(head), pools.separator(head, c)
    reference = pools.update_matrix(head, c)[triangle_size(3 * len(members), 3 * len(members)):]
    first = wrap(nodes[members[0]].pose[2] - reference[2])
    total = 0.0
    for k in range(1, len(members)):
        total += wrap(nodes[members[k]].pose[2] - reference[3 * k + 2] - first)
    return first + total / len(members)


@kernel
def evaluate(head, c, phi, work):  # type: ignore[no-untyped-def]
    """
    Return the energy of a prior at the present poses, its frame turned by phi.

    The work space, 9 numbers for each node, receives the displacement d, half the gradient U d - u
    in the frame, and r, the derivative of d by -phi, zero if the prior does not turn. phi is that
    of `present_frame`.
    """
    nodes, members, update = tb.nodes(head), pools.separator(head, c), pools.update_matrix(head, c)
    n = 3 * len(members)
    reference = update[triangle_size(n, n):]
    d, g, r = work[:n], work[n:2 * n], work[2 * n:3 * n]
    cos, sin = math.cos(phi), math.sin(phi)
    first = nodes[members[0]]
    turn = wrap(first.pose[2] - reference[2])
    anchored = tb.cliques(head)[c].anchored != 0
    # the point about which it turns, and how much of a rigid turn about it is displacement
    px = reference[0] if anchored else first.pose[0]
    py = reference[1] if anchored else first.pose[1]
    tangent = 1.0 if anchored else 0.0
    turning = 1.0 if turns(head, c) else 0.0
    for k in range(len(members)):
        f, i = nodes[members[k]], 3 * k
        dx, dy = f.pose[0] - px, f.pose[1] - py
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        rx, ry = reference[i] - reference[0], reference[i + 1] - reference[1]
        d[i], d[i + 1] = x - rx - tangent * phi * ry, y - ry + tangent * phi * rx
        d[i + 2] = (turn - (1.0 - tangent) * phi + wrap(f.pose[2] - reference[i + 2] - turn))
        r[i], r[i + 1] = turning * (tangent * ry - y), turning * (x - tangent * rx)
        r[i + 2] = 1.0 - tangent
    product(update, n, d, 1.0, g)
    energy = reference[n]
    for i in range(n):
        energy += d[i] * (g[i] - update[row_start(i, n) + n])
    return energy


@kernel
def keep_linearization(head, c, r):  # type: ignore[no-untyped-def]
    """Remember r (`evaluate`) of a new linearization; a rollback restores the last one."""
    row, pool_f = tb.cliques(head)[c], tb.pool_f(head)
    n = 3 * row.n_separator
    at = row.values + triangle_size(n, n) + n + 1
    transaction_log.log_clique(head, c)
    if row.values_born != head[tb.UPDATE]:
        row.values_born = head[tb.UPDATE]
        copied(pool_f[at:], pool_f[at + n:at + 2 * n])
    copied(r, pool_f[at:at + n])


@kernel
def gradient(head, c, work):  # type: ignore[no-untyped-def]
    """
    Return the energy of a prior.

    Half its gradient in map axes is `work[3k:6k]` of the work space, 9 numbers for each node.
    """
    phi = present_frame(head, c)
    energy = evaluate(head, c, phi, work)
    n = 3 * tb.cliques(head)[c].n_separator
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
    f, energy = tb.cliques(head)[c], evaluate(head, c, present_frame(head, c), tb.work_f(head))
    tb.scalars(head)[0].chi2 += energy - f.energy
    f.energy = energy


@kernel
def diagonal(head, c, k):  # type: ignore[no-untyped-def]
    """Return the mean information of an update matrix on a node's position, and on its heading."""
    update, n, i = pools.update_matrix(head, c), 3 * tb.cliques(head)[c].n_separator, 3 * k
    position = update[row_start(i, n) + i] + update[row_start(i + 1, n) + i + 1]
    return 0.5 * position, update[row_start(i + 2, n) + i + 2]


@kernel
def weakest(head, c, v):  # type: ignore[no-untyped-def]
    """Return the information of a prior on a node in its weakest direction."""
    nodes, update = pools.separator(head, c), pools.update_matrix(head, c)
    n = 3 * len(nodes)
    for k in range(len(nodes)):
        if nodes[k] == v:
            i = 3 * k
            x, y = update[row_start(i, n) + i:], update[row_start(i + 1, n) + i:]
            return weakest_of(x[0], x[1], x[2], y[1], y[2], update[row_start(i + 2, n) + i + 2])
    return 0.0, 0.0


@kernel
def start(head, c, anchored):  # type: ignore[no-untyped-def]
    """Initialise the row of a prior that has its nodes and numbers; add its energy to chi2."""
    nodes, members, f = tb.nodes(head), pools.separator(head, c), tb.cliques(head)[c]
    f.anchored = 1 if anchored else 0
    f.turn_seen = f.drift = f.energy = 0.0
    scale, first = 0.0, nodes[members[0]]
    for k in range(1, len(members)):
        node = nodes[members[k]]
        position, _ = diagonal(head, c, k)
        scale += 2.0 * position * ((node.pose[0] - first.pose[0]) ** 2
                                   + (node.pose[1] - first.pose[1]) ** 2)
    f.slip_scale = 0.25 * scale
    update_energy(head, c)


@kernel(signature=(tb.HEAD,), allocates=True)
def all_priors(head):  # type: ignore[no-untyped-def]
    """Return the rows of all priors in the table of the cliques, ascending."""
    found = np.empty(head[tb.N_PRIORS], np.int32)
    n = 0
    for c in range(head[tb.N_CLIQUES] if len(found) > 0 else 0):
        if is_prior(head, c):
            found[n] = c
            n += 1
    return found[:n]


@kernel(allocates=True)
def remove_cliques(head):  # type: ignore[no-untyped-def]
    """Remove all cliques but the priors, which become loose and take the first rows."""
    priors = all_priors(head)
    records = np.empty(len(priors), tb.CLIQUE)
    for k in range(len(priors)):
        records[k] = tb.cliques(head)[priors[k]]
    kept = 1 if len(priors) > 0 else 0
    nodes = tb.pool_i(head)[:kept * head[tb.POOL_I_END]].copy()
    values = tb.pool_f(head)[:kept * head[tb.POOL_F_END]].copy()
    head[tb.N_CLIQUES] = head[tb.POOL_F_END] = head[tb.POOL_I_END] = 0
    head[tb.FREE_CLIQUE] = head[tb.LOOSE] = -1
    head[tb.FREE_F:] = -1
    head[tb.N_PRIORS] = head[tb.N_FREED] = 0
    end = head[tb.LOG_END]
    for k in range(len(records)):
        old = records[k]
        c = transaction_log.take_clique(head, 0, old.n_separator)
        row = tb.cliques(head)[c]
        at, size = row.values, pools.n_values(0, old.n_separator)
        copied(nodes[old.members:], pools.separator(head, c))
        copied(values[old.values:], tb.pool_f(head)[at:at + size])
        row.turn_seen = row.drift = 0.0
        row.anchored, row.energy, row.slip_scale = old.anchored, old.energy, old.slip_scale
        row.sibling, head[tb.LOOSE] = head[tb.LOOSE], c
    head[tb.LOG_END] = end    # nothing of this can be rolled back


# --- edits, within an update --------------------------------------------------------------------

@kernel
def add_to_scales(head, c, sign):  # type: ignore[no-untyped-def]
    """Add the information of a prior to the diagonal scales of its nodes, or subtract it."""
    nodes = pools.separator(head, c)
    for k in range(len(nodes)):
        position, heading = diagonal(head, c, k)
        add_to_scale(head, nodes[k], sign * position, sign * heading)


@kernel
def _touch_nodes(head, c, sign):  # type: ignore[no-untyped-def]
    """Touch the nodes of a prior, and add its information to their scales, or subtract it."""
    for v in pools.separator(head, c):
        touch(head, v)
    add_to_scales(head, c, sign)
    head[tb.STRUCTURE] = 1


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS, FLAG))
def add(head, nodes, values, anchored):  # type: ignore[no-untyped-def]
    """Add a prior on nodes, by row, with numbers from `priors.packed`; tables have room."""
    c = transaction_log.take_clique(head, 0, len(nodes))
    row = tb.cliques(head)[c]
    copied(nodes, pools.separator(head, c))
    copied(values, tb.pool_f(head)[row.values:row.values + len(values)])
    start(head, c, anchored)
    row.sibling, head[tb.LOOSE] = head[tb.LOOSE], c     # without a parent
    _touch_nodes(head, c, 1.0)


@kernel(allocates=True)
def remove_of_node(head, v):  # type: ignore[no-untyped-def]
    """Take all priors on a node out of the graph."""
    cliques = tb.cliques(head)
    for c in all_priors(head):
        if not pools.is_among(v, pools.separator(head, c)):
            continue
        transaction_log.log_clique(head, c)
        _touch_nodes(head, c, -1.0)
        tb.scalars(head)[0].chi2 -= cliques[c].energy
        # out of the list of its parent's children, or of the loose ones
        parent, after = cliques[c].parent, cliques[c].sibling
        before = head[tb.LOOSE] if parent < 0 else cliques[parent].child
        if before != c:
            while cliques[before].sibling != c:
                before = cliques[before].sibling
            transaction_log.log_clique(head, before)
            cliques[before].sibling = after
        elif parent < 0:
            head[tb.LOOSE] = after
        else:
            transaction_log.log_clique(head, parent)
            cliques[parent].child = after
        cliques[c].parent = REMOVED
        transaction_log.drop_clique(head, c)


def add_priors(memory: tb.Memory, priors: Sequence[Prior], rows: Sequence[IntArray]) -> None:
    """Add priors to the graph, within an update; the other tables have room for them."""
    head, values, n = memory.head, [packed(prior) for prior in priors], sum(map(len, rows))
    # a block of a pool is at most twice as large as what is in it; r is kept twice
    for name, end, size in (('pool_f', tb.POOL_F_END, sum(map(len, values)) + 6 * n),
                            ('pool_i', tb.POOL_I_END, n)):
        memory.ensure(name, int(head[end]) + 2 * size, keep=int(head[end]))
    memory.ensure('work_f', 15 * max(map(len, rows)))   # what elimination needs for each node
    for prior, numbers, nodes in zip(priors, values, rows, strict=True):
        add(head, nodes, numbers, prior.anchored)


def priors_of(memory: tb.Memory, node_ids: IntArray) -> tuple[Prior, ...]:
    """Return all priors of a graph."""
    if memory.head[tb.N_PRIORS] == 0:
        return ()
    found = []
    for row in memory['cliques'][all_priors(memory.head)]:
        k, nodes = int(row['n_separator']), int(row['members'])
        found.append(unpacked(
            node_ids[memory['pool_i'][nodes:nodes + k]], memory['pool_f'][row['values']:],
            anchored=bool(row['anchored'])))
    return tuple(found)
