# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges of the other odometry sources between hidden nodes."""

from collections.abc import Iterable

import numpy as np
import pytest

from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.odometry.secondary_edges import SecondaryEdges
from pose_graph_ros.core.odometry.stream import OdometryStream

SECOND = 1_000_000_000
NODES = np.arange(1, 11) * SECOND
# Of other nodes than the hidden ones there may be rows in between.
ROWS = 2 * np.arange(10) + 1


def stream(times: Iterable[float]) -> OdometryStream:
    """Return settled samples at times [s] of a robot with 1 m/s and 0.1 rad/s."""
    one = OdometryStream(OdometrySource())
    for t in times:
        one.add(OdometrySample(
            round(t * 1e9), np.array([10.0 * np.sin(0.1 * t), 10.0 - 10.0 * np.cos(0.1 * t),
                                      0.1 * t])))
    one.settle_all(one.newest_ns)
    return one


def ends(edges: SecondaryEdges) -> list[tuple[int, int]]:
    """Return the numbers of the hidden nodes that the edges connect."""
    return [(int(edge.i[0]) // 2, int(edge.j[0]) // 2) for _, edge in edges.new]


def test_the_edges_do_not_depend_on_how_often_they_are_extended() -> None:
    times, edges = np.arange(0.55, 12.0, 0.1), SecondaryEdges()
    edges.skip_to('visual', 0, reached=False)
    growing = OdometryStream(OdometrySource())
    for one in stream(times).timeline.stamps_ns.tolist():
        growing.add(OdometrySample(one, np.array([one * 1e-9, 0.0, 0.0])))
        growing.settle_all(one)
        n_nodes = int(np.searchsorted(NODES, one)) + 1
        edges.extend('visual', growing, NODES[:n_nodes], ROWS[:n_nodes])
    assert ends(edges) == [(k, k + 1) for k in range(9)]
    edges.extend('visual', growing, NODES, ROWS)
    assert len(edges.new) == 9


@pytest.mark.parametrize('reached', [True, False])
def test_no_edge_spans_a_skip(*, reached: bool) -> None:
    visual = stream(np.arange(0.55, 10.5, 0.1))
    edges = SecondaryEdges()
    edges.skip_to('visual', 0, reached=False)
    edges.extend('visual', visual, NODES[:3], ROWS[:3])
    edges.skip_to('visual', 5, reached=reached)
    edges.extend('visual', visual, NODES, ROWS)
    assert ends(edges) == [(0, 1), (1, 2), (5, 6), (6, 7), (7, 8), (8, 9)]


def test_no_edge_spans_a_restart_after_a_graph_was_loaded() -> None:
    before = stream(np.arange(0.55, 4.5, 0.1))
    after = OdometryStream(OdometrySource())
    after.restore(before.saved(NODES[:4], (3, 4)))
    for t in np.arange(4.6, 10.5, 0.1):      # 1 km away: this is no motion of the robot
        after.add(OdometrySample(round(t * 1e9), np.array([1000.0 + t, 0.0, 0.0])))
    after.settle_all(after.newest_ns)
    assert NODES[3] < after.restarted_ns <= NODES[4]
    edges = SecondaryEdges()
    edges.progress['visual'] = 3, 4
    edges.extend('visual', after, NODES, ROWS)
    assert ends(edges) == [(k, k + 1) for k in range(4, 9)]
