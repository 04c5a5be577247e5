# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Choice of the primary source from the stamps of the odometry sources."""

from collections.abc import Iterable
from itertools import pairwise

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.odometry.primary_source import (
    choose_first,
    find_silence,
    first_with_sample,
    in_order_of_preference,
    Silence,
)
from pose_graph_ros.core.odometry.stream import OdometryStream

PATIENCE = 20

increasing = st.lists(st.integers(1, 200), min_size=1, max_size=25, unique=True).map(sorted)


def stream(stamps_ns: Iterable[int], settled_ns: int = -1) -> OdometryStream:
    """Return a stream of a moving robot whose samples are settled up to a stamp."""
    one = OdometryStream(OdometrySource())
    for stamp_ns in stamps_ns:
        one.add(OdometrySample(stamp_ns, np.array([0.02 * stamp_ns, 0.0, 0.0])))
    one.settle_all(settled_ns)
    return one


def test_configured_sources_come_first_in_their_order() -> None:
    streams = {name: stream([]) for name in ('c', 'a', 'd', 'b')}
    assert in_order_of_preference(streams, ('b', 'x', 'a')) == ['b', 'a', 'c', 'd']
    assert in_order_of_preference(streams, ()) == ['c', 'a', 'd', 'b']
    assert in_order_of_preference({}, ('b', 'x')) == []


# --- The first primary source ----------------------------------------------------------------

def first(wheel: Iterable[int], visual: Iterable[int], settled_ns: int) -> str | None:
    streams = {'visual': stream(visual), 'wheel': stream(wheel)}
    return choose_first(streams, ['wheel', 'visual'], 'wheel', settled_ns, PATIENCE)


def test_the_preferred_source_becomes_primary_at_its_first_sample() -> None:
    assert first([5], [1], settled_ns=4) is None
    assert first([5], [1], settled_ns=5) == 'wheel'


@pytest.mark.parametrize(('begin', 'expected'), [
    (1, 'wheel'), (20, 'wheel'), (21, 'wheel'), (22, 'visual'), (90, 'visual')])
def test_another_source_becomes_primary_after_the_patience(begin: int, expected: str) -> None:
    wheel, visual = range(begin, 100), range(1, 100)
    assert first(wheel, visual, settled_ns=95) == expected


def test_another_source_needs_a_sample_after_the_patience() -> None:
    assert first([], [1, 20], settled_ns=50) is None
    assert first([], [1, 20, 21], settled_ns=20) is None
    assert first([], [1, 20, 21], settled_ns=21) == 'visual'
    assert first([], [], settled_ns=50) is None


def test_a_preferred_source_without_samples_is_waited_for() -> None:
    streams = {'a': stream(range(1, 30)), 'b': stream(range(3, 30))}
    assert choose_first(streams, ['a', 'b'], 'absent', 20, PATIENCE) is None
    assert choose_first(streams, ['a', 'b'], 'absent', 21, PATIENCE) == 'a'
    assert choose_first(streams, ['b', 'a'], 'absent', 21, PATIENCE) == 'b'


@given(increasing, increasing, st.integers(1, 250), st.data())
def test_the_first_choice_is_final_and_does_not_depend_on_what_is_settled(
    wheel: list[int], visual: list[int], settled_ns: int, data: st.DataObject,
) -> None:
    chosen = first(wheel, visual, settled_ns)
    if chosen is not None:
        assert first(wheel, visual, settled_ns + data.draw(st.integers(0, 100))) == chosen
        # samples after the stamp do not matter
        assert first([k for k in wheel if k <= settled_ns], [k for k in visual if k <= settled_ns],
                     settled_ns) == chosen
    streams = {'wheel': stream(wheel, data.draw(st.integers(0, 200))),
               'visual': stream(visual, data.draw(st.integers(0, 200)))}
    assert choose_first(
        streams, ['wheel', 'visual'], 'wheel', settled_ns, PATIENCE) == chosen


def test_the_first_source_with_a_sample_in_the_interval() -> None:
    streams = {'a': stream([10, 40]), 'b': stream([20]), 'c': stream([])}
    assert first_with_sample(streams, ['c', 'a', 'b'], 5, 15) == 'a'
    assert first_with_sample(streams, ['c', 'b', 'a'], 9, 20) == 'b'
    assert first_with_sample(streams, ['a', 'b'], 10, 20) == 'b'    # 10 is not after 10
    assert first_with_sample(streams, ['a', 'b'], 10, 40) == 'a'


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
        assert (None if found is None else found.last_ns) == expected
        if found is not None:
            assert found.known_ns == min(k for k in visual if k > found.last_ns + PATIENCE)


def test_a_silence_is_known_from_a_sample_of_another_source() -> None:
    names = ['wheel', 'visual', 'lidar']
    streams = {'wheel': stream([10, 50]), 'visual': stream([12, 30, 33]), 'lidar': stream([31])}
    assert find_silence(streams, names, 10, ('visual', 30), PATIENCE) is None
    assert find_silence(streams, names, 10, ('visual', 33), PATIENCE) == Silence(10, 31)
    # the next sample of the primary source proves the same silence
    assert find_silence(streams, names, 10, ('wheel', 50), PATIENCE) == Silence(10, 31)


def test_samples_at_rest_that_were_left_out_end_no_silence() -> None:
    wheel = OdometryStream(OdometrySource())
    for stamp_ns in (10, 40, 70, 100):
        wheel.add(OdometrySample(stamp_ns, np.zeros(3)))
    wheel.settle_all(100)
    assert wheel.timeline.stamps_ns.tolist() == [10, 100]
    streams = {'wheel': wheel, 'visual': stream([95])}
    assert find_silence(
        streams, ['wheel', 'visual'], 70, ('wheel', 100), PATIENCE) == Silence(70, 95)


def test_a_silence_of_all_sources_is_none_of_the_primary_one() -> None:
    streams = {'wheel': stream([10, 100]), 'visual': stream([10, 100])}
    for source in streams:
        assert find_silence(
            streams, ['wheel', 'visual'], 10, (source, 100), PATIENCE) is None
