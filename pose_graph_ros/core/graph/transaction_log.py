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

# Kinds of entries of the log; an entry ends with its row (none of START) and its kind in log_i.
NODE, FACTOR, CLIQUE, TAKEN_CLIQUE, SOLUTION, ENERGY, START = range(7)
# Numbers of floats and of integers in the entries of each kind, but for START.
_FLOATS = (tb.NODE_F, tb.FACTOR_F, tb.CLIQUE_F, 0, tb.SCALE_T, 2)
_INTEGERS = (tb.NODE_I, tb.FACTOR_I, tb.CLIQUE_I, 0, 0, 1)
# Counters in the first entry.
STARTED_WITH = (
    tb.N_NODES, tb.N_FACTORS, tb.STRUCTURE, tb.N_TOUCHED, tb.N_WAITING, tb.NEWEST, tb.NEXT_NODE,
    tb.NEXT_FACTOR, tb.N_LEAVING, tb.N_PRIORS, tb.LOOSE)


@kernel
def copied(source, target):  # type: ignore[no-untyped-def]
    """Copy the first numbers of an array to another one, as many as that has."""
    for k in range(len(target)):
        target[k] = source[k]


@kernel
def _append(head, code, row, numbers, integers):  # type: ignore[no-untyped-def]
    """Append an entry: floats and integers of a row."""
    log_f, log_i = tb.log_f(head), tb.log_i(head)
    end_f, end_i = head[tb.LOG_F_END] + len(numbers), head[tb.LOG_I_END] + len(integers)
    copied(numbers, log_f[head[tb.LOG_F_END]:end_f])
    copied(integers, log_i[head[tb.LOG_I_END]:end_i])
    log_i[end_i], log_i[end_i + 1] = row, code
    head[tb.LOG_F_END], head[tb.LOG_I_END] = end_f, end_i + 2


@kernel
def _log_row(head, code, row, numbers, integers, stamp):  # type: ignore[no-untyped-def]
    """Log a whole row, unless its stamp says that this update has done so."""
    if integers[stamp] != head[tb.UPDATE]:
        _append(head, code, row, numbers, integers)
        integers[stamp] = head[tb.UPDATE]


@kernel
def log_node(head, v):  # type: ignore[no-untyped-def]
    """Log the row of a node, before it changes."""
    _log_row(head, NODE, v, tb.node_f(head)[v], tb.node_i(head)[v], tb.NODE_LOGGED)


@kernel
def log_solution(head, v):  # type: ignore[no-untyped-def]
    """Log the columns of a node that a solve changes, before they change."""
    row = tb.node_i(head)[v]
    if row[tb.NODE_LOGGED] != head[tb.UPDATE] and row[tb.SOLUTION_LOGGED] != head[tb.UPDATE]:
        row[tb.SOLUTION_LOGGED] = head[tb.UPDATE]
        _append(head, SOLUTION, v, tb.node_f(head)[v, :tb.SCALE_T], row[:0])


@kernel
def log_energy(head, e):  # type: ignore[no-untyped-def]
    """Log the linearization error and the energy of a factor, before they change."""
    row = tb.factor_i(head)[e]
    if row[tb.FACTOR_LOGGED] != head[tb.UPDATE] and row[tb.ENERGY_LOGGED] != head[tb.UPDATE]:
        row[tb.ENERGY_LOGGED] = head[tb.UPDATE]
        _append(head, ENERGY, e, tb.factor_f(head)[e, tb.ERROR2:tb.ENERGY + 1],
                row[tb.FACTOR_WAITS:tb.FACTOR_WAITS + 1])


@kernel
def log_factor(head, e):  # type: ignore[no-untyped-def]
    """Log the row of a factor, before it changes."""
    _log_row(head, FACTOR, e, tb.factor_f(head)[e], tb.factor_i(head)[e], tb.FACTOR_LOGGED)


@kernel
def log_clique(head, c):  # type: ignore[no-untyped-def]
    """Log the row of a clique, before it changes."""
    _log_row(head, CLIQUE, c, tb.clique_f(head)[c], tb.clique_i(head)[c], tb.CLIQUE_LOGGED)


@kernel
def take_clique(head, n_frontal, n_separator):  # type: ignore[no-untyped-def]
    """Return the row of a new clique with memory for its nodes and values."""
    clique_i, c = tb.clique_i(head), head[tb.FREE_CLIQUE]
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
    _append(head, TAKEN_CLIQUE, c, tb.clique_f(head)[c, :0], row[:0])
    return c


@kernel
def give_clique(head, c):  # type: ignore[no-untyped-def]
    """Give the row of a clique and its memory back."""
    row = tb.clique_i(head)[c]
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
    if tb.clique_i(head)[c, tb.BORN] == head[tb.UPDATE]:
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
    row = tb.clique_i(head)[c]
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
    log_i, n_touched = tb.log_i(head), head[tb.N_TOUCHED]
    head[tb.UPDATE] += 1
    copied(tb.scalars(head), tb.log_f(head)[:tb.N_SCALARS])
    end = n_touched + head[tb.N_WAITING]
    copied(tb.touched(head), log_i[:n_touched])
    copied(tb.waiting(head), log_i[n_touched:end])
    for counter in STARTED_WITH:
        log_i[end] = head[counter]
        end += 1
    log_i[end] = START
    head[tb.LOG_F_END], head[tb.LOG_I_END], head[tb.N_FREED] = tb.N_SCALARS, end + 1, 0
    return head[tb.FRONT_SERIAL] <= tb.LAST_STAMP and head[tb.UPDATE] <= tb.LAST_STAMP + 1


