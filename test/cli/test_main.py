# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `pose-graph`: its tools, and those of them that need no module of their own."""

from pathlib import Path
import subprocess
import sys

import pytest

from pose_graph_ros import __version__
from pose_graph_ros.adapters.parameters import as_markdown, as_yaml
from pose_graph_ros.cli.main import main, TOOLS
from pose_graph_ros.core import backend  # noqa: F401  declares the kernels
from pose_graph_ros.core.compiled import jit

RING = Path(__file__).parents[1] / 'data' / 'ring.g2o'
# What only some tools need, and what takes a tenth of a second or more to import.
HEAVY = ('rclpy', 'rosbags', 'pyproj', 'matplotlib', 'PIL', 'scipy', 'numba', 'numpy', 'yaml')


def test_help_lists_all_tools(capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(['--help'])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert all(f'\n    {tool} ' in printed for tool in TOOLS)


def test_the_version_is_that_of_the_package(capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(['--version'])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f'{__version__}\n'


def loaded(*words: str | Path) -> set[str]:
    """Return the names of all modules that are loaded after a tool has run in its own process."""
    code = ('import sys; from pose_graph_ros.cli.main import main\n'
            'try: main(sys.argv[1:])\n'
            'except SystemExit: pass\n'
            'print(*sys.modules)')
    done = subprocess.run([sys.executable, '-c', code, *map(str, words)], check=True,
                          capture_output=True, text=True, timeout=240)
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize('words', [
    ['--help'], ['--version'], ['no_such_tool'], *([tool, '--help'] for tool in TOOLS),
    ['simulate', 'a', '--fix-sigma', 'b']], ids=' '.join)
def test_help_and_wrong_words_load_nothing_that_takes_time(words) -> None:
    assert not loaded(*words) & set(HEAVY)


def test_solve_loads_what_it_needs(tmp_path) -> None:
    # neither Numba nor, but for an extension module, SciPy: they take longer to load than all else
    names = loaded('solve', RING, '-o', tmp_path / 'ring.g2o')
    assert 'pose_graph_ros.core.batch.plain_optimizer' in names
    assert names & set(HEAVY) <= {'numpy'}
    assert not {name for name in names if name.startswith('scipy.')} - {
        'scipy.sparse.linalg._dsolve._superlu'}
    # another start needs the compiled kernels
    if not jit.is_cached():
        loaded('compile-kernels')
    names = loaded('solve', RING, '--no-certificate', '--start', 'file')
    assert 'pose_graph_ros.core.batch.optimizer' in names
    # (Numba reads a settings file with PyYAML, and the version of SciPy)
    assert names & set(HEAVY) <= {'numpy', 'numba', 'yaml', 'scipy'}
    assert not {name for name in names if name.startswith((
        'scipy.linalg', 'scipy.sparse', 'numba.np.linalg', 'numba.np.arraymath'))}
    assert not {name for name in names if name.startswith((
        'pose_graph_ros.adapters', 'pose_graph_ros.ros', 'pose_graph_ros.core.smoother'))}


@pytest.mark.parametrize('words', [
    [], ['no_such_tool'], ['solve', 'a', '--edge2', 'b'],
    ['replay', 'bag', '--hold-out', 'some']])
def test_wrong_words_are_refused(words, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith('usage: pose-graph')


def test_parameters_are_printed_as_tables_and_as_a_file(capsys) -> None:
    assert main(['parameters']) == 0
    assert capsys.readouterr().out == as_markdown()
    assert main(['parameters', '--yaml']) == 0
    assert capsys.readouterr().out == as_yaml()


INTERRUPTED_IN_THE_COMPILER = """
import ctypes, os, signal, sys, time
from pose_graph_ros.cli.main import guarded

signal.signal(signal.SIGINT, signal.default_int_handler)    # a job in the background ignores it
hook = {}
exec(compile('def notify():\\n    kill(pid, number)\\n    for _ in range(1000): pass\\n',
             '/site-packages/llvmlite/binding/executionengine.py', 'exec'),
     {'kill': os.kill, 'pid': os.getpid(), 'number': signal.SIGINT, 'range': range}, hook)

def run():
    ctypes.CFUNCTYPE(None)(hook['notify'])()
    time.sleep(20.0)
    return 0

sys.exit(guarded(run))
"""


def test_ctrl_c_while_the_compiler_calls_back_ends_a_tool_without_a_word() -> None:
    done = subprocess.run([sys.executable, '-c', INTERRUPTED_IN_THE_COMPILER], check=False,
                          capture_output=True, text=True, timeout=15)
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')
