# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid propagation moves what a loop closure moves as a whole, and its errors stay bounded."""

import numpy as np
import pytest
from slow_smoother import EXACT

from pose_graph_ros.core.config import SmootherConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

STEP = np.array([1.0, 0.0, 0.1])
SIGMA = np.array([0.05, 0.05, 0.02])
RING, MIDDLE, TAIL = 63, 31, 300
TAIL_NODES = np.arange(MIDDLE + 1, MIDDLE + 1 + TAIL)
RING_NODES = np.setdiff1d(np.arange(RING + TAIL), TAIL_NODES)
# Exact except for the wildfire threshold alpha.
LINEAR = SmootherConfig(budget=1e-12, budget_share=1e-12, max_iterations=30)


def edges(pairs: list[tuple[int, int]], mean: FloatArray) -> Factors:
    return Factors([i for i, _ in pairs], [j for _, j in pairs], np.tile(mean, (len(pairs), 1)),
                 [np.diag(SIGMA**-2.0)] * len(pairs), [FactorKind.LOOP_CLOSURE] * len(pairs))


def ring_with_a_tail(config: SmootherConfig) -> IncrementalSmoother:
    """Return an open ring of nodes, the newest of which nearly meets the first, with a tail."""
    smoother = IncrementalSmoother(config)
    poses = [np.zeros(3)]
    pairs = []
    for k in range(1, RING + TAIL):
        before = MIDDLE if k == MIDDLE + TAIL + 1 else k - 1
        pairs.append((before, k))
        poses.append(se2.wrapped(se2.compose(poses[before], STEP)))
    smoother.update(GraphUpdate(hidden=np.array(poses), factors=edges(pairs, STEP), fix=[0]))
    return smoother


def closure(gap: FloatArray) -> Factors:
    return edges([(RING + TAIL - 1, 0)], STEP + gap)


def test_a_tail_moves_rigidly_when_the_ring_is_closed() -> None:
    smoother, exact = ring_with_a_tail(LINEAR), ring_with_a_tail(EXACT)
    before = smoother.poses.copy()
    update = GraphUpdate(factors=closure(np.array([0.5, -1.0, 0.3])))
    exact.update(update)
    result = smoother.update(update)
    assert np.min(np.hypot(*(smoother.poses - before)[TAIL_NODES, :2].T)) > 0.01
    assert result.visited < 2 * RING
    off = se2.wrapped(smoother.poses - exact.poses)
    assert np.max(np.abs(off[RING_NODES] / SIGMA)) < 5.0 * LINEAR.alpha
    tail = smoother.poses[TAIL_NODES]
    inner = se2.between(tail[:-1], tail[1:])
    # the first ones are in a clique with the end of the ring, which is solved for
    np.testing.assert_allclose(inner[8:], np.tile(STEP, (TAIL - 9, 1)), atol=1e-9)
    assert np.max(np.abs((inner[:8] - STEP) / SIGMA)) < LINEAR.alpha


@pytest.mark.parametrize('config', [LINEAR, EXACT], ids=['default', 'exact'])
def test_small_moves_do_not_get_lost(config: SmootherConfig) -> None:
    """A closure that gets stronger in many small steps bends the ring a little in each."""
    smoother, exact = ring_with_a_tail(config), ring_with_a_tail(EXACT)
    for engine in (smoother, exact):
        engine.update(GraphUpdate(factors=closure(np.array([0.05, -0.1, 0.02]))))
    number = len(smoother.graph.factors.edges) - 1
    for weight in np.geomspace(1.0, 0.01, 150):
        smoother.update(GraphUpdate(weigh={number: weight}))
    exact.update(GraphUpdate(weigh={number: weight}))
    off = se2.wrapped(smoother.poses - exact.poses)
    # along the tail an error of the heading grows with the distance from the ring
    assert np.max(np.abs(off[RING_NODES] / SIGMA)) < max(5.0 * config.alpha, 1e-6)