@kernel
def _restore_start(head):  # type: ignore[no-untyped-def]
    """Restore counters, scalars and lists from the first entry, the only one left in the log."""
    log_i, at = tb.log_i(head), head[tb.LOG_I_END] - 1 - len(STARTED_WITH)
    copied(tb.log_f(head), tb.scalars(head)[:tb.N_SCALARS])
    for counter in STARTED_WITH:
        head[counter] = log_i[at]
        at += 1
    n_touched = head[tb.N_TOUCHED]
    copied(log_i, tb.touched(head)[:n_touched])
    copied(log_i[n_touched:], tb.waiting(head)[:head[tb.N_WAITING]])


@kernel(signature=(tb.HEAD,))
def commit(head):  # type: ignore[no-untyped-def]
    """End an update: keep its changes, and give the memory of replaced values and cliques back."""
    freed = tb.freed(head)
    for k in range(0, head[tb.N_FREED], 2):
        c, values = freed[k], freed[k + 1]
        if values < 0:
            give_clique(head, c)
        else:
            row = tb.clique_i(head)[c]
            pools.give_values(head, values, pools.n_values(row[tb.N_FRONTAL], row[tb.N_SEPARATOR]))
    head[tb.N_FREED] = head[tb.LOG_F_END] = head[tb.LOG_I_END] = 0


@kernel
def _restore_values(head, c, before):  # type: ignore[no-untyped-def]
    """Restore a clique's values, which were at the index `before`, ahead of its row."""
    pool_f, row = tb.pool_f(head), tb.clique_i(head)[c]
    size = pools.n_values(row[tb.N_FRONTAL], row[tb.N_SEPARATOR])
    if row[tb.N_FRONTAL] == 0 and row[tb.VALUES_BORN] == head[tb.UPDATE]:
        # where a prior was linearized before; see `prior_rows`
        end, n = row[tb.VALUES] + size, 3 * row[tb.N_SEPARATOR]
        copied(pool_f[end - n:], pool_f[end - 2 * n:end - n])
    if row[tb.VALUES] != before:
        pools.give_values(head, row[tb.VALUES], size)


@kernel(signature=(tb.HEAD,))
def rollback(head):  # type: ignore[no-untyped-def]
    """End an update: restore all rows logged since `begin`, the newest entry first."""
    clique_i, log_f, log_i = tb.clique_i(head), tb.log_f(head), tb.log_i(head)
    end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
    while end_i > 0:
        row, code = log_i[end_i - 2], log_i[end_i - 1]
        if code == START:
            head[tb.LOG_I_END] = end_i
            _restore_start(head)
            break
        end_f -= _FLOATS[code]
        end_i -= 2 + _INTEGERS[code]
        numbers, integers = log_f[:0], log_i[:0]
        if code == TAKEN_CLIQUE:
            if clique_i[row, tb.N_FRONTAL] >= 0:  # else the same update has given it back
                give_clique(head, row)
        elif code == NODE:
            numbers, integers = tb.node_f(head)[row], tb.node_i(head)[row]
        elif code == SOLUTION:
            numbers = tb.node_f(head)[row, :tb.SCALE_T]
        elif code == FACTOR:
            numbers, integers = tb.factor_f(head)[row], tb.factor_i(head)[row]
        elif code == ENERGY:
            numbers = tb.factor_f(head)[row, tb.ERROR2:tb.ENERGY + 1]
            integers = tb.factor_i(head)[row, tb.FACTOR_WAITS:tb.FACTOR_WAITS + 1]
        else:
            _restore_values(head, row, log_i[end_i + tb.VALUES])
            numbers, integers = tb.clique_f(head)[row], clique_i[row]
        copied(log_f[end_f:], numbers)
        copied(log_i[end_i:], integers)
    head[tb.N_FREED] = head[tb.LOG_F_END] = head[tb.LOG_I_END] = 0


@kernel(signature=(tb.HEAD, ROWS))
def poses_before(head, poses):  # type: ignore[no-untyped-def]
    """Write the poses, shape (N, 3), as the update found them; those of new nodes as they are."""
    node_f, log_f, log_i = tb.node_f(head), tb.log_f(head), tb.log_i(head)
    for v in range(head[tb.N_NODES]):
        copied(node_f[v, tb.POSE:], poses[v])
    end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
    while end_i > 0 and log_i[end_i - 1] != START:
        row, code = log_i[end_i - 2], log_i[end_i - 1]
        end_f -= _FLOATS[code]
        end_i -= 2 + _INTEGERS[code]
        if code in (NODE, SOLUTION):
            copied(log_f[end_f + tb.POSE:], poses[row])


@kernel
def largest_move(head):  # type: ignore[no-untyped-def]
    """Return by how much the update has moved poses: the largest change of a coordinate [m]."""
    node_f, log_i, largest = tb.node_f(head), tb.log_i(head), 0.0
    end_f, end_i = head[tb.LOG_F_END], head[tb.LOG_I_END]
    while end_i > 0 and log_i[end_i - 1] != START:
        row, code = log_i[end_i - 2], log_i[end_i - 1]
        end_f -= _FLOATS[code]
        end_i -= 2 + _INTEGERS[code]
        if code in (NODE, SOLUTION) and tb.node_i(head)[row, tb.NODE_TYPE] == 0:
            for k in range(tb.POSE, tb.POSE + 2):
                largest = max(largest, abs(node_f[row, k] - tb.log_f(head)[end_f + k]))
    return largest
