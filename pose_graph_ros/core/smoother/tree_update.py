# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Update of the Bayes tree: the cliques that an update affects are eliminated again.

Each clique holds the rows of R of its frontal nodes and the update matrix for its parent: a Bayes
tree (M. Kaess et al., "iSAM2", IJRR 2012) with its intermediate results. An update affects the
cliques from the touched nodes up to the roots. The other children of these cliques, the *orphans*,
keep all their values, including their update matrices.
"""

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.elimination.assembly import eliminate_clique, work_size
from pose_graph_ros.core.elimination.ordering import grown, minimum_degree
from pose_graph_ros.core.elimination.symbolic import (
    in_postorder,
    NEWEST_LAST,
    newest_last,
    plant,
    structure,
)
from pose_graph_ros.core.graph import pools, tables as tb, transaction_log

# Return codes of the kernels of all modules here. UNFINISHED: what remains can wait for another
# step. MORE_MEMORY: the pools and the work space must grow to `NEED_F`, `NEED_I` and `NEED_WORK`
# of the head, then the kernel be called again. BAD_PIVOT: node `BAD_NODE` of the head is not
# determined. INTERRUPTED: see `interrupted`. After the last three the caller has to roll back.
DONE, UNFINISHED, MORE_MEMORY, BAD_PIVOT, DIVERGED, INTERRUPTED = range(6)
# Value of TOUCHED for nodes that are ordered before all others, since they are about to leave.
ORDERED_FIRST = 2


@kernel
def lacks_memory(head, need_f, need_i, need_work):  # type: ignore[no-untyped-def]
    """Tell whether the pools or the work space have to grow before a kernel can go on."""
    head[tb.NEED_F], head[tb.NEED_I], head[tb.NEED_WORK] = need_f, need_i, need_work
    return (need_f > len(tb.pool_f(head)) or need_i > len(tb.pool_i(head))
            or need_work > len(tb.work_f(head)))


@kernel(allocates=True)
def mark(head):  # type: ignore[no-untyped-def]
    """
    Mark the cliques from all touched nodes up to the roots, and for a new order from a fixed one.

    Return these cliques, for each touched node those from it up that were not marked yet, and the
    affected nodes: their frontal nodes and the touched nodes without a clique, but for those that
    leave the graph.
    """
    cliques = tb.cliques(head)
    nodes, pool_i, touched = tb.nodes(head), tb.pool_i(head), tb.touched(head)
    stamp = head[tb.FRONT_SERIAL] + 1
    head[tb.FRONT_SERIAL] = stamp
    marked = np.empty(64, np.int32)
    n_marked = n_affected = 0
    n_touched, fixed = head[tb.N_TOUCHED], head[tb.FIXED]
    if head[tb.STRUCTURE] == 0:
        fixed = -1
    for s in range(n_touched + 1):
        if s < n_touched:
            v = np.int64(touched[s])
            if nodes[v].clique < 0:
                n_affected += 1
            if nodes[v].touched == ORDERED_FIRST:
                fixed = -1  # cliques of other nodes that leave stay as they are
        else:
            v = fixed if n_affected > NEWEST_LAST else np.int64(-1)
        c = np.int64(nodes[v].clique) if v >= 0 else np.int64(-1)
        while c >= 0 and cliques[c].marked != stamp:
            cliques[c].marked = stamp
            if n_marked == len(marked):
                marked = grown(marked, 0)
            marked[n_marked] = c
            n_marked += 1
            n_affected += cliques[c].n_frontal
            c = cliques[c].parent
    affected = np.empty(n_affected, np.int32)
    n_affected = 0
    for k in range(n_marked):
        row = cliques[marked[k]]
        for m in range(row.members, row.members + row.n_frontal):
            affected[n_affected] = pool_i[m]
            n_affected += nodes[pool_i[m]].factor_list != tb.LEAVES
    for s in range(head[tb.N_TOUCHED]):
        v = touched[s]
        if nodes[v].clique < 0 and nodes[v].factor_list != tb.LEAVES:
            affected[n_affected] = v
            n_affected += 1
    return marked[:n_marked], affected[:n_affected]


@kernel(allocates=True)
def reordered(head, marked, affected):  # type: ignore[no-untyped-def]
    """
    Return a code and the cliques, without values, that replace the marked ones.

    They are those of a new order of the affected nodes, children first.
    """
    nodes, tree = tb.nodes(head), tb.cliques(head)
    n_leaving = 0   # the nodes that are about to leave come first
    for k in range(len(affected)):
        if nodes[affected[k]].touched == ORDERED_FIRST:
            affected[n_leaving], affected[k] = affected[k], affected[n_leaving]
            n_leaving += 1
    n_last = newest_last(affected[n_leaving:], head[tb.NEWEST], head[tb.FIXED])
    loose = np.empty(head[tb.N_PRIORS], np.int32)
    c, n_loose = head[tb.LOOSE], 0
    while c >= 0:
        loose[n_loose], c = c, tree[c].sibling
        n_loose += 1
    orphans, start, adjacency = structure(head, marked, loose[:n_loose], affected)
    raw = minimum_degree(len(affected), len(orphans), n_leaving, n_last, start, adjacency)
    cliques = in_postorder(affected, raw, n_leaving)
    if lacks_memory(head, head[tb.POOL_F_END] + cliques.need_f,
                    head[tb.POOL_I_END] + cliques.need_i, cliques.largest):
        return MORE_MEMORY, marked
    # to each orphan goes the drift of all cliques above it, which are about to be dropped
    drifting = False
    for k in range(len(marked)):
        drifting = drifting or tree[marked[k]].drift > 0.0
    for k in range(len(orphans) if drifting else 0):
        drift, c = 0.0, tree[orphans[k]].parent
        while c >= 0:
            drift += tree[c].drift
            c = tree[c].parent
        if drift > 0.0:
            transaction_log.log_clique(head, orphans[k])
            tree[orphans[k]].drift += drift
    for k in range(len(marked)):
        transaction_log.drop_clique(head, marked[k])
    return DONE, plant(head, cliques, orphans)


@kernel(allocates=True)
def renewed(head, marked):  # type: ignore[no-untyped-def]
    """Return a code and the marked cliques, with memory for new values, children first."""
    cliques, need, largest = tb.cliques(head), np.int64(0), np.int64(0)
    for k in range(len(marked)):
        row = cliques[marked[k]]
        largest = max(largest, work_size(row.n_frontal + row.n_separator))
        if row.values_born != head[tb.UPDATE]:
            need += pools.rounded(pools.n_values(row.n_frontal, row.n_separator))
    if lacks_memory(head, head[tb.POOL_F_END] + need, 0, largest):
        return MORE_MEMORY, marked
    # each path that was marked, from the bottom up, ends below an earlier one
    rows, end, n = np.empty(len(marked), np.int32), len(marked), 0
    while end > 0:
        begin = end - 1
        while begin > 0 and cliques[marked[begin - 1]].parent == marked[begin]:
            begin -= 1
        for k in range(begin, end):
            transaction_log.renew_values(head, marked[k])
            cliques[marked[k]].built = head[tb.ITERATION]
            rows[n] = marked[k]
            n += 1
        end = begin
    return DONE, rows


@kernel
def interrupted(head):  # type: ignore[no-untyped-def]
    """Tell whether another thread wants that to end which runs."""
    wanted = tb.interrupt(head)
    return wanted[tb.ALL] != 0 or wanted[head[tb.HEEDS]] != 0


@kernel
def eliminate(head, rows):  # type: ignore[no-untyped-def]
    """Eliminate cliques, put the roots on the stack of the back-substitution; return a code."""
    head[tb.N_ROOTS] = 0
    for c in rows:
        if interrupted(head):
            return INTERRUPTED
        head[tb.BAD_NODE] = eliminate_clique(head, c, True)
        if head[tb.BAD_NODE] >= 0:
            return BAD_PIVOT
        if tb.cliques(head)[c].parent < 0:
            tb.work_i(head)[head[tb.N_ROOTS]] = c
            head[tb.N_ROOTS] += 1
    return DONE
