# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Edit the graph in its tables: new rows, new weights, fixed nodes.

Each edit keeps the lists, the diagonal scales and chi2 up to date, and touches the nodes that have
to be eliminated again. Edits of existing rows are not checked here; `graph.Graph` has done so.

Only factors with a weight above 0 are in the lists of their nodes. The others are rows that
nothing looks at: adding one touches no node, and however many there are, solving takes no longer.
"""

from pose_graph_ros.core.compiled.jit import (
    BYTES,
    FLAG,
    INTEGERS,
    kernel,
    MATRICES,
    NUMBERS,
    ROWS,
)
from pose_graph_ros.core.graph import factors, prior_rows, rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.rows import touch

# Results of `add_rows`.
ADDED, NO_ROOM, UNSOUND = range(3)
# In place of a weight: the factor leaves the graph for good, by `removal.compact`.
DROPPED = -1.0


@kernel
def _start_nodes(head, first, first_other, types):  # type: ignore[no-untyped-def]
    """Initialise rows of new hidden nodes: poses, then from `first_other` on the others."""
    for v in range(first, first_other + len(types)):
        f, i = tb.node_f(head)[v], tb.node_i(head)[v]
        factors.refer_to_pose(f)
        f[tb.SCALE_T] = f[tb.SCALE_R] = 0.0
        i[:] = 0
        i[tb.CLIQUE] = i[tb.FACTOR_LIST] = -1
        i[tb.NODE_LOGGED] = head[tb.UPDATE]
        tb.node_id(head)[v] = head[tb.NEXT_NODE]
        head[tb.NEXT_NODE] += 1
        if v >= first_other:
            i[tb.NODE_TYPE] = types[v - first_other]
        touch(head, v)
        head[tb.STRUCTURE] = 1
    if first_other > first:
        head[tb.NEWEST] = first_other - 1


@kernel
def _have_common_clique(head, e):  # type: ignore[no-untyped-def]
    """Tell whether a clique that one end of a factor is frontal in has all its ends."""
    ends, n_ends = tb.factor_i(head)[e, tb.END_I:tb.END_K + 1], 0
    for end in ends:
        n_ends += end >= 0
    for end in ends:
        if end < 0:
            continue
        c, n = tb.node_i(head)[end, tb.CLIQUE], 0
        if c < 0:
            return False
        row = tb.clique_i(head)[c]
        n_nodes = row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]
        for v in tb.pool_i(head)[row[tb.NODES]:row[tb.NODES] + n_nodes]:
            if v == ends[0] or v == ends[1] or v == ends[2]:
                n += 1
        if n == n_ends:
            return True
    return False


@kernel
def _touch_ends(head, e):  # type: ignore[no-untyped-def]
    """Log and touch the ends of a factor; ask for a new ordering if no clique has all."""
    row = tb.factor_i(head)[e]
    if row[tb.END_J] >= 0 and head[tb.STRUCTURE] == 0 and not _have_common_clique(head, e):
        head[tb.STRUCTURE] = 1
    for v in row[tb.END_I:tb.END_K + 1]:
        if v >= 0:
            transaction_log.log_node(head, v)
            touch(head, v)


@kernel
def _link(head, e):  # type: ignore[no-untyped-def]
    """Put a factor at the heads of the lists of its ends; the caller has logged all rows."""
    node_i, row = tb.node_i(head), tb.factor_i(head)[e]
    for side in range(3):
        v = row[side]
        if v >= 0:
            row[tb.NEXT_I + side], node_i[v, tb.FACTOR_LIST] = (
                node_i[v, tb.FACTOR_LIST], 4 * e + side)


@kernel
def unlink(head, e, side):  # type: ignore[no-untyped-def]
    """Take a factor out of the list of one of its ends, whose row has been logged."""
    node_i, factor_i = tb.node_i(head), tb.factor_i(head)
    v, after = factor_i[e, side], factor_i[e, tb.NEXT_I + side]
    at = node_i[v, tb.FACTOR_LIST]
    if at == 4 * e + side:
        node_i[v, tb.FACTOR_LIST] = after
        return
    while True:
        before, link = at >> 2, tb.NEXT_I + (at & 3)
        at = factor_i[before, link]
        if at == 4 * e + side:
            transaction_log.log_factor(head, before)
            factor_i[before, link] = after
            return


@kernel
def _evaluate(head, e):  # type: ignore[no-untyped-def]
    """Linearize a factor, and add its energy to chi2."""
    factors.linearize(head, e)
    factors.check(head, e, factors.NO_TURN)
    tb.scalars(head)[tb.CHI2] += tb.factor_f(head)[e, tb.ENERGY]


@kernel
def weigh(head, e, weight):  # type: ignore[no-untyped-def]
    """Change the weight of a factor; at 0 it is in no list."""
    f, row = tb.factor_f(head)[e], tb.factor_i(head)[e]
    before = f[tb.WEIGHT]
    if weight == before:
        return
    transaction_log.log_factor(head, e)
    _touch_ends(head, e)
    rows.scale_by(head, e, weight - before)
    tb.scalars(head)[tb.CHI2] -= f[tb.ENERGY]
    f[tb.WEIGHT] = weight
    if weight > 0.0:
        if before == 0.0:
            _link(head, e)
        _evaluate(head, e)
        return
    f[tb.ERROR2] = f[tb.ENERGY] = 0.0
    for side in range(3):
        if row[side] >= 0:
            unlink(head, e, side)


@kernel
def _start(head, e):  # type: ignore[no-untyped-def]
    """Initialise the new row of a factor, and add it to the graph if it has a weight."""
    f, row = tb.factor_f(head)[e], tb.factor_i(head)[e]
    factors.prepare(f, row[tb.FACTOR_KIND])
    f[tb.ERROR2] = f[tb.ENERGY] = 0.0
    row[tb.FACTOR_CHECKED] = row[tb.FACTOR_WAITS] = 0
    row[tb.NEXT_I], row[tb.FACTOR_LOGGED] = -1, head[tb.UPDATE]
    tb.factor_id(head)[e] = head[tb.NEXT_FACTOR]
    head[tb.NEXT_FACTOR] += 1
    weight, f[tb.WEIGHT] = f[tb.WEIGHT], 0.0
    weigh(head, e, weight)


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS))
def set_weights(head, ids, weights):  # type: ignore[no-untyped-def]
    """Set weights of factors, by id; 0 takes one out of its lists, DROPPED out of the graph."""
    for m in range(len(ids)):
        e = rows.factor_row(head, ids[m])
        weigh(head, e, max(weights[m], 0.0))
        row = tb.factor_i(head)[e]
        if weights[m] == DROPPED and row[tb.NEXT_I] != tb.LEAVES:
            transaction_log.log_factor(head, e)
            row[tb.NEXT_I] = tb.LEAVES
            head[tb.N_LEAVING] += 1


@kernel(signature=(tb.HEAD, INTEGERS, ROWS, MATRICES))
def measure(head, ids, means, informations):  # type: ignore[no-untyped-def]
    """Give factors, by id, other measurements."""
    for m in range(len(ids)):
        e = rows.factor_row(head, ids[m])
        f = tb.factor_f(head)[e]
        weight = f[tb.WEIGHT]
        transaction_log.log_factor(head, e)
        weigh(head, e, 0.0)
        rows.write_measurement(f, means[m], informations[m])
        factors.prepare(f, tb.factor_i(head)[e, tb.FACTOR_KIND])
        weigh(head, e, weight)


@kernel(signature=(tb.HEAD, INTEGERS, FLAG))
def set_fixed(head, nodes, fixed):  # type: ignore[no-untyped-def]
    """Fix hidden nodes, by id, at their present poses, or free them."""
    node_i = tb.node_i(head)
    for node in nodes:
        v = rows.node_row(head, node)
        if (node_i[v, tb.FIXED] != 0) != fixed:
            transaction_log.log_node(head, v)
            node_i[v, tb.FIXED] = 1 if fixed else 0
            touch(head, v)


@kernel
def _lengths_agree(columns):  # type: ignore[no-untyped-def]
    i, j, mean, information, kind, weight, constants, k = columns
    n = len(i)
    return (mean.shape == (n, 3) and information.shape == (n, 3, 3) and constants.shape == (n, 4)
            and len(j) == n and len(kind) == n and len(weight) == n and len(k) == n)


@kernel(signature=(tb.HEAD, ROWS, ROWS, BYTES, INTEGERS, INTEGERS, ROWS, MATRICES, BYTES, NUMBERS,
                   ROWS, INTEGERS, FLAG))
def add_rows(  # type: ignore[no-untyped-def]
    head, hidden, others, types, i, j, mean, information, kind, weight, constants, k, checked,
):
    """
    Return ADDED after adding hidden nodes and factors, all of them, or why none.

    NO_ROOM: a table is full. UNSOUND: the rows fail the quick validation of `rows`, and
    `checks.check` has not accepted them (`checked`). `others` are values of new nodes that are no
    poses, with their NODE_TYPEs; the columns of factors follow.
    """
    columns = i, j, mean, information, kind, weight, constants, k
    first = head[tb.N_NODES]
    first_other = first + len(hidden)
    n_nodes = first_other + len(others)
    n_factors = head[tb.N_FACTORS] + len(i)
    if (hidden.shape[1] != 3 or others.shape[1] != 3 or len(types) != len(others)
            or not _lengths_agree(columns)):
        return UNSOUND
    if n_nodes + head[tb.N_PRIORS] > head[tb.NODE_ROOM] or n_factors > head[tb.FACTOR_ROOM]:
        return NO_ROOM
    # rows behind the ends are not part of the graph yet
    valid = rows.write_nodes(head, first, hidden)
    valid = rows.write_nodes(head, first_other, others) and valid
    valid = rows.write_rows(head, n_nodes, first_other, types, columns) and valid
    if not valid and not checked:
        return UNSOUND
    head[tb.N_NODES] = n_nodes
    _start_nodes(head, first, first_other, types)
    head[tb.N_FACTORS] = n_factors
    for e in range(n_factors - len(i), n_factors):
        _start(head, e)
    return ADDED


@kernel(signature=(tb.HEAD,), allocates=True)
def restart(head):  # type: ignore[no-untyped-def]
    """Remove all cliques but the priors, linearize all factors anew and touch all nodes."""
    node_i = tb.node_i(head)
    prior_rows.remove_cliques(head)
    head[tb.N_TOUCHED] = head[tb.N_WAITING] = 0
    tb.scalars(head)[tb.CHI2] = 0.0
    head[tb.STRUCTURE] = 1
    for v in range(head[tb.N_NODES]):
        factors.refer_to_pose(tb.node_f(head)[v])
        node_i[v, tb.CLIQUE] = -1
        node_i[v, tb.TOUCHED] = 0
        touch(head, v)
    for e in range(head[tb.N_FACTORS]):
        tb.factor_i(head)[e, tb.FACTOR_WAITS] = 0
        if tb.factor_f(head)[e, tb.WEIGHT] > 0.0:
            _evaluate(head, e)
    prior_rows.add_energies(head)
