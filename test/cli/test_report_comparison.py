# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph report A B`: what is told of two runs whose differences are known."""

from copy import deepcopy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_data import example

from pose_graph_ros.cli.main import main

DOUBTED = 3


def told(tmp_path: Path, capsys: Any, a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Return what the tool prints as JSON, with the data in the page as `data`."""
    for name, run in (('a', a), ('b', b)):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / 'run.json').write_text(json.dumps(run), encoding='utf-8')
    page = tmp_path / 'both.html'
    assert main(['report', str(tmp_path / 'a'), str(tmp_path / 'b'), '--json', '-o',
                 str(page)]) == 0
    text = page.read_text(encoding='utf-8').partition('id="data">')[2].partition('</script>')[0]
    return dict(json.loads(capsys.readouterr().out)) | {'data': json.loads(text)}


def moved(run: dict[str, Any], by: float) -> dict[str, Any]:
    """Return a run whose path is to the east of another's by some metres."""
    other = deepcopy(run)
    path = other['lines']['corrected']
    path['x'] = [x + by for x in path['x']]
    return other


def begun_later(run: dict[str, Any], seconds: float, east: float) -> dict[str, Any]:
    """Return the same run as told by one who counts times and places from elsewhere."""
    other = deepcopy(run)
    other['start_ns'] = str(int(run['start_ns']) + round(seconds * 1e9))
    other['offset'] = [run['offset'][0] + east, run['offset'][1]]
    for columns in (*other['lines'].values(), *other['fixes'], *other['closures']):
        for name, values in columns.items():
            shift = {'t': seconds, 'x': east}.get(name[0], 0.0) if isinstance(values, list) else 0
            if shift and name in ('t', 't0', 't1', 'x', 'x0', 'x1'):
                columns[name] = [value - shift for value in values]
    return other


def texts(found: dict[str, Any]) -> str:
    return '\n'.join(each['text'] for each in found['findings'])


def test_equal_runs_are_the_same_wherever_their_times_and_places_begin(tmp_path, capsys) -> None:
    run = example()
    found = told(tmp_path, capsys, run, begun_later(run, 12.5, 30.0))
    assert 'the paths are the same' in texts(found)
    assert found['springs'] == []
    assert found['data']['closures'] == found['data']['fixes'] == []
    assert [row for table in found['figures'] for row in table['rows']
            if row[1] and row[1] != row[2]] == []


def test_how_far_and_where_the_paths_are_apart_is_told(tmp_path, capsys) -> None:
    run, at = example(), 123
    other = moved(run, 2.0)
    other['lines']['corrected']['y'][at] += 5.0
    found = told(tmp_path, capsys, run, other)
    farthest, path = found['springs'][0], run['lines']['corrected']
    assert farthest['energy'] == pytest.approx(np.hypot(2.0, 5.0), rel=1e-3)
    assert farthest['from'] == {'t': path['t'][at], 'x': round(path['x'][at], 2),
                                'y': round(path['y'][at], 2)}
    assert len(found['springs']) == 10
    times = [each['from']['t'] for each in found['springs']]
    assert np.min(np.diff(np.sort(times))) > 0.04 * run['duration']
    rms = np.sqrt(4.0 + 25.0 / 400)
    errors = next(table['rows'] for table in found['figures'] if table['title'] == 'Errors')
    assert f'{rms:.2f} m' in {row[2] for row in errors}
    # all but that pose agree, if the whole path is moved back
    assert '2 m and 0' in ' '.join(row[0] for row in errors)
    assert 'most of it is a motion of the whole path' in texts(found)
    assert found['data']['errors']['position'][0] == pytest.approx(2.0)


def test_what_only_one_of_them_uses_is_listed_with_both_reasons(tmp_path, capsys) -> None:
    run = example()
    other = begun_later(run, 12.5, 0.0)
    closures, fixes = other['closures'][0], other['fixes'][0]
    closures['state'][3], closures['why'][3] = DOUBTED, 0
    fixes['state'][5:8] = [DOUBTED] * 3
    found = told(tmp_path, capsys, run, other)
    (changed,), data = found['data']['closures'], found['data']
    assert changed['id'] == ['loop_closure/3']
    assert changed['state'] == [DOUBTED]
    assert data['texts'][changed['why'][0]] == f'A: believed. B: {run["texts"][0]}.'
    assert changed['t0'] == [run['closures'][0]['t0'][3]]
    assert 'loop_closure: 1 loop closures that A uses are not used in B' in texts(found)
    used = [k for k in (5, 6, 7) if run['fixes'][0]['state'][k] in (0, 1)]
    assert data['fixes'][0]['id'] == [f'gps/{k}' for k in used]


def test_figures_and_parameters_that_differ_are_beside_each_other(tmp_path, capsys) -> None:
    run = example() | {'parameters': {'frequency': 10.0, 'odom.noise': 'model', 'same': 1}}
    other = deepcopy(run)
    other['parameters'] |= {'frequency': 5.0, 'new': [1, 2]}
    other['error_table'][0]['rms'] = 0.46
    other['facts'][5]['value'] = '904'
    found = told(tmp_path, capsys, run, other)
    rows = {row[0]: row[1:] for table in found['figures'] for row in table['rows']}
    assert rows['frequency'] == ['10.0', '5.0', '-5 (-50 %)']
    assert rows['new'] == ['by default', '[1, 2]', '']
    assert 'same' not in rows
    assert rows['corrected path to truth, rms'] == ['0.92 m', '0.46 m', '-0.46 m (-50 %)']
    assert 'corrected path to truth: 0.46 m rms in B, 0.92 m in A (-50 %)' in texts(found)
    assert '2 parameters differ: frequency, new' in texts(found)


def test_runs_of_different_days_are_compared_but_for_their_paths(tmp_path, capsys) -> None:
    run = example()
    other = run | {'start_ns': str(int(run['start_ns']) + 10**15)}
    found = told(tmp_path, capsys, run, other)
    assert 'do not overlap in time' in texts(found)
    assert found['data']['errors'] is None
    assert len(found['figures']) == 3


def test_runs_and_bags_and_graphs_are_not_compared_with_each_other(tmp_path, capsys) -> None:
    run = example(poses=20, fixes=3, closures=2, others=5)
    for name, data in (('a', run), ('g', run | {'kind': 'graph'})):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'run.json').write_text(json.dumps(data), encoding='utf-8')
    (tmp_path / 'bag.mcap').touch()
    for words, said in ((['a', 'bag.mcap'], 'expected one run, two runs to compare, or bags'),
                        (['a', 'a', 'a'], 'expected one run, two runs to compare, or bags'),
                        (['a', 'g'], 'expected two runs, or two solved graphs')):
        assert main(['report', *(str(tmp_path / word) for word in words)]) == 2
        out, err = capsys.readouterr()
        assert (out, err.count('\n')) == ('', 1)
        assert said in err
