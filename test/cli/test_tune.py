# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph tune` on bags, and what it says of wrong input."""

import contextlib
import io
import json
from pathlib import Path
from typing import Any

from helpers.noisy_drive import made, write
import pytest
import yaml

from pose_graph_ros.cli.main import main


@pytest.fixture(scope='module')
def overconfident(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag with fixes of 1 m that claim 3 cm."""
    return write(tmp_path_factory.mktemp('tune') / 'bag', *made(4, 120), claimed=0.03)


@pytest.fixture(scope='module')
def tuned(overconfident: Path) -> tuple[Path, dict[str, Any]]:
    """Return the parameter file and the summary."""
    out = overconfident.parent / 'tuned.yaml'
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        assert main(['tune', str(overconfident), '-o', str(out), '--folds', '2', '--json']) == 0
    return out, json.loads(text.getvalue())


def test_it_makes_errors_at_held_out_fixes_lower(tuned: tuple[Path, dict[str, Any]]) -> None:
    _, facts = tuned
    assert facts['verdict'] == 'better'
    assert facts['after']['rms'] < 0.9 * facts['before']['rms']
    assert facts['after']['nlpd'] < facts['before']['nlpd']
    assert 0.5 < facts['after']['nees'] < 2.0
    assert facts['before']['n'] == facts['after']['n'] > 100


def test_the_node_takes_the_file(tuned: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    path, facts = tuned
    content = yaml.safe_load(path.read_text())['/**']['ros__parameters']
    assert 0.8 < content['fix']['covariance_scale'] * 0.03**2 < 1.25
    bag = facts['bags'][0]
    assert main(['replay', bag, '--params-file', str(path), '-o', str(tmp_path / 'out')]) == 0
    given = {each['name'] for each in facts['parameters'] if each['changed']}
    assert given == {f'{source}.{name}' for source, of in content.items() for name in of}


@pytest.mark.parametrize(('args', 'message'), [
    (['missing'], 'missing'),
    (['{bag}', '-o', '{folder}'], 'is a folder'),
    (['{bag}', '-o', '{folder}/none/tuned.yaml'], 'no folder'),
    (['{bag}', '--fix', '/none'], 'no topic /none'),
    (['{bag}', '--truth', '/none'], 'no topic /none'),
    (['{bag}', '-p', 'sources:=[odom]'], 'nothing to tune by'),
])
def test_wrong_input_is_one_line(
    args: list[str], message: str, overconfident: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(['tune', *(each.format(bag=overconfident, folder=tmp_path)
                           for each in args)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith('error: ')
    assert error.count('\n') == 1
