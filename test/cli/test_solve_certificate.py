# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The certificate and the starts of `pose-graph solve`, and its JSON output."""

import json
from pathlib import Path
import re
from typing import Any

import numpy as np
from public_data import needs, PUBLIC
import pytest

from pose_graph_ros.cli.main import main

DATA = Path(__file__).resolve().parents[1] / 'data'
GOLDEN = json.loads((DATA / 'golden.json').read_text(encoding='utf-8'))
NAMES = [name for name in GOLDEN if name.endswith('.g2o')]
KEYS = {'hidden_nodes', 'edges', 'observed_nodes', 'chi2_start', 'chi2', 'iterations', 'seconds',
        'status', 'reason', 'start', 'starts', 'held', 'doubted', 'robust', 'edge2', 'certificate'}
OF_CERTIFICATE = {'verdict', 'reason', 'seconds', 'chi2', 'gap', 'relative_gap', 'lambda_min',
                  'rank', 'lower_minimum', 'chi2_from_it', 'chi2_bound', 'chi2_gap'}
# Optima of public files, where they are present: name, chi2, whether the bound is one of chi2.
OPTIMA = [('ring.g2o', 11.163100832, True), ('input_M3500_g2o.g2o', 137.912950936, True),
          ('M3500a.g2o', 912.115012171, True), ('intel_vertigo.g2o', 546.461111602, True),
          ('CSAIL_P_toro.graph', 38.956285872, False), ('city10000.g2o', 511.985163635, True)]


def solved(capsys: pytest.CaptureFixture[str], *args: object) -> dict[str, Any]:
    """Return the JSON output."""
    assert main(['solve', *map(str, args), '--json']) == 0
    values: dict[str, Any] = json.loads(capsys.readouterr().out)
    return values


def wound_ring(n: int) -> str:
    """Return a polygon as a file, its headings wound once too often."""
    turn = 2.0 * np.pi / n
    lines = [f'VERTEX_SE2 {k} 0 0 {2.0 * k * turn}' for k in range(n)]
    lines += [f'EDGE_SE2 {k} {(k + 1) % n} 1 0 {turn} 1 0 0 1 0 10' for k in range(n)]
    return '\n'.join(lines)


@pytest.mark.parametrize('name', NAMES)
def test_each_graph_is_certified(name, capsys) -> None:
    values = solved(capsys, DATA / name)
    assert set(values) == KEYS
    assert values['chi2'] == pytest.approx(GOLDEN[name]['chi2'], rel=1e-8)
    assert values['chi2_start'] > values['chi2']
    found = values['certificate']
    assert set(found) == OF_CERTIFICATE
    assert found['verdict'] == 'certified'
    assert found['rank'] == 1
    if found['chi2_bound'] is not None:
        assert found['chi2_bound'] < values['chi2']
        assert found['chi2_gap'] == values['chi2'] - found['chi2_bound']


def test_from_a_minimum_that_is_not_the_lowest_the_certificate_leads_to_it(
    tmp_path, capsys,
) -> None:
    path = tmp_path / 'ring.g2o'
    path.write_text(wound_ring(20), encoding='ascii')
    stuck = solved(capsys, path, '--start', 'file', '--no-certificate')
    assert stuck['chi2'] > 1.0
    assert stuck['certificate'] is None
    values = solved(capsys, path, '--start', 'file')
    assert values['chi2'] < 1e-8
    assert values['start'] == 'minimum of the chordal objective'
    assert values['certificate']['lower_minimum']
    assert values['certificate']['verdict'] == 'certified'
    assert main(['solve', str(path), '--start', 'file']) == 0
    printed = capsys.readouterr().out
    assert re.search(r'certificate: certified, .*\n  near the poses found first', printed)


def test_the_best_of_all_starts_is_kept(tmp_path, capsys) -> None:
    path = tmp_path / 'ring.g2o'
    path.write_text(wound_ring(20), encoding='ascii')
    values = solved(capsys, path, '--start', 'best', '--no-certificate')
    assert values['chi2'] < 1e-8
    assert [each['start'] for each in values['starts']] == [
        'chordal start', 'present poses', 'odometry']
    assert values['chi2'] <= min(each['chi2'] for each in values['starts']) + 1e-12
    # without poses in the file there is one start less; without a chain, all edges are composed
    text = '\n'.join(line for line in wound_ring(8).splitlines() if line.startswith('EDGE'))
    path.write_text(re.sub(r'^EDGE_SE2 3 4 .*$', '', text, flags=re.MULTILINE), encoding='ascii')
    values = solved(capsys, path, '--start', 'best')
    assert [each['start'] for each in values['starts']] == ['chordal start', 'odometry']
    assert values['chi2'] < 1e-8


@pytest.mark.parametrize(('text', 'because'), [
    ('EDGE_SE2_XY 0 1 1 0 1 0 1\nVERTEX_XY 1 0 0\nVERTEX_SE2 0 0 0 0', 'landmarks'),
    ('EDGE_PRIOR_SE2_XY 5 1 1 1 0 1', 'do not determine'),
])
def test_the_reason_is_said_where_there_is_none(text, because, tmp_path, capsys) -> None:
    path = tmp_path / 'graph.g2o'
    path.write_text(text, encoding='ascii')
    found = solved(capsys, path)['certificate']
    assert found['verdict'] == 'not attempted'
    assert because in found['reason']
    assert main(['solve', str(path)]) == 0
    assert f'not attempted, because {found["reason"]}' in capsys.readouterr().out


@needs('graphs')
@pytest.mark.parametrize(('name', 'chi2', 'bounded'), OPTIMA)
def test_the_optimum_of_a_public_graph_is_reached_and_certified(
    name, chi2, bounded, capsys,
) -> None:
    values = solved(capsys, PUBLIC / 'graphs' / name)
    assert values['chi2'] == pytest.approx(chi2, rel=1e-6)
    found = values['certificate']
    assert found['verdict'] == 'certified'
    assert (found['chi2_bound'] is not None) is bounded
    if bounded:
        assert chi2 * 0.999 < found['chi2_bound'] < chi2
