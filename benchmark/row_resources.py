# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of the requirements: covariances, compilation and start, memory."""

from collections.abc import Callable
import json
import os
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmark import ours, streets
from benchmark.metrics import ACCURACY, Metric
from benchmark.runs import MICROSECOND, Plan, quiet
from benchmark.section import file_worlds, Options, say, Section, Table
from benchmark.worlds import chain
from pose_graph_ros.core.geometry.se2 import FloatArray

NEWEST = 1.0
"""Time of the newest covariance [us]."""
ALL_OVER_FACTORIZATION = 2.0
COLD, WARM = 20.0, 0.5
"""First-ever compilation and a start from the cache [s]."""
BYTES = 700.0
"""Of a node of a chain."""
CHECKED = 7
"""Nodes whose covariances are compared with those from the plain sparse system."""

_START = '''
import time
begin = time.perf_counter()
import numpy as np
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.warm_up import warm_up
imported = time.perf_counter()
warm_up()
warm = time.perf_counter()
mean, information = np.array([1.0, 0.0, 0.1]), np.eye(3)
smoother = IncrementalSmoother()
smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
for _ in range(3):
    smoother.extend(mean, information)
smoother.update(GraphUpdate(edges=Edges([0], [3], mean[None], information[None], [1])))
smoother.newest_covariance()
print(imported - begin, warm - imported, time.perf_counter() - warm)
'''


