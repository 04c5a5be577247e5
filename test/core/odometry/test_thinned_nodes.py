# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Places of hidden nodes that have left the graph, against a chain of single steps."""

from hypothesis import given, settings, strategies as st
import numpy as np
from random_graphs import random_information, random_poses

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.covariance import propagated
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.thinned_nodes import ThinnedNodes


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_places_are_passed_on_from_anchor_to_anchor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 30
    kept, nodes = set(range(n)), ThinnedNodes()
    steps: dict[int, tuple[int, FloatArray, FloatArray]] = {}
    for _ in range(4):
        leaving = rng.choice(sorted(kept - {0}), 6, replace=False)
        kept -= set(leaving.tolist())
        anchors = rng.choice(sorted(kept), 6)
        relative, noise = random_poses(rng, 6), random_information(rng, 6)
        nodes.add(leaving, anchors, relative, noise)
        steps |= {int(node): (int(anchor), mean, C) for node, anchor, mean, C in zip(
            leaving, anchors, relative, noise, strict=True)}
    assert len(nodes) == len(steps)
    if seed % 2 == 0:   # else each place is passed on for itself
        assert nodes.places().numbers.tolist() == sorted(steps)
    for number in range(n):
        place = nodes.place(number)
        if number in kept:
            assert place is None
            continue
        assert place is not None
        chain = [steps[number]]
        while chain[-1][0] not in kept:
            chain.append(steps[chain[-1][0]])
        mean, C = np.zeros(3), np.zeros((3, 3))
        for _, step, noise_ in reversed(chain):
            mean, C = se2.compose(mean, step), at_the_end(mean, C, step, noise_)
        assert place.anchor == chain[-1][0]
        np.testing.assert_allclose(
            se2.between(place.mean, mean), 0.0, atol=1e-5)   # single precision
        np.testing.assert_allclose(place.noise, C, rtol=1e-5, atol=1e-4 * np.max(np.abs(C)))


def at_the_end(
    mean: FloatArray, C: FloatArray, step: FloatArray, noise: FloatArray,
) -> FloatArray:
    """Return the covariance of two steps one after the other, in the frame at the end."""
    axes = np.eye(3)
    axes[:2, :2] = se2.rotation(mean[2])
    end = np.eye(3)
    end[:2, :2] = se2.rotation(se2.compose(mean, step)[2])
    in_anchor = propagated(mean, axes @ C @ axes.T, step, noise)
    return end.T @ in_anchor @ end
