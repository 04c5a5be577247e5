# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The watchdog over the engine, which knows no clock; it imports no ROS."""

from collections.abc import Iterator
from contextlib import contextmanager
import logging
import threading
import time

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.graph.tables import ALL

logger = logging.getLogger(__name__)


class Watchdog:
    """Interrupts what the engine has been busy with for too long."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._busy: tuple[PoseGraphBackend, str, float] | None = None   # what, and since when [s]
        self.count = 0  # number of interruptions
        self.interrupted = ''  # what was, until the same is done in time

    @contextmanager
    def over(self, backend: PoseGraphBackend, what: str) -> Iterator[None]:
        """Let `watch` interrupt what is done with the engine meanwhile."""
        with self._lock:
            self._busy = backend, what, time.monotonic()
        try:
            yield
        finally:
            with self._lock:
                self._busy = None
                if what == self.interrupted and not backend.graph.memory.interrupted:
                    self.interrupted = ''
                backend.interrupt(ALL, on=False)

    def watch(self, timeout: float) -> None:
        """Interrupt what has taken longer than a time [s], 0 for none; called by a timer."""
        with self._lock:
            if self._busy is None or timeout == 0.0:
                return
            backend, what, since = self._busy
            # what is interrupted again and again has to be done at last
            timeout *= 1 + backend.n_interrupted
            if backend.graph.memory.interrupted or time.monotonic() - since < timeout:
                return
            backend.interrupt(ALL)
            self.count, self.interrupted = self.count + 1, what
        logger.warning(
            '%s has taken longer than %.1f s, see solve_timeout: it is interrupted and undone; '
            'the poses follow odometry. Measurements are tried again in smaller groups, and one '
            'that takes too long alone is set aside until ~/optimize', what, timeout)
