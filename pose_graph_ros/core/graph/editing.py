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
from pose_graph_ros.core.graph import (
    factor_types,
    factors,
    identities,
    prior_rows,
    rows,
    tables as tb,
    transaction_log,
)
from pose_graph_ros.core.graph.scales import scale_by_edge, scale_by_observed

# Results of `add_rows`.
ADDED, NO_ROOM, UNSOUND = range(3)
# In place of a weight: the constraint leaves the graph for good, when `compaction` takes it out.
DROPPED = -1.0


@kernel
def touch(head, v):  # type: ignore[no-untyped-def]
    """Mark a node for elimination in the next iteration; the caller has logged its row."""
    node_i, touched = tb.node_i(head), tb.touched(head)
    if node_i[v, tb.TOUCHED] == 0:
        node_i[v, tb.TOUCHED] = 1
        touched[head[tb.N_TOUCHED]] = v
        head[tb.N_TOUCHED] += 1


@kernel
def _start_nodes(head, first, first_other, types):  # type: ignore[no-untyped-def]
    """Initialise rows of new hidden nodes: poses, then from `first_other` on the others."""
    node_f, node_i = tb.node_f(head), tb.node_i(head)
    for v in range(first, first_other + len(types)):
        f, i = node_f[v], node_i[v]
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
    node_i, edge_i = tb.node_i(head), tb.edge_i(head)
    clique_i, pool_i = tb.clique_i(head), tb.pool_i(head)
    ends = edge_i[e, tb.END_I:tb.END_K + 1]
    n_ends = 2 if ends[2] < 0 else 3
    for k in range(n_ends):
        c, n = node_i[ends[k], tb.CLIQUE], 0
        if c < 0:
            return False
        row = clique_i[c]
        for m in range(row[tb.NODES], row[tb.NODES] + row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]):
            v = pool_i[m]
            if v == ends[0] or v == ends[1] or v == ends[2]:
                n += 1
        if n == n_ends:
            return True
    return False


@kernel
def _touch_edge(head, e):  # type: ignore[no-untyped-def]
    """Log and touch the ends of an edge; ask for a new ordering if no clique has both."""
    edge_i = tb.edge_i(head)
    if head[tb.STRUCTURE] == 0 and not _have_common_clique(head, e):
        head[tb.STRUCTURE] = 1
    for side in range(3):
        v = edge_i[e, side]
        if v >= 0:
            transaction_log.log_node(head, v)
            touch(head, v)


@kernel
def _link_edge(head, e):  # type: ignore[no-untyped-def]
    """Put an edge at the heads of the lists of its ends; the caller has logged all rows."""
    node_i, edge_i = tb.node_i(head), tb.edge_i(head)
    for side in range(3):
        v = edge_i[e, side]
        if v >= 0:
            edge_i[e, tb.NEXT_I + side] = node_i[v, tb.EDGE_LIST]
            node_i[v, tb.EDGE_LIST] = 4 * e + side


@kernel
def unlink_edge(head, e, side):  # type: ignore[no-untyped-def]
    """
    Take an edge out of the list of one of its ends, whose row has been logged.

    Parameters
    ----------
    e : int, edge
    side : int, 0 for its end I, 1 for J, 2 for K

    """
    node_i, edge_i = tb.node_i(head), tb.edge_i(head)
    v, after = edge_i[e, side], edge_i[e, tb.NEXT_I + side]
    entry = node_i[v, tb.EDGE_LIST]
    if entry == 4 * e + side:
        node_i[v, tb.EDGE_LIST] = after
        return
    while True:
        before, column = entry >> 2, tb.NEXT_I + (entry & 3)
        entry = edge_i[before, column]
        if entry == 4 * e + side:
            transaction_log.log_edge(head, before)
            edge_i[before, column] = after
            return


@kernel
def _unlink_observed(head, k):  # type: ignore[no-untyped-def]
    """Take an observed node out of the list of its hidden node, whose row has been logged."""
    node_i, observed_i = tb.node_i(head), tb.observed_i(head)
    v, after = observed_i[k, tb.OBS_NODE], observed_i[k, tb.OBS_NEXT]
    before = node_i[v, tb.OBSERVED_LIST]
    if before == k:
        node_i[v, tb.OBSERVED_LIST] = after
        return
    while observed_i[before, tb.OBS_NEXT] != k:
        before = observed_i[before, tb.OBS_NEXT]
    transaction_log.log_observed(head, before)
    observed_i[before, tb.OBS_NEXT] = after


