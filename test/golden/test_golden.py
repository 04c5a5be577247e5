# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The engine and the tools give what they gave: the figures of whole drives, in files.

Where a change means to change them, `make golden` makes the files anew; say in the commit why.
"""

from golden_cases import CASES, is_large, needs
from golden_runner import compared, PORTABLE, Runner
from public_data import missing
import pytest


@pytest.fixture(scope='module')
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    return Runner(tmp_path_factory.mktemp('golden'))


@pytest.mark.parametrize('name', [name for name in CASES if not is_large(name)])
def test_it_is_as_before(name: str, runner: Runner) -> None:
    if missing(*needs(name)):
        pytest.skip(missing(*needs(name)))
    assert '\n'.join(compared(name, runner.run(name), PORTABLE)) == ''
