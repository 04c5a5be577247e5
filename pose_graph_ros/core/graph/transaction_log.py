# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The transaction log: `begin` an update, log what it changes, then `commit` or `rollback`.

A rollback restores every row bit for bit. A kernel that changes a row from before the update logs
the row first; a stamp in the row makes sure that only the first change is logged. Values of
cliques are never overwritten: new values get memory of their own, and the old ones are given back
to the pools on commit. The first entry of the log holds the counters, scalars and lists with which
the update began.
"""

from pose_graph_ros.core.compiled.jit import kernel, ROWS
from pose_graph_ros.core.graph import pools, tables as tb

# Kinds of entries of the log; an entry ends with its row (but for START) and its kind in log_i.
NODE, EDGE, OBSERVED, CLIQUE, TAKEN_CLIQUE, SOLUTION, EDGE_ENERGY, START = range(8)
# Numbers of floats and of integers in the entries of each kind, but for START.
_FLOATS = (tb.NODE_F, tb.EDGE_F, tb.OBS_F, tb.CLIQUE_F, 0, tb.SCALE_T, 2)
_INTEGERS = (tb.NODE_I, tb.EDGE_I, tb.OBS_I, tb.CLIQUE_I, 0, 0, 1)
# Counters in the first entry.
STARTED_WITH = (
    tb.N_NODES, tb.N_EDGES, tb.N_OBSERVED, tb.STRUCTURE, tb.N_TOUCHED, tb.N_WAITING, tb.NEWEST,
    tb.NEXT_NODE, tb.NEXT_EDGE, tb.NEXT_OBSERVED, tb.N_LEAVING, tb.N_PRIORS, tb.LOOSE)


@kernel
def _log_row(head, code, row, numbers, integers):  # type: ignore[no-untyped-def]
    """Append an entry: the floats and the integers of a row."""
    log_f, log_i = tb.log_f(head), tb.log_i(head)
    end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
    for k in range(len(numbers)):
        log_f[end_f + k] = numbers[k]
    for k in range(len(integers)):
        log_i[end_i + k] = integers[k]
    log_i[end_i + len(integers)] = row
    log_i[end_i + len(integers) + 1] = code
    head[tb.LOG_F_END] = end_f + len(numbers)
    head[tb.LOG_I_END] = end_i + len(integers) + 2


@kernel
def log_node(head, v):  # type: ignore[no-untyped-def]
    """Log the row of a node, before it changes."""
    node_f, node_i = tb.node_f(head), tb.node_i(head)
    if node_i[v, tb.NODE_LOGGED] != head[tb.UPDATE]:
        _log_row(head, NODE, v, node_f[v], node_i[v])
        node_i[v, tb.NODE_LOGGED] = head[tb.UPDATE]


@kernel
def log_solution(head, v):  # type: ignore[no-untyped-def]
    """Log the columns of a node that a solve changes, before they change."""
    node_f, log_f, node_i = tb.node_f(head), tb.log_f(head), tb.node_i(head)
    log_i = tb.log_i(head)
    row = node_i[v]
    if row[tb.SOLUTION_LOGGED] != head[tb.UPDATE] and row[tb.NODE_LOGGED] != head[tb.UPDATE]:
        row[tb.SOLUTION_LOGGED] = head[tb.UPDATE]
        end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
        for k in range(tb.SCALE_T):
            log_f[end_f + k] = node_f[v, k]
        log_i[end_i], log_i[end_i + 1] = v, SOLUTION
        head[tb.LOG_F_END], head[tb.LOG_I_END] = end_f + tb.SCALE_T, end_i + 2


@kernel
def log_energy(head, e):  # type: ignore[no-untyped-def]
    """Log the linearization error and the energy of an edge, before they change."""
    edge_f, log_f, edge_i = tb.edge_f(head), tb.log_f(head), tb.edge_i(head)
    log_i = tb.log_i(head)
    row = edge_i[e]
    if row[tb.ENERGY_LOGGED] != head[tb.UPDATE] and row[tb.EDGE_LOGGED] != head[tb.UPDATE]:
        row[tb.ENERGY_LOGGED] = head[tb.UPDATE]
        end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
        log_f[end_f] = edge_f[e, tb.ERROR2]
        log_f[end_f + 1] = edge_f[e, tb.ENERGY]
        log_i[end_i], log_i[end_i + 1], log_i[end_i + 2] = row[tb.EDGE_WAITS], e, EDGE_ENERGY
        head[tb.LOG_F_END], head[tb.LOG_I_END] = end_f + 2, end_i + 3


@kernel
def log_edge(head, e):  # type: ignore[no-untyped-def]
    """Log the row of an edge, before it changes."""
    edge_f, edge_i = tb.edge_f(head), tb.edge_i(head)
    if edge_i[e, tb.EDGE_LOGGED] != head[tb.UPDATE]:
        _log_row(head, EDGE, e, edge_f[e], edge_i[e])
        edge_i[e, tb.EDGE_LOGGED] = head[tb.UPDATE]


@kernel
def log_observed(head, k):  # type: ignore[no-untyped-def]
    """Log the row of an observed node, before it changes."""
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    if observed_i[k, tb.OBS_LOGGED] != head[tb.UPDATE]:
        _log_row(head, OBSERVED, k, observed_f[k], observed_i[k])
        observed_i[k, tb.OBS_LOGGED] = head[tb.UPDATE]


@kernel
def log_clique(head, c):  # type: ignore[no-untyped-def]
    """Log the row of a clique, before it changes."""
    clique_f, clique_i = tb.clique_f(head), tb.clique_i(head)
    if clique_i[c, tb.CLIQUE_LOGGED] != head[tb.UPDATE]:
        _log_row(head, CLIQUE, c, clique_f[c], clique_i[c])
        clique_i[c, tb.CLIQUE_LOGGED] = head[tb.UPDATE]


@kernel
def take_clique(head, n_frontal, n_separator):  # type: ignore[no-untyped-def]
    """
    Return the row of a new clique with memory for its nodes and values.

    Parameters
    ----------
    n_frontal, n_separator : int, numbers of nodes

    """
    clique_i, log_i = tb.clique_i(head), tb.log_i(head)
    c = head[tb.FREE_CLIQUE]
    if c >= 0:
        head[tb.FREE_CLIQUE] = clique_i[c, tb.SIBLING]
    else:
        c = head[tb.N_CLIQUES]
        head[tb.N_CLIQUES] = c + 1
    row = clique_i[c]
    row[tb.PARENT] = row[tb.CHILD] = row[tb.SIBLING] = -1
    row[tb.N_FRONTAL], row[tb.N_SEPARATOR] = n_frontal, n_separator
    if n_frontal == 0:
        head[tb.N_PRIORS] += 1
    row[tb.NODES] = pools.take_nodes(head, n_frontal + n_separator)
    row[tb.VALUES] = pools.take_values(head, pools.n_values(n_frontal, n_separator))
    row[tb.MARKED] = row[tb.ANCHORED] = 0
    row[tb.BUILT] = head[tb.ITERATION]
    tb.clique_f(head)[c, tb.DRIFT] = 0.0
    row[tb.BORN] = row[tb.VALUES_BORN] = row[tb.CLIQUE_LOGGED] = head[tb.UPDATE]
    end = head[tb.LOG_I_END]
    log_i[end], log_i[end + 1] = c, TAKEN_CLIQUE
    head[tb.LOG_I_END] = end + 2
    return c


@kernel
def give_clique(head, c):  # type: ignore[no-untyped-def]
    """Give the row of a clique and its memory back."""
    clique_i = tb.clique_i(head)
    row = clique_i[c]
    pools.give_nodes(head, row[tb.NODES], row[tb.N_FRONTAL] + row[tb.N_SEPARATOR])
    pools.give_values(head, row[tb.VALUES], pools.n_values(row[tb.N_FRONTAL], row[tb.N_SEPARATOR]))
    if row[tb.N_FRONTAL] == 0:
        head[tb.N_PRIORS] -= 1
    row[tb.N_FRONTAL], row[tb.N_SEPARATOR] = -1, 0
    row[tb.SIBLING] = head[tb.FREE_CLIQUE]
    head[tb.FREE_CLIQUE] = c


@kernel
def drop_clique(head, c):  # type: ignore[no-untyped-def]
    """Give a clique back: at once if this update has made it, else on commit."""
    clique_i = tb.clique_i(head)
    if clique_i[c, tb.BORN] == head[tb.UPDATE]:
        give_clique(head, c)
    else:
        _give_on_commit(head, c, -1)


@kernel
def _give_on_commit(head, c, values):  # type: ignore[no-untyped-def]
    """List a clique (values = -1), or the index of its old values, to be given back on commit."""
    freed = tb.freed(head)
    end = head[tb.N_FREED]
    freed[end], freed[end + 1] = c, values
    head[tb.N_FREED] = end + 2


@kernel
def renew_values(head, c):  # type: ignore[no-untyped-def]
    """Give a clique new memory, without contents, for its values, once in an update."""
    clique_i = tb.clique_i(head)
    row = clique_i[c]
    if row[tb.VALUES_BORN] == head[tb.UPDATE]:
        return
    log_clique(head, c)
    _give_on_commit(head, c, row[tb.VALUES])
    row[tb.VALUES] = pools.take_values(
        head, pools.n_values(row[tb.N_FRONTAL], row[tb.N_SEPARATOR]))
    row[tb.VALUES_BORN] = head[tb.UPDATE]


@kernel(signature=(tb.HEAD,))
def begin(head):  # type: ignore[no-untyped-def]
    """
    Log counters, scalars and lists; return whether the counters of stamps are within `LAST_STAMP`.

    If they are not, `Memory.restart_stamps` is due, and `begin` again.
    """
    scalars, touched, waiting = tb.scalars(head), tb.touched(head), tb.waiting(head)
    log_f, log_i = tb.log_f(head), tb.log_i(head)
    head[tb.UPDATE] += 1
    for k in range(tb.N_SCALARS):
        log_f[k] = scalars[k]
    end = 0
    for k in range(head[tb.N_TOUCHED]):
        log_i[end] = touched[k]
        end += 1
    for k in range(head[tb.N_WAITING]):
        log_i[end] = waiting[k]
        end += 1
    for counter in STARTED_WITH:
        log_i[end] = head[counter]
        end += 1
    log_i[end] = START
    head[tb.LOG_F_END], head[tb.LOG_I_END], head[tb.N_FREED] = tb.N_SCALARS, end + 1, 0
    return head[tb.FRONT_SERIAL] <= tb.LAST_STAMP and head[tb.UPDATE] <= tb.LAST_STAMP + 1


@kernel
def _restore_start(head):  # type: ignore[no-untyped-def]
    """Restore counters, scalars and lists from the first entry, the only one left in the log."""
    scalars, touched, waiting = tb.scalars(head), tb.touched(head), tb.waiting(head)
    log_f, log_i = tb.log_f(head), tb.log_i(head)
    for k in range(tb.N_SCALARS):
        scalars[k] = log_f[k]
    at = head[tb.LOG_I_END] - 1 - len(STARTED_WITH)
    for counter in STARTED_WITH:
        head[counter] = log_i[at]
        at += 1
    for k in range(head[tb.N_TOUCHED]):
        touched[k] = log_i[k]
    for k in range(head[tb.N_WAITING]):
        waiting[k] = log_i[head[tb.N_TOUCHED] + k]


@kernel(signature=(tb.HEAD,))
def commit(head):  # type: ignore[no-untyped-def]
    """End an update: keep its changes, and give the memory of replaced values and cliques back."""
    clique_i, freed = tb.clique_i(head), tb.freed(head)
    for k in range(0, head[tb.N_FREED], 2):
        c, values = freed[k], freed[k + 1]
        if values < 0:
            give_clique(head, c)
        else:
            row = clique_i[c]
            pools.give_values(head, values, pools.n_values(row[tb.N_FRONTAL], row[tb.N_SEPARATOR]))
    head[tb.N_FREED] = head[tb.LOG_F_END] = head[tb.LOG_I_END] = 0


@kernel
def _restore_linearization(head, c):  # type: ignore[no-untyped-def]
    """Restore where a prior was linearized before the update; see `prior_rows`."""
    pool_f, row = tb.pool_f(head), tb.clique_i(head)[c]
    n = 3 * row[tb.N_SEPARATOR]
    at = row[tb.VALUES] + pools.n_values(0, row[tb.N_SEPARATOR]) - 2 * n
    for k in range(at, at + n):
        pool_f[k] = pool_f[k + n]


@kernel(signature=(tb.HEAD,))
def rollback(head):  # type: ignore[no-untyped-def]
    """End an update: restore all rows logged since `begin`, the newest entry first."""
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    log_f, node_i, edge_i = tb.log_f(head), tb.node_i(head), tb.edge_i(head)
    observed_i, clique_i, clique_f = tb.observed_i(head), tb.clique_i(head), tb.clique_f(head)
    log_i = tb.log_i(head)
    end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
    while end_i > 0:
        row, code = log_i[end_i - 2], log_i[end_i - 1]
        if code == START:
            head[tb.LOG_I_END] = end_i
            _restore_start(head)
            break
        end_i -= 2
        if code == TAKEN_CLIQUE:
            if clique_i[row, tb.N_FRONTAL] >= 0:  # else the same update has given it back
                give_clique(head, row)
        elif code == SOLUTION:
            end_f -= tb.SCALE_T
            for k in range(tb.SCALE_T):
                node_f[row, k] = log_f[end_f + k]
        elif code == EDGE_ENERGY:
            end_f -= 2
            end_i -= 1
            edge_f[row, tb.ERROR2], edge_f[row, tb.ENERGY] = log_f[end_f], log_f[end_f + 1]
            edge_i[row, tb.EDGE_WAITS] = log_i[end_i]
        elif code == CLIQUE:
            end_i -= tb.CLIQUE_I
            values = clique_i[row, tb.VALUES]
            if clique_i[row, tb.N_FRONTAL] == 0 and (
                    clique_i[row, tb.VALUES_BORN] == head[tb.UPDATE]):
                _restore_linearization(head, row)
            if values != log_i[end_i + tb.VALUES]:
                pools.give_values(head, values, pools.n_values(
                    clique_i[row, tb.N_FRONTAL], clique_i[row, tb.N_SEPARATOR]))
            for k in range(tb.CLIQUE_I):
                clique_i[row, k] = log_i[end_i + k]
            end_f -= tb.CLIQUE_F
            for k in range(tb.CLIQUE_F):
                clique_f[row, k] = log_f[end_f + k]
        else:
            if code == NODE:
                numbers, integers = node_f[row], node_i[row]
            elif code == EDGE:
                numbers, integers = edge_f[row], edge_i[row]
            else:
                numbers, integers = observed_f[row], observed_i[row]
            end_f -= len(numbers)
            end_i -= len(integers)
            for k in range(len(numbers)):
                numbers[k] = log_f[end_f + k]
            for k in range(len(integers)):
                integers[k] = log_i[end_i + k]
    head[tb.N_FREED] = head[tb.LOG_F_END] = head[tb.LOG_I_END] = 0


@kernel(signature=(tb.HEAD, ROWS))
def poses_before(head, poses):  # type: ignore[no-untyped-def]
    """Write the poses, shape (N, 3), as the update found them; those of new nodes as they are."""
    node_f, log_f, log_i = tb.node_f(head), tb.log_f(head), tb.log_i(head)
    for v in range(head[tb.N_NODES]):
        for k in range(3):
            poses[v, k] = node_f[v, tb.POSE + k]
    end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
    while end_i > 0 and log_i[end_i - 1] != START:
        row, code = log_i[end_i - 2], log_i[end_i - 1]
        end_f -= _FLOATS[code]
        end_i -= 2 + _INTEGERS[code]
        if code in (NODE, SOLUTION):
            for k in range(3):
                poses[row, k] = log_f[end_f + tb.POSE + k]


@kernel
def largest_move(head):  # type: ignore[no-untyped-def]
    """Return by how much the update has moved poses: the largest change of a coordinate [m]."""
    node_f, log_f, node_i = tb.node_f(head), tb.log_f(head), tb.node_i(head)
    log_i = tb.log_i(head)
    largest = 0.0
    end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
    while end_i > 0 and log_i[end_i - 1] != START:
        row, code = log_i[end_i - 2], log_i[end_i - 1]
        end_f -= _FLOATS[code]
        end_i -= 2 + _INTEGERS[code]
        if code in (NODE, SOLUTION) and node_i[row, tb.NODE_TYPE] == 0:
            for k in range(2):
                move = abs(node_f[row, tb.POSE + k] - log_f[end_f + tb.POSE + k])
                largest = max(largest, move)
    return largest
