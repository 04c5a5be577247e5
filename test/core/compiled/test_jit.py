# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels: kept between starts, in a folder that is there, and never the wrong ones."""

from collections.abc import Callable
import importlib
import os
from pathlib import Path
import shutil
import subprocess
import sys
from types import ModuleType

from helpers.all_kernels import call_all_kernels
import numba
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import _nrt_python, rtsys
import numpy as np
import pytest

from pose_graph_ros.core.compiled import jit, kernel_cache

TREE = Path(__file__).resolve().parents[3]
PACKAGE = 'kernels_of_a_test'
INNER = """
from pose_graph_ros.core.compiled.jit import kernel

GAIN = 2.0

@kernel(fastmath={'arcp', 'contract', 'nsz'})
def scaled(x):
    return GAIN * x
"""
OUTER = f"""
from pose_graph_ros.core.compiled.jit import kernel, NUMBERS
from {PACKAGE}.inner import scaled

@kernel(signature=(NUMBERS,))
def total(a):
    result = 0.0
    for i in range(a.size):
        result += scaled(a[i])
    return result
"""
OUTER_BY_MODULE = OUTER.replace('.inner import scaled', ' import inner').replace(
    'scaled(', 'inner.scaled(')
START = f"""
import logging
logging.basicConfig()
import numpy as np
from {PACKAGE} import outer
from pose_graph_ros.core.compiled import jit
kept = jit.is_cached()
print(outer.total(np.ones(3)), kept)
if hasattr(outer.total, 'stats'):
    print(sum(outer.total.stats.cache_hits.values()), outer.total.stats.cache_path)
"""
ONES = np.ones(3)
TOTAL = f'{PACKAGE}.outer.total'


@pytest.fixture(autouse=True)
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, '_registered', {})
    monkeypatch.setattr(jit, '_signatures', {})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a package with kernels, as this process could import it."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(numba.config, 'CACHE_DIR', '')
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)   # stamps of bytecode are in seconds
    package = tmp_path / PACKAGE
    package.mkdir()
    for name, text in (('__init__', ''), ('inner', INNER), ('outer', OUTER)):
        (package / f'{name}.py').write_text(text)
    kernel_cache.find_folders.cache_clear()
    kernel_cache._warn_once.cache_clear()
    return package


def start() -> ModuleType:
    """Import the package anew, as another process would."""
    for name in [name for name in sys.modules if name.partition('.')[0] == PACKAGE]:
        del sys.modules[name]
    importlib.invalidate_caches()
    return importlib.import_module(f'{PACKAGE}.outer')


def loaded(kernel: Dispatcher) -> bool:
    """Tell whether all signatures came from the cache."""
    hits, misses = kernel.stats.cache_hits.total(), kernel.stats.cache_misses.total()
    assert hits + misses > 0
    return misses == 0


# --- kernels ------------------------------------------------------------------------------------


def test_declared_signature_is_the_only_one() -> None:
    @jit.kernel(signature=(jit.NUMBER, jit.NUMBERS))
    def scaled_sum(factor, a):
        return factor * a.sum()

    with pytest.raises(TypeError, match='scaled_sum takes'):
        scaled_sum(2.0, np.ones(3, dtype=np.float32))
    assert scaled_sum.signatures == []
    assert scaled_sum(2, ONES) == 6.0   # an integer is converted
    assert len(scaled_sum.signatures) == 1
    for wrong in (np.ones(3, dtype=np.float32), np.ones((2, 2)), np.ones(6)[::2], 'text'):
        with pytest.raises(TypeError):
            scaled_sum(2.0, wrong)
    assert len(scaled_sum.signatures) == 1


# --- what is kept is used, and only if it is right ----------------------------------------------

def test_kernels_free_every_array_that_they_make() -> None:
    """Those that count no references must not be handed arrays to keep (`allocates`)."""
    call_all_kernels(150)
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        call_all_kernels(150)
        after = rtsys.get_allocation_stats()
    finally:
        _nrt_python.memsys_disable_stats()
    assert after.alloc > before.alloc
    assert after.alloc - before.alloc == after.free - before.free


def test_second_start_takes_all_from_the_cache(folder: Path) -> None:
    first = start()
    assert not jit.is_cached(TOTAL)
    assert first.total(ONES) == 6.0
    assert not loaded(first.total)
    again = start()
    assert jit.is_cached(TOTAL)
    assert again.total is not first.total
    assert again.total(ONES) == 6.0
    assert loaded(again.total)


def test_code_is_loaded_without_the_compiler(folder: Path) -> None:
    (folder / 'inner.py').write_text(INNER.replace('GAIN * x', 'GAIN * np.full(3, x).max()')
                                     .replace('kernel(', 'kernel(allocates=True, ')
                                     .replace('GAIN =', 'import numpy as np\nGAIN ='))
    (folder / 'outer.py').write_text(OUTER.replace('kernel(', 'kernel(allocates=True, '))
    script = START + "import sys\nprint('numba.np.arraymath' in sys.modules)\n"
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join((str(folder.parent), str(TREE))))
    first, again = (subprocess.run(
        [sys.executable, '-c', script], env=environment, capture_output=True, text=True,
        check=True).stdout.split() for _ in range(2))
    assert (first[:2], first[-1]) == (['6.0', 'False'], 'True')
    assert (again[:2], again[-1]) == (['6.0', 'True'], 'False')


@pytest.mark.parametrize('outer', [OUTER, OUTER_BY_MODULE], ids=['name', 'module'])
@pytest.mark.parametrize('change', [
    ('GAIN = 2.0', 'GAIN = 5.0'), ('GAIN * x', '(3.0 + GAIN) * x')], ids=['number', 'code'])
