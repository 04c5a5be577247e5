# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pattern of H and of its factor R: block by block, or counted in coarse cells for large graphs.

H has a block for each node and for each two nodes in a constraint together. In cells it is in the
order of time, and the factor R is that of the smoother, in its order of elimination: the rows of a
clique have a block for each later frontal node and each separator node.
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import networkx as nx
import numpy as np
from scipy.sparse import csr_array, eye_array

from pose_graph_ros.core.elimination.ordering import minimum_degree
from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.tables import N_CLIQUES
from pose_graph_ros.offline.graph_views import hidden, markov_random_field, terms

MOST_BINS = 120


class Pattern(NamedTuple):
    """The blocks of H by free hidden nodes; fixed ones have no unknown and no row."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    """Numbers of rows of the blocks."""
    blocks: BoolArray
    """Which blocks of H are not zero, shape (n, n), symmetric."""
    fill: BoolArray
    """Which other blocks of its factor R are not zero, shape (n, n), upper triangle."""


def pattern(graph: Any, order: list[int] | None = None) -> Pattern:
    """
    Return the pattern of H of a factor graph, its hidden nodes in their order or in another.

    With an order, in which they are eliminated, it has the fill of the factor R as well.
    """
    free = [row for row in order or hidden(graph) if not graph.nodes[row]['fixed']]
    place = {row: n for n, row in enumerate(free)}
    blocks = np.zeros((len(free), len(free)), dtype=bool)
    for term in terms(graph):
        at = [place[node] for node in term.nodes if node in place]
        if term.used:
            blocks[np.ix_(at, at)] = True
    fill = np.zeros_like(blocks) if order is None else filled(blocks) & ~blocks
    return Pattern(tuple(graph.nodes[row]['name'] for row in free),
                   tuple(graph.nodes[row]['size'] for row in free), blocks, fill)


def filled(blocks: BoolArray) -> BoolArray:
    """Return the pattern of the factor R of H = R^T R, shape (n, n), given that of H."""
    factor = np.triu(blocks)
    for k in range(len(factor)):    # neighbours that are left become a clique
        later = k + 1 + np.flatnonzero(factor[k, k + 1:])
        factor[np.ix_(later, later)] |= np.triu(np.ones((len(later), len(later)), dtype=bool))
    return np.asarray(factor)


def elimination_order(graph: Any) -> list[int]:
    """
    Return the hidden nodes of a factor graph in a fill-reducing order of elimination.

    It is the approximate minimum degree of `elimination.ordering`. A smoother puts its newest
    nodes last, which in a small graph leaves little to order; here none is put anywhere.
    """
    rows = hidden(graph)
    near = nx.to_scipy_sparse_array(nx.Graph(markov_random_field(graph)), nodelist=rows)
    near.sort_indices()
    n_cliques, first, n_frontal, _, nodes = minimum_degree(
        len(rows), 0, 0, 0, near.indptr.astype(np.int32), near.indices.astype(np.int32))
    return [rows[node] for k in range(n_cliques)
            for node in nodes[first[k]:first[k] + n_frontal[k]].tolist()]


class BinnedPattern(NamedTuple):
    """Blocks that are not zero, counted in cells."""

    size: int
    """Number of nodes, and so of block rows; fixed nodes have none."""
    nonzeros: int
    """Number of blocks: of H in both triangles, of R in the upper one."""
    bins: int
    """Number of cells along a side."""
    cells: IntArray
    """Row, column and number of blocks of each cell that is not empty, shape (C, 3)."""


def hessian(graph: Graph, most_bins: int = MOST_BINS) -> BinnedPattern:
    """Return the pattern of H, poses in the order of time and then biases."""
    free = np.flatnonzero(~graph.fixed)
    order = np.concatenate((free[graph.is_pose[free]], free[~graph.is_pose[free]]))
    factors = graph.factors_by_row
    ends = np.column_stack((factors.i, factors.j, factors.k))[factors.weight > 0.0]
    of_priors = [graph.node_rows(prior.nodes) for prior in graph.priors]
    # which terms have which nodes: nodes that share one have a block, and each has its own
    nodes = np.concatenate([ends[ends >= 0], *of_priors])
    terms = np.concatenate([np.nonzero(ends >= 0)[0], *(
        np.full(len(rows), len(ends) + k) for k, rows in enumerate(of_priors))])
    member = csr_array((np.ones(len(nodes)), (terms, nodes)),
                       shape=(len(ends) + len(of_priors), graph.n_nodes))[:, order]
    blocks = (member.T @ member + eye_array(len(order))).tocoo()
    return _binned([np.column_stack(blocks.coords)], len(order), most_bins)


def factor(graph: Graph, most_bins: int = MOST_BINS) -> BinnedPattern:
    """Return the pattern of the factor R that the smoother has of a graph."""
    memory, fixed = graph.memory, graph.fixed
    cliques = memory['cliques'][:memory.head[N_CLIQUES]]
    frontal, separator, first = (
        cliques[field].tolist() for field in ('n_frontal', 'n_separator', 'members'))
    nodes = memory['pool_i']
    place, n = np.full(graph.n_nodes, -1), 0
    # all cliques with frontal nodes, each after those below it
    rows = np.flatnonzero(cliques['n_frontal'] > 0).tolist()
    tree = nx.DiGraph()
    tree.add_nodes_from(rows)
    tree.add_edges_from((parent, row) for row, parent in zip(
        rows, cliques['parent'][rows].tolist(), strict=True) if parent >= 0)
    roots = [row for row in rows if tree.in_degree(row) == 0]
    order = [row for root in roots[::-1] for row in nx.dfs_preorder_nodes(tree, root)][::-1]
    for c in order:
        own = nodes[first[c]:first[c] + frontal[c]]
        own = own[~fixed[own]]
        place[own] = np.arange(n, n + len(own))
        n += len(own)

    def blocks() -> Iterator[IntArray]:
        for c in order:
            at = place[nodes[first[c]:first[c] + frontal[c] + separator[c]]]
            own, rest = at[:frontal[c]], at[frontal[c]:]
            own, rest = np.sort(own[own >= 0]), rest[rest >= 0]
            above, columns = np.triu_indices(len(own))
            yield np.column_stack((own[above], own[columns]))
            yield np.column_stack((np.repeat(own, len(rest)), np.tile(rest, len(own))))
    return _binned(blocks(), n, most_bins)


def _binned(blocks: Iterable[IntArray], size: int, most_bins: int) -> BinnedPattern:
    """Count blocks in cells; they come in parts, rows and columns of each, shape (B, 2)."""
    bins = min(most_bins, size)
    counts = np.zeros((bins, bins), dtype=np.int64)
    for some in blocks:
        np.add.at(counts, tuple((some * bins // max(size, 1)).T), 1)
    cells = np.argwhere(counts > 0)
    return BinnedPattern(size, int(np.sum(counts)), bins,
                         np.column_stack((cells, counts[tuple(cells.T)])))
