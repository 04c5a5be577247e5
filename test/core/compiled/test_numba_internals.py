# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The supported versions of Numba are the same everywhere, and others are refused."""

from pathlib import Path

import pytest

from pose_graph_ros.core.compiled.numba_internals import check_version, NEWEST, OLDEST
from pose_graph_ros.core.exceptions import NumbaVersionError

TREE = Path(__file__).parents[3]
LOWER, UPPER = '{}.{}'.format(*OLDEST), f'{NEWEST[0]}.{NEWEST[1] + 1}'


@pytest.mark.parametrize('version', ['0.59.1', '0.6.0', f'{UPPER}.0', f'{UPPER}.0rc1', '1.0.0'])
def test_other_versions_are_refused_with_the_cure(version: str) -> None:
    with pytest.raises(NumbaVersionError) as error:
        check_version(version)
    assert str(error.value) == (
        f"Numba {version} is not supported: pip install 'numba>={LOWER},<{UPPER}'")


@pytest.mark.parametrize(('name', 'bounds'), [
    ('setup.py', f"'numba>={LOWER},<{UPPER}'"), ('README.md', f"'numba>={LOWER},<{UPPER}'"),
    ('package.xml', f'version_gte="{LOWER}" version_lt="{UPPER}">python3-numba<')])
def test_bounds_are_the_same_everywhere(name: str, bounds: str) -> None:
    assert bounds in (TREE / name).read_text(encoding='utf-8')
