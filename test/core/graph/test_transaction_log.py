# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""No memory of the pools is lost, shared or given back twice."""

from hypothesis import given, settings, strategies as st
import numpy as np
from slow_smoother import EXACT, SlowGraph, World, world

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.graph import pools, tables as tb
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

seeds = st.integers(0, 2**32 - 1)


def begun(seed: int) -> tuple[World, IncrementalSmoother, SlowGraph]:
    simulation, smoother = world(seed), IncrementalSmoother(EXACT)
    first = GraphUpdate(hidden=np.array(simulation.truth), fix=[0])
    smoother.update(first)
    return simulation, smoother, SlowGraph().edited(first)


def free_blocks(graph: Graph, heads: int, pool: np.ndarray) -> list[tuple[int, int]]:
    """Return the blocks (begin, size) of the free lists of a pool."""
    blocks, size = [], -1
    for first in graph.memory.head[heads:heads + tb.N_SIZES].tolist():
        at, size = first, int(pools.rounded(size + 1))
        while at >= 0:
            blocks.append((at, size))
            at = int(pool[at])
    return blocks


def used_blocks(graph: Graph) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return the blocks of the lists of nodes and of the values of all cliques."""
    nodes, values = [], []
    for row in graph.memory['cliques'][:graph.memory.head[tb.N_CLIQUES]]:
        if row['n_frontal'] > 0:
            frontal, separator = int(row['n_frontal']), int(row['n_separator'])
            nodes.append((int(row['members']), int(pools.rounded(frontal + separator))))
            values.append((int(row['values']),
                           int(pools.rounded(pools.n_values(frontal, separator)))))
    return nodes, values


def assert_pools_are_whole(graph: Graph) -> None:
    """Assert that each number of a pool is in one block, of one clique or of a free list."""
    head = graph.memory.head
    nodes, values = used_blocks(graph)
    for used, heads, name, end in ((nodes, tb.FREE_I, 'pool_i', tb.POOL_I_END),
                                   (values, tb.FREE_F, 'pool_f', tb.POOL_F_END)):
        blocks = sorted(used + free_blocks(graph, heads, graph.memory[name]))
        ends = np.cumsum([0, *(size for _, size in blocks)])
        assert [begin for begin, _ in blocks] == ends[:-1].tolist()
        assert ends[-1] == head[end]
    assert (head[tb.LOG_END], head[tb.N_FREED]) == (0, 0)


@given(seeds, st.integers(1, 30))
@settings(max_examples=40)
def test_every_number_of_the_pools_belongs_to_one_clique_or_to_none(seed: int, steps: int) -> None:
    simulation, smoother, slow = begun(seed)
    for _ in range(steps):
        update = simulation.mixture(slow)
        if smoother.update(update).status is not Status.FAILED:
            slow = slow.edited(update)
        del simulation.truth[len(slow.poses):]
        assert_pools_are_whole(smoother.graph)
