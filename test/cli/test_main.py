# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `pose-graph`: its tools, and those of them that need no module of their own."""

from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros import __version__
from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.adapters.parameter_texts import as_markdown, as_yaml, sources_as_markdown
from pose_graph_ros.cli import main as command
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import simulate_drive

TOOLS = ('demo', 'replay', 'solve', 'simulate', 'parameters')


def test_help_lists_all_tools(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(['--help'])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert all(f'\n    {tool} ' in printed for tool in TOOLS)


@pytest.mark.parametrize('tool', TOOLS)
def test_each_tool_has_a_help(tool: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([tool, '--help'])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith(f'usage: pose-graph {tool} ')


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(['--version'])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f'{__version__}\n'


@pytest.mark.parametrize('words', [[], ['no_such_tool'], ['solve'], ['solve', 'a', '--edge2', 'b'],
                                   ['replay', 'bag', '--hold-out', 'some']])
def test_wrong_words_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith('usage: pose-graph')


def test_parameters_are_printed_as_tables_and_as_a_file(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(['parameters']) == 0
    assert capsys.readouterr().out == f'{as_markdown()}\n{sources_as_markdown()}'
    assert main(['parameters', '--yaml']) == 0
    assert capsys.readouterr().out == as_yaml()


def test_a_drive_is_simulated_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(command, 'simulate_drive', lambda seed: simulate_drive(seed, 12.0))
    folder = tmp_path / 'drive'
    assert main(['simulate', str(folder), '--seed', '5']) == 0
    assert capsys.readouterr().out == f'written: {folder}\n'
    drive = simulate_drive(5, 12.0)
    with open_bag(folder) as bag:
        assert sorted(bag.topics) == ['/gps/fix', '/ground_truth', '/odom']
        stamps = [message.recorded_ns for message in bag.messages(['/odom'])]
    np.testing.assert_array_equal(np.array(stamps) - 4_000_000, drive.odometry.stamps_ns)
    # what is there is not overwritten
    assert main(['simulate', str(folder)]) == 2
    assert capsys.readouterr().err == f'error: {folder}: exists already, not overwritten\n'
