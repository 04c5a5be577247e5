# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cliques of the ordering are those of elimination node by node, with little fill."""

from typing import NamedTuple

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.elimination.ordering import minimum_degree

Pairs = list[tuple[int, int]]


class Ordering(NamedTuple):
    """Result of `minimum_degree`, clique by clique."""

    frontal: list[list[int]]
    separator: list[list[int]]
    parent: list[int]
    parent_of_element: list[int]

    @property
    def order(self) -> list[int]:
        return [node for nodes in self.frontal for node in nodes]

    @property
    def blocks(self) -> int:
        """Number of blocks of R right of its diagonal."""
        return sum(len(f) * (len(f) - 1) // 2 + len(f) * len(s)
                   for f, s in zip(self.frontal, self.separator, strict=True))


def ordered(n: int, edges: Pairs, elements: list[list[int]] = [], n_last: int = 0,  # noqa: B006
            n_before: int = 0) -> Ordering:
    lists = [[n + k for k, element in enumerate(elements) if i in element]
             + sorted({b for a, b in edges if a == i} | {a for a, b in edges if b == i}
                      - {i}) for i in range(n)] + elements
    start = np.cumsum([0, *map(len, lists)]).astype(np.int32)
    adjacency = np.array([j for row in lists for j in row], dtype=np.int32)
    n_cliques, offset, n_frontal, parent, nodes = minimum_degree(
        n, len(elements), n_before, n_last, start, adjacency)
    ends = [(offset[k], offset[k] + n_frontal[k], offset[k + 1]) for k in range(n_cliques)]
    return Ordering(
        [nodes[begin:middle].tolist() for begin, middle, _ in ends],
        [nodes[middle:end].tolist() for _, middle, end in ends],
        parent[:n_cliques].tolist(), parent[n_cliques:n_cliques + len(elements)].tolist())


def fill(n: int, edges: Pairs, elements: list[list[int]], order: list[int]) -> list[set[int]]:
    """Return the neighbours of each node at its elimination, in the given order."""
    near = [set[int]() for _ in range(n)]
    pairs = edges + [(a, b) for element in elements for a in element for b in element]
    for a, b in pairs:
        if a != b:
            near[a].add(b)
            near[b].add(a)
    found = []
    for node in order:
        found.append(near[node])
        for other in near[node]:
            near[other] |= near[node] - {other}
            near[other].discard(node)
    return found


@st.composite
def graphs(draw: st.DrawFn) -> tuple[int, Pairs, list[list[int]], int]:
    n = draw(st.integers(1, 30))
    node = st.integers(0, n - 1)
    edges = draw(st.lists(st.tuples(node, node).filter(lambda pair: pair[0] != pair[1]),
                          max_size=3 * n)) if n > 1 else []
    if draw(st.booleans()):
        edges += [(i, i + 1) for i in range(n - 1)]
    elements = draw(st.lists(st.lists(node, min_size=1, max_size=6, unique=True), max_size=4))
    return n, edges, elements, draw(st.integers(0, min(n, 6)))


@given(graphs(), st.integers(0, 30))
@settings(max_examples=100)
def test_cliques_are_what_elimination_node_by_node_gives(
    graph: tuple[int, Pairs, list[list[int]], int], seed: int,
) -> None:
    n, edges, elements, n_last = graph
    n_before = seed % (n - n_last + 1)
    result = ordered(n, edges, elements, n_last, n_before)
    assert sorted(result.order) == list(range(n))
    assert set(result.order[:n_before]) == set(range(n_before))
    assert result.order[n - n_last:] == list(range(n - n_last, n))
    assert all((frontal[0] < n_before) == (frontal[-1] < n_before) for frontal in result.frontal)
    near = iter(fill(n, edges, elements, result.order))
    for frontal, separator in zip(result.frontal, result.separator, strict=True):
        assert len(set(frontal + separator)) == len(frontal) + len(separator)
        for k in range(len(frontal)):
            # exactly the blocks of the fill
            assert next(near) == set(frontal[k + 1:]) | set(separator)
    # the separator of a clique is a part of its parent
    nodes = [set(f + s) for f, s in zip(result.frontal, result.separator, strict=True)]
    for k, (separator, parent) in enumerate(zip(result.separator, result.parent, strict=True)):
        if len(separator) == 0:
            assert parent == -1
        else:
            assert parent > k
            assert set(separator) <= nodes[parent]
    for element, parent in zip(elements, result.parent_of_element, strict=True):
        assert set(element) <= nodes[parent]
        # what is below the nodes before all others has one of them
        assert min(element) < n_before or result.frontal[parent][0] >= n_before


def test_a_tree_gets_no_fill() -> None:
    rng = np.random.default_rng(1)
    edges = [(int(rng.integers(0, i)), i) for i in range(1, 200)]
    assert ordered(200, edges).blocks == len(edges)


@pytest.mark.parametrize('side', [8, 16])
def test_a_grid_gets_little_fill(side: int) -> None:
    edges = [(a, a + step) for a in range(side * side) for step in (1, side)
             if a + step < side * side and (step == side or (a + 1) % side != 0)]
    # row by row the fill is side^3; the best orders have some n log n blocks, n = side^2
    assert ordered(side * side, edges).blocks < 0.6 * side**3
    assert ordered(side * side, edges).blocks <= 2.0 * side**2 * np.log2(side**2)
