# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps of another time: which messages are used, and when time begins again."""

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.measurements import OdometrySample, YawRate
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper

SECOND = 1_000_000_000
EPOCH = 1_767_225_600.0
NOW = EPOCH + 100.0
BEGAN = [float(seconds) for seconds in np.arange(EPOCH, NOW, 0.1)]


class Given:
    """A keeper of the time of some sources of odometry, at first that of `BEGAN` by all."""

    def __init__(self, *odometry: str, began: bool = True) -> None:
        self.keeper = TimeKeeper(odometry or ('odom',), SECOND)
        for seconds in BEGAN if began else ():
            for source in odometry or ('odom',):
                assert self.send(seconds, source) == 'used'

    def send(self, seconds: float, source: str = 'odom') -> str:
        stamp_ns = round(seconds * SECOND)
        judged = self.keeper.judge(source, (
            YawRate(stamp_ns, 0.0) if source == 'gyro' else OdometrySample(stamp_ns, np.zeros(3))))
        if judged.jump_ns > 0:
            return 'again'
        return 'used' if judged.refusal is None else 'refused'

    def answers(self, *seconds: float, source: str = 'odom') -> set[str]:
        return {self.send(each, source) for each in seconds}

    def goes_on(self, source: str = 'odom') -> bool:
        """Whether odometry of the present time is used without a doubt."""
        answers = self.answers(*np.arange(NOW, NOW + 20.0, 0.1), source=source)
        return answers == {'used'} and not self.keeper.in_doubt


@given(st.lists(st.floats(-1e6, 1e6), max_size=30))
def test_bad_stamps_among_good_ones_change_nothing(bad: list[float]) -> None:
    one = Given()
    for step, each in enumerate(bad):
        assert one.send(NOW + 0.1 * step) == 'used'
        assert one.send(NOW + each) in ('used', 'refused')
    assert one.send(NOW + 0.1 * len(bad)) == 'used'
    assert one.keeper.now_ns <= round((NOW + 1.1 * len(bad) + 1.0) * SECOND)


@pytest.mark.parametrize('away', [-50.0, -3600.0])
def test_time_begins_again_once_stamps_behind_go_on_for_a_second(away: float) -> None:
    one, stamps = Given(), [NOW + away + 0.1 * step for step in range(11)]
    assert 'again' not in one.answers(*stamps[:-1])
    assert one.keeper.in_doubt
    assert one.send(stamps[-1]) == 'again'
    assert one.answers(*(stamps[-1] + 0.1 * step for step in range(50))) == {'used'}


@pytest.mark.parametrize('away', [-2.0, -3600.0])
def test_time_does_not_begin_again_where_it_may_not(away: float) -> None:
    one, asked = Given(), []
    one.keeper.may_begin_again = lambda source, _: asked.append(source) or len(asked) > 50
    stamps = [NOW + away + 0.1 * step for step in range(100)]
    assert one.answers(*stamps[:5]) == {'refused'}
    assert one.goes_on()
    assert set(asked) == {'odom'}
    # until it may
    assert [one.send(each) for each in stamps] == 45 * ['refused'] + ['again'] + 54 * ['used']


def test_first_stamps_that_are_far_ahead_hold_nobody_up() -> None:
    one = Given(began=False)
    one.keeper.may_begin_again = lambda _, is_new: is_new
    assert one.answers(NOW + 4e8, NOW + 4e8 + 0.1) == {'used'}
    answers = [one.send(NOW + 0.1 * step) for step in range(50)]
    assert answers == 10 * ['refused'] + ['again'] + 39 * ['used']


def test_after_a_long_silence_time_goes_on_once_stamps_agree_for_a_second() -> None:
    one, stamps = Given(), [NOW + 3600.0 + 0.1 * step for step in range(40)]
    assert [one.send(each) for each in stamps] == 10 * ['refused'] + 30 * ['used']


