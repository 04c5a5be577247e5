# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What graphs of growing size take: memory, a batch, a step, files; the figures of docs/scale.md.

    .venv/bin/python -m benchmark.scale --poses 10000 100000 1000000 --worlds drive grid

Each part of each graph has a process of its own, and prints a line of JSON. Times are processor
times [s], those of single steps in ms: mean, p50, p99, max. Memory is in bytes: `grown` and `peak`
are beyond what the process had before, with the world that it has made.
"""

import argparse
from collections.abc import Callable, Iterator
import contextlib
import io
from itertools import product
import json
from pathlib import Path
import resource
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

from benchmark import ours, partition, worlds
from benchmark.parts import resident_bytes
from benchmark.worlds import World
from pose_graph_ros.cli import main as cli
from pose_graph_ros.core.batch import gauss_newton, optimizer
from pose_graph_ros.core.elimination import assembly, symbolic
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import read_g2o, write_g2o
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

WORLDS: dict[str, Callable[[int], World]] = {
    'drive': worlds.drive, 'grid': worlds.grid, 'chain': worlds.chain}
STEPS = {10_000: 2000, 100_000: 1000}
"""Online, after the rest of the graph has been solved as a whole, by the number of poses."""
FEW_STEPS = 200
"""Of larger graphs."""


class Figures(dict[str, Any]):
    """What was measured, by name."""

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Note the processor time of what is done."""
        begin = time.process_time()
        yield
        self[name] = round(time.process_time() - begin, 4)


def structure(world: World, figures: Figures) -> None:
    """Measure the order of elimination and what it makes of R; and what a partition would give."""
    graph = world.graph(_truth(world))
    with figures.timed('ordering'):
        cliques = symbolic.analyse(graph.memory.head)
    figures.update(partition.cost(cliques)[0])
    figures['cut'] = [partition.cut(cliques, workers) for workers in (8, 64)]
    cliques = partition.dissected(world, graph, cliques)
    figures['dissected'] = partition.cost(cliques)[0]
    figures['dissected_cut'] = [partition.cut(cliques, workers) for workers in (8, 64)]


def batch(world: World, figures: Figures) -> None:
    """Measure a graph that is solved as a whole from the true poses."""
    with figures.timed('build'):
        graph = world.graph(_truth(world))
    with figures.timed('batch'):
        result = optimizer.optimize(graph, ours.BATCH)
    figures.update(status=result.status.value, iterations=result.iterations, chi2=result.chi2)
    of_iteration(graph, figures)


def linear_start(world: World, figures: Figures) -> None:
    """Measure the same from a linear start; its own is dead reckoning."""
    graph = world.graph(world.dead_reckoning())
    with figures.timed('batch'):
        result = optimizer.optimize_from_linear_start(graph, ours.BATCH)
    figures.update(status=result.status.value, iterations=result.iterations, chi2=result.chi2,
                   start=result.start.value)


def of_iteration(graph: Graph, figures: Figures) -> None:
    """Measure the parts of one iteration at the optimum."""
    head, right = graph.memory.head, np.empty((graph.n_nodes, 3))
    with figures.timed('evaluate'):
        gauss_newton.evaluate(head, right)
    with figures.timed('eliminate'):
        gauss_newton.eliminate(head, 0.0, assembly.LINEARIZED)
    with figures.timed('substitute'):
        gauss_newton.step(head, np.zeros_like(right), False)


def marginals(world: World, figures: Figures) -> None:
    """Measure the covariances of all poses."""
    smoother = IncrementalSmoother(graph=_solved(world, world.n_nodes))
    with figures.timed('marginals'):
        smoother.covariances()


def files(world: World, figures: Figures) -> None:
    """Measure a g2o file of the graph."""
    graph = world.graph(_truth(world))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'graph.g2o')
        with figures.timed('write_g2o'):
            write_g2o(graph, path)
        figures['bytes_g2o'] = path.stat().st_size
        del graph
        with figures.timed('read_g2o'):
            read_g2o(path)


def solve(world: World, figures: Figures) -> None:
    """Measure `pose-graph solve` of such a file from dead reckoning, without the certificate."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'graph.g2o')
        write_g2o(world.graph(world.dead_reckoning()), path)
        with figures.timed('solve'), contextlib.redirect_stdout(io.StringIO()):
            cli.main(['solve', str(path), '-o', str(path), '--no-certificate'])


def _truth(world: World) -> FloatArray:
    assert world.truth is not None
    return world.truth


def _solved(world: World, n: int) -> Graph:
    """Return the graph of the first nodes at its optimum."""
    graph = world.graph(_truth(world)[:n], n - 1)
    optimizer.optimize(graph, ours.BATCH)
    return graph


def online(world: World, figures: Figures) -> None:
    """Measure the last steps of an online run, from the optimum of what was before."""
    begin = world.n_nodes - STEPS.get(world.n_nodes, FEW_STEPS)
    smoother, took = IncrementalSmoother(graph=_solved(world, begin)), []
    for k in range(begin, world.n_nodes):
        first, end = world.edge_stops[k - 1:k + 1].tolist()
        now = time.process_time()
        done = smoother.extend(world.edges.mean[first], world.edges.information[first])
        closes = end > first + 1
        if closes:
            done = smoother.update(GraphUpdate(factors=world.edges.rows(slice(first + 1, end))))
        seconds = time.process_time() - now
        took.append((closes, seconds, done.eliminated, done.visited, done.iterations))
    for kind, closes in (('plain', False), ('closing', True)):
        rows = np.array([each[1:] for each in took if each[0] == closes]).reshape(-1, 4)
        figures[f'steps_{kind}'] = len(rows)
        if len(rows) > 0:
            figures[f'ms_{kind}'] = [round(1e3 * float(each), 4) for each in (
                np.mean(rows[:, 0]), *np.percentile(rows[:, 0], (50, 99)), np.max(rows[:, 0]))]
            figures[f'eliminated_visited_iterations_{kind}'] = rows[:, 1:].mean(axis=0).tolist()


PARTS = {part.__name__: part for part in (
    structure, batch, linear_start, marginals, files, solve, online)}


def peak_bytes() -> int:
    """Return the largest size that the resident set of this process has had [bytes]."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measure(name: str, n: int, part: str) -> Figures:
    """Measure a part of one graph."""
    ours.warm_up()
    before = resident_bytes()
    world = WORLDS[name](n)
    figures = Figures(world=name, poses=n, constraints=len(world.edges) + len(world.observed),
                      part=part, of_world=resident_bytes() - before)
    before = resident_bytes()
    PARTS[part](world, figures)
    figures.update(grown=resident_bytes() - before, peak=peak_bytes() - before)
    return figures


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.scale', description=(
        'Measure memory, batch, steps and files of graphs of growing size.'))
    parser.add_argument('--poses', type=int, nargs='+', default=[10_000, 100_000])
    parser.add_argument('--worlds', nargs='+', choices=WORLDS, default=['drive', 'grid'])
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=[*PARTS])
    parser.add_argument('--here', action='store_true', help='in this process: one graph')
    options = parser.parse_args()
    for name, n, part in product(options.worlds, options.poses, options.parts):
        if options.here:
            print(json.dumps(measure(name, n, part)), flush=True)
        else:
            subprocess.run([sys.executable, '-m', 'benchmark.scale', '--here', '--worlds', name,
                            '--poses', str(n), '--parts', part], check=False)


if __name__ == '__main__':
    main()
