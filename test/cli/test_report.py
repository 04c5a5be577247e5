# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tool `pose-graph report`: of folders, files and bags, and what it says of wrong ones."""

import json
import os
from pathlib import Path
import re
import time

from bag_of_messages import write_bag
from circle_bag import fixes, odometry
import numpy as np
import pytest
from run_schema import problems

from pose_graph_ros.cli.main import main


def run(*words: object) -> int:
    return main(['report', *map(str, words)])


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('report') / 'circle'
    write_bag(folder, (*odometry(), *fixes(np.zeros(2))))
    return folder


@pytest.fixture(scope='module')
def folder(bag: Path) -> Path:
    """Return the folder of a replay, of which the test must change nothing."""
    out = bag.parent / 'replayed'
    assert main(['replay', str(bag), '-o', str(out)]) == 0
    return out


def data_of(page: Path) -> dict[str, object]:
    """Return the data in a page."""
    found = re.search(r'<script[^>]*id="data"[^>]*>(.*?)</script>', page.read_text('utf-8'), re.S)
    assert found is not None
    return dict(json.loads(found[1]))


def test_the_page_has_the_data_of_the_run(folder, capsys) -> None:
    assert run(folder) == 0
    printed = capsys.readouterr().out
    page = folder / 'report.html'
    assert printed.endswith(f'written: {page} ({1e-6 * page.stat().st_size:.1f} MB)\n')
    data = json.loads((folder / 'run.json').read_text('utf-8'))
    assert data_of(page) == data
    assert all(each['text'] in printed for each in data['findings'])
    again = folder.parent / 'deep' / 'again.html'
    assert run(folder / 'run.json', '-o', again) == 0
    assert again.read_bytes() == page.read_bytes()


def test_json_has_the_findings_without_the_large_tables(folder, capsys) -> None:
    page = folder.parent / 'page.html'
    assert run(folder, '--json', '-o', page) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {
        'title', 'subtitle', 'start', 'duration', 'facts', 'findings', 'error_table', 'sources',
        'springs', 'page', 'bytes'}
    assert (found['page'], found['bytes']) == (str(page), page.stat().st_size)
    assert all('series' not in each and 'rows' in each for each in found['sources'])


def test_a_bag_is_replayed_first(bag, tmp_path, capsys) -> None:
    assert run(bag, '--run', tmp_path / 'out', '--hold-out', 4, '--until', 30) == 0
    printed = capsys.readouterr().out
    assert str(tmp_path / 'out' / 'report.html') in printed
    assert 'counts' not in printed  # that is what the replay says
    data = json.loads((tmp_path / 'out' / 'run.json').read_text('utf-8'))
    assert list(problems(data)) == []
    assert data['errors']['against'] == 'held-out fixes'
    assert data['duration'] == pytest.approx(30.0, abs=0.2)
    held_out = data['states'].index('held out')
    assert data['fixes'][0]['state'].count(held_out) == len(data['errors']['t'])
    assert 0.0 < max(data['errors']['position']) < 0.5


def test_page_summary_and_messages_count_measurements_alike(tmp_path) -> None:
    """Duplicates, and what came before odometry, are refused: they are in no other count."""
    bag, out = tmp_path / 'bag', tmp_path / 'out'
    assert main(['simulate', str(bag), '--world', 'hall', '--duration', '120', '--fix',
                 '--duplicate', '/gps/fix:0.2', '--jump', '/gps/fix:60:30,0:10']) == 0
    assert run(bag, '--odom', '/odom', '--fix', '/gps/fix', '--run', out) == 0
    summary = json.loads((out / 'summary.json').read_text('utf-8'))
    data = json.loads((out / 'run.json').read_text('utf-8'))
    accepted = summary['counts']['fix.accepted']
    assert sum(count for name, count in summary['counts'].items()
               if name.startswith('fix.')) > accepted
    assert summary['fixes_used'] + summary['fixes_doubted'] == accepted
    source = next(each for each in data['sources'] if each['name'] == 'fix')
    assert (source['count'], source['used']) == (accepted, summary['fixes_used'])
    states = data['fixes'][0]['state']
    assert len(states) - states.count(data['states'].index('refused')) == accepted
    assert states.count(data['states'].index('refused')) == summary['fixes_refused'] > 0
    judged = summary['judged']
    assert sum(judged['sources']['fix']['states'].values()) == accepted
    assert len(judged['constraints']) == summary['fixes_doubted']


