# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A node in a process that is forked off one which has imported its modules and loaded its kernels.

That takes two seconds of a processor, nearly all of a start. Nothing of ROS is initialised before
the fork, so from there on the node is one like any other.
"""

from collections.abc import Mapping, Sequence
import functools
import multiprocessing
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading

import pytest

FOLDER = Path(__file__).parent


class PreparedNode:
    """
    Starts a node, and has what the tests use of subprocess.Popen.

    Parameters
    ----------
    arguments : sequence of str, the command line of the node
    env : mapping, all its environment variables
    stderr : file for its standard error

    """

    def __init__(self, arguments: Sequence[str], env: Mapping[str, str], stderr: Path) -> None:
        self._process = _server().Process(
            target=_run, args=(list(arguments), dict(env), str(stderr)), daemon=True)
        self._process.start()
        self.pid: int = self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired('node', timeout or 0.0)
        return self._process.exitcode

    def send_signal(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


@functools.cache
def _server() -> ForkServerContext:
    server = multiprocessing.get_context('forkserver')
    server.set_forkserver_preload(['prepared_modules'])
    with pytest.MonkeyPatch.context() as patch:
        # it finds modules as any interpreter does, without the additions of pytest
        patch.setenv('PYTHONPATH', os.pathsep.join(
            [str(FOLDER), *filter(None, [os.environ.get('PYTHONPATH')])]))
        forkserver.ensure_running()
    return server


def _run(arguments: list[str], env: Mapping[str, str], stderr: str) -> None:
    os.environ.clear()
    os.environ.update(env)
    os.dup2(os.open(stderr, os.O_WRONLY | os.O_APPEND), 2)
    sys.argv = ['pose_graph_node', *arguments]
    threading.Thread(target=_end_with_the_tests, daemon=True).start()

    from pose_graph_ros.ros.main import main  # noqa: PLC0415  the node's only

    sys.exit(main())


def _end_with_the_tests() -> None:
    """End the node in whichever way the process of the tests has ended."""
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGKILL)