def test_a_large_threshold_lets_no_stamp_of_the_future_pass() -> None:
    one = Given()
    one.keeper.threshold_ns = 3600 * SECOND
    assert one.answers(*(NOW + 3000.0 + step for step in range(4))) == {'refused'}
    assert one.answers(*np.arange(NOW - 3000.0, NOW - 2990.0, 0.1)) == {'used'}  # late
    assert one.goes_on()


@pytest.mark.parametrize('away', [-3600.0, 3600.0])
def test_another_odometry_with_another_clock_is_refused_whatever_the_first_does(
    away: float,
) -> None:
    one = Given('odom', 'visual', began=False)
    for seconds in BEGAN:
        assert one.send(seconds) == 'used'
        assert one.send(seconds + away, 'visual') == 'refused'
    # while the first is silent
    assert one.answers(*np.arange(NOW + away, NOW + away + 30.0, 0.1), source='visual') == {
        'refused'}
    assert one.goes_on()


@pytest.mark.parametrize('away', [-3600.0, -30.0, 30.0, 3600.0])
def test_the_preferred_odometry_has_the_time_even_if_another_comes_first(away: float) -> None:
    one = Given('odom', 'visual', began=False)
    answers = []
    for seconds in BEGAN:
        one.send(seconds + away, 'visual')
        answers.append(one.send(seconds))
    assert answers[-900:] == 900 * ['used']
    assert answers.count('again') == (away > 0.0)
    assert one.send(NOW + away, 'visual') == ('used' if away == -30.0 else 'refused')


def test_an_odometry_half_a_minute_ahead_is_refused_as_long_as_the_preferred_one_goes_on() -> None:
    one = Given('odom', 'visual', began=False)
    for seconds in BEGAN:
        assert one.send(seconds) == 'used'
        assert one.answers(*(seconds + 30.0 + 0.01 * k for k in range(10)), source='visual') == {
            'refused'}
    assert one.goes_on()


def test_another_odometry_goes_on_where_the_preferred_one_ends() -> None:
    one = Given('odom', 'visual')
    assert one.goes_on('visual')
    assert one.answers(*np.arange(NOW + 20.0, NOW + 200.0, 0.1), source='visual') == {'used'}
    # which is used again when it comes back
    assert one.answers(*np.arange(NOW + 200.0, NOW + 210.0, 0.1)) == {'used'}


def test_an_odometry_that_is_late_by_half_a_minute_is_used() -> None:
    one = Given('odom', 'visual', began=False)
    for seconds in BEGAN:
        assert one.send(seconds) == one.send(seconds - 30.0, 'visual') == 'used'


@pytest.mark.parametrize('away', [-3600.0, -30.0, 3600.0])
@pytest.mark.parametrize('wrong', ['odom', 'visual'])
def test_time_is_that_of_the_odometry_that_goes_on(wrong: str, away: float) -> None:
    one, right = Given('odom', 'visual'), 'odom' if wrong == 'visual' else 'visual'
    for step in range(300):
        assert one.send(NOW + 0.1 * step, right) == 'used'
        assert one.send(NOW + away + 0.1 * step, wrong) != 'again'
    assert not one.keeper.in_doubt
    assert one.keeper.now_ns == round((NOW + 29.9) * SECOND)


def test_a_gyroscope_of_another_time_is_refused_and_has_no_say() -> None:
    one = Given()
    assert one.answers(*np.arange(NOW + 3600.0, NOW + 3700.0, 0.1), source='gyro') == {'refused'}
    assert one.answers(*np.arange(NOW, NOW + 10.0, 0.1), source='gyro') == {'used'}
    # it goes on while odometry is silent
    assert one.answers(*np.arange(NOW + 10.0, NOW + 200.0, 0.1), source='gyro') == {'used'}
    assert one.goes_on()


@given(st.integers(-10**6, 10**6))
def test_another_time_offset_is_no_other_time(offset: int) -> None:
    one = Given()
    one.keeper.shift('odom', offset * SECOND)
    assert one.answers(*(NOW + offset + 0.1 * step for step in range(30))) == {'used'}
    assert not one.keeper.in_doubt
