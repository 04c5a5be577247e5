# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Waiting measurements and stamps seen so far, compared with plain lists and sets."""


from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.measurements import (
    AnswerStatus,
    HeadingOnly,
    LoopClosure,
    Measurement,
    OdometrySample,
)
from pose_graph_ros.core.sources import pipeline
from pose_graph_ros.core.sources.pipeline import SeenStamps, WaitingMeasurements
from pose_graph_ros.core.sources.settings import SOURCES

SECOND = 1_000_000_000


def heading(stamp: int) -> HeadingOnly:
    return HeadingOnly(stamp, 1.0, 0.1)


def closure(stamp: int, **reference: int) -> LoopClosure:
    return LoopClosure(stamp, np.zeros(3), np.eye(3), **reference)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 20)), max_size=60))
def test_what_is_due_comes_out_by_stamp_then_by_arrival(steps: list[tuple[bool, int]]) -> None:
    pending, plain = WaitingMeasurements(), []
    for k, (push, number) in enumerate(steps):
        if push:
            one = heading(number)
            assert pending.push(f'{k}', one) is None
            plain.append((number, k))
        else:
            due = sorted(item for item in plain if item[0] <= number)
            plain = [item for item in plain if item[0] > number]
            assert [(w.due_ns, int(w.source)) for w in pending.pop_due(number)] == due
        assert len(pending) == len(plain)


@given(st.lists(st.integers(0, 30), max_size=40), st.integers(1, 9))
def test_where_there_are_too_many_the_latest_goes(stamps: list[int], most: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, 'SOURCES', replace(SOURCES, most_waiting=most))
        pending, plain = WaitingMeasurements(), []
        for k, stamp in enumerate(stamps):
            gone = pending.push(f'{k}', heading(stamp))
            plain = sorted([*plain, (stamp, k)])
            expected = plain.pop() if len(plain) > most else None
            assert (None if gone is None else (gone.due_ns, int(gone.source))) == expected
        assert [(w.due_ns, int(w.source)) for w in pending.pop_due(99)] == plain


@given(st.lists(st.tuples(
    st.sampled_from('ab'), st.integers(1, 6), st.sampled_from((None, 'ns', 'node', 'none')),
    st.integers(0, 3), st.booleans()), max_size=60))
def test_what_has_come_before_is_known(
    steps: list[tuple[str, int, str | None, int, bool]],
) -> None:
    seen, plain = SeenStamps(), set()
    for source, stamp, kind, number, add in steps:
        one: Measurement = heading(stamp)
        if kind is not None:
            one = closure(stamp, **({} if kind == 'none' else {f'reference_{kind}': number + 1}))
        key = source, stamp, kind, number if kind in ('ns', 'node') else 0
        assert seen.has(source, one) == (key in plain)
        if add and key not in plain:
            seen.add(source, one)
            plain.add(key)
        elif not add:
            seen.remove(source, one)
            plain.discard(key)


def test_a_dropped_measurement_may_be_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, 'SOURCES', replace(SOURCES, most_waiting=2))
    backend = PoseGraphBackend()
    ahead = heading(100 * SECOND)
    for one in (ahead, heading(2 * SECOND), heading(SECOND)):
        assert backend.add_measurement(one, 'compass').status is AnswerStatus.PENDING
    assert backend.counts['compass', 'too_many_pending'] == 1
    for k in range(30):
        backend.add_odometry(OdometrySample((1 + k) * SECOND, np.array([1.0 * k, 0.0, 0.0])))
    assert backend.n_waiting == 0
    assert backend.add_measurement(ahead, 'compass').status is AnswerStatus.PENDING
    assert backend.add_measurement(ahead, 'compass').reason == 'duplicate_stamp'
