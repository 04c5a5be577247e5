# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is logged: levels, what repeats, the end; changes of belief, a line for each way."""

from collections.abc import Iterator
import logging

import pytest

from pose_graph_ros.core.judgement.verdicts import Change, Judged, State
from pose_graph_ros.ros import log
from pose_graph_ros.ros.log import ANSWER, NodeLog, REPEAT_PERIOD, verdict_lines

core = logging.getLogger('pose_graph_ros.core.somewhere')


class Lines(list[tuple[str, str]]):
    """A logger that keeps what it is given."""

    def __getattr__(self, level: str) -> object:
        return lambda text: self.append((level, text))


class Clock:
    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(log, 'time', clock)
    return clock


@pytest.fixture
def lines(clock: Clock) -> Iterator[Lines]:
    lines = Lines()
    handler = NodeLog(lines)
    yield lines
    handler.close()


def fail(number: int) -> None:
    try:
        raise ValueError(number)
    except ValueError:
        core.exception('message %d could not be added', number)


def test_each_level_is_passed_on_and_nothing_of_others_below_a_warning(lines: Lines) -> None:
    for level in ('debug', 'info', 'warning', 'error', 'critical'):
        getattr(core, level)('it is %s, 100 %%', level)
    logging.getLogger('other').info('not asked for')
    logging.getLogger('other').warning('asked for')
    levels = {'critical': 'fatal'}
    assert lines == [
        *((levels.get(level, level), f'it is {level}, 100 %')
          for level in ('debug', 'info', 'warning', 'error', 'critical')),
        ('warning', 'asked for')]


def test_what_repeats_is_left_out_and_counted(lines: Lines, clock: Clock) -> None:
    for number in range(500):
        fail(number)
        clock.now += 0.0001
    ((level, text),) = lines
    assert level == 'error'
    assert text.startswith('message 0 could not be added\nTraceback')
    assert text.endswith('ValueError: 0')
    clock.now += REPEAT_PERIOD
    fail(500)
    fail(501)
    assert len(lines) == 2
    assert lines[1][1].endswith('ValueError: 500 (499 more like it before)')


def test_what_differs_in_more_than_numbers_is_another_message(lines: Lines) -> None:
    for source in ('gps1', 'gps2'):
        for value in (1.5e-7, -3, 0x7f):
            core.warning('%s: not_finite: got %s', source, value)
    core.warning('%s: not_finite: got %s', 'gps1', 7)
    for step in (1.0, 2.0):
        core.info('the pose is set to %g', step)
    assert [text for _, text in lines] == [
        'gps1: not_finite: got 1.5e-07', 'gps2: not_finite: got 1.5e-07',
        'gps1: not_finite: got 7', 'the pose is set to 1', 'the pose is set to 2']


def test_lines_of_one_way_are_left_out_though_they_differ(lines: Lines, clock: Clock) -> None:
    for names in ('loop/1', 'loop/2, loop/3'):
        core.info('thrown out: %s', names, extra={'way': ('loop', 'out')})
    core.info('believed: loop/4', extra={'way': ('loop', 'back')})
    clock.now += REPEAT_PERIOD
    core.info('thrown out: %s', 'loop/5', extra={'way': ('loop', 'out')})
    assert [text for _, text in lines] == [
        'thrown out: loop/1', 'believed: loop/4', 'thrown out: loop/5 (1 more like it before)']


def test_each_answer_to_a_person_is_logged(lines: Lines) -> None:
    for number in (7, 8):
        core.warning('there is no closure %d', number, extra=ANSWER)
    assert lines == [('warning', 'there is no closure 7'), ('warning', 'there is no closure 8')]


def test_at_the_end_python_logs_as_before(clock: Clock) -> None:
    package, before = logging.getLogger('pose_graph_ros'), list(logging.getLogger().handlers)
    lines, others = Lines(), Lines()
    handler, other = NodeLog(lines), NodeLog(others)
    for number in range(3):
        core.error('broken %d', number)
    other.close()
    assert package.level == logging.DEBUG
    handler.close()
    assert lines == others == [('error', 'broken 0')]
    assert package.level == logging.NOTSET
    assert logging.getLogger().handlers == before
    core.error('elsewhere')
    assert len(lines) == 1


# --- changes of belief

SECOND = 1_000_000_000
BELIEVED, WEAK, WAITING, DOUBTED = (
    State.BELIEVED, State.WEAKLY_BELIEVED, State.WAITING, State.DOUBTED)


def closure(number: int, before: State | None, after: State) -> Change:
    return Change(f'loop/{number}', Judged.LOOP_CLOSURE, 'loop', number * SECOND, before, after)


def fix(number: int, before: State | None, after: State) -> Change:
    return Change(f'fix/{number}', Judged.FIX, 'fix', number * SECOND, before, after)


def said(*changes: Change, doubted: tuple[str, ...] = ()) -> list[tuple[int, str]]:
    return [(level, text) for level, text, _ in verdict_lines(changes, doubted)]


def test_each_way_of_closures_is_a_line_and_new_ones_wait_without_a_word() -> None:
    assert said(*(closure(k, BELIEVED, DOUBTED) for k in range(7)), closure(7, WAITING, DOUBTED),
                 closure(8, DOUBTED, WEAK), closure(9, None, WAITING),
                 closure(10, WAITING, BELIEVED)) == [
        (logging.WARNING, 'loop: 7 closures that had been believed are thrown out: '
                          'loop/0, loop/1, loop/2, loop/3, loop/4 and 2 more'),
        (logging.INFO, 'loop: 1 closure is now doubted: loop/7'),
        (logging.INFO, 'loop: 1 closure that had been doubted is now believed: loop/8')]


def test_fixes_are_spans_of_time_unless_all_of_a_source_are_doubted() -> None:
    out, back = ([fix(k, *states) for k in (30, 9, 20)]
                 for states in ((BELIEVED, DOUBTED), (DOUBTED, BELIEVED)))
    assert said(*out, *back, fix(40, None, DOUBTED)) == [
        (logging.WARNING, 'fix: 3 fixes that had been believed are thrown out: from 9.000 to '
                          '30.000'),
        (logging.INFO, 'fix: 3 fixes that had been doubted are now believed: from 9.000 to '
                       '30.000')]
    assert said(*out, closure(1, BELIEVED, WAITING), doubted=('fix',)) == [
        (logging.WARNING, 'loop: 1 closure that had been believed is thrown out: loop/1')]
