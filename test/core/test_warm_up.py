# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""After the warm-up nothing is left to compile, and its helpers end with it in any case."""

from collections.abc import Callable
import importlib
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from types import ModuleType

import numba
import pytest

from pose_graph_ros.core import warm_up
from pose_graph_ros.core.compiled import jit


def run_alone(code: str, **environment: str) -> str:
    """Run code in an interpreter of its own, where nothing has been compiled or loaded before."""
    path = os.pathsep.join(map(os.path.abspath, sys.path))
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': path, **environment})
    assert done.returncode == 0, f'exit code {done.returncode}: {done.stderr[-3000:]}'
    return done.stdout


# --- what the engine does ------------------------------------------------------------------------

LONG_RUN = """
from helpers.all_kernels import call_all_kernels
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.warm_up import warm_up

def signatures():
    return {name: list(map(str, kernel.signatures)) for name, kernel in jit._registered.items()}

assert warm_up() > 0.0
before = signatures()
call_all_kernels(700)
call_all_kernels(300, max_iterations=1)
grown = {name: found for name, found in signatures().items() if found != before[name]}
assert not grown, grown
"""
BUILD = """
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.compiled import jit

PoseGraphBackend()
compiled = [name for name, kernel in jit._registered.items() if kernel.signatures]
assert not compiled, compiled
"""
KEPT = """
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.warm_up import warm_up

warm_up()
missing = [name for name in jit.declared() if not jit.is_cached(name)]
assert jit.is_cached(), missing
"""


@pytest.mark.timeout(300)
def test_a_long_run_after_the_warm_up_compiles_nothing() -> None:
    run_alone(LONG_RUN)


def test_a_backend_is_built_without_compiling() -> None:
    """So that a node is up before anything is compiled."""
    run_alone(BUILD)


@pytest.mark.timeout(300)
def test_the_next_start_finds_the_code_of_all_kernels() -> None:
    run_alone(KEPT)


def test_it_can_be_stopped_between_two_kernels() -> None:
    run_alone("""
from pose_graph_ros.core import warm_up
loaded = []
warm_up.jit.compile_kernels = loaded.extend
warm_up.warm_up(lambda: len(loaded) == 3)
assert len(loaded) == 3, loaded
warm_up.warm_up()
assert loaded[3:] == warm_up.jit.declared()
""")


PACKAGE = 'helped_kernels_of_a_test'
FILES = {
    '__init__': '',
    'outer': """
from pose_graph_ros.core.compiled.jit import kernel, NUMBER

@kernel(signature=(NUMBER,))
def twice(x):
    return 2.0 * x
""",
    'help': f"""
import os, time
from pathlib import Path
from pose_graph_ros.core.warm_up import end_with_parent

def along():
    end_with_parent()
    from {PACKAGE}.outer import twice
    twice(1.0)
    print('not to be seen')

def die():
    os._exit(3)

def stay():
    end_with_parent()
    name = Path(__file__).with_name('pid')
    name.with_suffix('.new').write_text(str(os.getpid()))
    name.with_suffix('.new').rename(name)
    time.sleep(600.0)
""",
}
PARENT = f"""
import time
from pose_graph_ros.core.warm_up import helper
with helper('{PACKAGE}.help', 'stay'):
    time.sleep(600.0)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a package with a kernel, the only one that this process knows of."""
    monkeypatch.setattr(jit, '_registered', {})
    monkeypatch.setattr(jit, '_signatures', {})
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv('NUMBA_CACHE_DIR', raising=False)
    monkeypatch.setattr(numba.config, 'CACHE_DIR', '')
    monkeypatch.setattr(os, 'sched_getaffinity', lambda process: {0, 1})
    package = tmp_path / PACKAGE
    package.mkdir()
    for name, text in FILES.items():
        (package / f'{name}.py').write_text(text)
    return package


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of what helpers were started for."""
    names: list[str] = []

    start = warm_up.helper
    monkeypatch.setattr(
        warm_up, 'helper', lambda module, name: (names.append(name), start(module, name))[1])
    return names


@pytest.fixture
def warm(
    folder: Path, started: list[str], monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., ModuleType]:
    """Return what does the warm-up as in a new process, helped by a function of the package."""
    def run(*helpers: str, stopped: Callable[[], bool] = lambda: False) -> ModuleType:
        for name in [name for name in sys.modules if name.partition('.')[0] == PACKAGE]:
            del sys.modules[name]
        importlib.invalidate_caches()
        jit._registered.clear()
        jit._signatures.clear()
        module = importlib.import_module(f'{PACKAGE}.outer')
        monkeypatch.setattr(
            warm_up, 'HELPERS', tuple((f'{PACKAGE}.help', helper) for helper in helpers))
        warm_up.warm_up(stopped)
        return module

    return run


def pid(folder: Path) -> int:
    """Wait until the helper has said who it is."""
    deadline = time.monotonic() + 240.0
    while not (folder / 'pid').exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return int((folder / 'pid').read_text())


def is_alive(process: int) -> bool:
    try:
        # an orphan that nobody waits for is as good as gone
        state = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in 'ZX'


def test_what_a_helper_has_compiled_is_loaded(
    warm: Callable[..., ModuleType], started: list[str], capfd: pytest.CaptureFixture[str],
) -> None:
    first = warm('along', 'along')
    assert first.twice.stats.cache_misses.total() == 0
    assert started == ['along', 'along']
    again = warm('along', 'along')
    assert again is not first
    assert again.twice.stats.cache_misses.total() == 0
    assert started == ['along', 'along']    # all is there
    assert capfd.readouterr() == ('', '')


def test_without_its_helpers_a_process_compiles_all(
    warm: Callable[..., ModuleType], started: list[str],
) -> None:
    helpers = 'die', 'there is no such function'
    module = warm(*helpers)
    assert started == [*helpers]
    assert module.twice.stats.cache_misses.total() == 1


def test_a_helper_that_is_stuck_is_not_waited_for(
    folder: Path, warm: Callable[..., ModuleType], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(warm_up, 'PATIENCE', 1.0)
    start = time.monotonic()
    module = warm('stay')
    assert module.twice.signatures
    assert time.monotonic() - start < 240.0     # it would stay for ten minutes
    if (folder / 'pid').exists():   # it may have had no time to say who it is
        assert not Path(f'/proc/{pid(folder)}').exists()


def test_with_the_warm_up_its_helpers_are_stopped(
    folder: Path, warm: Callable[..., ModuleType],
) -> None:
    module = warm('stay', stopped=(folder / 'pid').exists)
    assert module.twice.signatures == []
    assert not Path(f'/proc/{pid(folder)}').exists()    # not even as a zombie


def test_a_helper_ends_with_a_process_that_is_killed(folder: Path) -> None:
    path = os.pathsep.join(map(os.path.abspath, sys.path))
    parent = subprocess.Popen([sys.executable, '-c', PARENT], env={**os.environ,
                                                                   'PYTHONPATH': path})
    helper = pid(folder)
    assert is_alive(helper)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 240.0
    while is_alive(helper):
        assert time.monotonic() < deadline
        time.sleep(0.01)
