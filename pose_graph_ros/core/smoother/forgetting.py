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

from pose_graph_ros.core.compiled.jit import FLAG, INTEGERS, kernel
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.graph import pools, prior_rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.editing import touch_with, unlink
from pose_graph_ros.core.graph.pools import product, row_start, triangle_size
from pose_graph_ros.core.graph.rows import scale_by
from pose_graph_ros.core.smoother.tree_update import DONE, lacks_memory, MORE_MEMORY, ORDERED_FIRST


@kernel(allocates=True)
def _whole(head, leaving):  # type: ignore[no-untyped-def]
    """Tell of which cliques all nodes at and below leave, and which of all nodes leave."""
    leaves, whole = np.zeros(head[tb.N_NODES], np.bool_), np.ones(head[tb.N_CLIQUES], np.bool_)
    for v in leaving:
        leaves[v] = True
    for v in range(len(leaves)):
        c = -1 if leaves[v] else tb.nodes(head)[v].clique
        while c >= 0 and whole[c]:
            whole[c], c = False, tb.cliques(head)[c].parent
    return whole, leaves


@kernel(signature=(tb.HEAD, INTEGERS))
def far_from_linear(head, leaving):  # type: ignore[no-untyped-def]
    """
    Tell whether the linearization errors of the constraints of leaving nodes are above a budget.

    It is a part of that of a step that moves as many nodes, as what leaves keeps its linearization
    for good. An edge between two of them counts twice.
    """
    scalars, error2 = tb.scalars(head)[0], 0.0
    for v in leaving:
        at = tb.nodes(head)[v].factor_list
        while at >= 0:
            error2 += tb.factors(head)[at >> 2].error2
            at = tb.factors(head)[at >> 2].next[at & 3]
    return error2 > 0.1 * min(scalars.budget, scalars.share * len(leaving))


@kernel(signature=(tb.HEAD, INTEGERS, FLAG), allocates=True)
def touch_mixed(head, leaving, all_of_them):  # type: ignore[no-untyped-def]
    """
    Touch all cliques that have to be eliminated again before nodes can leave; tell whether any.

    These are the cliques with a leaving node that hold, or are above, one that remains. Their
    leaving nodes are ordered before all others, or `all_of_them` are. The caller has begun an
    update.
    """
    nodes, mixed = tb.nodes(head), False
    whole, _ = _whole(head, leaving)
    for v in leaving:
        mixed = mixed or not whole[nodes[v].clique]
    for v in leaving:
        if not mixed or (whole[nodes[v].clique] and not all_of_them):
            continue
        touch_with(head, v, whole)
        nodes[v].touched = ORDERED_FIRST
    if mixed:
        head[tb.STRUCTURE] = 1
    return mixed


@kernel
def _drop_subtree(head, top, leaves):  # type: ignore[no-untyped-def]
    """Drop all cliques below one, and all constraints in them and in it; return their energy."""
    pool_i, stack, cliques = tb.pool_i(head), tb.work_i(head), tb.cliques(head)
    stack[0] = top
    depth, energy = 1, 0.0
    while depth > 0:
        depth -= 1
        c = stack[depth]
        row = cliques[c]
        if row.n_frontal == 0:
            prior_rows.add_to_scales(head, c, -1.0)
            energy += cliques[c].energy
        for m in range(row.members, row.members + row.n_frontal):
            node = tb.nodes(head)[pool_i[m]]
            at = node.factor_list
            while at >= 0:
                e, f = at >> 2, tb.factors(head)[at >> 2]
                at = f.next[at & 3]
                if f.weight == 0.0:
                    continue    # another of its ends has left just before
                scale_by(head, e, -f.weight)
                for side in range(3):
                    if f.ends[side] >= 0 and not leaves[f.ends[side]]:
                        unlink(head, e, side)
                energy += f.energy
                f.weight = f.energy = f.error2 = 0.0
            node.clique, node.factor_list = -1, tb.LEAVES
            head[tb.N_LEAVING] += 1
        child = row.child
        while child >= 0:
            stack[depth] = child
            depth += 1
            child = cliques[child].sibling
        if c != top:
            transaction_log.give_clique(head, c)
    cliques[top].child = -1
    return energy


