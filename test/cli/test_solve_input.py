# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What `pose-graph solve` says of files that are wrong, or written in another way than usual."""

import gzip
import json
from pathlib import Path
import re

import pytest

from pose_graph_ros.cli.main import main

I = '1 0 0 1 0 1'   # noqa: E741
FIRST = f'VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 {I}\n'
# Text behind two good lines, and what is said.
WRONG = {
    'truncated': ('EDGE_SE2 1 2 1 0 0 1 0 0 1 0', ':3: EDGE_SE2 is followed by 11 .*got 10'),
    'indefinite': ('EDGE_SE2 1 2 1 0 0 1 2 0 1 0 1', ':3: .* not positive semidefinite'),
}


@pytest.mark.parametrize('name', WRONG)
def test_a_wrong_file_is_one_line_that_names_it(name, tmp_path, capsys) -> None:
    path, (line, said) = tmp_path / 'graph.g2o', WRONG[name]
    path.write_text(FIRST + line, encoding='ascii')
    assert main(['solve', str(path)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert re.fullmatch(f'error: {re.escape(str(path))}{said}.*\n', captured.err)


def test_what_overflows_is_null_in_json(tmp_path, capsys) -> None:
    path = tmp_path / 'graph.g2o'
    path.write_text(f'EDGE_SE2 0 1 1e200 0 0 {I}\nEDGE_SE2 0 1 -1e200 0 0 {I}\n', encoding='ascii')
    assert main(['solve', str(path), '--json']) == 1
    # by Python's default, JSON would have the word Infinity, which no other program reads
    result = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert result['chi2'] is result['chi2_start'] is None
    assert (result['status'], result['start']) == ('failed', 'chordal start')
    assert result['certificate']['verdict'] == 'not attempted'
    assert result['certificate']['reason'] == 'the optimisation failed: chi2 is not finite'


def solved(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, object]:
    assert main(['solve', str(path), '--json', *options]) == 0
    values: dict[str, object] = json.loads(capsys.readouterr().out)
    return values


def test_line_ends_and_compression_change_nothing(tmp_path, capsys) -> None:
    text = FIRST + f'EDGE_SE2 1 2 1 0 1 {I}\nEDGE_SE2 2 0 -1.7 0.2 -1 {I}\n'
    results = []
    for name, content in (('unix.g2o', text.encode()), ('old.g2o', text.replace(
            '\n', '\r\n').encode()), ('packed.g2o.gz', gzip.compress(text.encode()))):
        path = tmp_path / name
        path.write_bytes(content)
        values = solved(path, capsys)
        results.append((values['chi2'], values['hidden_nodes'], values['edges']))
    assert results[0][0] > 0.01
    assert results[1:] == results[:2]


def test_an_edge_from_a_node_to_itself_is_skipped_with_one_warning(tmp_path, capsys) -> None:
    path = tmp_path / 'graph.g2o'
    one = '1 0 0 1 0 1'
    path.write_text(f'EDGE_SE2 0 1 1 0 0 {one}\nEDGE_SE2 1 1 0 0 0 {one}\n'
                    f'EDGE_SE2 0 0 1 0 0 {one}\n', encoding='ascii')
    assert main(['solve', str(path)]) == 0
    out, err = capsys.readouterr()
    assert '2 hidden nodes, 1 edges' in out
    assert err == f'warning: {path}: 2 edges from a node to itself are skipped\n'


def test_a_toro_file_is_replayed_and_reported_as_it_is_solved(tmp_path) -> None:
    path = tmp_path / 'drive.graph'
    path.write_text(''.join(f'EDGE2 {k} {k + 1} 1 0 0.1 100 0 100 400 0 0\n' for k in range(9)),
                    encoding='ascii')
    assert main(['replay', str(path), '-o', str(tmp_path / 'run')]) == 0
    assert len((tmp_path / 'run' / 'path.tum').read_text().splitlines()) >= 10
    assert main(['report', str(path), '--run', str(tmp_path / 'again'), '-o',
                 str(tmp_path / 'page.html')]) == 0
    assert (tmp_path / 'page.html').stat().st_size > 10_000
