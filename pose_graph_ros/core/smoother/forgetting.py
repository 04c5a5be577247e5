# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Nodes leave the graph: what the tree says about the nodes that remain becomes dense priors.

A subtree all of whose nodes leave needs no elimination: the update matrix of its topmost clique is
the Schur complement of all constraints in it on the nodes that remain, so it is the prior. Where
the leaving nodes are not yet whole subtrees, their cliques are eliminated again with these nodes
before all others (`touch_mixed`, then a step). `drop` turns the topmost cliques into priors, gives
the cliques below back and marks the nodes as gone. Nothing else changes: the rows of R of all
other cliques remain, and with them estimate and covariances.
"""

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGERS, kernel
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.graph import (
    factors,
    pools,
    prior_rows,
    tables as tb,
    transaction_log,
)
from pose_graph_ros.core.graph.editing import unlink
from pose_graph_ros.core.graph.pools import row_start, triangle_size
from pose_graph_ros.core.graph.rows import add_to_scale, scale_by, touch
from pose_graph_ros.core.smoother.tree_update import (
    DONE,
    lacks_memory,
    MORE_MEMORY,
    ORDERED_FIRST,
)

# States of cliques: whether all nodes at and below them leave.
_UNKNOWN, _WHOLE, _MIXED = range(3)


@kernel(allocates=True)
def _states(head, nodes):  # type: ignore[no-untyped-def]
    """Return the states of all cliques, and which of all nodes are those given."""
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    leaves = np.zeros(head[tb.N_NODES], np.bool_)
    for v in nodes:
        leaves[v] = True
    state = np.zeros(head[tb.N_CLIQUES], np.uint8)
    stack = tb.work_i(head)
    for v in nodes:
        stack[0] = node_i[v, tb.CLIQUE]
        depth = 1
        while depth > 0:
            c = stack[depth - 1]
            row = clique_i[c]
            found = _WHOLE if state[c] == _UNKNOWN else state[c]
            for m in range(row[tb.NODES], row[tb.NODES] + row[tb.N_FRONTAL]):
                if not leaves[pool_i[m]]:
                    found = _MIXED
            bottom, child = depth, row[tb.CHILD] if state[c] == _UNKNOWN else -1
            while child >= 0 and found == _WHOLE:
                if clique_i[child, tb.N_FRONTAL] > 0:
                    if state[child] == _UNKNOWN and leaves[pool_i[clique_i[child, tb.NODES]]]:
                        stack[depth] = child
                        depth += 1
                    elif state[child] != _WHOLE:
                        found = _MIXED
                child = clique_i[child, tb.SIBLING]
            if found == _MIXED:
                depth = bottom
            if depth == bottom:
                state[c] = found
                depth -= 1
    return state, leaves


@kernel(signature=(tb.HEAD, INTEGERS))
def far_from_linear(head, nodes):  # type: ignore[no-untyped-def]
    """
    Tell whether the linearization errors of the constraints of leaving nodes are above a budget.

    It is that of a step that moves as many nodes. An edge between two of them counts twice.
    """
    scalars, error2 = tb.scalars(head), 0.0
    for v in nodes:
        at = tb.node_i(head)[v, tb.FACTOR_LIST]
        while at >= 0:
            error2 += tb.factor_f(head)[at >> 2, tb.ERROR2]
            at = tb.factor_i(head)[at >> 2, tb.NEXT_I + (at & 3)]
    return error2 > min(scalars[tb.SETTING_BUDGET], scalars[tb.SETTING_SHARE] * len(nodes))


@kernel(signature=(tb.HEAD, INTEGERS), allocates=True)
def touch_mixed(head, nodes):  # type: ignore[no-untyped-def]
    """
    Touch all cliques that have to be eliminated again before nodes can leave; tell whether any.

    These are the cliques with a leaving node that hold, or are above, one that remains. Their
    leaving nodes are ordered before all others. The caller has begun an update.
    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    touched, stack = tb.touched(head), tb.work_i(head)
    state, _ = _states(head, nodes)
    mixed = False
    for v in nodes:
        if state[node_i[v, tb.CLIQUE]] == _WHOLE:
            continue
        mixed = True
        transaction_log.log_node(head, v)
        if node_i[v, tb.TOUCHED] == 0:
            touched[head[tb.N_TOUCHED]] = v
            head[tb.N_TOUCHED] += 1
        node_i[v, tb.TOUCHED] = ORDERED_FIRST
        stack[0] = node_i[v, tb.CLIQUE]
        depth = 1
        while depth > 0:
            depth -= 1
            child = clique_i[stack[depth], tb.CHILD]
            while child >= 0:
                if (clique_i[child, tb.N_FRONTAL] > 0 and state[child] != _WHOLE
                        and prior_rows.is_in_separator(head, child, v)):
                    other = pool_i[clique_i[child, tb.NODES]]
                    transaction_log.log_node(head, other)
                    touch(head, other)
                    stack[depth] = child
                    depth += 1
                child = clique_i[child, tb.SIBLING]
    if mixed:
        head[tb.STRUCTURE] = 1
    return mixed