@kernel
def _turn_into_prior(head, c, energy):  # type: ignore[no-untyped-def]
    """
    Turn a clique into a prior on its separator, which remains where it is in the tree.

    Its energy at the present poses is given [sigma^2].
    """
    nodes, pool_f, work_f = tb.nodes(head), tb.pool_f(head), tb.work_f(head)
    pool_i, row = tb.pool_i(head), tb.cliques(head)[c]
    n_frontal, n = row.n_frontal, row.n_separator
    size, old_nodes, old_values, members = 3 * n, row.members, row.values, pools.separator(head, c)
    phi, seen = clique_frames.present_turn(head, c), row.turn_seen
    # the update matrix in map axes, with the right-hand side at the present poses
    clique_frames.turned_update(head, c, phi, work_f)
    n_numbers = triangle_size(size, size)
    work = work_f[n_numbers:]
    x, rest = work[:size], work[size:2 * size]
    for i in range(size):
        x[i] = nodes[members[i // 3]].delta[i % 3]
    product(work_f, size, x, 1.0, rest)
    for i in range(size):
        work_f[row_start(i, size) + size] = -rest[i]
    row.members = pools.take(head, pools.NODES, n)
    row.values = pools.take(head, pools.VALUES, pools.n_values(0, n))
    transaction_log.copied(members, pool_i[row.members:row.members + n])
    at = row.values + n_numbers
    transaction_log.copied(work_f, pool_f[row.values:at])
    for k in range(n):
        for m in range(3):
            pool_f[at + 3 * k + m] = nodes[members[k]].pose[m]
    pool_f[at + size] = energy
    pools.give(head, pools.NODES, old_nodes, n_frontal + n)
    pools.give(head, pools.VALUES, old_values, pools.n_values(n_frontal, n))
    row.n_frontal = 0
    head[tb.N_PRIORS] += 1
    prior_rows.start(head, c, row.anchored != 0)
    prior_rows.keep_linearization(head, c, work_f[2 * size:3 * size])
    row.turn_seen = seen - phi
    prior_rows.add_to_scales(head, c, 1.0)


@kernel(signature=(tb.HEAD, INTEGERS), allocates=True)
def drop(head, leaving):  # type: ignore[no-untyped-def]
    """
    Return DONE after taking nodes that are whole subtrees out of the tree.

    Their rows leave with the next `Graph.commit`. MORE_MEMORY: nothing has changed, and the pools
    must grow to `NEED_F` and `NEED_I` of the head. No node may be touched.
    """
    nodes, cliques, pool_i = tb.nodes(head), tb.cliques(head), tb.pool_i(head)
    scalars = tb.scalars(head)[0]
    whole, leaves = _whole(head, leaving)
    tops = np.empty(len(leaving), np.int32)
    n_tops, need_f, need_i = 0, head[tb.POOL_F_END], head[tb.POOL_I_END]
    for v in leaving:
        c = nodes[v].clique
        row = cliques[c]
        if pool_i[row.members] == v and (row.parent < 0 or not whole[row.parent]):
            tops[n_tops] = c
            n_tops += 1
            need_f += pools.rounded(pools.n_values(0, row.n_separator))
            need_i += pools.rounded(row.n_separator)
    if lacks_memory(head, need_f, need_i, 0):
        return MORE_MEMORY
    for t in range(n_tops):
        # rows and columns of the update matrix that are what rounding has left of zero
        members, update = pools.separator(head, tops[t]), pools.update_matrix(head, tops[t])
        size = 3 * len(members)
        for i in range(size):
            node = nodes[members[i // 3]]
            scale = node.scale_t if i % 3 < 2 else node.scale_r
            if update[row_start(i, size) + i] <= 1e-14 * scale * scale:
                for k in range(i):
                    update[row_start(k, size) + i] = 0.0
                for k in range(i, size + 1):
                    update[row_start(i, size) + k] = 0.0
        energy = _drop_subtree(head, tops[t], leaves)
        scalars.chi2 -= energy
        if size > 0:
            _turn_into_prior(head, tops[t], energy)
        else:
            transaction_log.give_clique(head, tops[t])
    head[tb.N_TURNED] = 0
    head[tb.LOG_END] = 0
    return DONE

