# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A second interpreter that does a part of the work, and ends with this one in any case.

Numba's compiler holds a lock, so threads cannot share its work: processes can, as what one has
compiled the other loads. This one may be a node with threads and handlers of signals, so the other
is started afresh and not forked, and gets nothing but the path of imports and the environment.
Its output is discarded; a failure only costs time.
"""

from collections.abc import Callable
from contextlib import suppress
import os
import subprocess
import sys
import threading
import time
from types import TracebackType
from typing import Self

# The path is set before anything of ours is imported: where there are two installations, or none
# that a bare interpreter would find, it must be this one.
BEGIN = ('import importlib, sys; _, module, name, *sys.path = sys.argv; '
         'getattr(importlib.import_module(module), name)()')
# The end of the pipe that this process holds, in whichever way it ends, ends the other.
PIPE = 0
POLL_PERIOD = 0.05


class HelperProcess:
    """
    Runs a function of a module in an interpreter of its own until the context is left.

    Parameters
    ----------
    module, name : str, the function, without arguments; it calls `end_with_parent` first

    """

    def __init__(self, module: str, name: str) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        # no interpreter is known where Python is embedded; none can be started without memory
        with suppress(OSError, ValueError):
            if sys.executable:
                self._process = subprocess.Popen(
                    [sys.executable, '-c', BEGIN, module, name, *map(os.fspath, sys.path)],
                    stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            if self._process.stdin is not None:
                self._process.stdin.close()

    def wait(self, patience: float, stopped: Callable[[], bool]) -> None:
        """
        Wait until the process has ended.

        Parameters
        ----------
        patience : float, maximum time [s]
        stopped : callable, ends the wait once it returns True

        """
        deadline = time.monotonic() + patience
        while (self._process is not None and self._process.poll() is None and not stopped()
               and time.monotonic() < deadline):
            time.sleep(POLL_PERIOD)


def end_with_parent() -> None:
    """End this process as soon as the one that has started it is gone."""
    threading.Thread(target=_wait_for_parent, name='parent', daemon=True).start()


def _wait_for_parent() -> None:
    os.read(PIPE, 1)
    os._exit(1)
