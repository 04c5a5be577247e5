# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The log says once that belief has changed, not for each message."""

import logging

from pose_graph_ros.core.judgement.verdicts import Change, Judged, SourceVerdicts, State
from pose_graph_ros.ros.log import Announcer, REPEAT_PERIOD

SECOND = 1_000_000_000
BELIEVED, WEAK, WAITING, DOUBTED = (
    State.BELIEVED, State.WEAKLY_BELIEVED, State.WAITING, State.DOUBTED)


def closure(number: int, before: State | None, after: State) -> Change:
    return Change(f'loop/{number}', Judged.LOOP_CLOSURE, 'loop', number * SECOND, before, after)


def fix(number: int, before: State | None, after: State) -> Change:
    return Change(f'fix/{number}', Judged.FIX, 'fix', number * SECOND, before, after)


def totals(*, doubting: bool) -> dict[str, SourceVerdicts]:
    return {'fix': SourceVerdicts({}, 1.0, doubting)}


def test_closures_that_are_thrown_out_together_are_one_line() -> None:
    announcer = Announcer()
    lines = announcer.lines([closure(k, BELIEVED, DOUBTED) for k in range(7)], {}, 0.0)
    assert lines == [(logging.WARNING, (
        'loop: 7 closures that had been believed are thrown out: '
        'loop/0, loop/1, loop/2, loop/3, loop/4 and 2 more'))]
    assert announcer.lines([], {}, 100.0) == []


def test_lines_of_a_source_are_a_period_apart_and_nothing_is_lost() -> None:
    announcer = Announcer()
    said = [line for step in range(100) for line in announcer.lines(
        [closure(step, WEAK, WAITING)], {}, step * REPEAT_PERIOD / 40)]
    assert len(said) == 3
    said += announcer.lines([], {}, 100 * REPEAT_PERIOD / 40, flush=True)
    assert sum(int(text.split()[1]) for _, text in said) == 100


def test_what_changes_back_before_it_is_said_is_not_said() -> None:
    announcer = Announcer()
    announcer.lines([closure(0, BELIEVED, DOUBTED)], {}, 0.0)
    assert announcer.lines([closure(1, BELIEVED, DOUBTED)], {}, 1.0) == []
    assert announcer.lines([closure(1, DOUBTED, BELIEVED)], {}, 2.0, flush=True) == []


def test_new_ones_wait_without_a_word_and_doubts_are_told() -> None:
    announcer = Announcer()
    assert announcer.lines([closure(0, None, WAITING)], {}, 0.0) == []
    assert announcer.lines([closure(0, WAITING, BELIEVED)], {}, 1.0) == []
    assert announcer.lines([closure(1, WAITING, DOUBTED)], {}, 2.0) == [
        (logging.INFO, 'loop: 1 closure is now doubted: loop/1')]
    assert announcer.lines([closure(1, DOUBTED, WEAK)], {}, 2.0 + REPEAT_PERIOD) == [
        (logging.INFO, 'loop: 1 closure that had been doubted is now believed: loop/1')]


def test_a_run_of_doubted_fixes_is_one_line_at_its_begin_and_one_at_its_end() -> None:
    announcer = Announcer()
    assert announcer.lines([fix(7, None, DOUBTED)], totals(doubting=False), 0.0) == []
    said = announcer.lines([fix(9, None, WAITING)], totals(doubting=True), 9.0)
    for k in range(10, 39):
        said += announcer.lines([fix(k, None, WAITING)], totals(doubting=True), float(k))
    assert said == [(logging.WARNING, 'fix: its newest measurements are doubted since 9.000; '
                     'the path goes on without them')]
    assert announcer.lines([fix(k, WAITING, DOUBTED) for k in range(9, 39)],
                           totals(doubting=True), 39.0) == []
    assert announcer.lines([], totals(doubting=False), 40.0) == [
        (logging.INFO, 'fix: its newest measurements are believed again; 30 of them, until '
         '38.000, were doubted')]
    assert announcer.lines([], totals(doubting=False), 100.0) == []


def test_a_run_begins_with_the_first_that_is_doubted_though_the_source_is_doubted_later() -> None:
    announcer = Announcer()
    assert announcer.lines([fix(1, None, DOUBTED)], totals(doubting=False), 1.0) == []
    for k in (5, 6):
        assert announcer.lines([fix(k, None, DOUBTED)], totals(doubting=False), float(k)) == []
    ((_, text),) = announcer.lines([fix(7, None, DOUBTED)], totals(doubting=True), 7.0)
    assert 'since 5.000;' in text
    ((_, text),) = announcer.lines([fix(8, None, DOUBTED)], totals(doubting=False), 8.0)
    assert '; 4 of them, until 8.000, were' in text


def test_fixes_that_come_back_are_a_span_of_time() -> None:
    announcer = Announcer()
    assert announcer.lines([fix(k, DOUBTED, BELIEVED) for k in (30, 9, 20)],
                           totals(doubting=False), 0.0) == [
        (logging.INFO, 'fix: 3 fixes that had been doubted are now believed: from 9.000 to '
         '30.000')]
    assert announcer.lines([fix(k, BELIEVED, DOUBTED) for k in (9, 20)],
                           totals(doubting=False), REPEAT_PERIOD) == [
        (logging.WARNING, 'fix: 2 fixes that had been believed are thrown out: from 9.000 to '
         '20.000')]
