# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `pose-graph` with the tools around the node.

A tool is the module of this package with its name, whose `execute` is called. It is imported when
its arguments are known to be right, as the imports take up to seconds; what these arguments are is
told by a function with its name in `arguments`, of `simulate` in `simulation_options`.
"""

import argparse
from collections.abc import Callable
import gc
import importlib
import os
import signal
import sys
import textwrap
import threading
from types import FrameType

from pose_graph_ros import __version__
from pose_graph_ros.core.exceptions import PoseGraphError

SUMMARIES = {
    'demo': 'play a bag to the node over DDS',
    'replay': 'run a bag or a g2o file through the engine of the node, without ROS',
    'solve': 'optimise a g2o file',
    'report': 'make one HTML page of a run: map, errors, residuals, what is doubted',
    'draw': 'draw a small graph as SVG or PNG',
    'marginalize': 'take nodes out of a graph, and keep what they told',
    'tune': 'estimate the noise of the sources from bags; write a parameter file',
    'migrate': 'make a parameter file of those of robot_localization, fuse, slam_toolbox',
    'simulate': 'write a simulated drive as a rosbag2 or a graph',
    'parameters': 'print the parameters of the node',
    'compile-kernels': 'compile the solver for later starts'}
"""Tools and what they do."""
RETRY = 0.01  # after which an interrupt is tried again [s]


def main(args: list[str] | None = None) -> int:
    """Run a tool with command line arguments; return the exit code."""
    words = sys.argv[1:] if args is None else args
    parser = argparse.ArgumentParser(
        prog='pose-graph', description='Tools around the pose graph node.')
    parser.add_argument('--version', action='version', version=__version__)
    tools = parser.add_subparsers(title='tools', required=True)
    parsers = {name: tools.add_parser(name, help=text) for name, text in SUMMARIES.items()}
    # no option before the tool's name has a value
    chosen = next((word for word in words if not word.startswith('-')), '')

    def run() -> int:
        if chosen in parsers:
            # the description, the arguments and, behind these, the examples
            tool, name = parsers[chosen], (
                'simulation_options' if chosen == 'simulate' else 'arguments')
            declare = getattr(importlib.import_module(f'pose_graph_ros.cli.{name}'),
                              chosen.replace('-', '_'))
            tool.description, examples, rest = textwrap.dedent(
                declare.__doc__).strip().partition('examples:')
            tool.epilog = examples + rest
            tool.formatter_class = argparse.RawDescriptionHelpFormatter
            declare(tool)
        options = parser.parse_args(words)
        module = importlib.import_module(f'pose_graph_ros.cli.{chosen.replace("-", "_")}')
        return int(module.execute(options))
    return guarded(run)


def guarded(run: Callable[[], int]) -> int:
    """
    Call a function and return the exit code that it returns.

    Errors that the user can correct are printed on one line; the code is then 2.
    """
    # whoever handles signals otherwise, or calls this in another thread, goes on with that
    ours = threading.current_thread() is threading.main_thread() and (
        signal.getsignal(signal.SIGINT) is signal.default_int_handler)
    if ours:
        signal.signal(signal.SIGINT, _interrupt)
        signal.signal(signal.SIGALRM, _interrupt)
    try:
        return run()
    except BrokenPipeError:  # the reader of the output, such as head, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (PoseGraphError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    finally:
        if ours:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _interrupt(_: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; later, where the compiler would swallow it."""
    while frame is not None:
        # LLVM calls Python back, and an exception there is printed and forgotten
        if os.path.join('llvmlite', 'binding') in frame.f_code.co_filename:
            signal.setitimer(signal.ITIMER_REAL, RETRY)
            return
        frame = frame.f_back
    gc.freeze()     # the compiler has made so many objects that to look at them takes seconds
    raise KeyboardInterrupt


if __name__ == '__main__':
    sys.exit(main())