def test_the_page_is_shown_in_a_browser(folder, tmp_path, monkeypatch) -> None:
    shown = tmp_path / 'shown'
    browser = tmp_path / 'browser'
    browser.write_text(f'#!/bin/sh\necho "$1" > {shown}\n', encoding='utf-8')
    browser.chmod(0o755)
    monkeypatch.setenv('BROWSER', f'{browser} %s')
    assert run(folder, '--open', '-o', tmp_path / 'page.html') == 0
    end = time.monotonic() + 10.0
    while not (shown.exists() and shown.read_text('utf-8').endswith('\n')):
        assert time.monotonic() < end
        time.sleep(0.01)
    assert shown.read_text('utf-8').strip() == (tmp_path / 'page.html').as_uri()


@pytest.mark.parametrize(('content', 'said'), [
    ('', ':1: not JSON: '), ('[1,\n', ':2: not JSON: '), ('[]', 'not the run.json of a replay'),
    ('{"version": 1, "title": NaN}', 'expected finite numbers, got NaN'),
    ('{"version": 2}', 'expected version 1, got 2: replay the bag again'),
    ('{"version": 1, "title": 3}', 'no subtitle')])
def test_what_is_no_run_is_refused_in_one_line(content, said, tmp_path, capsys) -> None:
    file = tmp_path / 'run.json'
    file.write_text(content, encoding='utf-8')
    assert run(tmp_path) == 2
    out, err = capsys.readouterr()
    assert (out, err.count('\n')) == ('', 1)
    assert err.startswith(f'error: {file}')
    assert said in err
    assert not (tmp_path / 'report.html').exists()


def test_folders_that_are_no_runs_and_wrong_options_are_named(
    folder, bag, tmp_path, capsys,
) -> None:
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'words.txt').write_text('words', encoding='utf-8')
    for words, said in (
            ([tmp_path / 'empty'], 'expected the folder of a replay or a demo with run.json'),
            ([tmp_path / 'words.txt'], 'expected run.json, or a file with the suffix .mcap'),
            ([tmp_path / 'missing'], 'missing: does not exist'),
            ([folder, bag], 'expected one run, two runs to compare, or bags'),
            ([folder, '--odom', '/odom'], '--odom: '), ([folder, '--from', 3], '--from: '),
            ([folder, '-o', 'page.png'], '--out page.png: the name must end in .html'),
            ([bag, '--run', bag], 'this is a bag; name another folder'),
            ([bag, '--run', tmp_path / 'out', '--odom', '/nope'], 'no topic /nope (--odom)')):
        assert run(*words) == 2
        out, err = capsys.readouterr()
        assert (out, err.count('\n')) == ('', 1)
        assert said in err
    if os.getuid() != 0:
        (tmp_path / 'empty').chmod(0o500)
        assert run(folder, '-o', tmp_path / 'empty' / 'page.html') == 2


def test_a_recording_that_was_cut_off_has_a_report(bag, tmp_path) -> None:
    cut = tmp_path / 'cut'
    cut.mkdir()
    (file,) = bag.glob('*.mcap')
    (cut / file.name).write_bytes(file.read_bytes()[:-1000])
    assert run(cut, '--run', tmp_path / 'out') == 0
    found = json.loads((tmp_path / 'out' / 'run.json').read_text(encoding='utf-8'))['findings']
    assert 'has no metadata.yaml; what can be read of it is used' in found[0]['text']
