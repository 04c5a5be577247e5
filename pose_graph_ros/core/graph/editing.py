# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Edit the graph in its tables: new rows, new weights, fixed nodes.

Each edit keeps the lists, the diagonal scales and chi2 up to date, and touches the nodes that have
to be eliminated again. Edits of existing rows are not checked here; `graph.Graph` has done so.

Only constraints with a weight above 0 are in the lists of their nodes. The others are rows that
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
# In place of a weight: the constraint leaves the graph for good, by `removal.compact`.
DROPPED = -1.0


@kernel
def _start_nodes(head, first, first_other, types):  # type: ignore[no-untyped-def]
    """Initialise rows of new hidden nodes: poses, then from `first_other` on the others."""
    for v in range(first, first_other + len(types)):
        f, i = tb.node_f(head)[v], tb.node_i(head)[v]
        factors.refer_to_pose(f)
        f[tb.SCALE_T] = f[tb.SCALE_R] = 0.0
        i[:] = 0
        i[tb.CLIQUE] = i[tb.EDGE_LIST] = i[tb.OBSERVED_LIST] = -1
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
    """Tell whether a clique that one end of an edge is frontal in has all its ends."""
    ends = tb.edge_i(head)[e, tb.END_I:tb.END_K + 1]
    n_ends = 2 if ends[2] < 0 else 3
    for k in range(n_ends):
        c, n = tb.node_i(head)[ends[k], tb.CLIQUE], 0
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
def _touch_ends(head, entry):  # type: ignore[no-untyped-def]
    """Log and touch the ends of a constraint; ask for a new ordering if no clique has all."""
    _, _, i, j, k = factors.parts(head, entry)
    if entry >= 0 and head[tb.STRUCTURE] == 0 and not _have_common_clique(head, entry):
        head[tb.STRUCTURE] = 1
    for v in (i, j, k):
        if v >= 0:
            transaction_log.log_node(head, v)
            touch(head, v)


@kernel
def _link(head, entry):  # type: ignore[no-untyped-def]
    """Put a constraint at the heads of the lists of its ends; the caller has logged all rows."""
    node_i, (_, row) = tb.node_i(head), factors.rows_of(head, entry)
    for side in range(3):
        v = row[side]
        if v >= 0:
            column, name = _listed_as(entry, side)
            row[tb.NEXT_I + side], node_i[v, column] = node_i[v, column], name


@kernel
def _listed_as(entry, side):  # type: ignore[no-untyped-def]
    """Return in which list of an end a constraint is, and as which number."""
    return (tb.EDGE_LIST, 4 * entry + side) if entry >= 0 else (tb.OBSERVED_LIST, -1 - entry)


@kernel
def unlink(head, entry, side):  # type: ignore[no-untyped-def]
    """Take a constraint out of the list of one of its ends, whose row has been logged."""
    node_i, (_, row) = tb.node_i(head), factors.rows_of(head, entry)
    column, name = _listed_as(entry, side)
    v, after = row[side], row[tb.NEXT_I + side]
    at = node_i[v, column]
    if at == name:
        node_i[v, column] = after
        return
    while True:
        before, link = (at >> 2, tb.NEXT_I + (at & 3)) if entry >= 0 else (-1 - at, tb.NEXT_I)
        row = factors.rows_of(head, before)[1]
        at = row[link]
        if at == name:
            transaction_log.log_constraint(head, before)
            row[link] = after
            return


@kernel
def _evaluate(head, entry):  # type: ignore[no-untyped-def]
    """Linearize a constraint, and add its energy to chi2."""
    factors.linearize(head, entry)
    factors.check(head, entry, factors.NO_TURN)
    tb.scalars(head)[tb.CHI2] += factors.parts(head, entry)[0][tb.ENERGY]


@kernel
def weigh(head, entry, weight):  # type: ignore[no-untyped-def]
    """Change the weight of a constraint; at 0 it is in no list."""
    f, _, _, _, _ = factors.parts(head, entry)
    before = f[tb.WEIGHT]
    if weight == before:
        return
    transaction_log.log_constraint(head, entry)
    _touch_ends(head, entry)
    rows.scale_by(head, entry, weight - before)
    tb.scalars(head)[tb.CHI2] -= f[tb.ENERGY]
    f[tb.WEIGHT] = weight
    if weight > 0.0:
        if before == 0.0:
            _link(head, entry)
        _evaluate(head, entry)
        return
    f[tb.ERROR2] = f[tb.ENERGY] = 0.0
    for side in range(3):
        if factors.rows_of(head, entry)[1][side] >= 0:
            unlink(head, entry, side)