@kernel
def _drop_factors(head, v, leaves):  # type: ignore[no-untyped-def]
    """Take the factors of a leaving node out of all lists and sums; return their energy."""
    node_i, factor_i = tb.node_i(head), tb.factor_i(head)
    energy, at = 0.0, node_i[v, tb.FACTOR_LIST]
    while at >= 0:
        e = at >> 2
        at = factor_i[e, tb.NEXT_I + (at & 3)]
        f = tb.factor_f(head)[e]
        if f[tb.WEIGHT] == 0.0:
            continue    # another of its ends has left just before
        scale_by(head, e, -f[tb.WEIGHT])
        for m in range(3):
            if factor_i[e, m] >= 0 and not leaves[factor_i[e, m]]:
                unlink(head, e, m)
        energy += f[tb.ENERGY]
        f[tb.WEIGHT] = f[tb.ENERGY] = f[tb.ERROR2] = 0.0
    node_i[v, tb.CLIQUE], node_i[v, tb.FACTOR_LIST] = -1, tb.LEAVES
    head[tb.N_LEAVING] += 1
    return energy


@kernel
def _scale_by_prior(head, c, sign):  # type: ignore[no-untyped-def]
    """Add the information of a prior to the diagonal scales of its nodes, or subtract it."""
    pool_i, row = tb.pool_i(head), tb.clique_i(head)[c]
    for k in range(row[tb.N_SEPARATOR]):
        position, heading = prior_rows.diagonal(head, c, k)
        add_to_scale(head, pool_i[row[tb.NODES] + k], sign * position, sign * heading)


@kernel
def _drop_subtree(head, top, leaves):  # type: ignore[no-untyped-def]
    """Drop all cliques below one, and all constraints in them and in it; return their energy."""
    clique_i, clique_f, pool_i = tb.clique_i(head), tb.clique_f(head), tb.pool_i(head)
    stack = tb.work_i(head)
    stack[0] = top
    depth, energy = 1, 0.0
    while depth > 0:
        depth -= 1
        c = stack[depth]
        row = clique_i[c]
        if row[tb.N_FRONTAL] == 0:
            _scale_by_prior(head, c, -1.0)
            energy += clique_f[c, tb.PRIOR_ENERGY]
        for m in range(row[tb.NODES], row[tb.NODES] + row[tb.N_FRONTAL]):
            energy += _drop_factors(head, pool_i[m], leaves)
        child = row[tb.CHILD]
        while child >= 0:
            stack[depth] = child
            depth += 1
            child = clique_i[child, tb.SIBLING]
        if c != top:
            transaction_log.give_clique(head, c)
    clique_i[top, tb.CHILD] = -1
    return energy


