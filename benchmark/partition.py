# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A large graph in parts: the tree of its cliques, where it is cut, and a solver of the parts.

    .venv/bin/python -m benchmark.partition grid 100000 8

Two orders of elimination are compared: minimum degree, which the engine has, and nested dissection
of the true positions, whose leaves are in the order of the former.
"""

from collections.abc import Iterator
from dataclasses import replace
import sys
import time
from typing import Any

import numpy as np

from benchmark import ours, worlds
from benchmark.worlds import World
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.elimination import ordering, symbolic
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import prior_rows
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import Prior
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

LEAF = 200
"""Nodes that are not divided any more."""
SLACK = 1.2
"""A part may have so many times its share of the nodes."""
ROUNDS, SAME = 20, 1e-6
"""The solver of parts ends after so many rounds, or so near to the optimum [m]."""


def cost(cliques: symbolic.Cliques) -> tuple[dict[str, Any], FloatArray, FloatArray]:
    """Return figures of all cliques; the work [flop] and the rows of the separator of each."""
    rows = 3.0 * cliques.n_frontal
    columns = 3.0 * np.diff(cliques.first)
    rest = columns - rows
    # each row of m numbers is taken off a triangle of m^2 / 2: the sum of m^2 from rest + 1 on
    work = (columns * (columns + 1) * (2 * columns + 1) - rest * (rest + 1) * (2 * rest + 1)) / 6
    return {'nnz': float(np.sum(rows * columns - rows * (rows - 1) / 2)),
            'values': cliques.need_f, 'largest_front': int(np.max(columns)),
            'flops': float(np.sum(work))}, work, rest


def tops(cliques: symbolic.Cliques, workers: int) -> tuple[IntArray, IntArray]:
    """Return the top clique of the part that each clique is in; -1 in the root; and all tops."""
    n, size = len(cliques.n_frontal), cliques.n_frontal.astype(np.int64)
    parent = cliques.parent[:n].tolist()
    for k, above in enumerate(parent):
        if above >= 0:
            size[above] += size[k]
    is_root = size > SLACK * np.sum(cliques.n_frontal) / workers
    top = np.full(n, -1)
    for k in np.flatnonzero(~is_root)[::-1].tolist():   # parents before children
        above = parent[k]
        top[k] = k if above < 0 or is_root[above] else top[above]
    return top, np.unique(top[top >= 0])


def cut(cliques: symbolic.Cliques, workers: int) -> dict[str, Any]:
    """Return what each of some workers has to do if it gets whole subtrees, and one the rest."""
    _, work, rest = cost(cliques)
    top, parts = tops(cliques, workers)
    load, of_part = np.zeros(workers), np.bincount(top[top >= 0], work[top >= 0], len(top))
    for part in parts[np.argsort(-of_part[parts])]:
        load[np.argmin(load)] += of_part[part]
    root, total = np.sum(work[top < 0]), np.sum(work)
    return {'workers': workers, 'parts': len(parts),
            'root_nodes': int(np.sum(cliques.n_frontal[top < 0])),
            'root_share': round(root / total, 4),
            'speedup': round(total / (root + np.max(load)), 2),
            'largest_separator': int(np.max(rest[parts]) / 3),
            # a triangle with its right-hand side
            'bytes_messages': int(8 * np.sum(rest[parts] * (rest[parts] + 3) / 2))}


def dissected(world: World, graph: Graph, by_degree: symbolic.Cliques) -> symbolic.Cliques:
    """Return the cliques of nested dissection."""
    head, place = graph.memory.head, np.empty(graph.n_nodes, dtype=np.int64)
    place[np.concatenate([by_degree.nodes[begin:begin + n] for begin, n in zip(
        by_degree.first[:-1].tolist(), by_degree.n_frontal.tolist(), strict=True)])] = np.arange(
            graph.n_nodes)
    assert world.truth is not None
    order = np.concatenate([nodes[np.argsort(place[nodes])] for nodes in _halved(
        np.arange(graph.n_nodes), np.stack((world.edges.i, world.edges.j)), world.truth,
        np.zeros(graph.n_nodes, dtype=np.int8))]).astype(np.int32)
    _, start, adjacency = symbolic.structure(
        head, np.empty(0, np.int32), prior_rows.all_priors(head), order)
    # all nodes are those that are eliminated last, in their order
    return symbolic.Cliques(*symbolic.in_postorder(
        order, ordering.minimum_degree(len(order), 0, 0, len(order), start, adjacency), 0))


def _halved(nodes: IntArray, edges: IntArray, poses: FloatArray, side: Any) -> Iterator[IntArray]:
    """Yield leaves and separators of nodes with the edges among them, shape (2, M)."""
    if len(nodes) <= LEAF:
        yield nodes
        return
    axis = int(np.argmax(np.ptp(poses[nodes, :2], axis=0)))
    along = poses[nodes, axis]
    upper = along > np.median(along)    # a street with the median is not divided
    if not np.any(upper):
        upper = along == np.max(along)
    if np.all(upper):
        yield nodes
        return
    side[nodes] = upper
    across = edges[:, side[edges[0]] != side[edges[1]]]
    ends = [np.unique(across[side[across] == half]) for half in (0, 1)]
    separator = min(ends, key=len)
    side[separator] = 2
    parts = [(nodes[side[nodes] == half], edges[:, np.all(side[edges] == half, axis=0)])
             for half in (0, 1)]
    for part in parts:
        yield from _halved(*part, poses, side)
    yield separator


def in_parts(world: World, workers: int) -> Iterator[dict[str, Any]]:
    """
    Solve a world in parts from its true poses; yield how far from the optimum each round begins.

    A round solves each part with its separator fixed, marginalises it, and solves the root.
    """
    assert world.truth is not None
    graph, n, edges = world.graph(world.truth), world.n_nodes, world.edges
    cliques = symbolic.analyse(graph.memory.head)
    part, top = np.empty(n, dtype=np.int64), tops(cliques, workers)[0]
    for k, begin in enumerate(cliques.first[:-1].tolist()):
        part[cliques.nodes[begin:begin + cliques.n_frontal[k]]] = top[k]
    optimizer.optimize(graph, ours.EXACT)
    best, lowest = graph.poses.copy(), optimizer.chi2_of(graph)
    of_edge = np.maximum(part[edges.i], part[edges.j])
    root, poses = np.flatnonzero(part < 0), world.truth.copy()
    for _ in range(ROUNDS):
        priors, seconds = list[Prior](), []
        for k in np.unique(part[part >= 0]):
            begin = time.process_time()
            inside, factors = np.flatnonzero(part == k), edges.rows(of_edge == k)
            ends = np.unique(np.concatenate((factors.i, factors.j)))
            nodes = np.concatenate((inside, ends[part[ends] < 0]))
            small = _graph(poses, nodes, factors, part[nodes] < 0)
            optimizer.optimize(small, ours.EXACT)
            poses[inside] = small.poses[:len(inside)]
            IncrementalSmoother(graph=small).forget(range(len(inside)))
            priors += [replace(prior, nodes=np.searchsorted(root, nodes[prior.nodes]))
                       for prior in small.priors]
            seconds.append(time.process_time() - begin)
        graph.set_poses(poses)
        off = float(np.max(np.abs(poses - best)[:, :2]))
        figures = {'above': optimizer.chi2_of(graph) - lowest, 'off': off,
                   'parts': len(seconds), 'root_nodes': len(root), 'longest': max(seconds),
                   'sum': sum(seconds), 'bytes': sum(8 * len(each.vector) * (
                       len(each.vector) + 3) // 2 for each in priors)}
        begin = time.process_time()
        small = _graph(poses, root, edges.rows(of_edge < 0), np.zeros(len(root), dtype=bool))
        small.apply(GraphUpdate(priors=tuple(priors)))
        optimizer.optimize(small, ours.EXACT)
        yield figures | {'root': time.process_time() - begin}
        if off < SAME:
            return
        poses[root] = small.poses


def _graph(poses: FloatArray, nodes: IntArray, edges: Factors, fixed: BoolArray) -> Graph:
    """Return the graph of some nodes; node 0 of the world is fixed as well."""
    place, graph = np.full(len(poses), -1), Graph()
    place[nodes] = np.arange(len(nodes))
    graph.apply(GraphUpdate(
        hidden=poses[nodes], factors=edges.replaced(i=place[edges.i], j=place[edges.j]),
        fix=np.flatnonzero(fixed | (nodes == 0)).tolist()))
    return graph


if __name__ == '__main__':
    ours.warm_up()
    for figures in in_parts(getattr(worlds, sys.argv[1])(int(sys.argv[2])), int(sys.argv[3])):
        print(figures, flush=True)
