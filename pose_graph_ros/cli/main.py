# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `pose-graph` with the tools around the node."""

import argparse
from pathlib import Path
import sys

from pose_graph_ros import __version__
from pose_graph_ros.adapters.parameter_texts import as_markdown, as_yaml, sources_as_markdown
from pose_graph_ros.cli import demo, replay, solve
from pose_graph_ros.cli.simulate import simulate_drive, write_drive


def main(args: list[str] | None = None) -> int:
    """Run a tool with command line arguments; return the exit code."""
    parser = argparse.ArgumentParser(
        prog='pose-graph', description='Tools around the pose graph node.')
    parser.add_argument('--version', action='version', version=__version__)
    tools = parser.add_subparsers(title='tools', required=True)

    for module, name, summary in (
            (demo, 'demo', 'play a bag to the node over DDS'),
            (replay, 'replay', 'run a bag through the engine of the node, without ROS'),
            (solve, 'solve', 'optimise a g2o file')):
        tool = tools.add_parser(name, help=summary, description=module.__doc__,
                                formatter_class=argparse.RawDescriptionHelpFormatter)
        module.add_arguments(tool)
        tool.set_defaults(execute=module.execute)

    simulate = tools.add_parser('simulate', help='write a simulated drive as a rosbag2')
    simulate.add_argument('out', type=Path, help='folder of the rosbag2')
    simulate.add_argument('--seed', type=int, default=1, help='(default: %(default)s)')
    simulate.set_defaults(execute=_simulate)

    parameters = tools.add_parser('parameters', help='print the parameters of the node')
    parameters.add_argument('--yaml', action='store_true', help='print them as a parameter file')
    parameters.set_defaults(execute=_parameters)

    options = parser.parse_args(args)
    return replay.guarded(options)


def _simulate(options: argparse.Namespace) -> int:
    write_drive(simulate_drive(options.seed), options.out)
    print(f'written: {options.out}')
    return 0


def _parameters(options: argparse.Namespace) -> int:
    print(as_yaml() if options.yaml else f'{as_markdown()}\n{sources_as_markdown()}', end='')
    return 0


if __name__ == '__main__':
    sys.exit(main())
