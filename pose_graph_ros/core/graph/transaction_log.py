# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The transaction log: `begin` an update, log what it changes, then `commit` or `rollback`.

A rollback restores every row bit for bit. A kernel that changes a row from before the update logs
the row first; a stamp in the row makes sure that only the first change is logged. Values of
cliques are never overwritten: new values get memory of their own, and the old ones are given back
to the pools on commit. The first entries of the log hold the lists, scalars and counters with
which the update began.
"""

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import pools, tables as tb
from pose_graph_ros.core.graph.constraints import NodeKind

# Kinds of entries of the log, which are words, the row that these are of, and the kind.
NODE, FACTOR, CLIQUE, TAKEN_CLIQUE, WAITING, TOUCHED, SCALARS, COUNTERS = range(8)


def largest(n_nodes: int, n_factors: int) -> int:
    """Return how many words the log of one update may have."""
    # for each node also a clique, new cliques, and the lists of `begin`
    of_node = (tb.NODE.itemsize + tb.CLIQUE.itemsize) // tb.WORD + 16
    of_factor = tb.FACTOR.itemsize // tb.WORD + 6
    return n_nodes * of_node + n_factors * of_factor + tb.SCALARS.itemsize


@kernel
def copied(source, target):  # type: ignore[no-untyped-def]
    """Copy the first numbers of an array to another one, as many as that has."""
    for k in range(len(target)):
        target[k] = source[k]


@kernel
def _append(head, kind, row, words):  # type: ignore[no-untyped-def]
    """Append an entry."""
    log, begin = tb.log(head), head[tb.LOG_END]
    end = begin + len(words)
    copied(words, log[begin:end])
    log[end], log[end + 1] = row, kind
    head[tb.LOG_END] = end + 2


@kernel(inline='always')    # Numba returns no arrays but arguments otherwise
def _words(head, kind, row):  # type: ignore[no-untyped-def]
    """Return the words that an entry of a kind holds."""
    if kind == NODE:
        return tb.node_words(head)[row]
    if kind == FACTOR:
        return tb.factor_words(head)[row]
    if kind == CLIQUE:
        return tb.clique_words(head)[row]
    if kind == WAITING:
        return tb.waiting(head)[:head[tb.N_WAITING]]
    if kind == TOUCHED:
        return tb.touched(head)[:head[tb.N_TOUCHED]]
    if kind == SCALARS:
        return tb.scalar_words(head)[0]
    if kind == COUNTERS:
        return head[tb.N_NODES:tb.LOOSE + 1]
    return head[:0]     # of a clique that was taken only the row matters


@kernel
def log_node(head, v):  # type: ignore[no-untyped-def]
    """Log a node, before it changes."""
    node = tb.nodes(head)[v]
    if node.logged != head[tb.UPDATE]:
        _append(head, NODE, v, tb.node_words(head)[v])
        node.logged = head[tb.UPDATE]


@kernel
def log_factor(head, e):  # type: ignore[no-untyped-def]
    """Log a factor, before it changes."""
    f = tb.factors(head)[e]
    if f.logged != head[tb.UPDATE]:
        _append(head, FACTOR, e, tb.factor_words(head)[e])
        f.logged = head[tb.UPDATE]


@kernel
def log_clique(head, c):  # type: ignore[no-untyped-def]
    """Log a clique, before it changes."""
    clique = tb.cliques(head)[c]
    if clique.logged != head[tb.UPDATE]:
        _append(head, CLIQUE, c, tb.clique_words(head)[c])
        clique.logged = head[tb.UPDATE]


@kernel
def take_clique(head, n_frontal, n_separator):  # type: ignore[no-untyped-def]
    """Return the row of a new clique with memory for its nodes and values."""
    cliques, c = tb.cliques(head), head[tb.FREE_CLIQUE]
    if c >= 0:
        head[tb.FREE_CLIQUE] = cliques[c].sibling
    else:
        c = head[tb.N_CLIQUES]
        head[tb.N_CLIQUES] = c + 1
    row = cliques[c]
    row.parent = row.child = row.sibling = -1
    row.n_frontal, row.n_separator = n_frontal, n_separator
    if n_frontal == 0:
        head[tb.N_PRIORS] += 1
    row.members = pools.take(head, pools.NODES, n_frontal + n_separator)
    row.values = pools.take(head, pools.VALUES, pools.n_values(n_frontal, n_separator))
    row.marked = row.anchored = 0
    row.built = head[tb.ITERATION]
    row.drift = 0.0
    row.born = row.values_born = row.logged = head[tb.UPDATE]
    _append(head, TAKEN_CLIQUE, c, _words(head, TAKEN_CLIQUE, c))
    return c


@kernel
def give_clique(head, c):  # type: ignore[no-untyped-def]
    """Give the row of a clique and its memory back."""
    row = tb.cliques(head)[c]
    pools.give(head, pools.NODES, row.members, row.n_frontal + row.n_separator)
    pools.give(head, pools.VALUES, row.values, pools.n_values(row.n_frontal, row.n_separator))
    if row.n_frontal == 0:
        head[tb.N_PRIORS] -= 1
    row.n_frontal, row.n_separator = -1, 0
    row.sibling = head[tb.FREE_CLIQUE]
    head[tb.FREE_CLIQUE] = c


@kernel
def drop_clique(head, c):  # type: ignore[no-untyped-def]
    """Give a clique back: at once if this update has made it, else on commit."""
    if tb.cliques(head)[c].born == head[tb.UPDATE]:
        give_clique(head, c)
        return
    freed, end = tb.freed(head), head[tb.N_FREED]
    freed[end], freed[end + 1], head[tb.N_FREED] = c, -1, end + 2


@kernel
def renew_values(head, c):  # type: ignore[no-untyped-def]
    """Give a clique new memory, without contents, for its values, once in an update."""
    row = tb.cliques(head)[c]
    if row.values_born == head[tb.UPDATE]:
        return
    log_clique(head, c)
    freed, end = tb.freed(head), head[tb.N_FREED]
    freed[end], freed[end + 1], head[tb.N_FREED] = c, row.values, end + 2
    row.values = pools.take(head, pools.VALUES, pools.n_values(row.n_frontal, row.n_separator))
    row.values_born = head[tb.UPDATE]


@kernel(signature=(tb.HEAD,))
def begin(head):  # type: ignore[no-untyped-def]
    """Log lists, scalars and counters: a rollback restores the lengths of the lists first."""
    head[tb.UPDATE] += 1
    head[tb.LOG_END] = head[tb.N_FREED] = 0
    for kind in range(WAITING, COUNTERS + 1):
        _append(head, kind, 0, _words(head, kind, 0))


@kernel(signature=(tb.HEAD,))
def commit(head):  # type: ignore[no-untyped-def]
    """End an update: keep its changes, and give the memory of replaced values and cliques back."""
    freed = tb.freed(head)
    for k in range(0, head[tb.N_FREED], 2):
        c, values = freed[k], freed[k + 1]
        if values < 0:
            give_clique(head, c)
        else:
            row = tb.cliques(head)[c]
            pools.give(head, pools.VALUES, values, pools.n_values(row.n_frontal, row.n_separator))
    head[tb.LOGGED] = max(head[tb.LOGGED], head[tb.LOG_END])
    head[tb.N_FREED] = head[tb.LOG_END] = 0


@kernel(signature=(tb.HEAD,))
def rollback(head):  # type: ignore[no-untyped-def]
    """End an update: restore all that was logged since `begin`, the newest entry first."""
    log, pool_f, end = tb.log(head), tb.pool_f(head), head[tb.LOG_END]
    while end > 0:
        at, kind = log[end - 2], log[end - 1]
        end -= 2 + len(_words(head, kind, at))
        if kind == TAKEN_CLIQUE:
            if tb.cliques(head)[at].n_frontal >= 0:     # else the same update has given it back
                give_clique(head, at)
            continue
        if kind != CLIQUE:
            copied(log[end:], _words(head, kind, at))
            continue
        row = tb.cliques(head)[at]
        values, size = row.values, pools.n_values(row.n_frontal, row.n_separator)
        if row.n_frontal == 0 and row.values_born == head[tb.UPDATE]:
            # where a prior was linearized before; see `prior_rows`
            last, n = values + size, 3 * row.n_separator
            copied(pool_f[last - n:], pool_f[last - 2 * n:last - n])
        copied(log[end:], tb.clique_words(head)[at])
        if row.values != values:
            pools.give(head, pools.VALUES, values, size)
    head[tb.N_FREED] = head[tb.LOG_END] = 0


@kernel
def largest_move(head):  # type: ignore[no-untyped-def]
    """Return by how much the update has moved poses: the largest change of a coordinate [m]."""
    nodes, log, end, largest = tb.nodes(head), tb.log(head), head[tb.LOG_END], 0.0
    while end > 0 and log[end - 1] != COUNTERS:
        row, kind = log[end - 2], log[end - 1]
        end -= 2 + len(_words(head, kind, row))
        if kind == NODE and nodes[row].kind == NodeKind.POSE:
            for k in range(2):
                largest = max(largest, abs(nodes[row].pose[k] - tb.log_numbers(head)[end + k]))
    return largest
