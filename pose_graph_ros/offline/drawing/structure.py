# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is connected to what in a graph: hidden nodes, and the constraints between them.

A constraint is here a *term* of chi2: its kind, and the rows of the hidden nodes that it has.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, TypeVar

import numpy as np

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, NodeKind, ObservedKind
from pose_graph_ros.core.graph.graph import GraphRows

Item = TypeVar('Item')


class Sort(StrEnum):
    """Where a term comes from; the value is what a legend says."""

    ODOMETRY = 'odometry'
    LOOP_CLOSURE = 'loop closure'
    TURN = 'turn (gyro)'
    LANDMARK = 'landmark seen'
    OBSERVED = 'measured in the map'
    BIAS = 'change of a bias'
    PRIOR = 'left by marginalisation'


_SORTS = {EdgeKind.ODOMETRY: Sort.ODOMETRY, EdgeKind.LOOP_CLOSURE: Sort.LOOP_CLOSURE,
          EdgeKind.BIAS: Sort.BIAS, EdgeKind.TURN: Sort.TURN, EdgeKind.POINT: Sort.LANDMARK,
          EdgeKind.RANGE: Sort.LANDMARK, EdgeKind.PRIOR: Sort.PRIOR}
_LETTERS = {NodeKind.POSE: 'x', NodeKind.LANDMARK: 'l', NodeKind.BIAS: 'b'}


class Term(NamedTuple):
    """A constraint."""

    sort: Sort
    nodes: tuple[int, ...]
    """Rows of its hidden nodes; an edge leads from the first to the second."""
    used: bool = True
    """Whether it has a weight above 0."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Hidden nodes and terms of a graph."""

    names: tuple[str, ...]
    """`x` and id of poses, `l` of landmarks, `b` of biases."""
    kinds: tuple[NodeKind, ...]
    fixed: tuple[bool, ...]
    sizes: tuple[int, ...]
    """Numbers of coordinates."""
    poses: FloatArray
    """Shape (N, 3) [m, m, rad]."""
    terms: tuple[Term, ...]

    @property
    def n_nodes(self) -> int:
        """Number of hidden nodes."""
        return len(self.names)

    def neighbours(self) -> list[set[int]]:
        """Return the rows that share a term with each row, itself not among them."""
        near: list[set[int]] = [set() for _ in self.names]
        for term in self.terms:
            for node in term.nodes if term.used else ():
                near[node].update(term.nodes)
        for node, others in enumerate(near):
            others.discard(node)
        return near


def structure(rows: GraphRows, ids: IntArray | None = None) -> Structure:
    """
    Return the structure of a graph.

    A position whose error is correlated in time is in the graph twice, as an edge to a bias and
    as an observed node without weight; only the edge counts.

    Parameters
    ----------
    rows : GraphRows
    ids : ndarray, shape (N,), optional, number of each hidden node; by default its id

    """
    ids = rows.node_ids if ids is None else ids
    kinds = tuple(NodeKind(kind) for kind in rows.node_kind.tolist())
    edges, observed = rows.edges.renumbered(rows.rows_of), rows.observed.renumbered(rows.rows_of)
    terms, measured = [], set()
    stepped = set(edges.i[edges.kind == EdgeKind.ODOMETRY].tolist())
    for i, j, k, kind, weight, mean in zip(
            edges.i.tolist(), edges.j.tolist(), edges.k.tolist(), edges.kind.tolist(),
            edges.weight.tolist(), edges.mean.tolist(), strict=True):
        sort = _SORTS[EdgeKind(kind)]
        if sort is Sort.LOOP_CLOSURE and i == j + 1 and j not in stepped:
            sort = Sort.ODOMETRY    # that leads back
            stepped.add(j)
        if kind == EdgeKind.BIAS and kinds[i] is NodeKind.POSE:
            sort = Sort.OBSERVED
            measured.add((i, *mean[:2]))
        terms.append(Term(sort, (i, j) if k < 0 else (i, j, k), weight > 0.0))
    for node, kind, weight, mean in zip(
            observed.node.tolist(), observed.kind.tolist(), observed.weight.tolist(),
            observed.mean.tolist(), strict=True):
        if weight > 0.0 or (node, *mean[:2]) not in measured:
            sort = Sort.PRIOR if kind == ObservedKind.PRIOR else Sort.OBSERVED
            terms.append(Term(sort, (node,), weight > 0.0))
    terms += [Term(Sort.PRIOR, tuple(rows.rows_of(prior.nodes).tolist()))
              for prior in rows.priors]
    sizes = (np.where(rows.node_kind == NodeKind.LANDMARK, 2, 3) if rows.dimension is None
             else rows.dimension)
    return Structure(
        tuple(f'{_LETTERS[kind]}{name}' for kind, name in zip(kinds, ids.tolist(), strict=True)),
        kinds, tuple(rows.fixed.tolist()), tuple(sizes.tolist()), rows.poses.copy(),
        tuple(terms))


def within(whole: Structure, start: int, hops: int) -> BoolArray:
    """
    Return which hidden nodes a number of terms connects to one of them at most, shape (N,).

    Parameters
    ----------
    whole : Structure
    start : int, row
    hops : int, 0 for the node alone

    """
    near, distance = whole.neighbours(), {start: 0}
    waiting = deque([start])
    while waiting:
        node = waiting.popleft()
        if distance[node] < hops:
            for other in sorted(near[node] - distance.keys()):
                distance[other] = distance[node] + 1
                waiting.append(other)
    return np.isin(np.arange(whole.n_nodes), list(distance))


def part(whole: Structure, chosen: BoolArray) -> tuple[Structure, int]:
    """
    Return some nodes with the terms among them, and how many terms lead to other nodes.

    Raises GraphUpdateError if none is chosen.

    Parameters
    ----------
    whole : Structure
    chosen : ndarray of bool, shape (N,)

    """
    if not np.any(chosen):
        raise GraphUpdateError('none of the hidden nodes is chosen')
    rows = np.flatnonzero(chosen).tolist()
    number = {row: n for n, row in enumerate(rows)}
    terms, n_cut = [], 0
    for term in whole.terms:
        inside = [node in number for node in term.nodes]
        if all(inside):
            terms.append(term._replace(nodes=tuple(number[node] for node in term.nodes)))
        n_cut += any(inside) and not all(inside)
    return replace(
        whole, names=_of(whole.names, rows), kinds=_of(whole.kinds, rows),
        fixed=_of(whole.fixed, rows), sizes=_of(whole.sizes, rows), poses=whole.poses[rows],
        terms=tuple(terms)), n_cut


def _of(items: Sequence[Item], rows: Sequence[int]) -> tuple[Item, ...]:
    return tuple(items[row] for row in rows)
