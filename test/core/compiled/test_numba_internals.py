# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The supported versions of Numba are the same everywhere, and others are refused."""

from pathlib import Path
import re
import subprocess
import sys

import numba
import pytest

from pose_graph_ros.core.compiled.numba_internals import check_version, NEWEST, OLDEST
from pose_graph_ros.core.exceptions import NumbaVersionError

TREE = Path(__file__).parents[3]
LOWER, UPPER = '{}.{}'.format(*OLDEST), f'{NEWEST[0]}.{NEWEST[1] + 1}'


@pytest.mark.parametrize('version', [
    numba.__version__, f'{LOWER}.0', '{}.{}.7'.format(*NEWEST), f'{LOWER}.0+1.gabcdef'])
def test_tested_versions_are_accepted(version: str) -> None:
    check_version(version)


@pytest.mark.parametrize('version', ['0.59.1', '0.6.0', f'{UPPER}.0', f'{UPPER}.0rc1', '1.0.0'])
def test_other_versions_are_refused_with_the_cure(version: str) -> None:
    with pytest.raises(NumbaVersionError) as error:
        check_version(version)
    assert str(error.value) == (
        f"Numba {version} is not supported: pip install 'numba>={LOWER},<{UPPER}'")


@pytest.mark.parametrize(('module', 'program'), [
    ('cli.main', 'error'), ('ros.main', 'pose_graph_node')])
def test_programs_say_so_in_one_line(module: str, program: str) -> None:
    if program != 'error':
        pytest.importorskip('rclpy')
    code = (f'import sys, numba; numba.__version__ = "{UPPER}.1"\n'
            f'from pose_graph_ros.{module} import main; sys.exit(main(["replay", "a"]))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=False, timeout=240)
    assert done.returncode == 2
    assert done.stderr == (
        f"{program}: Numba {UPPER}.1 is not supported: pip install 'numba>={LOWER},<{UPPER}'\n")


@pytest.mark.parametrize(('name', 'bounds'), [
    ('setup.py', f"'numba>={LOWER},<{UPPER}'"), ('README.md', f"'numba>={LOWER},<{UPPER}'"),
    ('package.xml', f'version_gte="{LOWER}" version_lt="{UPPER}">python3-numba<')])
def test_bounds_are_the_same_everywhere(name: str, bounds: str) -> None:
    assert bounds in (TREE / name).read_text(encoding='utf-8')


def test_the_lock_is_within_the_bounds() -> None:
    lock = (TREE / 'requirements.lock').read_text(encoding='utf-8')
    check_version(re.search('^numba==(.+)$', lock, re.MULTILINE)[1])
