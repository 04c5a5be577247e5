# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Removal of nodes and factors for good, in two steps.

Within an update they leave all lists, and with it the tree, but keep their rows, which are logged
as any other edit; so a rollback brings them back. After the update `compact` takes the rows out:
those that stay move up, in their order, and all that refers to a row is rewritten. A factor leaves
with any of its nodes. Cliques keep their rows.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.jit import INTEGERS, kernel
from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph import prior_rows, rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.constraints import NodeKind
from pose_graph_ros.core.graph.editing import weigh
from pose_graph_ros.core.graph.graph_update import Gone, NOTHING_GONE
from pose_graph_ros.core.graph.rows import touch

_POSE = int(NodeKind.POSE)


@kernel(signature=(tb.HEAD, INTEGERS))
def remove_nodes(head, ids):  # type: ignore[no-untyped-def]
    """Take hidden nodes, by id, out of the graph with all their factors; rows leave later."""
    nodes, cliques = tb.nodes(head), tb.cliques(head)
    for number in ids:
        v = rows.node_row(head, number)
        prior_rows.remove_of_node(head, v)
        if nodes[v].factor_list == tb.LEAVES:
            continue
        transaction_log.log_node(head, v)
        while nodes[v].factor_list >= 0:
            weigh(head, nodes[v].factor_list >> 2, 0.0)
        # Touch a node of each clique that has it, so that all of them are built anew. They are a
        # subtree below the clique that it is frontal in. A clique may have it in the separator
        # although no constraint below leads to it any more.
        top = parent = nodes[v].clique
        c = cliques[top].child if top >= 0 else -1
        while c >= 0 or parent != top:
            if c >= 0 and prior_rows.is_in_separator(head, c, v):
                u = tb.pool_i(head)[cliques[c].members]
                transaction_log.log_node(head, u)
                touch(head, u)
                parent, c = c, cliques[c].child
            elif c >= 0:
                c = cliques[c].sibling
            else:
                c, parent = cliques[parent].sibling, cliques[parent].parent
        touch(head, v)
        nodes[v].factor_list = tb.LEAVES
        head[tb.N_LEAVING] += 1
        head[tb.STRUCTURE] = 1
    v = head[tb.NEWEST]     # the last pose that does not leave
    while v >= 0 and (nodes[v].factor_list == tb.LEAVES or nodes[v].kind != _POSE):
        v -= 1
    head[tb.NEWEST] = v


def compact(memory: tb.Memory) -> Gone:
    """Take out all rows that leave, and return their ids; the update must have been committed."""
    head = memory.head
    if head[tb.N_LEAVING] == 0:
        return NOTHING_GONE
    nodes, factors = _rows_in_use(memory)
    stays = nodes['factor_list'] != tb.LEAVES
    with_ends = np.append(stays, True)  # -1: no such end
    factor_stays = (factors['next'][:, 0] != tb.LEAVES) & np.all(
        with_ends[factors['ends']], axis=1)
    nodes_gone, moved = _moved_up(memory, 'node', tb.N_NODES, stays)
    factors_gone, factors_moved = _moved_up(memory, 'factor', tb.N_FACTORS, factor_stays)
    _rewrite_rows(memory, moved, factors_moved)
    _rewrite_lists(memory, moved, factors_moved)
    head[tb.N_LEAVING] = 0
    return Gone(nodes_gone, factors_gone)


def _rows_in_use(memory: tb.Memory) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    return (memory['nodes'][:memory.head[tb.N_NODES]],
            memory['factors'][:memory.head[tb.N_FACTORS]])


def _moved_up(
    memory: tb.Memory, name: str, counter: int, stays: BoolArray,
) -> tuple[IntArray, IntArray]:
    """Move rows that stay up; return the ids of the others, and where each row is now, or -1."""
    n, gone = len(stays), memory[f'{name}_id'][:len(stays)][~stays].astype(np.int64)
    if len(gone) > 0:
        first, left = int(np.argmin(stays)), n - len(gone)
        for table in map(tb.as_bytes, (memory[f'{name}s'], memory[f'{name}_id'])):
            table[first:left] = table[first:n][stays[first:]]
        memory.head[counter] = left
    # one more, so that -1 stays -1
    return gone, np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1)


def _rewrite_rows(memory: tb.Memory, node_rows: IntArray, factor_rows: IntArray) -> None:
    """Rewrite ends of factors and the lists of the factors of each node."""
    nodes, factors = _rows_in_use(memory)

    def entries(old: npt.NDArray[np.int32]) -> IntArray:
        return np.where(old >= 0, 4 * factor_rows[old >> 2] + (old & 3), -1)

    nodes['factor_list'] = entries(nodes['factor_list'])
    factors['ends'] = node_rows[factors['ends']]
    # those without a weight are in no list
    listed = (factors['weight'] > 0.0)[:, None] & (factors['ends'] >= 0)
    factors['next'][listed] = entries(factors['next'][listed])


def _rewrite_lists(memory: tb.Memory, nodes: IntArray, factors: IntArray) -> None:
    """Rewrite the nodes of cliques, what is touched or waits, and the newest pose."""
    head, pool_i = memory.head, memory['pool_i']
    cliques = memory['cliques'][:head[tb.N_CLIQUES]]
    sizes = np.maximum(cliques['n_frontal'] + cliques['n_separator'], 0)    # -1 if unused
    begins = np.cumsum(sizes) - sizes
    at = np.arange(np.sum(sizes)) + np.repeat(cliques['members'] - begins, sizes)
    pool_i[at] = nodes[pool_i[at]]
    touched = nodes[memory['touched'][:head[tb.N_TOUCHED]]]
    waiting = factors[memory['waiting'][:head[tb.N_WAITING]]]
    for name, counter, entries in (
            ('touched', tb.N_TOUCHED, touched[touched >= 0]),
            ('waiting', tb.N_WAITING, waiting[waiting >= 0])):
        memory[name][:len(entries)] = entries
        head[counter] = len(entries)
    head[tb.NEWEST] = nodes[head[tb.NEWEST]]
