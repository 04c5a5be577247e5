# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The states of the alignment: found once, checked when the evidence has doubled, saved."""

from dataclasses import replace

import numpy as np
import pytest
from saved_graphs import assert_same_value

from pose_graph_ros.core.alignment.monitor import AlignmentMonitor, AlignmentState
from pose_graph_ros.core.config import BackendConfig, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.measurements import (
    Absolute,
    HeadingOnly,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.sources.kinds import observed
from pose_graph_ros.core.sources.queued import Queued

SECOND = 1_000_000_000
CONFIG, SOURCE = BackendConfig(), OdometrySource()
T_MAP_ODOM = np.array([30.0, -7.0, 2.5])


def driven(
    n: int, source: OdometrySource = SOURCE, *, twist: tuple[float, ...] = (),
    begin: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> HiddenNodes:
    """Return the nodes of exact odometry along a curve, a node per metre and second."""
    rows = iter(range(n))
    nodes = HiddenNodes(replace(CONFIG, odometry={'odom': source}), lambda *_: next(rows))
    drive(nodes, n, twist=twist, begin=begin)
    return nodes


def drive(
    nodes: HiddenNodes, n: int, *, begin: tuple[float, ...], twist: tuple[float, ...] = (),
) -> None:
    pose, variance = np.array(begin), np.array(twist) if twist else None
    for k in range(n + 1):      # the last one settles the one before
        nodes.add_sample(OdometrySample((k + 1) * SECOND, pose, 1.0, variance), 'odom')
        pose = se2.compose(pose, np.array([1.01, 0.0, 0.05]))


NODES = driven(70)


def graph_at(poses: FloatArray) -> Graph:
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses))
    return graph


GRAPH = graph_at(NODES.odometry)


def attached(measurement: Absolute, node: int, source: str = 'fix') -> Queued:
    return observed(source, measurement, Attachment(node, np.zeros(3), np.zeros((3, 3))))


def fixes(
    nodes: range, T_map_odom: FloatArray = T_MAP_ODOM, source: str = 'fix',
) -> list[Queued]:
    where = se2.compose(T_map_odom, NODES.odometry)[:, :2]
    return [attached(Position((k + 1) * SECOND, where[k], 0.04 * np.eye(2), np.zeros(2)), k,
                     source) for k in nodes]


def aligned_with(first: list[Queued]) -> AlignmentMonitor:
    monitor_ = AlignmentMonitor(CONFIG)
    assert monitor_.find(GRAPH, first, NODES) is not None
    monitor_.add(first)
    return monitor_


def test_positions_lead_from_local_over_unaligned_to_aligned() -> None:
    some = AlignmentMonitor(CONFIG)
    assert (some.state, some.sigma) == (AlignmentState.LOCAL, np.inf)
    assert some.find(GRAPH, [], NODES) is None
    assert some.state is AlignmentState.LOCAL
    assert some.find(GRAPH, fixes(range(1)), NODES) is None
    assert some.state is AlignmentState.UNALIGNED
    assert not some.is_aligned
    T_map_graph = some.find(GRAPH, fixes(range(12)), NODES)
    assert T_map_graph is not None
    assert some.is_aligned
    assert 0.0 < some.sigma < CONFIG.alignment.sigma_heading
    np.testing.assert_allclose(T_map_graph, T_MAP_ODOM, atol=1e-9)
    # found once
    assert some.find(GRAPH, fixes(range(12)), NODES) is None


def test_biases_in_the_graph_are_no_way_of_the_robot() -> None:
    nodes = driven(12, begin=(900.0, 400.0, 0.0))
    graph = Graph()
    for k, pose in enumerate(nodes.odometry):
        graph.apply(GraphUpdate(hidden=pose[None]))
        if k % 3 == 0:
            graph.apply(GraphUpdate(biases=np.zeros((1, 3)), dimensions=[1]))
    some, alone = AlignmentMonitor(CONFIG), AlignmentMonitor(CONFIG)
    ids = graph.node_ids[graph.is_pose].tolist()
    where = [attached(Position((k + 1) * SECOND, pose[:2], 0.04 * np.eye(2), np.zeros(2)), k)
             for k, pose in enumerate(nodes.odometry)]
    among_biases = HiddenNodes(CONFIG, lambda *_: ids.pop(0))
    drive(among_biases, 12, begin=(900.0, 400.0, 0.0))
    numbers = among_biases.ids.tolist()
    moved = [each._replace(factor=each.factor.replaced(i=[number]))
             for each, number in zip(where, numbers, strict=True)]
    assert some.find(graph, moved, among_biases) is not None
    assert alone.find(graph_at(nodes.odometry), where, nodes) is not None
    assert some.sigma == pytest.approx(alone.sigma)


