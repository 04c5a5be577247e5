# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Add priors to the graph and take them out, within an update; read them."""

from collections.abc import Sequence

from pose_graph_ros.core.compiled.jit import FLAG, INTEGERS, kernel, NUMBERS
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph import prior_rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.editing import touch
from pose_graph_ros.core.graph.priors import packed, Prior, unpacked
from pose_graph_ros.core.graph.scales import add_to_scale

# Numbers of work space for each node of a prior.
_WORK = 15


@kernel(signature=(tb.HEAD,), allocates=True)
def rows_of_priors(head):  # type: ignore[no-untyped-def]
    """Return the rows of all priors in the table of the cliques, ascending."""
    return prior_rows.all_priors(head)


@kernel
def _touch_nodes(head, c, sign):  # type: ignore[no-untyped-def]
    """Touch the nodes of a prior, and add its information to their scales, or subtract it."""
    pool_i, row = tb.pool_i(head), tb.clique_i(head)[c]
    for k in range(row[tb.N_SEPARATOR]):
        v = pool_i[row[tb.NODES] + k]
        transaction_log.log_node(head, v)
        position, heading = prior_rows.diagonal(head, c, k)
        add_to_scale(head, v, sign * position, sign * heading)
        touch(head, v)
    head[tb.STRUCTURE] = 1


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS, FLAG))
def add(head, nodes, values, anchored):  # type: ignore[no-untyped-def]
    """
    Add a prior; the tables and the pools have room for it.

    Parameters
    ----------
    nodes : ndarray of int, shape (k,), rows of its nodes
    values : ndarray, from `priors.packed`
    anchored : bool

    """
    c = transaction_log.take_clique(head, 0, len(nodes))
    row, pool_i, pool_f = tb.clique_i(head)[c], tb.pool_i(head), tb.pool_f(head)
    for k in range(len(nodes)):
        pool_i[row[tb.NODES] + k] = nodes[k]
    for k in range(len(values)):
        pool_f[row[tb.VALUES] + k] = values[k]
    prior_rows.start(head, c, anchored)
    prior_rows.make_loose(head, c)
    _touch_nodes(head, c, 1.0)


@kernel
def _unlink(head, c):  # type: ignore[no-untyped-def]
    """Take a prior out of the list of its parent's children, or of the loose ones."""
    clique_i = tb.clique_i(head)
    parent, after = clique_i[c, tb.PARENT], clique_i[c, tb.SIBLING]
    before = head[tb.LOOSE] if parent < 0 else clique_i[parent, tb.CHILD]
    if before == c:
        if parent < 0:
            head[tb.LOOSE] = after
        else:
            transaction_log.log_clique(head, parent)
            clique_i[parent, tb.CHILD] = after
        return
    while clique_i[before, tb.SIBLING] != c:
        before = clique_i[before, tb.SIBLING]
    transaction_log.log_clique(head, before)
    clique_i[before, tb.SIBLING] = after


@kernel
def remove(head, c):  # type: ignore[no-untyped-def]
    """Take a prior out of the graph."""
    clique_i, clique_f = tb.clique_i(head), tb.clique_f(head)
    transaction_log.log_clique(head, c)
    _touch_nodes(head, c, -1.0)
    tb.scalars(head)[tb.CHI2] -= clique_f[c, tb.PRIOR_ENERGY]
    _unlink(head, c)
    clique_i[c, tb.PARENT] = prior_rows.REMOVED
    transaction_log.drop_clique(head, c)


@kernel
def remove_of_node(head, v):  # type: ignore[no-untyped-def]
    """Take all priors on a node out of the graph."""
    clique_i, pool_i = tb.clique_i(head), tb.pool_i(head)
    for c in range(head[tb.N_CLIQUES] if head[tb.N_PRIORS] > 0 else 0):
        if prior_rows.is_prior(head, c):
            row = clique_i[c]
            for m in range(row[tb.NODES], row[tb.NODES] + row[tb.N_SEPARATOR]):
                if pool_i[m] == v:
                    remove(head, c)
                    break


def _n_values(k: int) -> int:
    """Return `pools.n_values` of a prior with k nodes."""
    return 3 * k * (3 * k + 3) // 2 + 9 * k + 1


def _room(n: int) -> int:
    """Return an upper bound of the block that n numbers take from a pool."""
    return n + n // 8 + 1


def add_priors(memory: tb.Memory, priors: Sequence[Prior], rows: Sequence[IntArray]) -> None:
    """
    Add priors to the graph, within an update; the other tables have room for them.

    Parameters
    ----------
    memory : Memory
    priors : sequence of Prior, which `check_priors` has accepted
    rows : sequence of ndarray of int, rows of the nodes of each

    """
    head = memory.head
    sizes = [len(each) for each in rows]
    for name, end, more in (
            ('pool_f', tb.POOL_F_END, sum(_room(_n_values(k)) for k in sizes)),
            ('pool_i', tb.POOL_I_END, sum(map(_room, sizes)))):
        memory.ensure(name, int(head[end]) + more, keep=int(head[end]))
    memory.ensure('work_f', _WORK * max(sizes))
    for prior, nodes in zip(priors, rows, strict=True):
        add(head, nodes, packed(prior), prior.anchored)


def priors_of(memory: tb.Memory, node_ids: IntArray) -> tuple[Prior, ...]:
    """
    Return all priors of a graph.

    Parameters
    ----------
    memory : Memory
    node_ids : ndarray of int, ids of the hidden nodes by row

    """
    if memory.head[tb.N_PRIORS] == 0:
        return ()
    found = []
    for row in memory['clique_i'][rows_of_priors(memory.head)]:
        k, nodes, at = (int(row[m]) for m in (tb.N_SEPARATOR, tb.NODES, tb.VALUES))
        size = _n_values(k)
        found.append(unpacked(
            node_ids[memory['pool_i'][nodes:nodes + k]], memory['pool_f'][at:at + size],
            anchored=bool(row[tb.ANCHORED])))
    return tuple(found)
