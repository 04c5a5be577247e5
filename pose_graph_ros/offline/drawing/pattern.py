# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pattern of H: which blocks are not zero, and which ones elimination fills."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.elimination.ordering import minimum_degree
from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.offline.drawing.structure import Structure


class Pattern(NamedTuple):
    """The blocks of H by free hidden nodes; fixed ones have no unknown and no row."""

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    """Numbers of rows of the blocks."""
    blocks: BoolArray
    """Which blocks of H are not zero, shape (n, n), symmetric."""
    fill: BoolArray
    """Which other blocks of its factor R are not zero, shape (n, n), upper triangle."""


def pattern(graph: Structure, order: IntArray | None = None) -> Pattern:
    """
    Return the pattern of H and, if an order is given, the fill of its factor in that order.

    Parameters
    ----------
    graph : Structure
    order : ndarray of int, shape (N,), optional
        Rows of all hidden nodes as they are eliminated; else that of the graph.

    """
    rows = np.arange(graph.n_nodes) if order is None else order
    free = [row for row in rows.tolist() if not graph.fixed[row]]
    place = {row: n for n, row in enumerate(free)}
    blocks = np.zeros((len(free), len(free)), dtype=bool)
    for term in graph.terms:
        at = [place[node] for node in term.nodes if node in place]
        if term.used:
            blocks[np.ix_(at, at)] = True
    fill = np.zeros_like(blocks) if order is None else filled(blocks) & ~blocks
    return Pattern(tuple(graph.names[row] for row in free),
                   tuple(graph.sizes[row] for row in free), blocks, fill)


def filled(blocks: BoolArray) -> BoolArray:
    """Return the pattern of the factor R of H = R^T R, shape (n, n), given that of H."""
    factor = np.triu(blocks)
    for k in range(len(factor)):    # neighbours that are left become a clique
        later = k + 1 + np.flatnonzero(factor[k, k + 1:])
        factor[np.ix_(later, later)] |= np.triu(np.ones((len(later), len(later)), dtype=bool))
    return np.asarray(factor)


def elimination_order(graph: Structure) -> IntArray:
    """
    Return the rows of a graph in a fill-reducing order of elimination, shape (N,).

    It is the approximate minimum degree of `elimination.ordering`. A smoother puts its newest
    nodes last, which in a small graph leaves little to order; here none is put anywhere.
    """
    near = [sorted(others) for others in graph.neighbours()]
    start = np.concatenate(([0], np.cumsum([len(others) for others in near])))
    adjacency = np.array([row for others in near for row in others], dtype=np.int32)
    n_cliques, first, n_frontal, _, nodes = minimum_degree(
        graph.n_nodes, 0, 0, 0, start.astype(np.int32), adjacency)
    return np.concatenate([np.empty(0, dtype=np.int64)] + [
        nodes[first[k]:first[k] + n_frontal[k]] for k in range(n_cliques)])
