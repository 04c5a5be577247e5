# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph report graph.g2o`: what is told of a solved graph."""

import json
from pathlib import Path
from typing import Any

from false_loops import laps
import numpy as np
import pytest
from run_schema import problems, SCHEMA

from pose_graph_ros.cli.main import main
from pose_graph_ros.core.io.g2o import read_g2o, write_g2o

DATA = Path(__file__).resolve().parents[1] / 'data'
GRAPH = {key: kind for key, kind in SCHEMA.items() if key != 'parameters'} | {
    'kind': 'text', 'by_node': None}
LANDMARKS = """
VERTEX_SE2 3 0 0 0
VERTEX_SE2 4 1 0 0.1
VERTEX_SE2 5 2 0.1 0.2
VERTEX_SE2 9 3 0.4 0.3
VERTEX_XY 10 1.5 2
EDGE_SE2 3 4 1 0 0.1 100 0 0 100 0 1000
EDGE_SE2 4 5 1 0 0.1 100 0 0 100 0 1000
EDGE_SE2 5 9 1.1 0 0.1 100 0 0 100 0 1000
EDGE_SE2 3 9 3 0.4 0.35 100 0 0 100 0 1000
EDGE_SE2_XY 3 10 1.5 2.1 50 3 50
EDGE_SE2_XY 4 10 0.7 1.9 50 3 50
EDGE_PRIOR_SE2_XY 9 3.1 0.1 100 0 100
EDGE_PRIOR_SE2 5 2.1 0.1 0.25 100 0 0 100 0 100
"""


def told(tmp_path: Path, capsys: Any, file: Path, *words: str, code: int = 0) -> dict[str, Any]:
    """Return run.json of a graph."""
    assert main(['report', str(file), '--run', str(tmp_path / 'out'), *words]) == code
    assert str(tmp_path / 'out' / 'report.html') in capsys.readouterr().out
    found = dict(json.loads((tmp_path / 'out' / 'run.json').read_text(encoding='utf-8')))
    assert list(problems(found, GRAPH)) == []
    return found


def facts(found: dict[str, Any]) -> dict[str, str]:
    return {each['label']: each['value'] for each in found['facts']}


def test_poses_and_chi2_are_those_of_solve(tmp_path, capsys) -> None:
    file, out = DATA / 'manhattan.g2o', tmp_path / 'solved.g2o'
    assert main(['solve', str(file), '-o', str(out), '--json']) == 0
    solved, graph = json.loads(capsys.readouterr().out), read_g2o(out)
    found = told(tmp_path, capsys, file)
    assert facts(found)['chi2'] == f'{solved["chi2"]:.5g}'
    assert facts(found)['certificate'] == solved['certificate']['verdict'].replace('_', ' ')
    path = found['lines']['corrected']
    places = np.column_stack((path['x'], path['y'])) + found['offset']
    np.testing.assert_allclose(places, graph.graph.poses[:, :2], atol=0.02)
    # times are ids of nodes
    assert np.array(path['t']) + int(found['start_ns']) // 10**9 == pytest.approx(graph.ids)
    # and the largest energies are its own
    edges, energies = graph.graph.factors, graph.graph.energies().factors
    for spring, k in zip(found['springs'], np.argsort(-energies), strict=False):
        assert spring['name'] == f'{graph.ids[edges.i[k]]} -> {graph.ids[edges.j[k]]}'
        assert spring['energy'] == pytest.approx(energies[k], rel=1e-2)
    # a report of the folder is the same
    assert main(['report', str(tmp_path / 'out'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['facts'] == found['facts']


def test_closures_have_their_errors_and_wrong_ones_are_doubted_if_asked(tmp_path, capsys) -> None:
    drive, file = laps(4, n_wrong=3), tmp_path / 'laps.g2o'
    write_g2o(drive.graph, file)
    plain = told(tmp_path, capsys, file)
    assert '--robust decides' in ' '.join(each['text'] for each in plain['findings'])
    found = told(tmp_path, capsys, file, '--robust')
    table, ends = found['closures'][0], drive.graph.factors_at(drive.closures)
    wrong = {f'{i} -> {j}' for i, j in zip(*(
        each[~drive.right].tolist() for each in (ends.i, ends.j)), strict=True)}
    states = dict(zip(table['id'], table['state'], strict=True))
    doubted = {name for name, state in states.items() if state == 3}
    assert wrong <= doubted
    assert len(doubted) < 6
    # how far each is off at the optimum without these
    off = dict(zip(table['id'], table['d'], strict=True))
    assert max(off[name] for name in set(off) - doubted) < 5.0 < min(off[name] for name in wrong)
    said = next(each for each in found['findings'] if 'are not used' in each['text'])
    assert len(said['at']) == 2 * len(doubted)


def test_landmarks_and_measured_positions_are_on_the_map(tmp_path, capsys) -> None:
    file = tmp_path / 'landmarks.g2o'
    file.write_text(LANDMARKS, encoding='ascii')
    found = told(tmp_path, capsys, file)
    assert facts(found)['sightings'] == '2'
    assert {each['source']: len(each['t']) for each in found['fixes']} == {
        'observed': 2, 'landmarks': 1}
    # expected residuals add up to measured coordinates less unknowns
    expected = sum(each['energy']['expected'] * each['used'] for each in found['sources'])
    assert expected == pytest.approx(9 + 3 + 4 + 5 - 14, abs=0.01)
    notes = {each['label']: each['note'] for each in found['facts']}
    assert notes['chi2'] == '7 degrees of freedom'


def test_options_of_bags_are_refused_and_those_of_graphs_elsewhere(tmp_path, capsys) -> None:
    ring = str(DATA / 'ring.g2o')
    for words, said in (([ring, '--odom', '/odom'], '--odom: '), ([ring, '--until', '3'], 'until'),
                        ([ring, ring], 'expected one graph alone'),
                        ([str(tmp_path / 'bag.mcap'), '--robust'], 'the option is for a graph')):
        assert main(['report', *words, '--run', str(tmp_path / 'out')]) == 2
        out, err = capsys.readouterr()
        assert (out, err.count('\n')) == ('', 1)
        assert said in err


@pytest.mark.parametrize(('text', 'said'), [
    ('VERTEX_SE2 0 1 2 0\n', ''),
    ('VERTEX_SE2 3 0 0 0\nVERTEX_SE2 5 1 0 0\nEDGE_SE2 3 5 1 0 0 1 0 0 1 0 0\n',
     'is not determined'),
    ('VERTEX_SE2 3 0 0 0\nVERTEX_SE2 5 1 0 0\n', 'that begin at 5'),
    ('VERTEX_SE2 8646911284551352320 0 0 0\nVERTEX_SE2 8646911284551352321 1 0 0\n'
     'EDGE_SE2 8646911284551352320 8646911284551352321 1 0 0 1 0 0 1 0 1\n', 'certified')])
def test_graphs_that_tell_little_have_a_report_as_well(text, said, tmp_path, capsys) -> None:
    file = tmp_path / 'little.g2o'
    file.write_text(text, encoding='ascii')
    found = told(tmp_path, capsys, file)
    assert said in ' '.join(each['text'] for each in found['findings'])


def test_landmarks_alone_are_no_graph_to_report(tmp_path, capsys) -> None:
    file = tmp_path / 'points.g2o'
    file.write_text('VERTEX_XY 5 1 1\nVERTEX_XY 6 1 2\n', encoding='ascii')
    assert main(['report', str(file), '--run', str(tmp_path / 'out')]) == 2
    assert capsys.readouterr().err == (
        f'error: {file}: expected poses, got landmarks alone\n')
