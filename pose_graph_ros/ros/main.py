# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The process of the node: from the command line to a clean end.

Callbacks run in a thread of their own, and the main thread waits for SIGINT or SIGTERM, as Python
handles signals only there. A second one, or one while the node starts or ends, has no further
effect.
"""

from queue import SimpleQueue
import signal
import sys
from threading import Thread

SWITCH_INTERVAL = 0.0005  # for which a thread may run Python while another one waits [s]


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code."""
    ends: SimpleQueue[int] = SimpleQueue()  # signals, or 0 if the callbacks end by themselves
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda number, _: ends.put(number))
    # ruff: noqa: PLC0415  the imports take most of the start; signals must be handled before
    import logging

    import rclpy
    from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
    from rclpy.signals import SignalHandlerOptions

    from pose_graph_ros.core.exceptions import ConfigError, NumbaVersionError
    try:
        from pose_graph_ros.ros import memory
        from pose_graph_ros.ros.node import PoseGraphNode
        from pose_graph_ros.ros.spinning import Spinner
    except NumbaVersionError as error:
        print(f'pose_graph_node: {error}', file=sys.stderr)
        return 2

    memory.give_back_large_arrays()
    # by default the thread of the engine would delay messages by 5 ms at a time
    sys.setswitchinterval(SWITCH_INTERVAL)
    logging.captureWarnings(capture=True)  # the node logs them, as all that is logged
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = PoseGraphNode()
        if node.get_parameter('autostart').value:
            node.start()
    except (ConfigError, InvalidParameterTypeException, InvalidParameterValueException,
            RuntimeError) as error:  # RuntimeError: by rcl, such as for bad arguments
        print(f'pose_graph_node: {error}', file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    spinner = Spinner(node)

    def spin() -> None:
        try:
            spinner.spin()
        finally:
            ends.put(0)

    thread = Thread(target=spin, name='callbacks')
    thread.start()
    ends.get()
    spinner.stop()
    thread.join()
    node.close()
    spinner.close()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
