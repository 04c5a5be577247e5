# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A silence of the primary source is found by the stamps of the others, which have edges too."""

from collections.abc import Iterable
from itertools import pairwise

from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.odometry.stream import find_silence, OdometryStream

PATIENCE = 20

increasing = st.lists(st.integers(1, 200), min_size=1, max_size=25, unique=True).map(sorted)


def stream(stamps_ns: Iterable[int], settled_ns: int = -1) -> OdometryStream:
    """Return a stream of a moving robot whose samples are settled up to a stamp."""
    one = OdometryStream(OdometrySource())
    for stamp_ns in stamps_ns:
        one.add(OdometrySample(stamp_ns, np.array([0.02 * stamp_ns, 0.0, 0.0])))
    list(one.settle(settled_ns))
    return one


# --- Silences --------------------------------------------------------------------------------

def slow_silence(wheel: list[int], visual: list[int], last_ns: int, until_ns: int) -> int | None:
    """Return the last stamp before the first silence that another source proves, by a walk."""
    stamps = [last_ns, *(k for k in wheel if last_ns < k <= until_ns), until_ns + 1]
    for begin, end in pairwise(stamps):
        if any(begin + PATIENCE < k < end for k in visual):
            return begin
    return None


@given(increasing, increasing, st.data())
def test_silences_are_those_of_a_slow_walk(
    wheel: list[int], visual: list[int], data: st.DataObject,
) -> None:
    last_ns = data.draw(st.sampled_from(wheel))
    by_visual = [k for k in visual if k > last_ns]
    if not by_visual:
        return
    settled_ns = data.draw(st.sampled_from(by_visual))
    expected = slow_silence(wheel, visual, last_ns, settled_ns)
    for until in (-1, last_ns, 200):
        streams = {'wheel': stream(wheel, until), 'visual': stream(visual, settled_ns)}
        found = find_silence(
            streams, ['wheel', 'visual'], last_ns, ('visual', settled_ns), PATIENCE)
        assert found == (None if expected is None else (
            expected, min(k for k in visual if k > expected + PATIENCE)))


def test_samples_at_rest_that_were_left_out_end_no_silence() -> None:
    wheel = OdometryStream(OdometrySource())
    for stamp_ns in (10, 40, 70, 100):
        wheel.add(OdometrySample(stamp_ns, np.zeros(3)))
    list(wheel.settle(100))
    assert wheel.timeline.stamps_ns.tolist() == [10, 100]
    streams = {'wheel': wheel, 'visual': stream([95])}
    assert find_silence(
        streams, ['wheel', 'visual'], 70, ('wheel', 100), PATIENCE) == (70, 95)


SECOND = 1_000_000_000
NODES = np.arange(1, 11) * SECOND
# Of other nodes than the hidden ones there may be rows in between.
ROWS = 2 * np.arange(10) + 1


def filled(times: Iterable[float]) -> OdometryStream:
    """Return settled samples at times [s] of a robot with 1 m/s and 0.1 rad/s."""
    one = OdometryStream(OdometrySource())
    for t in times:
        one.add(OdometrySample(
            round(t * 1e9), np.array([10.0 * np.sin(0.1 * t), 10.0 - 10.0 * np.cos(0.1 * t),
                                      0.1 * t])))
    list(one.settle(one.newest_ns))
    return one


def test_no_edge_spans_a_restart_after_a_graph_was_loaded() -> None:
    before = filled(np.arange(0.55, 4.5, 0.1))
    after = OdometryStream(OdometrySource())
    before.tie_from(3, reached=True)
    after.restore(before.saved(NODES[:4]))
    for t in np.arange(4.6, 10.5, 0.1):      # 1 km away: this is no motion of the robot
        after.add(OdometrySample(round(t * 1e9), np.array([1000.0 + t, 0.0, 0.0])))
    list(after.settle(after.newest_ns))
    assert NODES[3] < after.restarted_ns <= NODES[4]
    # the edges connect consecutive nodes after it
    assert [(int(edge.i[0]) // 2, int(edge.j[0]) // 2) for edge in after.secondary_edges(
        NODES, ROWS)] == [(k, k + 1) for k in range(4, 9)]
