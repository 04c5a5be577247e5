# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the guides tell a reader to write into files and to type is what the project takes."""

import argparse
from collections.abc import Iterator
import importlib
from itertools import pairwise
import os
from pathlib import Path
import re
import shlex
from typing import Any

import pytest
import yaml

from pose_graph_ros.adapters import launch_arguments
from pose_graph_ros.adapters.parameters import checked_together, yaml_value
from pose_graph_ros.cli import shared
from pose_graph_ros.cli.main import main

ROOT = Path(__file__).resolve().parents[1]
GUIDES = sorted((ROOT / 'docs' / 'guides').glob('*.md'))
DEFAULTS = {name: default for name, (default, _) in launch_arguments.arguments(ROOT).items()}
LAUNCH = ['ros2', 'launch', 'pose_graph_ros', 'pose_graph.launch.py']
RUN = ['ros2', 'run', 'pose_graph_ros', 'pose_graph_node']
LONG = () if 'POSE_GRAPH_GUIDES' in os.environ else ('gnss', 'loop_closures', 'tuning')
"""Pages whose commands take minutes: `make guides` runs them, too."""


def blocks(page: Path, *languages: str) -> list[str]:
    """Return the blocks of code of a page in some languages."""
    found = re.findall(r'^ *```(\w*)\n(.*?)^ *```', page.read_text(encoding='utf-8'), re.M | re.S)
    return [text for language, text in found if language in languages]


def commands(page: Path) -> Iterator[list[str]]:
    """Yield the words of each command in the blocks for a shell, those of a pipe one by one."""
    for block in blocks(page, '', 'bash', 'sh', 'console', 'shell'):
        for line in block.replace('\\\n', ' ').splitlines():
            try:
                words = shlex.shlex(line.strip().removeprefix('$ '), posix=True,
                                    punctuation_chars='|&;<>')
                words.whitespace_split, words.commenters = True, '#'
                found: list[list[str]] = [[]]
                for word in words:
                    if set(word) <= set('|&;<>'):
                        found.append([])
                    else:
                        found[-1].append(word)
            except ValueError:
                continue    # what a program has printed
            yield from found


def settings(page: Path, folder: Path) -> list[dict[str, Any]]:
    """Return the parameters of each file for the node on a page, read as the tools read it."""
    found = []
    for text in blocks(page, 'yaml'):
        names = {str(name).rpartition('/')[2] for name in yaml_value(text)}
        if 'ros__parameters' in text and names & {'**', '*', 'pose_graph'}:
            file = folder / f'{len(found)}.yaml'
            file.write_text(text, encoding='utf-8')
            found.append(shared.parameter_values(argparse.Namespace(params_file=file, param=[])))
    return found


def given(words: list[str]) -> dict[str, str]:
    """Return what is given as NAME:=VALUE."""
    assert all(':=' in word for word in words), words
    return dict(word.split(':=', 1) for word in words)


@pytest.mark.parametrize('page', GUIDES, ids=lambda page: page.name)
def test_files_of_parameters_are_right(page: Path, tmp_path: Path) -> None:
    for values in settings(page, tmp_path):
        checked_together(values)


@pytest.mark.parametrize('page', GUIDES, ids=lambda page: page.name)
def test_the_node_can_be_started_as_it_says(page: Path, tmp_path: Path) -> None:
    files = [*settings(page, tmp_path), {}]
    for words in commands(page):
        parameters: dict[str, Any] = {}
        if words[:4] == LAUNCH:
            typed = given([word for word in words[4:] if word != '--show-args'])
            assert launch_arguments.unknown(words[4:], DEFAULTS, included=False) == []
            for name in ('rviz', 'remap_tf', 'use_sim_time', 'autostart'):
                if name in typed:
                    launch_arguments.switch(typed, name)
            parameters = launch_arguments.parameters(DEFAULTS | typed)
            has_file = 'params_file' in typed
        elif words[:4] == RUN:
            options = [*pairwise(words)]
            parameters = {name: yaml.safe_load(text) for name, text in given(
                [word for option, word in options if option == '-p']).items()}
            has_file = '--params-file' in words
        if len(parameters) > 0:
            parameters.pop('use_sim_time', None)
            # with the first file of the page, whose name the reader chooses
            checked_together((files[0] if has_file else {}) | parameters)


@pytest.mark.parametrize('page', GUIDES, ids=lambda page: page.name)
def test_tools_take_their_options(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for words in commands(page):
        if words[:1] == ['pose-graph'] and words[1:2] not in (['--version'], ['--help']):
            tool = importlib.import_module(f'pose_graph_ros.cli.{words[1].replace("-", "_")}')
            with monkeypatch.context() as patch:
                patch.setattr(tool, 'execute', lambda _: 0)
                assert main(words[1:]) == 0, words


@pytest.mark.slow
@pytest.mark.parametrize('page', [page for page in GUIDES if page.stem not in LONG],
                         ids=lambda page: page.name)
def test_its_commands_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for text in blocks(page, 'yaml'):
        if (name := re.match(r' *# (\w+\.yaml)\n', text)) is not None:
            Path(name[1]).write_text(text, encoding='utf-8')
    for words in commands(page):
        if words[:1] == ['pose-graph']:
            assert main(words[1:]) == 0, words
        elif words[:4] == LAUNCH and (made := Path('pose_graph.yaml')).is_file():
            # the call that `migrate` has written
            assert ' '.join(words) in made.read_text(encoding='utf-8')


def test_wrong_ones_would_be_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / 'page.md'

    def fails(check: Any, text: str, *more: Any) -> bool:
        page.write_text(text)
        try:
            check(page, *more)
        except (AssertionError, ValueError, SystemExit):
            return True
        return False

    head = '```yaml\n/**:\n  ros__parameters:\n    '
    assert fails(test_files_of_parameters_are_right, f'{head}frequncy: 3.0\n```\n', tmp_path)
    assert not fails(test_files_of_parameters_are_right, f'{head}frequency: 3.0\n```\n', tmp_path)
    for typed in ('odmo:=/odom', 'rviz:=yes', 'compatible:=fuse', 'gyro:=/imu'):
        text = f'```bash\n{" ".join(LAUNCH)} {typed}\n```\n'
        assert fails(test_the_node_can_be_started_as_it_says, text, tmp_path), typed
    text = f'```bash\n{" ".join(RUN)} --ros-args -p frequncy:=3.0\n```\n'
    assert fails(test_the_node_can_be_started_as_it_says, text, tmp_path)
    text = '```bash\npose-graph solve \\\n  --no-such-option a.g2o\n```\n'
    assert fails(test_tools_take_their_options, text, monkeypatch)
