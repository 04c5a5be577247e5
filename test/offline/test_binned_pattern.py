# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Patterns in cells against those of single blocks of the same graphs."""

from honest_drive import HonestDrive
import numpy as np

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.cli.replay import run
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.offline.pattern import BinnedPattern, factor, filled, hessian


def graph_of(correlation_time: float) -> Graph:
    drive = HonestDrive(1, seconds=120.0, closures=8, tau=correlation_time)
    return run(drive.measurements(), checked(
        {'global_pose.correlation_time': correlation_time})).backend.graph


def blocks_of(graph: Graph) -> np.ndarray:
    """Which blocks of H are not zero, shape (N, N), poses first."""
    order = np.concatenate((np.flatnonzero(graph.is_pose), np.flatnonzero(~graph.is_pose)))
    place = np.argsort(order)
    blocks = np.eye(graph.n_nodes, dtype=bool)
    edges = graph.factors_by_row.edges
    for i, j, weight in zip(place[edges.i], place[edges.j], edges.weight, strict=True):
        blocks[i, j] |= weight > 0.0
        blocks[j, i] |= weight > 0.0
    return blocks[~graph.fixed[order]][:, ~graph.fixed[order]]


def counts_of(pattern: BinnedPattern) -> np.ndarray:
    counts = np.zeros((pattern.bins, pattern.bins), dtype=int)
    counts[tuple(pattern.cells[:, :2].T)] = pattern.cells[:, 2]
    return counts


def test_with_a_cell_for_each_block_the_pattern_of_h_is_exact() -> None:
    for correlation_time in (0.0, 20.0):
        graph = graph_of(correlation_time)
        expected = blocks_of(graph)
        found = hessian(graph, most_bins=10_000)
        assert (found.size, found.nonzeros) == (len(expected), np.sum(expected))
        assert np.array_equal(counts_of(found), expected)


def test_the_factor_has_the_fill_of_its_order() -> None:
    for correlation_time in (0.0, 20.0):
        graph = graph_of(correlation_time)
        found = factor(graph, most_bins=10_000)
        pattern = counts_of(found)
        assert np.array_equal(pattern, np.triu(pattern))
        assert np.all(np.diag(pattern) == 1)
        assert np.max(pattern) == 1
        # elimination in this order fills no block that is not there
        assert np.array_equal(filled(pattern.astype(bool)), pattern.astype(bool))
        # and of H, every block is in it
        assert found.nonzeros >= (np.sum(blocks_of(graph)) + found.size) // 2
        assert found.nonzeros < 8 * found.size
        coarse = factor(graph, most_bins=9)
        assert (np.sum(coarse.cells[:, 2]), coarse.bins) == (found.nonzeros, 9)