@pytest.mark.parametrize('node', [0, 3])
def test_a_certain_heading_and_one_position_are_enough(node: int) -> None:
    some = AlignmentMonitor(CONFIG)
    heading = float(se2.wrap(T_MAP_ODOM[2] + NODES.odometry[node, 2]))
    compass = [attached(HeadingOnly(SECOND, heading, variance), node, 'compass')
               for variance in (1e-4, 4e-4)]
    T_map_graph = some.find(GRAPH, [*compass, *fixes(range(1))], NODES)
    assert T_map_graph is not None
    np.testing.assert_allclose(T_map_graph, T_MAP_ODOM, atol=1e-9)
    assert some.sigma == pytest.approx(0.01)    # of the better one


def test_a_wrong_first_angle_is_corrected_and_its_sigma_too() -> None:
    wrong = se2.compose(T_MAP_ODOM, np.array([0.0, 0.0, 1.5]))
    some = aligned_with(fixes(range(5), wrong))
    some.add(fixes(range(5, 35)))
    found = some.recheck(graph_at(se2.compose(wrong, NODES.odometry)), NODES)
    assert found is not None
    turn = se2.wrap(found[:, 2] - se2.compose(T_MAP_ODOM, NODES.odometry)[:, 2])
    assert np.max(np.abs(turn)) < 0.2
    assert 0.0 < some.sigma < np.inf
    assert some.is_aligned


@pytest.mark.parametrize('n', [0, 1, 20])
def test_a_saved_monitor_decides_as_the_first_one_would_have(n: int) -> None:
    wrong = se2.compose(T_MAP_ODOM, np.array([0.0, 0.0, 1.5]))
    one = AlignmentMonitor(CONFIG)
    if n > 0:
        first = [*fixes(range(min(n, 5)), wrong, 'gps'), *fixes(range(5, n), source='beacon')]
        one.find(GRAPH, first[:5], NODES)
        one.add(first)
    other = AlignmentMonitor(CONFIG)
    other.load(one.saved())
    assert (other.state, other.sigma) == (one.state, one.sigma)
    assert_same_value(other.saved(), one.saved())
    assert one.saved().evidence.sources == min(n, 5) * ('gps',) + (n - 5) * ('beacon',)
    for each in (one, other):
        each.add(fixes(range(n, 50)))
    solved = graph_at(se2.compose(wrong, NODES.odometry))
    results = [each.recheck(solved, NODES) for each in (one, other)]
    assert (results[0] is None) is (results[1] is None) is (n < 20)
    if n == 20:
        np.testing.assert_array_equal(results[0], results[1])
    assert_same_value(other.saved(), one.saved())


def test_what_was_measured_on_nodes_that_have_left_is_no_evidence_any_more() -> None:
    wrong = se2.compose(T_MAP_ODOM, np.array([0.0, 0.0, 1.5]))
    nodes, graph = driven(70), graph_at(se2.compose(wrong, NODES.odometry))
    some = aligned_with(fixes(range(5), wrong))
    some.add(fixes(range(5, 65)))
    some.forget(30)
    assert some.saved().evidence.factors.i.tolist() == list(range(30, 65))
    nodes.forget(graph.poses[:30])
    found = some.recheck(graph, nodes)
    assert found is not None
    turn = se2.wrap(found[30:, 2] - se2.compose(T_MAP_ODOM, NODES.odometry)[30:, 2])
    assert np.max(np.abs(turn)) < 0.2
    # what is still in the graph before them keeps its place in front of them
    np.testing.assert_allclose(
        se2.between(found[30], found[:30]), se2.between(graph.poses[30], graph.poses[:30]),
        atol=1e-9)


def test_checks_end_when_the_path_is_not_that_of_odometry_any_more() -> None:
    wrong = se2.compose(T_MAP_ODOM, np.array([0.0, 0.0, 1.5]))
    some = aligned_with(fixes(range(5), wrong))
    some.stop_rechecking()
    some.add(fixes(range(5, 65)))
    assert len(some.saved().evidence.sources) == 0
    assert some.recheck(graph_at(se2.compose(wrong, NODES.odometry)), NODES) is None
