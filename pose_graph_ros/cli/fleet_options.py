# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arguments of `pose-graph fleet`, whose help is the docstring."""

import argparse
from pathlib import Path

from pose_graph_ros.cli.arguments import add_replayed, number


def fleet(parser: argparse.ArgumentParser) -> None:
    """
    Replay many bags on Dask: one table, one overview, and nothing done twice.

    BAG is a bag as for `replay`, a folder with bags in it at any depth, a pattern, a text file
    with one of these in each line, or a URL of a file system that fsspec knows (s3://...). Each
    bag is replayed as `replay` does it, by one of the workers. A result is kept by the content of
    the bag, the parameters and the version: the same call again does only what is missing or
    changed. With --sweep, each point of a grid of parameters is tried on all bags.

    examples:
      pose-graph fleet bags/ -o july --params-file robot.yaml
      pose-graph fleet 'bags/**/*.mcap' -o july --set odom.sigma_scale:=1.0 --hold-out 5
      pose-graph fleet list.txt -o july --scheduler tcp://10.0.0.1:8786
      pose-graph fleet bags/ -o sweep --sweep odom.sigma_distance=0.01,0.03,0.1
      pose-graph fleet bags/ -o sweep --sweep odom.sigma_distance=0.01,0.3 --trials 50

    exit code: 0 all converged, 1 some failed or did not converge, 2 wrong input
    or no scheduler, 130 after Ctrl-C
    """
    parser.add_argument('bags', metavar='BAG', nargs='+',
                        help='bag, folder, pattern, .txt with one in each line, or URL')
    parser.add_argument('-o', '--out', metavar='DIR', type=Path, default=Path('fleet'),
                        help='folder for the results, which all workers share '
                        '(default: %(default)s)')
    where = parser.add_mutually_exclusive_group()
    where.add_argument('--workers', metavar='N', type=number(1, 4096, whole=True),
                       help='processes on this machine (default: one for each processor)')
    where.add_argument('--scheduler', metavar='ADDRESS',
                       help='address of a Dask scheduler, such as tcp://10.0.0.1:8786')
    group = parser.add_argument_group('sweep of parameters')
    group.add_argument('--sweep', metavar='NAME=A,B', action='append', default=[],
                       help='values to try; may be repeated, for all combinations')
    group.add_argument('--trials', metavar='N', type=number(1, 100_000, whole=True),
                       help='in place of the grid, points at random between the least and the '
                       'largest values')
    group.add_argument('--seed', metavar='N', type=number(0, whole=True), default=1,
                       help='of the random points (default: %(default)s)')
    group.add_argument('--score', choices=('held-out', 'truth'), default='held-out',
                       help='error of the path: at fixes that are held out, or to the truth '
                       '(default: %(default)s)')
    add_replayed(parser)
