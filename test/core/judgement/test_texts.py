# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts in words."""

from dataclasses import replace
from itertools import product
import json
import math

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.judgement.texts import (
    as_json,
    details,
    joined,
    nanoseconds,
    number_of,
    seconds,
    sentence,
    short,
    states_by_stamps,
    total_values,
    totals_text,
)
from pose_graph_ros.core.judgement.verdicts import (
    Decision,
    Judged,
    SourceVerdicts,
    State,
    Verdict,
)

CLOSURE = Verdict(
    'loop_closure/17', Judged.LOOP_CLOSURE, 'loop_closure', 1_695_250_000_000,
    1_600_000_000_000, State.DOUBTED, 1_700_500_000_000, Decision.AUTO,
    np.array([4.0, -3.0, 0.2]), 14.25, (), ('loop_closure/3', 'odometry'), edge=True, number=40)


def test_a_sentence_says_state_and_reason() -> None:
    assert sentence(CLOSURE) == (
        'Doubted and not used since 1700.500: it was 14.2 sigma from the path without it; it '
        'contradicts loop_closure/3.')
    # odometry is the path without it, which is not far
    assert sentence(replace(CLOSURE, distance=0.04, contradicted_by=())) == (
        'Doubted and not used since 1700.500: by itself it could be right, 0.0 sigma from the '
        'path without it, but all others together agree better without it.')
    assert sentence(replace(
        CLOSURE, state=State.BELIEVED, distance=1.0, supported_by=('loop_closure/3',),
        contradicted_by=())) == (
        'Believed and used since 1700.500: it was 1.0 sigma from the path without it; '
        'loop_closure/3 agrees with it.')
    assert sentence(replace(CLOSURE, decision=Decision.OUT)).startswith(
        'Not used since 1700.500, as a person has decided')


def test_times_may_be_those_of_the_drive() -> None:
    start = 1_600_000_000_000
    assert sentence(CLOSURE, start).startswith('Doubted and not used since 100.5 s: it was')
    wrong = replace(CLOSURE, kind=Judged.ODOMETRY, contradicted_by=())
    assert sentence(wrong, start) == (
        'Doubted and not used since 100.5 s: it is wrong by 5.00 m and 0.20 rad, somewhere '
        'between 0.0 s and 95.2 s.')
    assert 'between 1600.000 and 1695.250.' in sentence(wrong)


@pytest.mark.parametrize(('state', 'decision', 'distance'), list(product(
    State, Decision, (math.nan, 0.5))))
def test_every_state_has_a_sentence_of_its_own(
    state: State, decision: Decision, distance: float,
) -> None:
    verdict = replace(CLOSURE, state=state, decision=decision, distance=distance)
    text = sentence(verdict)
    assert 'nan' not in text
    assert text.endswith('.')
    others = {sentence(replace(verdict, state=other)) for other in State if other is not state}
    assert (text in others) == (decision is not Decision.AUTO)


def test_details_have_all_that_is_known() -> None:
    assert details(CLOSURE) == {
        'kind': 'loop_closure', 'stamp': '1695.250000000',
        'reference_stamp': '1600.000000000',
        'state': 'doubted', 'since': '1700.500', 'residual': '[4.000, -3.000, 0.200]',
        'distance': '14.25', 'supported_by': '', 'contradicted_by': 'loop_closure/3, odometry',
        'decision': 'auto'}
    fix = replace(CLOSURE, kind=Judged.FIX, reference_ns=None)
    assert details(fix)['reference_stamp'] == ''


@given(st.integers(0, 2**62))
def test_a_stamp_in_seconds_is_rounded_down_to_the_millisecond(stamp_ns: int) -> None:
    whole, _, rest = seconds(stamp_ns).partition('.')
    assert len(rest) == 3
    assert nanoseconds(seconds(stamp_ns, 9)) == stamp_ns
    assert 0 <= stamp_ns - int(whole) * 10**9 - int(rest) * 10**6 < 10**6


def test_totals_name_the_states_that_occur() -> None:
    totals = SourceVerdicts(
        {State.BELIEVED: 7, State.WEAKLY_BELIEVED: 1, State.DOUBTED: 3}, 2.5, doubting=False)
    assert totals_text(totals) == (
        '3 doubted, 1 believed weakly, 7 believed, sigmas times 2.5')
    assert total_values({'loop': totals}) == {
        'loop.believed': '8', 'loop.believed_weakly': '1', 'loop.doubted': '3',
        'loop.waiting': '0', 'loop.scale': '2.5'}
    assert total_values({'loop': totals._replace(n_forgotten=4)})['loop.forgotten'] == '4'


def test_lists_are_bounded_and_nouns_are_counted() -> None:
    assert joined(['a', 'b']) == 'a, b'
    assert joined([str(k) for k in range(7)]) == '0, 1, 2, 3, 4 and 2 more'
    assert number_of(1, Judged.FIX) == '1 fix'
    assert number_of(2, Judged.FIX) == '2 fixes'


@pytest.mark.parametrize(('value', 'digits', 'text'), [
    (98.7, 2, '99'), (283.4, 2, '283'), (0.0456, 2, '0.046'), (0.5, 2, '0.5'), (9.96, 2, '10'),
    (1.25e-7, 2, '1.2e-07'), (0.0, 2, '0'), (-1234.5, 3, '-1234'), (14.96, 3, '15'),
    (math.nan, 2, 'nan')])
def test_numbers_for_people_have_no_exponents(value: float, digits: int, text: str) -> None:
    assert short(value, digits) == text


def test_states_are_found_by_source_and_stamps() -> None:
    fix = replace(CLOSURE, source='fix', reference_ns=None, state=State.BELIEVED)
    assert states_by_stamps([CLOSURE, fix]) == {
        ('loop_closure', 1_695_250_000_000, 1_600_000_000_000): State.DOUBTED,
        ('fix', 1_695_250_000_000, None): State.BELIEVED}


def test_as_json_has_numbers_and_no_nan() -> None:
    found = as_json(replace(CLOSURE, residual=np.array([1.0, 2.0, np.nan]), distance=math.inf))
    assert found['residual'] == [1.0, 2.0, None]
    assert found['distance'] is None
    assert found['contradicted_by'] == ['loop_closure/3', 'odometry']
    assert (found['id'], found['state']) == ('loop_closure/17', 'doubted')
    json.dumps(found, allow_nan=False)
