# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Optimise a g2o file, and print the constraints with the largest energies."""

import argparse
from pathlib import Path
import time

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.io.g2o import EDGE2_ORDERS, read_g2o, write_g2o

N_LARGEST = 5  # number of edges, and of observed nodes, that are printed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.add_argument('graph', type=Path, help='g2o file')
    parser.add_argument('-o', '--out', metavar='FILE', type=Path, help='optimised g2o file')
    parser.add_argument('--start', choices=('chordal', 'file'), default='chordal',
                        help='start from the constraints or from the poses in the file '
                             '(default: %(default)s)')
    parser.add_argument('--edge2', choices=EDGE2_ORDERS,
                        help='format of the tag EDGE2 in this file')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    file = read_g2o(options.graph, options.edge2)
    graph = file.graph
    print(f'{graph.n_nodes} hidden nodes, {len(graph.edges)} edges, '
          f'{len(graph.observed)} observed nodes; chi2 {graph.energies().chi2:.9g} as read')
    if not file.has_start:
        print('nodes without a pose in the file start at poses composed from the edges')
    start = time.monotonic()
    optimize = (optimizer.optimize if options.start == 'file'
                else optimizer.optimize_from_linear_start)
    result = optimize(graph, SolverConfig(max_iterations=200))
    print(f'chi2 {result.chi2:.9g}, {result.status.value} after {result.iterations} iterations, '
          f'{time.monotonic() - start:.3f} s{": " if result.reason else ""}{result.reason}')
    energies = graph.energies()
    for k in np.argsort(energies.edges)[::-1][:N_LARGEST]:
        print(f'  edge {file.ids[graph.edges.i[k]]} -> {file.ids[graph.edges.j[k]]}: '
              f'energy {energies.edges[k]:.4g}')
    for k in np.argsort(energies.observed)[::-1][:N_LARGEST]:
        print(f'  observed node on {file.ids[graph.observed.node[k]]}: '
              f'energy {energies.observed[k]:.4g}')
    if options.out is not None:
        write_g2o(graph, options.out, file.ids)
    return 0 if result.status is optimizer.Status.CONVERGED else 1