@kernel
def _clear_rounding(head, c):  # type: ignore[no-untyped-def]
    """Clear rows and columns of an update matrix that are what rounding has left of zero."""
    node_f, pool_f, pool_i = tb.node_f(head), tb.pool_f(head), tb.pool_i(head)
    row = tb.clique_i(head)[c]
    rows, size = 3 * row[tb.N_FRONTAL], 3 * row[tb.N_SEPARATOR]
    update = pool_f[row[tb.VALUES] + triangle_size(rows, rows + size):]
    for i in range(size):
        f = node_f[pool_i[row[tb.NODES] + (rows + i) // 3]]
        scale = f[tb.SCALE_T] if i % 3 < 2 else f[tb.SCALE_R]
        if update[row_start(i, size) + i] <= 1e-14 * scale * scale:
            for k in range(i):
                update[row_start(k, size) + i] = 0.0
            for k in range(i, size + 1):
                update[row_start(i, size) + k] = 0.0


@kernel
def _turn_into_prior(head, c, energy):  # type: ignore[no-untyped-def]
    """
    Turn a clique into a prior on its separator, which remains where it is in the tree.

    Its energy at the present poses is given [sigma^2].
    """
    node_f, pool_f, work_f = tb.node_f(head), tb.pool_f(head), tb.work_f(head)
    clique_i, clique_f, pool_i = tb.clique_i(head), tb.clique_f(head), tb.pool_i(head)
    row = clique_i[c]
    n_frontal, n = row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
    size, old_nodes, old_values = 3 * n, row[tb.NODES], row[tb.VALUES]
    nodes = pool_i[old_nodes + n_frontal:old_nodes + n_frontal + n]
    phi, seen = clique_frames.present_turn(head, c), clique_f[c, tb.TURN_SEEN]
    # the update matrix in map axes, with the right-hand side at the present poses
    at = old_values + triangle_size(3 * n_frontal, 3 * n_frontal + size)
    n_numbers = triangle_size(size, size)
    clique_frames.turned_update(pool_f[at:], n, nodes, node_f, phi, work_f)
    work = work_f[n_numbers:]
    minus_x, right = work[:size], work[size:2 * size]
    for i in range(size):
        minus_x[i] = -node_f[nodes[i // 3], tb.DELTA + i % 3]
        right[i] = work_f[row_start(i, size) + size]
    clique_frames.add_product(work_f, size, minus_x, right)
    for i in range(size):
        work_f[row_start(i, size) + size] = right[i]
    row[tb.NODES] = pools.take_nodes(head, n)
    row[tb.VALUES] = pools.take_values(head, pools.n_values(0, n))
    for k in range(n):
        pool_i[row[tb.NODES] + k] = nodes[k]
    at = row[tb.VALUES]
    for k in range(n_numbers):
        pool_f[at + k] = work_f[k]
    at += n_numbers
    for k in range(n):
        for m in range(3):
            pool_f[at + 3 * k + m] = node_f[nodes[k], tb.POSE + m]
    pool_f[at + size] = energy
    pools.give_nodes(head, old_nodes, n_frontal + n)
    pools.give_values(head, old_values, pools.n_values(n_frontal, n))
    row[tb.N_FRONTAL] = 0
    head[tb.N_PRIORS] += 1
    prior_rows.start(head, c, row[tb.ANCHORED] != 0)
    prior_rows.keep_linearization(head, c, work_f[2 * size:3 * size])
    clique_f[c, tb.TURN_SEEN] = seen - phi
    _scale_by_prior(head, c, 1.0)


@kernel
def _keep_waiting(head):  # type: ignore[no-untyped-def]
    """Take the constraints without a weight out of the list of the waiting."""
    waiting, kept = tb.waiting(head), 0
    for n in range(head[tb.N_WAITING]):
        if factors.parts(head, waiting[n])[0][tb.WEIGHT] > 0.0:
            waiting[kept] = waiting[n]
            kept += 1
    head[tb.N_WAITING] = kept


@kernel(signature=(tb.HEAD, INTEGERS), allocates=True)
def drop(head, nodes):  # type: ignore[no-untyped-def]
    """
    Return DONE after taking nodes that are whole subtrees out of the tree.

    Their rows leave with the next `Graph.commit`. MORE_MEMORY: nothing has changed, and the pools
    must grow to `NEED_F` and `NEED_I` of the head. No node may be touched.
    """
    node_i, clique_i = tb.node_i(head), tb.clique_i(head)
    pool_i, scalars = tb.pool_i(head), tb.scalars(head)
    state, leaves = _states(head, nodes)
    tops = np.empty(len(nodes), np.int32)
    n_tops, need_f, need_i = 0, head[tb.POOL_F_END], head[tb.POOL_I_END]
    for v in nodes:
        c = node_i[v, tb.CLIQUE]
        row = clique_i[c]
        if pool_i[row[tb.NODES]] == v and (
                row[tb.PARENT] < 0 or state[row[tb.PARENT]] != _WHOLE):
            tops[n_tops] = c
            n_tops += 1
            need_f += pools.rounded(pools.n_values(0, row[tb.N_SEPARATOR]))
            need_i += pools.rounded(row[tb.N_SEPARATOR])
    if lacks_memory(head, need_f, need_i, 0):
        return MORE_MEMORY
    for k in range(n_tops):
        _clear_rounding(head, tops[k])
        energy = _drop_subtree(head, tops[k], leaves)
        scalars[tb.CHI2] -= energy
        if clique_i[tops[k], tb.N_SEPARATOR] > 0:
            _turn_into_prior(head, tops[k], energy)
        else:
            transaction_log.give_clique(head, tops[k])
    _keep_waiting(head)
    head[tb.N_TURNED] = 0
    head[tb.LOG_F_END] = head[tb.LOG_I_END] = 0
    return DONE

