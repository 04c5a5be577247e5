# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verdicts in words."""

from itertools import product
import json
import math

import numpy as np
import pytest

from pose_graph_ros.core.judgement.texts import as_json, sentence, short
from pose_graph_ros.core.judgement.verdicts import Decision, Judged, State, Verdict

CLOSURE = Verdict(
    'loop_closure/17', Judged.LOOP_CLOSURE, 'loop_closure', 1_695_250_000_000,
    1_600_000_000_000, State.DOUBTED, 1_700_500_000_000, Decision.AUTO,
    np.array([4.0, -3.0, 0.2]), 14.25, (), ('loop_closure/3', 'odometry'), number=40)


def test_a_sentence_says_state_and_reason() -> None:
    assert sentence(CLOSURE) == (
        'Doubted and not used since 1700.500: it was 14.2 sigma from the path without it; it '
        'contradicts loop_closure/3.')
    # odometry is the path without it, which is not far
    assert sentence(CLOSURE._replace(distance=0.04, contradicted_by=())) == (
        'Doubted and not used since 1700.500: by itself it could be right, 0.0 sigma from the '
        'path without it, but all others together agree better without it.')
    # of a fix, what was expected when it came may have been as wrong
    fix = CLOSURE._replace(
        kind=Judged.FIX, distance=0.04, contradicted_by=('odometry',),
        supported_by=('fix/3', 'fix/4'), residual=np.array([4.0, -3.0, np.nan]))
    assert sentence(fix) == ('Doubted and not used since 1700.500: it is 5 m from the path that '
                             'the others tell; fix/3, fix/4 agree with it.')
    assert 'it is 5 m and 0.20 rad from' in sentence(fix._replace(residual=CLOSURE.residual))
    assert sentence(CLOSURE._replace(
        state=State.BELIEVED, distance=1.0, supported_by=('loop_closure/3',),
        contradicted_by=())) == (
        'Believed and used since 1700.500: it was 1.0 sigma from the path without it; '
        'loop_closure/3 agrees with it.')
    assert sentence(CLOSURE._replace(decision=Decision.OUT)).startswith(
        'Not used since 1700.500, as a person has decided')


@pytest.mark.parametrize(('state', 'decision', 'distance'), list(product(
    State, Decision, (math.nan, 0.5))))
def test_every_state_has_a_sentence_of_its_own(
    state: State, decision: Decision, distance: float,
) -> None:
    verdict = CLOSURE._replace(state=state, decision=decision, distance=distance)
    text = sentence(verdict)
    assert 'nan' not in text
    assert text.endswith('.')
    others = {sentence(verdict._replace(state=other)) for other in State if other is not state}
    assert (text in others) == (decision is not Decision.AUTO)


@pytest.mark.parametrize(('value', 'digits', 'text'), [
    (98.7, 2, '99'), (283.4, 2, '283'), (0.0456, 2, '0.046'), (0.5, 2, '0.5'), (9.96, 2, '10'),
    (1.25e-7, 2, '1.2e-07'), (0.0, 2, '0'), (-1234.5, 3, '-1234'), (14.96, 3, '15'),
    (math.nan, 2, 'nan')])
def test_numbers_for_people_have_no_exponents(value: float, digits: int, text: str) -> None:
    assert short(value, digits) == text


def test_as_json_has_numbers_and_no_nan() -> None:
    found = as_json(CLOSURE._replace(residual=np.array([1.0, 2.0, np.nan]), distance=math.inf))
    assert found['residual'] == [1.0, 2.0, None]
    assert found['distance'] is None
    assert found['contradicted_by'] == ['loop_closure/3', 'odometry']
    assert (found['id'], found['state']) == ('loop_closure/17', 'doubted')
    json.dumps(found, allow_nan=False)
