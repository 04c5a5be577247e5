# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which hidden nodes leave where a place is driven again and again."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from random_graphs import random_poses

from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.window import thinning


def slowly_crowded(
    poses: list[list[float]], preferred: list[bool], config: ThinningConfig,
) -> dict[int, int]:
    """Return what leaves, each with the nearest of those around it that stay."""
    stay: list[int] = []
    anchors = {}
    for row in sorted(range(len(poses)), key=lambda row: (-preferred[row], row)):
        x, y, theta = poses[row]
        near = {k: math.dist(poses[k][:2], (x, y)) for k in stay
                if abs(math.remainder(poses[k][2] - theta, 2.0 * math.pi)) < config.angle}
        near = {k: distance for k, distance in near.items() if distance <= config.cell}
        if len(near) >= config.poses:
            anchors[row] = min(near, key=near.__getitem__)
        else:
            stay.append(row)
    return anchors


@given(st.integers(0, 2**32 - 1), st.integers(0, 80), st.sampled_from((0.7, 2.0, 30.0)),
       st.sampled_from((0.5, math.pi / 2.0, 7.0)), st.integers(1, 3))
@settings(max_examples=60)
def test_those_leave_that_have_enough_others_around_them(
    seed: int, n: int, cell: float, angle: float, kept: int,
) -> None:
    rng = np.random.default_rng(seed)
    poses, preferred = random_poses(rng, n), rng.random(n) < 0.2
    config = ThinningConfig(cell=cell, angle=angle, poses=kept)
    expected = slowly_crowded(poses.tolist(), preferred.tolist(), config)
    for part in (3, 1000):
        found = thinning.crowded(poses, preferred, config, part)
        assert dict(zip(*(rows.tolist() for rows in found), strict=True)) == expected
        assert found.leaving.tolist() == sorted(expected)


def laps(n: int, per_lap: int) -> Graph:
    """Return a chain around a circle, with a closure to the lap before at each lap's begin."""
    angle = 2.0 * np.pi / per_lap * (np.arange(n) + 0.25)
    poses = np.column_stack((10.0 + 5.0 * np.cos(angle), 10.0 + 5.0 * np.sin(angle), angle))
    i = np.arange(n - 1)
    edges = Edges(i, i + 1, np.zeros((n - 1, 3)), np.tile(np.eye(3), (n - 1, 1, 1)),
                  np.full(n - 1, EdgeKind.ODOMETRY))
    j = np.arange(per_lap, n, per_lap)
    closures = Edges(j - per_lap, j, np.zeros((len(j), 3)), np.tile(np.eye(3), (len(j), 1, 1)),
                     np.full(len(j), EdgeKind.LOOP_CLOSURE))
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=poses, edges=Edges.joined([edges, closures]), fix=(0,),
        observed=ObservedNodes([per_lap + 3], mean=np.zeros((1, 3)),
                               information=np.eye(3)[None], kind=[0])))
    return graph


def test_the_newest_nodes_and_the_fixed_one_stay_and_then_the_oldest() -> None:
    graph = laps(60, 20)
    # two nodes of a lap are as near to each other as that
    found = thinning.crowd(graph, ThinningConfig(cell=2.0, newest=15))
    leaving = set(found.leaving.tolist())
    assert leaving == {*range(1, 19, 2), 19, *range(20, 45)}
    assert not leaving & set(found.anchors.tolist())
    assert dict(zip(*map(np.ndarray.tolist, found), strict=True))[40] == 0


def test_a_group_is_connected_and_has_few_neighbours() -> None:
    chain = np.column_stack((np.arange(29), np.arange(1, 30)))
    assert thinning.group(np.array([3, 4, 5, 9]), chain).tolist() == [3, 4, 5]
    assert len(thinning.group(np.arange(1, 29), chain)) == thinning.LIMITS.group_nodes
    # a hub with many neighbours leaves alone
    star = np.column_stack((np.zeros(20, dtype=int), np.arange(1, 21)))
    assert thinning.group(np.array([0, 1, 2]), star).tolist() == [0]


def test_ten_new_nodes_are_waited_for_and_biases_are_none() -> None:
    smoother, some, looked = IncrementalSmoother(), thinning.Thinning(), []
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    for k in range(2, 42):
        smoother.update(GraphUpdate(biases=np.zeros((2, 3)), observed=ObservedNodes(
            smoother.graph.next_ids.node + np.arange(2), None, np.zeros((2, 3)),
            np.tile(np.eye(3), (2, 1, 1)), np.full(2, ObservedKind.GLOBAL_POSE))))
        smoother.extend(np.array([1.0, 0.0, 0.0]), np.eye(3))
        if some.places(smoother, ThinningConfig(cell=2.0, newest=15), k) is not None:
            looked.append(k)
    assert np.diff(looked).tolist() == [10, 10, 10]
