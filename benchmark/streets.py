# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Generated drives along streets and corridors, with loop closures where they come by again.

Each stands for a public set that the engine is judged on, with the sizes, noise, chi2 per degree
of freedom and loop statistics of that set:

    grid      M3500: a walk in a small grid, closures all the time
    city      city10000: the same, larger and denser, here also with positions
    corridor  ais2klinik: floppy; 0.42 m steps whose heading is claimed to 0.08 rad each, and rare
              bursts of closures, each of which swings thousands of nodes
    campus    MIT Killian court: strong drift of the heading, hardly any closures
    drive     kitti_00: a car, precise steps, a few bursts of closures, directed backwards

The sigmas of these sets are much larger than their noise (chi2 per degree of freedom 0.02 to
0.7); `pessimism` is that factor.
"""

from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from benchmark.worlds import arranged, closures, odometry, SEED, seen, World
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.offline.simulation.streets import street_path


def grid(n: int = 3500, seed: int = SEED) -> World:
    """Return a walk like M3500, 3500 nodes."""
    rng = np.random.default_rng(seed)
    truth = street_path(rng, n, 1.0, np.full(12, 4.0), fresh=1.0)
    i, j = _pairs(truth, rng, round(0.558 * n), radius=1.5, gap=4, per_node=5)
    sigma = (0.023, 0.023, 0.023)
    edges = Edges.joined((odometry(truth, sigma, rng, pessimism=6.5),
                          closures(truth, i, j, sigma, rng, pessimism=6.5)))
    return arranged('grid', truth, edges)


def city(n: int = 10000, seed: int = SEED) -> World:
    """Return a drive like city10000, 10 000 nodes, with a position on every 20th node."""
    rng = np.random.default_rng(seed)
    truth = street_path(rng, n, 1.0, np.full(12, 10.0), fresh=3.0)
    i, j = _pairs(truth, rng, round(1.069 * n), radius=1.6, gap=5, per_node=8)
    sigma = (0.018, 0.018, 0.0125)
    edges = Edges.joined((odometry(truth, sigma, rng, pessimism=8.0),
                          closures(truth, i, j, sigma, rng, pessimism=8.0)))
    observed = seen(truth, np.arange(20, n, 20), (1.5, 1.5, 1.0), rng, heading=False)
    return arranged('city GPS', truth, edges, observed)


def corridor(n: int = 15000, seed: int = SEED) -> World:
    """Return a floppy graph like ais2klinik, 15 000 nodes, about 1600 closures."""
    rng = np.random.default_rng(seed)
    # the size of the building goes with the length of the drive
    spacing = rng.uniform(12.0, 110.0, max(3, round(7 * np.sqrt(n / 15000))))
    truth = street_path(rng, n, 0.42, spacing, fresh=1.5, rounding=5)
    i, j = _bursts(truth, rng, round(0.107 * n), radius=1.0, gap=100, length=(15, 100))
    sigma, pessimism = (0.019, 0.018, 0.015), 5.3
    edges = Edges.joined((odometry(truth, sigma, rng, pessimism=pessimism),
                          closures(truth, i, j, sigma, rng, pessimism=pessimism)))
    return arranged('corridor', truth, edges)


def campus(n: int = 808, seed: int = SEED) -> World:
    """Return a walk like MIT Killian court, 808 nodes, 20 closures."""
    rng = np.random.default_rng(seed)
    truth = street_path(rng, n, 2.3, rng.uniform(50.0, 170.0, 3), fresh=1.0, rounding=3)
    i, j = _bursts(truth, rng, 20, radius=2.5, gap=60, length=(3, 8))
    edges = Edges.joined((odometry(truth, (0.15, 0.1, 0.05), rng, pessimism=1.2),
                          closures(truth, i, j, (0.2, 0.2, 0.04), rng, pessimism=1.2)))
    return arranged('campus', truth, edges)


def drive(n: int = 4541, seed: int = SEED) -> World:
    """Return a drive like kitti_00, 4541 nodes, 137 closures."""
    rng = np.random.default_rng(seed)
    truth = street_path(rng, n, 0.82, rng.uniform(60.0, 160.0, 4), fresh=1.0, rounding=15)
    i, j = _bursts(truth, rng, round(0.0302 * n), radius=4.0, gap=200, length=(6, 30), every=3)
    sigma, pessimism = (0.02, 0.022, 0.001), 2.0
    # as the set has it: the heading correlated with both coordinates
    correlation = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, -0.15], [0.1, -0.15, 1.0]])
    weight = np.linalg.inv(correlation * np.outer(sigma, sigma) * pessimism**2)
    edges = Edges.joined((odometry(truth, sigma, rng, weight=weight),
                          closures(truth, j, i, sigma, rng, weight=weight)))
    return arranged('drive', truth, edges)


def _candidates(truth: FloatArray, radius: float, gap: int) -> IntArray:
    """Return all pairs (i, j), shape (M, 2), j - i >= gap, of poses within the radius [m]."""
    pairs = cKDTree(truth[:, :2]).query_pairs(radius, output_type='ndarray')
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= gap]
    return pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]


def _pairs(
    truth: FloatArray, rng: np.random.Generator, count: int, *, radius: float, gap: int,
    per_node: int,
) -> tuple[IntArray, IntArray]:
    """Return about `count` random closures, at most `per_node` to one node."""
    pairs = rng.permutation(_candidates(truth, radius, gap))
    order = np.argsort(pairs[:, 1], kind='stable')
    rank = np.empty(len(pairs), dtype=np.int64)
    first = np.searchsorted(pairs[order, 1], pairs[order, 1])
    rank[order] = np.arange(len(pairs)) - first
    chosen = pairs[rank < per_node][:count]
    chosen = chosen[np.lexsort((chosen[:, 0], chosen[:, 1]))]
    return chosen[:, 0], chosen[:, 1]


def _bursts(
    truth: FloatArray, rng: np.random.Generator, count: int, *, radius: float, gap: int,
    length: tuple[int, int], every: int = 1,
) -> tuple[IntArray, IntArray]:
    """Return closures in bursts: runs of nodes that each close to the nearest earlier one."""
    pairs = _candidates(truth, radius, gap)
    distance = np.hypot(*(truth[pairs[:, 0], :2] - truth[pairs[:, 1], :2]).T)
    pairs = pairs[np.lexsort((distance, pairs[:, 1]))]
    pairs = pairs[np.unique(pairs[:, 1], return_index=True)[1]]
    breaks = [0, *(np.flatnonzero(np.diff(pairs[:, 1]) > 1) + 1).tolist(), len(pairs)]
    runs = []
    for begin, end in pairwise(breaks):
        at = begin
        while at < end:
            size = every * int(rng.integers(*length))
            runs.append(pairs[at:min(at + size, end):every])
            at += size
    chosen: list[IntArray] = []
    for k in rng.permutation(len(runs)):
        chosen.append(runs[k][:count - sum(map(len, chosen))])
    found = np.concatenate(chosen)
    found = found[np.argsort(found[:, 1])]
    return found[:, 0], found[:, 1]
