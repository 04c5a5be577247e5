# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tool that compiles before the first start; what it calls has its tests in core."""

import os
import subprocess
import sys

from pose_graph_ros.cli import compile_kernels as module
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.compiled import jit


def test_it_says_what_it_does_and_where_the_code_is(capsys) -> None:
    assert main(['compile-kernels']) == 0
    assert jit.is_cached()
    first, second = capsys.readouterr().out.splitlines()
    assert first in {f'{word} the solver for this processor ({jit.processor()})'
                     for word in ('loading', 'compiling')}
    folder = os.path.commonpath(jit.cache_folders())
    assert second.split(' s; kept in ')[1].startswith(folder)


def test_code_that_could_not_be_kept_is_a_failure(monkeypatch, capsys) -> None:
    monkeypatch.setattr(jit, 'is_cached', lambda *_: False)
    monkeypatch.setattr(module, 'warm_up', lambda: 0.0)
    assert main(['compile-kernels']) == 1
    assert 'not kept: the next start compiles again' in capsys.readouterr().err


def test_without_a_compiler_it_does_not_claim_to_have_compiled() -> None:
    done = subprocess.run(
        [sys.executable, '-c', 'from pose_graph_ros.cli.main import main; '
         'raise SystemExit(main(["compile-kernels"]))'],
        env={**os.environ, 'NUMBA_DISABLE_JIT': '1'}, capture_output=True, text=True, check=False,
        timeout=240)
    assert done.returncode == 2
    assert done.stderr == 'error: NUMBA_DISABLE_JIT is set, so nothing is compiled\n'