@kernel
def weigh_edge(head, e, weight):  # type: ignore[no-untyped-def]
    """
    Change the weight of an edge; at 0 it is in no list.

    Parameters
    ----------
    e : int, row
    weight : float

    """
    edge_f, scalars = tb.edge_f(head), tb.scalars(head)
    f = edge_f[e]
    before = f[tb.WEIGHT]
    if weight == before:
        return
    transaction_log.log_edge(head, e)
    _touch_edge(head, e)
    scale_by_edge(head, e, weight - before)
    scalars[tb.CHI2] -= f[tb.ENERGY]
    f[tb.WEIGHT] = weight
    if weight == 0.0:
        for side in range(3):
            if tb.edge_i(head)[e, side] >= 0:
                unlink_edge(head, e, side)
        f[tb.ERROR2] = f[tb.ENERGY] = 0.0
        return
    if before == 0.0:
        _link_edge(head, e)
    factors.linearize_edge(head, e)
    factors.check_edge(head, e, factors.NO_TURN)
    scalars[tb.CHI2] += f[tb.ENERGY]


@kernel
def weigh_one_observed(head, k, weight):  # type: ignore[no-untyped-def]
    """
    Change the weight of an observed node; at 0 it is in no list.

    Parameters
    ----------
    k : int, row
    weight : float

    """
    observed_f, scalars, observed_i = tb.observed_f(head), tb.scalars(head), tb.observed_i(head)
    node_i = tb.node_i(head)
    f, v = observed_f[k], observed_i[k, tb.OBS_NODE]
    before = f[tb.WEIGHT]
    if weight == before:
        return
    transaction_log.log_observed(head, k)
    transaction_log.log_node(head, v)
    touch(head, v)
    scale_by_observed(head, k, weight - before)
    scalars[tb.CHI2] -= f[tb.ENERGY]
    f[tb.WEIGHT] = weight
    if weight == 0.0:
        _unlink_observed(head, k)
        f[tb.ERROR2] = f[tb.ENERGY] = 0.0
        return
    if before == 0.0:
        observed_i[k, tb.OBS_NEXT], node_i[v, tb.OBSERVED_LIST] = node_i[v, tb.OBSERVED_LIST], k
    factors.linearize_observed(head, k)
    factors.check_observed(head, k)
    scalars[tb.CHI2] += f[tb.ENERGY]


@kernel
def _start_edges(head, first, last):  # type: ignore[no-untyped-def]
    """Initialise new rows of edges, and add those with a weight to the graph."""
    edge_f, edge_i, edge_id = tb.edge_f(head), tb.edge_i(head), tb.edge_id(head)
    for e in range(first, last):
        edge_id[e] = head[tb.NEXT_EDGE]
        head[tb.NEXT_EDGE] += 1
        f, row = edge_f[e], edge_i[e]
        factor_types.prepare(f, row[tb.EDGE_KIND])
        f[tb.ERROR2] = f[tb.ENERGY] = 0.0
        row[tb.EDGE_CHECKED] = row[tb.EDGE_WAITS] = 0
        row[tb.NEXT_I] = -1
        row[tb.EDGE_LOGGED] = head[tb.UPDATE]
        weight, f[tb.WEIGHT] = f[tb.WEIGHT], 0.0
        weigh_edge(head, e, weight)


