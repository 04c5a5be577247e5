# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `pose-graph` with the tools around the node.

A tool is the module of this package with its name, whose `execute` is called. It is imported when
its arguments are known to be right, as the imports take up to seconds.
"""

import argparse
import atexit
from collections.abc import Callable
import gc
import importlib
import inspect
import os
import signal
import sys
import threading
from types import FrameType

from pose_graph_ros import __version__
from pose_graph_ros.core.exceptions import PoseGraphError

TOOLS = {name: {'fleet': 'fleet_options', 'simulate': 'simulation_options'}.get(name, 'arguments')
         for name in ('demo', 'replay', 'solve', 'report', 'draw', 'marginalize', 'tune', 'fleet',
                      'migrate', 'simulate', 'parameters', 'compile-kernels')}
"""Modules with the function that adds the arguments of a tool; its docstring says what it does."""
RETRY = 0.01  # after which an interrupt is tried again [s]


def main(args: list[str] | None = None) -> int:
    """Run a tool with command line arguments; return the exit code."""
    parser = argparse.ArgumentParser(
        prog='pose-graph', description='Tools around the pose graph node.')
    parser.add_argument('--version', action='version', version=__version__)
    words = sys.argv[1:] if args is None else args
    if args is None:    # the process is ours
        gc.set_threshold(100_000)   # reading makes many objects, and none of them is garbage
        atexit.register(gc.freeze)  # else the interpreter looks at each object again as it ends
    # of the others not even the arguments are loaded, which takes as long as a small graph
    named = words[:1] if len(words) > 0 and words[0] in TOOLS else [*TOOLS]
    tools = parser.add_subparsers(title='tools', required=True, dest='tool', metavar=(
        None if len(named) > 1 else f'{{{",".join(TOOLS)}}}'))
    for name in named:
        module = importlib.import_module(f'pose_graph_ros.cli.{TOOLS[name]}')
        declare = getattr(module, name.replace('-', '_'))
        # the description, the arguments and, behind these, the examples
        text, examples, rest = inspect.cleandoc(declare.__doc__ or '').partition('examples:')
        summary = text.partition('\n')[0].removesuffix('.')
        declare(tools.add_parser(
            name, help=summary[0].lower() + summary[1:], description=text, epilog=examples + rest,
            formatter_class=argparse.RawDescriptionHelpFormatter))

    def run() -> int:
        options = parser.parse_args(words)
        module = importlib.import_module(f'pose_graph_ros.cli.{options.tool.replace("-", "_")}')
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
