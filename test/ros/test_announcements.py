# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The log says that belief has changed, a line for each way, and not for each message."""

import logging

from pose_graph_ros.core.judgement.verdicts import Change, Judged, State
from pose_graph_ros.ros.log import verdict_lines

SECOND = 1_000_000_000
BELIEVED, WEAK, WAITING, DOUBTED = (
    State.BELIEVED, State.WEAKLY_BELIEVED, State.WAITING, State.DOUBTED)


def closure(number: int, before: State | None, after: State) -> Change:
    return Change(f'loop/{number}', Judged.LOOP_CLOSURE, 'loop', number * SECOND, before, after)


def fix(number: int, before: State | None, after: State) -> Change:
    return Change(f'fix/{number}', Judged.FIX, 'fix', number * SECOND, before, after)


def lines(*changes: Change, doubted: tuple[str, ...] = ()) -> list[tuple[int, str]]:
    return [(level, text) for level, text, _ in verdict_lines(changes, doubted)]


def test_each_way_of_closures_is_a_line_and_new_ones_wait_without_a_word() -> None:
    assert lines(*(closure(k, BELIEVED, DOUBTED) for k in range(7)), closure(7, WAITING, DOUBTED),
                 closure(8, DOUBTED, WEAK), closure(9, None, WAITING),
                 closure(10, WAITING, BELIEVED)) == [
        (logging.WARNING, 'loop: 7 closures that had been believed are thrown out: '
                          'loop/0, loop/1, loop/2, loop/3, loop/4 and 2 more'),
        (logging.INFO, 'loop: 1 closure is now doubted: loop/7'),
        (logging.INFO, 'loop: 1 closure that had been doubted is now believed: loop/8')]


def test_fixes_are_spans_of_time_unless_all_of_a_source_are_doubted() -> None:
    out, back = ([fix(k, *states) for k in (30, 9, 20)]
                 for states in ((BELIEVED, DOUBTED), (DOUBTED, BELIEVED)))
    assert lines(*out, *back, fix(40, None, DOUBTED)) == [
        (logging.WARNING, 'fix: 3 fixes that had been believed are thrown out: from 9.000 to '
                          '30.000'),
        (logging.INFO, 'fix: 3 fixes that had been doubted are now believed: from 9.000 to '
                       '30.000')]
    assert lines(*out, closure(1, BELIEVED, WAITING), doubted=('fix',)) == [
        (logging.WARNING, 'loop: 1 closure that had been believed is thrown out: loop/1')]