@kernel
def _start_observed(head, first, last):  # type: ignore[no-untyped-def]
    """Initialise new rows of observed nodes, and add those with a weight to the graph."""
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    observed_id = tb.observed_id(head)
    for k in range(first, last):
        observed_id[k] = head[tb.NEXT_OBSERVED]
        head[tb.NEXT_OBSERVED] += 1
        f, row = observed_f[k], observed_i[k]
        f[tb.ERROR2] = f[tb.ENERGY] = 0.0
        row[tb.OBS_WAITS], row[tb.OBS_NEXT] = 0, -1
        row[tb.OBS_LOGGED] = head[tb.UPDATE]
        weight, f[tb.WEIGHT] = f[tb.WEIGHT], 0.0
        weigh_one_observed(head, k, weight)


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS))
def weigh_edges(head, edges, weights):  # type: ignore[no-untyped-def]
    """
    Set the weights of edges.

    Parameters
    ----------
    edges, weights : ndarray, shape (M,)
        Ids and weights; 0 takes an edge out of all lists, DROPPED out of the graph.

    """
    edge_i = tb.edge_i(head)
    for m in range(len(edges)):
        e = identities.edge_row(head, edges[m])
        weigh_edge(head, e, max(weights[m], 0.0))
        if weights[m] == DROPPED and edge_i[e, tb.NEXT_I] != tb.LEAVES:
            transaction_log.log_edge(head, e)
            edge_i[e, tb.NEXT_I] = tb.LEAVES
            head[tb.N_LEAVING] += 1


@kernel(signature=(tb.HEAD, INTEGERS, ROWS, MATRICES))
def measure_edges(head, edges, means, informations):  # type: ignore[no-untyped-def]
    """
    Give edges other measurements.

    Parameters
    ----------
    edges : ndarray of int, shape (M,), ids
    means, informations : ndarray, shapes (M, 3) and (M, 3, 3)

    """
    edge_f, edge_i, scalars = tb.edge_f(head), tb.edge_i(head), tb.scalars(head)
    for m in range(len(edges)):
        e = identities.edge_row(head, edges[m])
        f = edge_f[e]
        weight = f[tb.WEIGHT]
        transaction_log.log_edge(head, e)
        if weight > 0.0:
            _touch_edge(head, e)
            scale_by_edge(head, e, -weight)
            scalars[tb.CHI2] -= f[tb.ENERGY]
        rows.write_measurement(f, means[m], informations[m])
        factor_types.prepare(f, edge_i[e, tb.EDGE_KIND])
        if weight > 0.0:
            scale_by_edge(head, e, weight)
            factors.linearize_edge(head, e)
            factors.check_edge(head, e, factors.NO_TURN)
            scalars[tb.CHI2] += f[tb.ENERGY]


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS))
def weigh_observed(head, observed, weights):  # type: ignore[no-untyped-def]
    """
    Set the weights of observed nodes.

    Parameters
    ----------
    observed, weights : ndarray, shape (K,), as for `weigh_edges`

    """
    observed_i = tb.observed_i(head)
    for m in range(len(observed)):
        k = identities.observed_row(head, observed[m])
        weigh_one_observed(head, k, max(weights[m], 0.0))
        if weights[m] == DROPPED and observed_i[k, tb.OBS_NEXT] != tb.LEAVES:
            transaction_log.log_observed(head, k)
            observed_i[k, tb.OBS_NEXT] = tb.LEAVES
            head[tb.N_LEAVING] += 1


@kernel(signature=(tb.HEAD, INTEGERS, FLAG))
def set_fixed(head, nodes, fixed):  # type: ignore[no-untyped-def]
    """
    Fix hidden nodes at their present poses, or free them.

    Parameters
    ----------
    nodes : ndarray of int, shape (N,), ids
    fixed : bool

    """
    node_i = tb.node_i(head)
    for node in nodes:
        v = identities.node_row(head, node)
        if (node_i[v, tb.FIXED] != 0) != fixed:
            transaction_log.log_node(head, v)
            node_i[v, tb.FIXED] = 1 if fixed else 0
            touch(head, v)


@kernel
def _lengths_agree(n, mean, information, kind, weight):  # type: ignore[no-untyped-def]
    return (mean.shape == (n, 3) and information.shape == (n, 3, 3) and len(kind) == n
            and len(weight) == n)


@kernel(signature=(
    tb.HEAD, ROWS, ROWS, BYTES, INTEGERS, INTEGERS, ROWS, MATRICES, BYTES, NUMBERS, ROWS,
    INTEGERS, INTEGERS, ROWS, ROWS, MATRICES, BYTES, NUMBERS, FLAG))
