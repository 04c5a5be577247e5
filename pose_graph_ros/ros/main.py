# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The process of the node: from the command line to a clean end.

SIGINT and SIGTERM are kept for the loop to check, so a second signal, or one while the node
starts or ends, has no further effect.
"""

import signal
import sys

SWITCH_INTERVAL = 0.0005  # for which a thread may run Python while another one waits [s]


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code."""
    received: list[int] = []
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda number, _: received.append(number))
    # ruff: noqa: PLC0415  the imports take most of the start; signals must be handled before
    import logging

    import rclpy
    from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from pose_graph_ros.core.exceptions import ConfigError
    from pose_graph_ros.ros import memory
    from pose_graph_ros.ros.node import PoseGraphNode

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
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while len(received) == 0 and rclpy.ok():
        try:
            executor.spin_once(timeout_sec=0.1)
        except Exception:
            # no message, and no error of the middleware, may end the node
            logging.getLogger(__name__).exception('a callback failed')
    node.close()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