def test_change_in_what_a_kernel_calls_is_noticed(
    folder: Path, outer: str, change: tuple[str, str],
) -> None:
    (folder / 'outer.py').write_text(outer)
    assert start().total(ONES) == 6.0
    (folder / 'inner.py').write_text(INNER.replace(*change))
    changed = start()
    assert not jit.is_cached(TOTAL)
    assert changed.total(ONES) == 15.0
    again = start()
    assert again.total(ONES) == 15.0
    assert loaded(again.total)


@pytest.mark.parametrize('damage', [
    lambda content: b'', lambda content: content[:len(content) // 2],
    lambda content: b'\0' * 100,
    lambda content: content[:-1000] + bytes([content[-1000] ^ 1]) + content[-999:],
], ids=['empty', 'half', 'zeros', 'bit'])
def test_damaged_file_costs_time_alone(
    folder: Path, damage: Callable[[bytes], bytes],
) -> None:
    start().total(ONES)
    [path] = (folder / '__pycache__').glob('*total*.nbc')
    path.write_bytes(damage(path.read_bytes()))
    repaired = start()
    assert repaired.total(ONES) == 6.0
    assert not loaded(repaired.total)
    again = start()
    assert again.total(ONES) == 6.0
    assert loaded(again.total)


# --- the folder ---------------------------------------------------------------------------------

class Places:
    """The places where compiled kernels can be kept, each of which can be blocked."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.source = root / 'source'
        self.numba, self.xdg, self.home = (root / name for name in ('numba', 'xdg', 'home'))
        self.source.mkdir()
        self.home.mkdir()
        monkeypatch.setattr(numba.config, 'CACHE_DIR', str(self.numba))
        monkeypatch.setenv('XDG_CACHE_HOME', str(self.xdg))
        monkeypatch.setenv('HOME', str(self.home))

    def find(self) -> Path | None:
        found = kernel_cache.find_folders.__wrapped__(self.source)[0]
        assert found is None or found.is_dir()
        return found


def block(path: Path) -> None:
    """Make a path that no folder can be made at, not even by root."""
    shutil.rmtree(path, ignore_errors=True)
    path.write_text('a file')


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Places:
    return Places(tmp_path, monkeypatch)


def test_first_folder_that_can_be_written_to_is_taken(
    places: Places, caplog: pytest.LogCaptureFixture,
) -> None:
    assert places.find().parent == places.numba
    block(places.numba)
    assert places.find() == places.source / '__pycache__'
    block(places.source / '__pycache__')
    assert places.find().parent == places.xdg / 'pose_graph_ros'
    block(places.xdg)
    assert places.find().parent == places.home / '.cache' / 'pose_graph_ros'
    assert caplog.text == ''
    block(places.home)
    assert places.find() is None
    assert 'NUMBA_CACHE_DIR' in caplog.text


# --- whole processes ----------------------------------------------------------------------------

# Root can write everywhere, unless it gives up this right.
UNPRIVILEGED = ('setpriv', '--bounding-set', '-dac_override', '--inh-caps', '-all')


def launch(folder: Path, *prefix: str, **environment: str) -> 'subprocess.Popen[str]':
    inherited = os.environ.get('PYTHONPATH', '').split(os.pathsep)
    path = os.pathsep.join([str(folder.parent), str(TREE), *inherited])
    return subprocess.Popen(
        [*prefix, sys.executable, '-c', START], env={'PYTHONPATH': path, **environment}, text=True,
        cwd=folder.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def output(process: 'subprocess.Popen[str]') -> tuple[list[str], str]:
    out, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    return out.splitlines(), errors


def test_processes_that_compile_at_the_same_time_do_no_harm(folder: Path) -> None:
    processes = [launch(folder, PYTHONHASHSEED=seed) for seed in '12']
    for process in processes:
        assert output(process)[0][0].startswith('6.0 ')
    # the order of a set, as in an option of a kernel, differs from process to process
    lines, _ = output(launch(folder, PYTHONHASHSEED='3'))
    assert lines == ['6.0 True', f'1 {folder / "__pycache__"}']


def test_code_of_a_read_only_installation_is_loaded(folder: Path, tmp_path: Path) -> None:
    # as in a robot's image: root compiles beside the source, and another user runs the node
    bytecode = {'PYTHONDONTWRITEBYTECODE': '1'}     # its stamps are in seconds
    assert output(launch(folder, **bytecode))[0][0] == '6.0 False'
    own = {'XDG_CACHE_HOME': str(tmp_path / 'own'), **bytecode}
    (folder / '__pycache__').chmod(0o555)
    try:
        user = UNPRIVILEGED if os.getuid() == 0 else ()
        lines, errors = output(launch(folder, *user, **own))
        assert lines[0] == '6.0 True'
        assert errors == ''
        # what has changed since is compiled again, and kept where this user can write
        (folder / 'inner.py').write_text(INNER.replace('2.0', '3.0'))
        changed = lines[0].replace('6.0', '9.0')
        lines, errors = output(launch(folder, *user, **own))
        assert (lines[0], errors) == (changed.replace('True', 'False'), '')
        lines, _ = output(launch(folder, *user, **own))
        assert lines[0] == changed
        assert lines[1].startswith(f'1 {tmp_path / "own"}')
        # with no folder at all to write in, nothing is lost either
        (folder / 'inner.py').write_text(INNER)
        (tmp_path / 'own').rename(tmp_path / 'other')
        nowhere = own | dict.fromkeys(('HOME', 'XDG_CACHE_HOME'), '/proc/nowhere')
        lines, errors = output(launch(folder, *user, **nowhere))
        assert (lines[0], errors) == ('6.0 True', '')
    finally:
        (folder / '__pycache__').chmod(0o755)