def add_rows(  # type: ignore[no-untyped-def]
    head, hidden, others, types, i, j, mean, information, kind, weight, bias, k,
    node, offset, observed_mean, observed_information, observed_kind, observed_weight, checked,
):
    """
    Return ADDED after adding hidden nodes, edges and observed nodes, all of them, or why none.

    NO_ROOM: a table is full. UNSOUND: the rows fail the quick validation of `rows`, and were not
    checked.

    Parameters
    ----------
    hidden : ndarray, shape (N, 3), poses of new nodes
    others, types : ndarray, shapes (S, 3) and (S,)
        Values of new nodes that are no poses, and their NODE_TYPE.
    i, j, mean, information, kind, weight, bias, k : ndarray, columns of `Edges`
    node, offset, observed_mean, observed_information, observed_kind, observed_weight : ndarray
        Columns of `ObservedNodes`.
    checked : bool, whether `constraints.check` has accepted the rows

    """
    first = head[tb.N_NODES]
    first_other = first + len(hidden)
    n_nodes = first_other + len(others)
    n_edges = head[tb.N_EDGES] + len(i)
    n_observed = head[tb.N_OBSERVED] + len(node)
    if (hidden.shape[1] != 3 or others.shape[1] != 3 or len(types) != len(others)
            or len(j) != len(i) or len(k) != len(i)
            or not _lengths_agree(len(i), mean, information, kind, weight)
            or bias.shape != (len(i), 4)
            or offset.shape != (len(node), 3)
            or not _lengths_agree(len(node), observed_mean, observed_information, observed_kind,
                                  observed_weight)):
        return UNSOUND
    if (n_nodes + head[tb.N_PRIORS] > head[tb.NODE_ROOM] or n_edges > head[tb.EDGE_ROOM]
            or n_observed > head[tb.OBSERVED_ROOM]):
        return NO_ROOM
    # rows behind the ends are not part of the graph yet
    valid = rows.write_nodes(head, first, hidden)
    valid = rows.write_nodes(head, first_other, others) and valid
    valid = rows.write_edges(head, n_nodes, first_other, types, i, j, mean, information, kind,
                             weight, bias, k) and valid
    valid = rows.write_all_observed(
        head, n_nodes, first_other, types, node, offset, observed_mean, observed_information,
        observed_kind, observed_weight) and valid
    if not valid and not checked:
        return UNSOUND
    head[tb.N_NODES] = n_nodes
    _start_nodes(head, first, first_other, types)
    first, head[tb.N_EDGES] = head[tb.N_EDGES], n_edges
    _start_edges(head, first, n_edges)
    first, head[tb.N_OBSERVED] = head[tb.N_OBSERVED], n_observed
    _start_observed(head, first, n_observed)
    return ADDED


@kernel(signature=(tb.HEAD,), allocates=True)
def restart(head):  # type: ignore[no-untyped-def]
    """Remove all cliques but the priors, linearize all constraints anew and touch all nodes."""
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    scalars, node_i, edge_i = tb.scalars(head), tb.node_i(head), tb.edge_i(head)
    observed_i = tb.observed_i(head)
    prior_rows.remove_cliques(head)
    head[tb.N_TOUCHED] = head[tb.N_WAITING] = 0
    scalars[tb.CHI2] = 0.0
    head[tb.STRUCTURE] = 1
    for v in range(head[tb.N_NODES]):
        factors.refer_to_pose(node_f[v])
        node_i[v, tb.CLIQUE] = -1
        node_i[v, tb.TOUCHED] = 0
        touch(head, v)
    for e in range(head[tb.N_EDGES]):
        edge_i[e, tb.EDGE_WAITS] = 0
        if edge_f[e, tb.WEIGHT] > 0.0:
            factors.linearize_edge(head, e)
            factors.check_edge(head, e, factors.NO_TURN)
            scalars[tb.CHI2] += edge_f[e, tb.ENERGY]
    for k in range(head[tb.N_OBSERVED]):
        observed_i[k, tb.OBS_WAITS] = 0
        if observed_f[k, tb.WEIGHT] > 0.0:
            factors.linearize_observed(head, k)
            factors.check_observed(head, k)
            scalars[tb.CHI2] += observed_f[k, tb.ENERGY]
    prior_rows.add_energies(head)
