# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points of a sweep, and which of them is the best."""

import math
from pathlib import Path

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.adapters.parameters import yaml_value
from pose_graph_ros.cli.fleet import sweep
from pose_graph_ros.core.exceptions import ConfigError


def test_a_grid_has_all_combinations() -> None:
    points = sweep.points_of(['a.x=1.0,2.0', 'b=[1, 2],[3]', 'c=true,model'], None, 1)
    assert len(points) == 8
    assert points[0] == {'a.x': 1.0, 'b': [1, 2], 'c': True}
    assert points[-1] == {'a.x': 2.0, 'b': [3], 'c': 'model'}
    assert len({str(point) for point in points}) == 8


def test_random_points_are_between_and_by_ratio() -> None:
    texts = ['small=0.001,0.1,0.01', 'whole=2,9', 'shift=-1.0,1.0', 'word=model,twist']
    points = sweep.points_of(texts, 2000, 1)
    assert points == sweep.points_of(texts, 2000, 1) != sweep.points_of(texts, 2000, 2)
    small = np.array([point['small'] for point in points])
    assert 0.001 <= small.min() < 0.0011
    assert 0.09 < small.max() <= 0.1
    assert np.mean(small < 0.01) == pytest.approx(0.5, abs=0.05)    # half of them by ratio
    assert {point['whole'] for point in points} == {*range(2, 10)}
    assert np.mean([point['shift'] for point in points]) == pytest.approx(0.0, abs=0.05)
    assert {point['word'] for point in points} == {'model', 'twist'}


@pytest.mark.parametrize('text', ['a', 'a=', '=1', 'a=[1', 'a=1,{'])
def test_what_is_no_point_is_told(text: str) -> None:
    with pytest.raises(ConfigError, match='expected NAME=VALUE'):
        sweep.points_of([text], None, 1)


def test_too_many_points_are_told() -> None:
    many = ','.join(map(str, range(400)))
    with pytest.raises(ConfigError, match='160000 points'):
        sweep.points_of([f'a={many}', f'b={many}'], None, 1)


@given(st.lists(st.lists(st.floats(0.01, 100.0), min_size=5, max_size=5), min_size=1, max_size=6))
def test_scores_are_means_over_drives_and_differences_are_paired(
    errors: list[list[float]],
) -> None:
    points = [{'p': k} for k in range(len(errors))]
    found = sweep.scored(points, [
        {f'drive{k}': error for k, error in enumerate(own)} for own in errors])
    means = [np.mean(own) for own in errors]
    assert [each.mean for each in found] == pytest.approx(sorted(means))
    best = errors[found[0].parameters['p']]
    for each in found:
        own = np.array(errors[each.parameters['p']])
        assert (each.drives, each.failed) == (5, 0)
        assert each.spread == pytest.approx(np.std(own, ddof=1))
        assert each.worst == max(own)
        assert each.worse_by == pytest.approx(np.mean(own - best), abs=1e-9)
        assert each.standard_error == pytest.approx(
            np.std(own - best, ddof=1) / math.sqrt(5), abs=1e-9)


def test_a_point_that_fails_on_the_hard_drive_is_not_the_best() -> None:
    found = sweep.scored([{'p': 1}, {'p': 2}, {'p': 3}], [
        {'easy': 1.0, 'hard': 9.0, 'broken': None}, {'easy': 0.9, 'hard': None, 'broken': None},
        {'easy': 1.1, 'hard': 9.5, 'broken': None}])
    assert [each.parameters['p'] for each in found] == [1, 3, 2]
    assert [(each.drives, each.failed) for each in found] == [(2, 0), (2, 0), (1, 1)]
    assert found[0].mean == 5.0


def test_what_is_unset_in_the_best_point_is_not_in_its_file(tmp_path: Path) -> None:
    found = sweep.scored([{'datum': []}], [{'a': 1.0}])
    sweep.write(found, {'datum': [48.0, 11.0], 'frequency': 5.0}, 'truth', tmp_path)
    text = (tmp_path / sweep.BEST).read_text()
    assert 'frequency: 5.0' in text
    assert 'datum' not in text


def test_texts_of_the_best_point_are_read_again_as_they_are(tmp_path: Path) -> None:
    named = {'file_folder': 'a: b', 'graph_file': '#1', 'odom.topic': '~/odom', 'map_frame': '5',
             'odom_frame': "it's", 'sources': ['odom', 'fix, two'], 'state_file': ''}
    sweep.write(sweep.scored([{'frequency': 1e-5}], [{'a': 1.0}]), named, 'truth', tmp_path)
    read = yaml_value((tmp_path / sweep.BEST).read_text())
    assert read['/**']['ros__parameters'] == named | {'frequency': 1e-5}


def test_nothing_to_score(tmp_path: Path) -> None:
    found = sweep.scored([{'p': 1.0}], [{'a': None}])
    assert (found[0].drives, found[0].failed) == (0, 0)
    assert math.isnan(found[0].mean)
    assert 'nan' in '\n'.join(sweep.lines(found))