def measure_covariances(options: Options) -> Section:
    """Measure covariances: of the newest node after each step, of all nodes, of a pair."""
    section = Section(
        'Covariances',
        f'Asked for: the newest one below {NEWEST:.0f} us a step; those of all nodes in at most '
        f'{ALL_OVER_FACTORIZATION:.0f} times a factorisation. An iteration is linearizing, '
        'factorising and solving once (batch.optimize with one iteration). The deviation is the '
        'largest of an element, over the roots of the diagonal, from the plain sparse system.')
    table = Table('', ('world', 'nodes', 'newest p50 us', 'newest p99 us', 'all ms',
                       'iteration ms', 'all / iteration', 'pair us', 'deviation all',
                       'deviation newest'))
    section.tables.append(table)
    n = (1000, 1200) if options.quick else (10000, 3500)
    worlds = options.chosen([(f'chain {n[0]}', lambda: chain(n[0])),
                             ('grid', lambda: streets.grid(n[1]))])
    worlds += [world for world in file_worlds(options, section.notes)
               if not (options.quick and world.n_nodes > n[1])]
    ours.warm_up_covariances()
    for world in worlds:
        say(f'  {world.name}')
        newest: list[float] = []

        def time_newest(smoother: ours.IncrementalSmoother, _: int,
                        newest: list[float] = newest) -> None:
            begin = time.perf_counter()
            smoother.newest_covariance()
            newest.append(time.perf_counter() - begin)

        ours.run(world, Plan(), time_newest)
        smoother = ours.smoothed(world)
        every, iteration, pair = [], [], []
        graph = world.graph(smoother.poses.copy())
        with quiet():
            for _ in range(options.repeats):
                every.append(_seconds(smoother.covariances))
                graph.set_poses(smoother.poses)
                iteration.append(_seconds(lambda graph=graph: ours.iterate(graph)))
                pair.append(_seconds(lambda s=smoother, w=world:
                                     s.joint_covariance(w.n_nodes // 3, w.n_nodes - 1)))
        nodes = np.linspace(1, world.n_nodes - 1, CHECKED).astype(int).tolist()
        graph.set_poses(smoother.poses)
        oracle = ours.oracle_covariances(graph, nodes)
        deviation = _deviation(smoother.covariances()[nodes], oracle)
        deviation_newest = _deviation(smoother.newest_covariance()[None], oracle[-1:])
        p50, p99 = (float(value) / MICROSECOND for value in np.percentile(newest, (50, 99)))
        ratio = float(np.median(every) / np.median(iteration))
        table.add(world.name, str(world.n_nodes), f'{p50:.2f}', f'{p99:.2f}',
                  f'{1e3 * np.median(every):.2f}', f'{1e3 * np.median(iteration):.2f}',
                  f'{ratio:.2f}', f'{np.median(pair) / MICROSECOND:.0f}', f'{deviation:.1e}',
                  f'{deviation_newest:.1e}')
        key = f'covariances/{world.name}'
        section.metrics += [
            Metric(f'{key}/newest', p50, ' us', None, NEWEST),
            Metric(f'{key}/all over an iteration', ratio, 'x', None, ALL_OVER_FACTORIZATION),
            Metric(f'{key}/deviation of all', deviation, '', ACCURACY),
            Metric(f'{key}/deviation of the newest', deviation_newest, '', ACCURACY)]
    return section


def _seconds(job: Callable[[], object]) -> float:
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def _deviation(covariances: FloatArray, oracle: FloatArray) -> float:
    """Return the largest difference, each in units of the roots of the diagonal."""
    root = np.sqrt(np.diagonal(oracle, axis1=1, axis2=2))
    return float(np.max(np.abs(covariances - oracle) / (root[:, :, None] * root[:, None, :])))


def measure_start(options: Options) -> Section:
    """Measure the first start, with an empty cache of compiled code, and the next ones."""
    section = Section(
        'Compilation and start',
        f'A new process: import, warm-up, and a first node, closure and covariance, which tell '
        f'whether the warm-up has left anything out. Asked for: below {COLD:.0f} s with an empty '
        f'cache, below {WARM} s with a full one.')
    table = Table('', ('start', 'import s', 'warm-up s', 'first use s', 'total s'))
    section.tables.append(table)
    with tempfile.TemporaryDirectory() as folder:
        say('  compiling')
        cold = _start(folder)
        warm = np.median([_start(folder) for _ in range(max(options.repeats, 3))], axis=0)
    for name, row in (('empty cache', cold), ('full cache', warm)):
        table.add(name, *(f'{value:.2f}' for value in (*row, sum(row))))
    section.metrics = [
        Metric('start/first ever', float(sum(cold)), ' s', None, COLD),
        Metric('start/from the cache', float(sum(warm)), ' s', None, WARM)]
    return section


def _start(cache: str) -> list[float]:
    """Return the times [s] of importing, warming up and first use, in a new process."""
    return [float(word) for word in _child(_START, NUMBA_CACHE_DIR=cache).split()[-3:]]


def measure_memory(options: Options) -> Section:
    """Measure what a node of a long chain takes."""
    n = 100000 if options.quick else 1000000
    section = Section(
        'Memory', f'Growth of the resident set of a new process over a chain of {n} nodes, its '
        f'data and compiled code not counted. Asked for: below {BYTES:.0f} bytes a node.')
    say(f'  chain of {n}')
    figures = json.loads(_child(
        f'from benchmark.row_resources import chain_memory\nchain_memory({n})').splitlines()[-1])
    table = Table('', ('nodes', 'bytes a node', 'peak, bytes a node', 'step us'))
    table.add(str(n), f'{figures["grown"] / n:.0f}', f'{figures["peak"] / n:.0f}',
              f'{figures["seconds"] / n / MICROSECOND:.2f}')
    section.tables.append(table)
    section.metrics = [
        Metric(f'memory/chain {n}/bytes a node', figures['grown'] / n, '',
               ACCURACY, BYTES)]
    return section


def chain_memory(n: int) -> None:
    """Run a chain and print how much the process has grown [bytes]; for a process of its own."""
    ours.warm_up()
    world = chain(n)
    grown: list[int] = []
    peak = 0

    def look(_: ours.IncrementalSmoother, k: int) -> None:
        nonlocal peak
        if k in (0, n - 1):
            grown.append(_resident())
        if k % 1000 == 0:
            peak = max(peak, _resident())

    run = ours.run(world, Plan(), look)
    print(json.dumps({'grown': grown[1] - grown[0], 'peak': max(peak, grown[1]) - grown[0],
                      'seconds': float(np.sum(run.seconds))}))


def _resident() -> int:
    """Return the size of the resident set of this process [bytes]."""
    with open('/proc/self/statm', encoding='ascii') as file:
        return int(file.read().split()[1]) * os.sysconf('SC_PAGE_SIZE')


def _child(program: str, **environment: str) -> str:
    """Run a program in a new process and return what it prints."""
    return subprocess.run(
        [sys.executable, '-c', program], env=os.environ | environment, check=True,
        stdout=subprocess.PIPE, text=True).stdout
