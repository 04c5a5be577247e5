# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The process of the node: from the command line to a clean end.

Callbacks run in a thread of their own, and the main thread waits for SIGINT or SIGTERM. It waits
for a byte in a pipe, which Python writes at once: the system may hand a signal to any thread, and
that alone would not wake this one. A second signal, or one while the node starts or ends, has no
further effect. At the end nothing is waited for that cannot be interrupted, such as a compilation
or a solve: `ros2 launch` kills a node that does not end within 5 s.
"""

import contextlib
import ctypes
import os
import select
import signal
import sys
from threading import Thread

M_MMAP_THRESHOLD, LARGE = -3, 2**18     # of malloc.h; from which on a block is large [bytes]


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit code."""
    ends, end = os.pipe()   # a byte for each signal, and one if the callbacks end by themselves
    os.set_blocking(end, False)
    signal.set_wakeup_fd(end)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    # ruff: noqa: PLC0415  the imports take most of the start; signals must be handled before
    import logging

    import rclpy
    from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
    from rclpy.signals import SignalHandlerOptions

    from pose_graph_ros.core.exceptions import ConfigError, NumbaVersionError
    try:
        from pose_graph_ros.ros.node import PoseGraphNode
        from pose_graph_ros.ros.spinning import Spinner
    except NumbaVersionError as error:
        print(f'pose_graph_node: {error}', file=sys.stderr)
        return 2

    return_when_freed()
    logging.captureWarnings(capture=True)  # the node logs them, as all that is logged
    if select.select([ends], [], [], 0.0)[0]:
        return 0
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = PoseGraphNode()
        node.begin(sys.argv if args is None else args)
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
            os.write(end, b'\0')

    thread = Thread(target=spin, name='callbacks')
    thread.start()
    os.read(ends, 1)
    spinner.stop()
    thread.join(0.5)    # for a callback [s]
    node.close()
    spinner.close()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


def return_when_freed() -> None:
    """
    Let the C library give large blocks pages of their own, which go when they are freed.

    Else it keeps up to 64 MB in each heap once a block as large was freed.
    """
    with contextlib.suppress(OSError, AttributeError):  # on another system than Linux
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGE)


if __name__ == '__main__':
    sys.exit(main())
