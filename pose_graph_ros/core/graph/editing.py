# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Edit the graph in its tables: new rows, new weights, fixed nodes.

Each edit keeps the lists, the diagonal scales and chi2 up to date, and touches the nodes that have
to be eliminated again. Edits of existing rows are not checked here; `graph.Graph` has done so.

Only factors with a weight above 0 are in the lists of their nodes. The others are rows that
nothing looks at: adding one touches no node, and however many there are, solving takes no longer.

What is removed for good, nodes and factors, leaves all lists within an update, and with it the
tree, but keeps its rows, which are logged as any other edit; so a rollback brings them back. After
the update `compact` takes the rows out: those that stay move up, in their order, and all that
refers to a row is rewritten. A factor leaves with any of its nodes. Cliques keep their rows.
"""

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph import factors, prior_rows, rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.constraints import FACTORS, NodeKind
from pose_graph_ros.core.graph.graph_update import Gone
from pose_graph_ros.core.graph.pools import is_among, separator
from pose_graph_ros.core.graph.rows import touch

# Results of `add_rows`.
ADDED, NO_ROOM, UNSOUND = range(3)
# In place of a weight: the factor leaves the graph for good, by `compact`.
DROPPED = -1.0
# By kind, whether factors are between nodes that are no biases.
_ARE_EDGES = np.array([factor.j not in {(), (NodeKind.BIAS,)} for factor in FACTORS.values()])
NOTHING_GONE = Gone(*np.empty((2, 0), np.int64))


@kernel
def _have_common_clique(head, e):  # type: ignore[no-untyped-def]
    """Tell whether a clique that one end of a factor is frontal in has all its ends."""
    ends = tb.factors(head)[e].ends
    i, j, k = ends[0], ends[1], ends[2]
    for end in (i, j, k):
        if end < 0:
            continue
        c = tb.nodes(head)[end].clique
        if c < 0:
            return False
        clique = tb.cliques(head)[c]
        n_nodes = clique.n_frontal + clique.n_separator
        members = tb.pool_i(head)[clique.members:clique.members + n_nodes]
        if (is_among(i, members) and (j < 0 or is_among(j, members))
                and (k < 0 or is_among(k, members))):
            return True
    return False


@kernel
def unlink(head, e, side):  # type: ignore[no-untyped-def]
    """Take a factor out of the list of one of its ends, whose row has been logged."""
    factors = tb.factors(head)
    node, after = tb.nodes(head)[factors[e].ends[side]], factors[e].next[side]
    at = node.factor_list
    if at == 4 * e + side:
        node.factor_list = after
        return
    while factors[at >> 2].next[at & 3] != 4 * e + side:
        at = factors[at >> 2].next[at & 3]
    transaction_log.log_factor(head, at >> 2)
    factors[at >> 2].next[at & 3] = after


@kernel
def weigh(head, e, weight):  # type: ignore[no-untyped-def]
    """Change the weight of a factor; at 0 it is in no list."""
    nodes, f = tb.nodes(head), tb.factors(head)[e]
    before = f.weight
    if weight == before:
        return
    transaction_log.log_factor(head, e)
    if f.ends[1] >= 0 and head[tb.STRUCTURE] == 0 and not _have_common_clique(head, e):
        head[tb.STRUCTURE] = 1
    for side in range(3):
        v = f.ends[side]
        if v < 0:
            continue
        touch(head, v)
        if weight == 0.0:
            unlink(head, e, side)
        elif before == 0.0:     # put it at the head of the list
            f.next[side], nodes[v].factor_list = nodes[v].factor_list, 4 * e + side
    rows.scale_by(head, e, weight - before)
    tb.scalars(head)[0].chi2 -= f.energy
    f.weight = weight
    f.error2 = f.energy = 0.0
    if weight > 0.0:
        factors.linearize(head, e)
        factors.check(head, e, factors.NO_TURN)
        tb.scalars(head)[0].chi2 += f.energy


@kernel(signature=(tb.HEAD, jit.INTEGERS, jit.NUMBERS))
def set_weights(head, chosen, weights):  # type: ignore[no-untyped-def]
    """Set weights of factors, by row; 0 takes one out of its lists, DROPPED out of the graph."""
    for m in range(len(chosen)):
        e = chosen[m]
        weigh(head, e, max(weights[m], 0.0))
        f = tb.factors(head)[e]
        if weights[m] == DROPPED and f.next[0] != tb.LEAVES:
            transaction_log.log_factor(head, e)
            f.next[0] = tb.LEAVES
            head[tb.N_LEAVING] += 1


@kernel(signature=(tb.HEAD, jit.INTEGERS, jit.ROWS, jit.MATRICES))
def measure(head, chosen, means, informations):  # type: ignore[no-untyped-def]
    """Give factors, by row, other measurements."""
    for m in range(len(chosen)):
        e = chosen[m]
        f = tb.factors(head)[e]
        weight = f.weight
        transaction_log.log_factor(head, e)
        weigh(head, e, 0.0)
        rows.write_measurement(f, means[m], informations[m])
        factors.prepare(f, f.kind)
        weigh(head, e, weight)


@kernel(signature=(tb.HEAD, jit.INTEGERS, jit.FLAG))
def set_fixed(head, chosen, fixed):  # type: ignore[no-untyped-def]
    """Fix hidden nodes, by row, at their present poses, or free them."""
    nodes = tb.nodes(head)
    for v in chosen:
        if (nodes[v].fixed != 0) != fixed:
            touch(head, v)
            nodes[v].fixed = 1 if fixed else 0


def find_newest_and_fixed(memory: tb.Memory) -> None:
    """Note the newest pose and the first fixed node, of those that do not leave."""
    nodes = memory['nodes'][:memory.head[tb.N_NODES]]
    stays = nodes['factor_list'] != tb.LEAVES
    for counter, of_kind, place in ((tb.NEWEST, nodes['kind'] == np.uint8(NodeKind.POSE), -1),
                                    (tb.FIXED, nodes['fixed'] != 0, 0)):
        found = np.flatnonzero(stays & of_kind)
        memory.head[counter] = found[place] if len(found) > 0 else -1


@kernel(signature=(tb.HEAD, jit.ROWS, jit.BYTES, tb.RECORDS, jit.FLAG))
def add_rows(head, values, types, records, checked):  # type: ignore[no-untyped-def]
    """
    Return ADDED after adding hidden nodes and factors, all of them, or why none.

    NO_ROOM: a table is full. UNSOUND: the rows fail the quick validation of `rows`, and
    `checks.check` has not accepted them (`checked`). Nodes are given by their values and types, as
    by `checks.new_nodes`; the records are those of `Factors`.
    """
    nodes, first = tb.nodes(head), head[tb.N_NODES]
    n_nodes, n_factors = first + len(values), head[tb.N_FACTORS] + len(records)
    if values.shape[1] != 3 or len(types) != len(values):
        return UNSOUND
    if n_nodes + head[tb.N_PRIORS] > head[tb.NODE_ROOM] or n_factors > head[tb.FACTOR_ROOM]:
        return NO_ROOM
    # rows behind the ends are not part of the graph yet
    valid = rows.write_nodes(head, first, values, types)
    valid = rows.write_rows(head, n_nodes, records) and valid
    if not valid and not checked:
        return UNSOUND
    head[tb.N_NODES] = n_nodes
    for v in range(first, n_nodes):
        rows.start_node(head, v)
        tb.node_id(head)[v] = head[tb.NEXT_NODE]
        head[tb.NEXT_NODE] += 1
        touch(head, v)
        head[tb.STRUCTURE] = 1
        if nodes[v].kind == NodeKind.POSE:
            head[tb.NEWEST] = v
        head[tb.N_BIASES] += nodes[v].kind == NodeKind.BIAS
    head[tb.N_FACTORS] = n_factors
    for e in range(n_factors - len(records), n_factors):
        f = tb.factors(head)[e]
        factors.prepare(f, f.kind)
        head[tb.N_EDGES] += _ARE_EDGES[f.kind]
        f.error2 = f.energy = 0.0
        f.checked = f.waits = 0
        f.next[0], f.logged = -1, head[tb.UPDATE]
        tb.factor_id(head)[e] = head[tb.NEXT_FACTOR]
        head[tb.NEXT_FACTOR] += 1
        weight, f.weight = f.weight, 0.0
        weigh(head, e, weight)
    return ADDED


@kernel(signature=(tb.HEAD,), allocates=True)
def restart(head):  # type: ignore[no-untyped-def]
    """Remove all cliques but the priors, linearize all factors anew and touch all nodes."""
    prior_rows.remove_cliques(head)
    head[tb.N_TOUCHED], head[tb.STRUCTURE] = head[tb.N_NODES], 1
    for v in range(head[tb.N_NODES]):
        tb.nodes(head)[v].clique, tb.nodes(head)[v].touched = -1, 1
        tb.touched(head)[v] = v
    factors.linearize_all(head)
    settle(head)


@kernel(signature=(tb.HEAD,), allocates=True)
def settle(head):  # type: ignore[no-untyped-def]
    """
    Evaluate all factors and bring the tables into the state after a step of the smoother.

    If the sum of the squared linearization errors exceeds the smoother's budget, the factors
    with large errors are listed in `waiting`, to be linearized again in its next step.
    """
    nodes, scalars, waiting = tb.nodes(head), tb.scalars(head)[0], tb.waiting(head)
    for v in range(head[tb.N_NODES]):
        for k in range(3):
            nodes[v].seen[k] = nodes[v].delta[k]
    chi2 = error2 = 0.0
    for e in range(head[tb.N_FACTORS]):
        f = tb.factors(head)[e]
        f.waits = 0
        if f.weight > 0.0:
            factors.check(head, e, factors.NO_TURN)
            chi2 += f.energy
            error2 += f.error2
    scalars.chi2 = chi2
    for c in prior_rows.all_priors(head):
        tb.cliques(head)[c].energy = 0.0
        prior_rows.update_energy(head, c)
    head[tb.N_WAITING] = head[tb.N_TURNED] = head[tb.REFINED] = head[tb.LISTED] = 0
    if not 0.0 < scalars.budget < error2:
        return
    threshold = factors.LEAST_FRACTION * scalars.share
    for e in range(head[tb.N_FACTORS]):
        f = tb.factors(head)[e]
        if f.error2 > threshold:
            f.waits = 1
            waiting[head[tb.N_WAITING]] = e
            head[tb.N_WAITING] += 1


# --- removal for good, in two steps --------------------------------------------------------------

@kernel
def touch_with(head, v, spared):  # type: ignore[no-untyped-def]
    """
    Touch a node, and one of each clique that has it, but for those that are spared.

    They are a subtree below the clique that it is frontal in. A clique may have it in the
    separator although no constraint below leads to it any more.
    """
    nodes, cliques, stack = tb.nodes(head), tb.cliques(head), tb.work_i(head)
    touch(head, v)
    stack[0], depth = nodes[v].clique, 1 if nodes[v].clique >= 0 else 0
    while depth > 0:
        depth -= 1
        c = cliques[stack[depth]].child
        while c >= 0:
            if cliques[c].n_frontal > 0 and not spared[c] and is_among(
                    v, separator(head, c)):
                touch(head, tb.pool_i(head)[cliques[c].members])
                stack[depth] = c
                depth += 1
            c = cliques[c].sibling


@kernel(signature=(tb.HEAD, jit.INTEGERS), allocates=True)
def remove_nodes(head, chosen):  # type: ignore[no-untyped-def]
    """Take hidden nodes, by row, out of the graph with all their factors; rows leave later."""
    nodes, spared = tb.nodes(head), np.zeros(head[tb.N_CLIQUES], np.bool_)
    for v in chosen:
        prior_rows.remove_of_node(head, v)
        if nodes[v].factor_list == tb.LEAVES:
            continue
        while nodes[v].factor_list >= 0:
            weigh(head, nodes[v].factor_list >> 2, 0.0)
        touch_with(head, v, spared)
        nodes[v].factor_list = tb.LEAVES
        head[tb.N_LEAVING] += 1
        head[tb.STRUCTURE] = 1


def compact(memory: tb.Memory) -> Gone:
    """Take out all rows that leave, and return their ids; the update must have been committed."""
    head = memory.head
    if head[tb.N_LEAVING] == 0:
        return NOTHING_GONE
    nodes, factors = memory['nodes'][:head[tb.N_NODES]], memory['factors'][:head[tb.N_FACTORS]]
    stays = nodes['factor_list'] != tb.LEAVES
    with_ends = np.append(stays, True)  # -1: no such end
    factor_stays = (factors['next'][:, 0] != tb.LEAVES) & np.all(
        with_ends[factors['ends']], axis=1)
    nodes_gone, of_node = _moved_up(memory, 'node', tb.N_NODES, stays)
    factors_gone, of_factor = _moved_up(memory, 'factor', tb.N_FACTORS, factor_stays)
    nodes, factors = memory['nodes'][:head[tb.N_NODES]], memory['factors'][:head[tb.N_FACTORS]]

    def entries(old: npt.NDArray[np.int32]) -> IntArray:
        return np.where(old >= 0, 4 * of_factor[old >> 2] + (old & 3), -1)

    nodes['factor_list'] = entries(nodes['factor_list'])
    factors['ends'] = of_node[factors['ends']]
    # those without a weight are in no list
    listed = (factors['weight'] > 0.0)[:, None] & (factors['ends'] >= 0)
    factors['next'][listed] = entries(factors['next'][listed])
    pool_i, cliques = memory['pool_i'], memory['cliques'][:head[tb.N_CLIQUES]]
    sizes = np.maximum(cliques['n_frontal'] + cliques['n_separator'], 0)    # -1 if unused
    begins = np.cumsum(sizes) - sizes
    at = np.arange(np.sum(sizes)) + np.repeat(cliques['members'] - begins, sizes)
    pool_i[at] = of_node[pool_i[at]]
    for name, counter, rows_now in (
            ('touched', tb.N_TOUCHED, of_node), ('waiting', tb.N_WAITING, of_factor)):
        left = rows_now[memory[name][:head[counter]]]
        left = left[left >= 0]
        memory[name][:len(left)], head[counter] = left, len(left)
    find_newest_and_fixed(memory)
    head[tb.N_BIASES] = np.count_nonzero(nodes['kind'] == np.uint8(NodeKind.BIAS))
    head[tb.N_EDGES] = np.count_nonzero(_ARE_EDGES[factors['kind']])
    head[tb.N_LEAVING] = 0
    return Gone(nodes_gone, factors_gone)


def _moved_up(memory: tb.Memory, name: str, counter: int,
              stays: BoolArray) -> tuple[IntArray, IntArray]:
    """Move rows that stay up; return the ids of the others, and where each row is now, or -1."""
    n, gone = len(stays), memory[f'{name}_id'][:len(stays)][~stays].astype(np.int64)
    if len(gone) > 0:
        first, left = int(np.argmin(stays)), n - len(gone)
        for table in map(tb.as_bytes, (memory[f'{name}s'], memory[f'{name}_id'])):
            table[first:left] = table[first:n][stays[first:]]
        memory.head[counter] = left
    # one more, so that -1 stays -1
    return gone, np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1)