@kernel
def _start(head, entry):  # type: ignore[no-untyped-def]
    """Initialise the new row of a constraint, and add it to the graph if it has a weight."""
    f, kind, _, _, _ = factors.parts(head, entry)
    factors.prepare(f, kind)
    f[tb.ERROR2] = f[tb.ENERGY] = 0.0
    row = factors.rows_of(head, entry)[1]
    row[tb.EDGE_CHECKED] = row[tb.EDGE_WAITS] = 0
    row[tb.NEXT_I], row[tb.EDGE_LOGGED] = -1, head[tb.UPDATE]
    if entry >= 0:
        tb.edge_id(head)[entry] = head[tb.NEXT_EDGE]
        head[tb.NEXT_EDGE] += 1
    else:
        tb.observed_id(head)[-1 - entry] = head[tb.NEXT_OBSERVED]
        head[tb.NEXT_OBSERVED] += 1
    weight, f[tb.WEIGHT] = f[tb.WEIGHT], 0.0
    weigh(head, entry, weight)


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS, FLAG))
def set_weights(head, ids, weights, of_edges):  # type: ignore[no-untyped-def]
    """
    Set the weights of edges or observed nodes, by id.

    0 takes one out of all lists, DROPPED out of the graph.
    """
    for m in range(len(ids)):
        entry = rows.entry_of(head, ids[m], of_edges)
        weigh(head, entry, max(weights[m], 0.0))
        row = factors.rows_of(head, entry)[1]
        if weights[m] == DROPPED and row[tb.NEXT_I] != tb.LEAVES:
            transaction_log.log_constraint(head, entry)
            row[tb.NEXT_I] = tb.LEAVES
            head[tb.N_LEAVING] += 1


@kernel(signature=(tb.HEAD, INTEGERS, ROWS, MATRICES))
def measure_edges(head, edges, means, informations):  # type: ignore[no-untyped-def]
    """Give edges, by id, other measurements."""
    for m in range(len(edges)):
        e = rows.entry_of(head, edges[m], True)
        f, kind, _, _, _ = factors.parts(head, e)
        weight = f[tb.WEIGHT]
        transaction_log.log_constraint(head, e)
        weigh(head, e, 0.0)
        rows.write_measurement(f, means[m], informations[m])
        factors.prepare(f, kind)
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
    i, j, mean, information, kind, weight, bias, k = columns
    n = len(i)
    return (mean.shape == (n, 3) and information.shape == (n, 3, 3) and bias.shape == (n, 4)
            and len(j) == n and len(kind) == n and len(weight) == n and len(k) == n)


_COLUMNS = (INTEGERS, INTEGERS, ROWS, MATRICES, BYTES, NUMBERS, ROWS, INTEGERS)


@kernel(signature=(tb.HEAD, ROWS, ROWS, BYTES, *_COLUMNS, *_COLUMNS, FLAG))
def add_rows(  # type: ignore[no-untyped-def]
    head, hidden, others, types, i, j, mean, information, kind, weight, bias, k,
    node, to, observed_mean, observed_information, observed_kind, observed_weight, offset, third,
    checked,
):
    """
    Return ADDED after adding hidden nodes, edges and observed nodes, all of them, or why none.

    NO_ROOM: a table is full. UNSOUND: the rows fail the quick validation of `rows`, and
    `checks.check` has not accepted them (`checked`). `others` are values of new nodes that are no
    poses, with their NODE_TYPEs; the columns of edges follow, and of observed nodes as edges.
    """
    edges = i, j, mean, information, kind, weight, bias, k
    observed = (node, to, observed_mean, observed_information, observed_kind, observed_weight,
                offset, third)
    first = head[tb.N_NODES]
    first_other = first + len(hidden)
    n_nodes = first_other + len(others)
    n_edges = head[tb.N_EDGES] + len(i)
    n_observed = head[tb.N_OBSERVED] + len(node)
    if (hidden.shape[1] != 3 or others.shape[1] != 3 or len(types) != len(others)
            or not _lengths_agree(edges) or not _lengths_agree(observed)):
        return UNSOUND
    if (n_nodes + head[tb.N_PRIORS] > head[tb.NODE_ROOM] or n_edges > head[tb.EDGE_ROOM]
            or n_observed > head[tb.OBSERVED_ROOM]):
        return NO_ROOM
    # rows behind the ends are not part of the graph yet
    valid = rows.write_nodes(head, first, hidden)
    valid = rows.write_nodes(head, first_other, others) and valid
    valid = rows.write_rows(head, True, n_nodes, first_other, types, edges) and valid
    valid = rows.write_rows(head, False, n_nodes, first_other, types, observed) and valid
    if not valid and not checked:
        return UNSOUND
    head[tb.N_NODES] = n_nodes
    _start_nodes(head, first, first_other, types)
    head[tb.N_EDGES], head[tb.N_OBSERVED] = n_edges, n_observed
    for e in range(n_edges - len(i), n_edges):
        _start(head, e)
    for row in range(n_observed - len(node), n_observed):
        _start(head, -1 - row)
    return ADDED


@kernel(signature=(tb.HEAD,), allocates=True)
def restart(head):  # type: ignore[no-untyped-def]
    """Remove all cliques but the priors, linearize all constraints anew and touch all nodes."""
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
    for entry in range(-head[tb.N_OBSERVED], head[tb.N_EDGES]):
        factors.rows_of(head, entry)[1][tb.EDGE_WAITS] = 0
        if factors.is_used(head, entry):
            _evaluate(head, entry)
    prior_rows.add_energies(head)
