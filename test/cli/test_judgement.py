# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a summary says of what was believed."""

import json

import numpy as np

from pose_graph_ros.cli.replay import judgement, judgement_lines, NAMED
from pose_graph_ros.core.judgement.verdicts import (
    Decision,
    Judged,
    SourceVerdicts,
    State,
    Verdict,
)


def verdict(source: str, kind: Judged, number: int, state: State) -> Verdict:
    return Verdict(
        f'{source}/{number}', kind, source, number * 10**9, None, state, 10**9, Decision.AUTO,
        np.zeros(3), 1.0, (), (), edge=True, number=number)


VERDICTS = [
    *(verdict('loop', Judged.LOOP_CLOSURE, k, State.DOUBTED) for k in range(NAMED + 5)),
    verdict('loop', Judged.LOOP_CLOSURE, 90, State.BELIEVED),
    verdict('fix', Judged.FIX, 0, State.BELIEVED), verdict('fix', Judged.FIX, 1, State.WAITING)]
TOTALS = {
    'loop': SourceVerdicts({State.DOUBTED: NAMED + 5, State.BELIEVED: 1}, 2.5, doubting=False),
    'fix': SourceVerdicts({State.BELIEVED: 1, State.WAITING: 1}, 1.0, doubting=False)}


def test_the_text_is_bounded() -> None:
    lines = list(judgement_lines(TOTALS, VERDICTS))
    assert lines[0] == 'loop: 15 doubted, 1 believed, sigmas times 2.5'
    assert [line.split(':')[0].strip() for line in lines[1:NAMED + 1]] == [
        f'loop/{k}' for k in range(NAMED)]
    assert lines[NAMED + 1:] == [
        '  and 5 more, all of which are in summary.json', 'fix: 1 waiting, 1 believed']


def test_the_file_has_all_closures_and_all_fixes_that_are_not_believed() -> None:
    found = judgement(TOTALS, VERDICTS)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    names = {each['id'] for each in found['constraints']}
    assert names == {each.id for each in VERDICTS} - {'fix/0'}
    assert found['sources']['loop'] == {
        'states': {'doubted': 15, 'waiting': 0, 'believed weakly': 0, 'believed': 1},
        'scale': 2.5, 'forgotten': 0}
