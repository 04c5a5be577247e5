# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the callbacks of a node, by the executor that takes the least time of the processor."""

from collections.abc import Callable
import logging

from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an older rclpy
    EventsExecutor = None

logger = logging.getLogger(__name__)

# Without a limit the EventsExecutor waits to the last instant of the steady clock; where rclpy was
# built for an old C library, as on PyPI, that overflows and hangs [s].
LONGEST_WAIT = 3600.0


class Spinner:
    """Runs the callbacks of a node, in one thread, until it is told to stop."""

    def __init__(self, node: Node) -> None:
        self._node = node
        kind = SingleThreadedExecutor if EventsExecutor is None else EventsExecutor
        self._executor: Executor = kind(context=node.context)
        self._stopped = Future()
        self._executor.add_node(node)

    def spin(self) -> None:
        """Run callbacks until `stop` is called; no exception of one of them ends it."""
        while not self._stopped.done() and self._node.context.ok():
            try:
                if EventsExecutor is None:
                    # it begins each wait with all that has changed
                    self._executor.spin_once(timeout_sec=0.1)
                else:
                    self._executor.spin_until_future_complete(
                        self._stopped, timeout_sec=LONGEST_WAIT)
            except Exception:
                # no message, and no error of the middleware, may end the node
                logger.exception('a callback failed')

    def stop(self) -> None:
        """End `spin`; from any thread, any number of times."""
        if not self._stopped.done():
            self._stopped.set_result(None)
            self._executor.wake()

    def close(self) -> None:
        """Release the node, before it is destroyed."""
        self._executor.shutdown(timeout_sec=1.0)


def guarded(callback: Callable[..., None], is_due: Callable[[], bool]) -> Callable[..., None]:
    """
    Return a callback that never raises, and does nothing if it is not due any more.

    Of messages that came together, the executor would leave those behind an error for later; and
    events that were under way when subscriptions and timers were destroyed still come.
    """
    def call(*arguments: object) -> None:
        try:
            if is_due():
                callback(*arguments)
        except Exception:
            logger.exception('a callback failed')
    return call
