# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts as messages: held to rclpy's own reading, and bounded."""

from types import SimpleNamespace as Space

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
from rclpy.serialization import deserialize_message

from pose_graph_ros.adapters.verdict_messages import (
    read_decision,
    states_in,
    verdicts_cdr,
)
from pose_graph_ros.core.judgement.texts import details, sentence, states_by_stamps
from pose_graph_ros.core.judgement.verdicts import (
    Decision,
    Judged,
    SourceVerdicts,
    State,
    Verdict,
)
from pose_graph_ros.core.measurements import Answer

STAMP = 1_800_000_000_000_000_007


def verdict(number: int, state: State, decision: Decision = Decision.AUTO) -> Verdict:
    return Verdict(
        f'loop/{number}', Judged.LOOP_CLOSURE, 'loop', number * 10**9, None, state, STAMP,
        decision, np.array([1.0, 2.0, np.nan]), 3.0, ('loop/1', 'loop/2'), (), edge=True, number=7)


def test_a_message_is_read_as_what_it_is() -> None:
    verdicts = [verdict(k, state) for k, state in enumerate(State)]
    totals = {'loop': SourceVerdicts({State.DOUBTED: 1, State.BELIEVED: 9}, 2.0, doubting=True)}
    message = deserialize_message(verdicts_cdr(verdicts, totals, STAMP, 'map'), DiagnosticArray)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(STAMP, 10**9)
    assert message.header.frame_id == 'map'
    summary, *statuses = message.status
    assert (summary.name, summary.level) == ('summary', DiagnosticStatus.WARN)
    assert summary.message == '4 of 10 are listed; loop: 1 doubted, 9 believed, sigmas times 2'
    assert {item.key: item.value for item in summary.values}['loop.doubted'] == '1'
    levels = {State.BELIEVED: DiagnosticStatus.OK, State.WEAKLY_BELIEVED: DiagnosticStatus.OK,
              State.DOUBTED: DiagnosticStatus.WARN, State.WAITING: DiagnosticStatus.STALE}
    assert len(statuses) == len(verdicts)
    for status, each in zip(statuses, verdicts, strict=True):
        assert status.level == levels[each.state]
        assert (status.name, status.hardware_id) == (each.id, 'loop')
        assert status.message == sentence(each)
        assert {item.key: item.value for item in status.values} == details(each)
    assert states_in(message) == states_by_stamps(verdicts)


def test_an_empty_message_says_so() -> None:
    message = deserialize_message(verdicts_cdr([], {}, STAMP, 'kürzel'), DiagnosticArray)
    assert [status.message for status in message.status] == [
        '0 of 0 are listed; nothing is judged yet']


@pytest.mark.parametrize(('value', 'expected'), [
    ('in', Decision.IN), ('OUT', Decision.OUT), (' auto ', Decision.AUTO)])
def test_a_decision_is_read(value: str, expected: Decision) -> None:
    assert read_decision(Space(key='loop/7', value=value)) == ('loop/7', expected)


def test_another_word_is_answered_with_those_that_are_expected() -> None:
    answer = read_decision(Space(key='loop/7', value='maybe'))
    assert isinstance(answer, Answer)
    assert answer.reason == 'unknown_decision'
    assert answer.detail == (
        "expected one of in, out, auto as the value for the key 'loop/7', got 'maybe'")
