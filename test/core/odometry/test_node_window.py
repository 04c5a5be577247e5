# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hidden nodes that have left the graph: later nodes, edges and attachments are as without."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import random_information, random_poses
from saved_graphs import assert_same_value

from pose_graph_ros.core.config import BackendConfig, NodePolicy, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.covariance import propagated
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import Answer, OdometrySample
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes, NewNode
from pose_graph_ros.core.odometry.node_table import NodeTable
from pose_graph_ros.core.sources.kinds import attach

SECOND = 1_000_000_000
WINDOW = 6
CONFIG = BackendConfig(
    nodes=NodePolicy(minimum_travel_distance=1.0), odometry_patience=2.0,
    odometry={name: OdometrySource() for name in ('wheel', 'visual')})
SILENCES = st.lists(st.tuples(
    st.sampled_from(['wheel', 'visual']), st.floats(0.0, 25.0), st.floats(1.7, 9.0)), max_size=4)


def pose_at(time: float) -> np.ndarray:
    """Return a pose on a circle with a radius of 5 m, at 1.5 m/s."""
    angle = 0.3 * time
    return np.array([5.0 * np.sin(angle), 5.0 - 5.0 * np.cos(angle), se2.wrap(angle)])


def arrivals(silences: list[tuple[str, float, float]]) -> list[tuple[str, OdometrySample]]:
    times = {'wheel': np.arange(0.0, 30.0, 0.1), 'visual': np.arange(0.03, 30.0, 0.13)}
    for name, begin, long in silences:
        keep = (times[name] < begin) | (times[name] > begin + long)
        times[name] = times[name][keep]
    return sorted(((name, OdometrySample(SECOND + round(t * 1e9), pose_at(t)))
                   for name, when in times.items() for t in when.tolist()),
                  key=lambda item: item[1].stamp_ns)


def empty_nodes() -> tuple[HiddenNodes, list[tuple[bytes, str]]]:
    made: list[tuple[bytes, str]] = []

    def make(new: NewNode) -> int:
        made.append((new.mean.tobytes(), new.source))
        return len(made) - 1

    return HiddenNodes(CONFIG, make), made


def forget(nodes: HiddenNodes) -> None:
    """Let all but the newest nodes leave, at other poses than those of odometry."""
    n = len(nodes) - nodes.n_frozen - WINDOW
    if n > 0:
        nodes.forget(nodes.odometry[:n] + 100.0)


@settings(max_examples=15, deadline=None)
@given(SILENCES)
def test_nodes_edges_and_attachments_are_those_of_nodes_that_never_left(
    silences: list[tuple[str, float, float]],
) -> None:
    (whole, made), (part, made_too) = empty_nodes(), empty_nodes()
    edges, edges_too = [], []
    for k, (source, sample) in enumerate(arrivals(silences)):
        for nodes, all_edges in ((whole, edges), (part, edges_too)):
            nodes.add_sample(sample, source)
            all_edges.extend(nodes.take_secondary_edges())
        forget(part)
        if part.n_frozen == 0 or k % 10 > 0:
            continue
        first_ns = int(part.stamps_ns[part.n_frozen])
        for stamp in np.linspace(first_ns, part.covered_ns, 3).astype(int).tolist():
            assert_same_value(part.attach(stamp), whole.attach(stamp))
        assert all(len(each.timeline) < 150 for each in part.streams.values())
    assert made_too == made
    assert part.n_primaries == whole.n_primaries
    np.testing.assert_array_equal(part.stamps_ns, whole.stamps_ns)
    np.testing.assert_array_equal(part.ids, whole.ids)
    np.testing.assert_array_equal(part.odometry, whole.odometry[part.n_frozen:])
    np.testing.assert_array_equal(part.frozen, whole.odometry[:part.n_frozen] + 100.0)
    np.testing.assert_array_equal(
        part.travelled, whole.travelled[part.n_frozen:])
    # no edge begins at a node that has left, as one after a long silence would
    wanted = {(int(edge.i[0]), int(edge.j[0])): edge for _, edge in edges}
    found = {(int(edge.i[0]), int(edge.j[0])): edge for _, edge in edges_too}
    for ends in found.keys() & wanted.keys():
        assert_same_value(tuple(found[ends].columns), tuple(wanted[ends].columns))
    assert len(silences) > 0 or found.keys() == wanted.keys()


def test_between_the_last_that_left_and_the_next_odometry_leads_backwards() -> None:
    nodes, _ = empty_nodes()
    for _, sample in arrivals([('visual', 0.0, 40.0)]):
        nodes.add_sample(sample, 'wheel')
    whole = {k: nodes.attach(int(nodes.stamps_ns[k])) for k in range(len(nodes))}
    forget(nodes)
    first, before_ns = nodes.n_frozen, nodes.last_frozen_ns
    first_ns = int(nodes.stamps_ns[first])
    assert whole[first] is not None
    for stamp in np.linspace(before_ns, first_ns, 5).astype(int).tolist():
        found = nodes.attach(stamp)
        assert found is not None
        assert found.node == nodes.ids[first]
        there = pose_at((stamp - SECOND) * 1e-9)
        np.testing.assert_allclose(
            se2.compose(pose_at((first_ns - SECOND) * 1e-9), found.motion), there, atol=2e-3)
        # as uncertain as the motion between the two, in whatever direction
        motion = nodes.streams['wheel'].timeline.motion(stamp, first_ns)
        forth = nodes.streams['wheel'].covariance(motion, floor=False)
        assert np.linalg.det(found.noise) == pytest.approx(np.linalg.det(forth), rel=1e-6)
    too_old = attach(nodes, before_ns - 1)
    assert isinstance(too_old, Answer)
    assert too_old.reason == 'before_window'


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_places_are_passed_on_from_anchor_to_anchor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 30
    kept, nodes = set(range(n)), NodeTable()
    for number in range(n):
        nodes.append(number, number, np.zeros(3))
    steps: dict[int, tuple[int, FloatArray, FloatArray]] = {}
    for _ in range(4):
        leaving = rng.choice(sorted(kept - {0}), 6, replace=False)
        kept -= set(leaving.tolist())
        anchors = rng.choice(sorted(kept), 6)
        relative, noise = random_poses(rng, 6), random_information(rng, 6)
        nodes.thin(leaving, anchors, relative, noise)
        steps |= {int(node): (int(anchor), mean, C) for node, anchor, mean, C in zip(
            leaving, anchors, relative, noise, strict=True)}
    assert nodes.n_thinned == len(steps)
    if seed % 2 == 0:   # else each place is passed on for itself
        assert nodes.places()['numbers'].tolist() == sorted(steps)
    for number in range(n):
        place = nodes.attachment(number, np.zeros(3), np.zeros((3, 3)))
        assert nodes.has_left(number) == (number not in kept)
        if number in kept:
            assert place.node == number
            continue
        chain = [steps[number]]
        while chain[-1][0] not in kept:
            chain.append(steps[chain[-1][0]])
        mean, C = np.zeros(3), np.zeros((3, 3))
        for _, step, noise_ in reversed(chain):
            mean, C = se2.compose(mean, step), at_the_end(mean, C, step, noise_)
        assert place.node == chain[-1][0]
        np.testing.assert_allclose(
            se2.between(place.motion, mean), 0.0, atol=1e-5)   # single precision
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
