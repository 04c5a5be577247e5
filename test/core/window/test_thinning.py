# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which hidden nodes leave where a place is driven again and again."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from random_graphs import random_poses

from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.window.sparse_removal import grown, LIMITS, neighbours
from pose_graph_ros.core.window.thinning import crowded


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
        found = crowded(poses, preferred, config, part)
        assert dict(found.tolist()) == expected
        assert found[:, 0].tolist() == sorted(expected)


def test_a_group_is_connected_and_has_few_neighbours() -> None:
    def group(leaving: list[int], ends: IntArray) -> list[int]:
        near = neighbours(np.array(leaving), ends)
        return grown(near, leaving[0], LIMITS.group_nodes, LIMITS.group_neighbours).tolist()

    chain = np.column_stack((np.arange(29), np.arange(1, 30)))
    assert group([3, 4, 5, 9], chain) == [3, 4, 5]
    assert len(group(list(range(1, 29)), chain)) == LIMITS.group_nodes
    # a hub with many neighbours leaves alone
    star = np.column_stack((np.zeros(20, dtype=int), np.arange(1, 21)))
    assert group([0, 1, 2], star) == [0]
