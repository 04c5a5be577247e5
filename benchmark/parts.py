# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Other parts of the engine by themselves: the back end's calls, batch, covariances, start, memory.
"""

from collections import defaultdict
from collections.abc import Callable
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmark import ours, worlds
from benchmark.metrics import ACCURACY, OPTIMUM, RATIO
from benchmark.runs import MICROSECOND, Plan, quiet
from benchmark.section import about, Options, Section, Table
from benchmark.worlds import chain, World
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, NodePolicy, OdometrySource
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample

PERIOD_NS = 100_000_000
"""Of the odometry, and of the timer of the updates."""
CONFIG = BackendConfig(
    nodes=NodePolicy(minimum_travel_distance=0.5, minimum_interval=0.0),
    odometry={'odom': OdometrySource(reorder_window=0.0)})
"""Each sample makes a node, as in the other rows."""
CALLS = ('add_odometry', 'add_measurement', 'update, nothing new', 'update, a global pose',
         'refine, to the end')


def back_end(options: Options) -> Section:
    """
    Measure chains of 1 000 to 100 000 nodes.

    What the node does with the same chain: a hidden node by `PoseGraphBackend.add_odometry` at 10
    Hz, each global pose by `add_measurement`, `update` at its timer of 10 Hz, and `refine` in the
    time that is left. The rows above time only what the first three call of the smoother: `extend`
    and `update`. An update also computes chi2 of all constraints.
    """
    section = Section('Chain through the back end', about(back_end))
    table = section.table(
        'Time of a call [us]', 'world', 'call', 'calls', 'mean', 'p50', 'p99', 'max')
    sizes = (1000, 10000) if options.quick else (1000, 10000, 100000)
    for world in options.chosen([(f'chain {n}', lambda n=n: chain(n)) for n in sizes]):
        _drive(chain(100))
        runs = [_drive(world) for _ in range(options.repeats)]
        for call in CALLS:
            rows = np.array([(len(run[call]), np.mean(run[call]), *np.percentile(
                run[call], (50, 99)), np.max(run[call])) for run in runs])
            calls, mean, p50, p99, most = np.median(rows, axis=0).tolist()
            table.add(world.name, call, f'{calls:.0f}', *(
                f'{value / MICROSECOND:.1f}' for value in (mean, p50, p99, most)))
        total = np.median([sum(map(sum, run.values())) for run in runs]) / world.n_nodes
        section.ask(f'back_end/{world.name}/all calls, mean', total / MICROSECOND, ' us')
    return section


def _drive(world: World) -> dict[str, list[float]]:
    """Drive a back end over a world; return the times of the calls of each kind [s]."""
    backend, seconds = PoseGraphBackend(CONFIG), defaultdict[str, list[float]](list)
    poses, observed, begin = world.dead_reckoning(), world.observed, 0
    covariance = np.linalg.inv(observed.information)

    def timed(call: str, function: Callable[..., object], *arguments: object) -> None:
        start = time.perf_counter()
        function(*arguments)
        seconds[call].append(time.perf_counter() - start)

    with quiet():
        for k, end in enumerate(world.observed_stops.tolist()):
            timed('add_odometry', backend.add_odometry, OdometrySample(
                (k + 1) * PERIOD_NS, poses[k]))
            for m in range(begin, end):
                timed('add_measurement', backend.add_measurement, GlobalPose(
                    (int(observed.i[m]) + 1) * PERIOD_NS, observed.mean[m], covariance[m]),
                    'pose')
            timed(CALLS[3] if end > begin else CALLS[2], backend.update)
            if end > begin:
                timed(CALLS[4], _refine, backend)
            begin = end
    assert backend.graph.n_nodes == world.n_nodes
    return seconds


def _refine(backend: PoseGraphBackend) -> None:
    while not backend.refine().finished:
        pass


FASTER = 5.0
SAME = 1e-6
"""chi2 this much above the best known, as a part of it, is another minimum."""
LONG = 10.0
"""What takes longer is done once [s]."""
ENOUGH = 0.2
"""What is over sooner is done again until it has taken so long in all [s], or ..."""
MORE = 10
"""... so many times as often as asked for."""

BATCH = ('world', 'nodes', 'closures', 'ours, no guess ms', 'GTSAM LM, odometry ms', 'ratio',
           'ours, same start ms', 'GTSAM LM, same start ms', 'ratio', 'best chi2',
           'ours, no guess', 'ours, same start', 'GTSAM, odometry', 'GTSAM, same start', 'runs')


def batch(options: Options) -> Section:
    """
    Measure all worlds that have loop closures, and one chain.

    Whole graphs. Without a guess: our own start included, against GTSAM LM from odometry. From the
    same (chordal) start: the optimisation alone. Asked for: {FASTER:.0f} times GTSAM in both, and
    the best known optimum. Best: the lowest that any run here leads to, all of them under our
    error model; the chi2 of GTSAM are under its own.
    """
    section = Section('Batch', about(batch))
    n = 1000 if options.quick else 10000
    chosen = [(f'chain {n}', lambda: chain(n)), ('corridor', worlds.corridor)]
    table = section.table('', *BATCH)
    for world in options.chosen(chosen[:1] if options.quick else chosen) + options.closing(
            section.notes):
        _measure_world(section, table, world, options)
    return section


def _measure_world(section: Section, table: Table, world: World, options: Options) -> None:
    odometry, same = world.dead_reckoning(), ours.start_of_batch(world)
    nothing = world.graph(odometry)
    from_same = world.graph(same)

    def own() -> float:
        nothing.set_poses(odometry)
        return ours.solve_from_nothing(nothing)

    def own_same() -> float:
        from_same.set_poses(same)
        return ours.solve(from_same)

    jobs: dict[str, Callable[[], float]] = {'nothing': own, 'same': own_same}
    ends = {}
    if options.gtsam:
        # the rest of the benchmark can be used without GTSAM
        from benchmark import gtsam_peer  # noqa: PLC0415

        factors = gtsam_peer.whole_graph(world)
        starts = {'odometry': gtsam_peer.values_of(odometry),
                  'lm same': gtsam_peer.values_of(same)}

        def peer(name: str) -> Callable[[], float]:
            def job() -> float:
                ends[name] = gtsam_peer.optimize(factors, starts[name])
                return 2.0 * float(factors.error(ends[name]))
            return job

        jobs |= {name: peer(name) for name in starts}

    times, chi2 = _timed(jobs, options.repeats)
    best = min(chi2['nothing'], chi2['same'],
               *(ours.polished(world, gtsam_peer.poses_of(values)) for values in ends.values()))
    key = f'batch/{world.name}'
    ratios = {'nothing': '', 'same': ''}
    for mine, theirs in (('nothing', 'odometry'), ('same', 'lm same')):
        if theirs in times:
            ratio = times[theirs] / times[mine]
            ratios[mine] = f'{ratio:.1f}'
            section.ask(f'{key}/ratio, {"no guess" if mine == "nothing" else "same start"}', ratio,
                        'x', RATIO, least=FASTER)
    section.ask(f'{key}/chi2, no guess', chi2['nothing'], '', OPTIMUM)
    section.ask(f'{key}/above the best known', (chi2['nothing'] - best) / max(best, 1.0),
                most=SAME)
    ms = {name: f'{1e3 * value:.2f}' for name, value in times.items()}
    found = {name: f'{value:.7g}' for name, value in chi2.items()}
    table.add(
        world.name, str(world.n_nodes), str(world.closures()), ms['nothing'],
        ms.get('odometry', ''), ratios['nothing'], ms['same'], ms.get('lm same', ''),
        ratios['same'], f'{best:.7g}', found['nothing'], found['same'],
        found.get('odometry', ''), found.get('lm same', ''), str(options.repeats))


def _timed(
    jobs: dict[str, Callable[[], float]], repeats: int,
) -> tuple[dict[str, float], dict[str, float]]:
    """Run all jobs in turns, short ones oftener; return median times [s] and the last results."""
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    results = {}
    with quiet():
        for turn in range(repeats * MORE):
            for name, job in jobs.items():
                taken = seconds[name]
                if taken and (taken[0] > LONG or (turn >= repeats and sum(taken) > ENOUGH)):
                    continue
                begin = time.perf_counter()
                results[name] = job()
                seconds[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values)) for name, values in seconds.items()}, results


NEWEST = 1.0
"""Time of the newest covariance [us]."""
ALL_OVER_FACTORIZATION = 2.0
COLD, WARM = 20.0, 0.5
"""First-ever compilation and a start from the cache [s]."""
BYTES = 700.0
"""Of a node of a chain."""
CHECKED = 7
"""Nodes whose covariances are compared with those of a fresh smoother."""

_START = '''
import time
begin = time.perf_counter()
import numpy as np
from pose_graph_ros.core.graph.constraints import Factors
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
smoother.update(GraphUpdate(factors=Factors([0], [3], mean[None], information[None], [1])))
smoother.newest_covariance()
print(imported - begin, warm - imported, time.perf_counter() - warm)
'''


def covariances(options: Options) -> Section:
    """
    Measure covariances: of the newest node after each step, of all nodes, of a pair.

    Asked for: the newest one below {NEWEST:.0f} us a step; those of all nodes in at most
    {ALL_OVER_FACTORIZATION:.0f} times a factorisation. An iteration is linearizing, factorising
    and solving once (batch.optimize with one iteration). The deviation is the largest of an
    element, over the roots of the diagonal, from those of a fresh smoother, linearized at the
    estimate.
    """
    section = Section('Covariances', about(covariances))
    table = section.table('', 'world', 'nodes', 'newest p50 us', 'newest p99 us', 'all ms',
                          'iteration ms', 'all / iteration', 'pair us', 'deviation all',
                          'deviation newest')
    n = (1000, 1200) if options.quick else (10000, 3500)
    for world in options.chosen([
            (f'chain {n[0]}', lambda: chain(n[0])), ('grid', lambda: worlds.grid(n[1]))
            ]) + options.file_worlds(section.notes, n[1] if options.quick else np.inf):
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
        oracle = ours.fresh_covariances(world, world.n_nodes - 1, smoother.poses.copy())[nodes]
        deviation = _deviation(smoother.covariances()[nodes], oracle)
        deviation_newest = _deviation(smoother.newest_covariance()[None], oracle[-1:])
        p50, p99 = (float(value) / MICROSECOND for value in np.percentile(newest, (50, 99)))
        ratio = float(np.median(every) / np.median(iteration))
        table.add(world.name, str(world.n_nodes), f'{p50:.2f}', f'{p99:.2f}',
                  f'{1e3 * np.median(every):.2f}', f'{1e3 * np.median(iteration):.2f}',
                  f'{ratio:.2f}', f'{np.median(pair) / MICROSECOND:.0f}', f'{deviation:.1e}',
                  f'{deviation_newest:.1e}')
        key = f'covariances/{world.name}'
        section.ask(f'{key}/newest', p50, ' us', most=NEWEST)
        section.ask(f'{key}/all over an iteration', ratio, 'x', most=ALL_OVER_FACTORIZATION)
        section.ask(f'{key}/deviation of all', deviation, '', ACCURACY)
        section.ask(f'{key}/deviation of the newest', deviation_newest, '', ACCURACY)
    return section


def _seconds(job: Callable[[], object]) -> float:
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def _deviation(covariances: FloatArray, oracle: FloatArray) -> float:
    """Return the largest difference, each in units of the roots of the diagonal."""
    root = np.sqrt(np.diagonal(oracle, axis1=1, axis2=2))
    return float(np.max(np.abs(covariances - oracle) / (root[:, :, None] * root[:, None, :])))


def start(options: Options) -> Section:
    """
    Measure the first start, with an empty cache of compiled code, and the next ones.

    A new process: import, warm-up, and a first node, closure and covariance, which tell whether
    the warm-up has left anything out. Asked for: below {COLD:.0f} s with an empty cache, below
    {WARM} s with a full one.
    """
    section = Section('Compilation and start', about(start))
    table = section.table('', 'start', 'import s', 'warm-up s', 'first use s', 'total s')
    with tempfile.TemporaryDirectory() as folder:
        cold = _start(folder)
        warm = np.median([_start(folder) for _ in range(max(options.repeats, 3))], axis=0)
    for name, row in (('empty cache', cold), ('full cache', warm)):
        table.add(name, *(f'{value:.2f}' for value in (*row, sum(row))))
    section.ask('start/first ever', sum(cold), ' s', most=COLD)
    section.ask('start/from the cache', sum(warm), ' s', most=WARM)
    return section


def _start(cache: str) -> list[float]:
    """Return the times [s] of importing, warming up and first use, in a new process."""
    return [float(word) for word in child(_START, NUMBA_CACHE_DIR=cache).split()[-3:]]


def memory(options: Options) -> Section:
    """
    Measure what a node of a long chain takes.

    Growth of the resident set of a new process over a chain of {n} nodes, its data and compiled
    code not counted. Asked for: below {BYTES:.0f} bytes a node.
    """
    n = 100000 if options.quick else 1000000
    section = Section('Memory', about(memory, n=n))
    figures = json.loads(child(
        f'from benchmark.parts import chain_memory\nchain_memory({n})').splitlines()[-1])
    table = section.table('', 'nodes', 'bytes a node', 'peak, bytes a node', 'step us')
    table.add(str(n), f'{figures["grown"] / n:.0f}', f'{figures["peak"] / n:.0f}',
              f'{figures["seconds"] / n / MICROSECOND:.2f}')
    section.ask(f'memory/chain {n}/bytes a node', figures['grown'] / n, '', ACCURACY, most=BYTES)
    return section


def chain_memory(n: int) -> None:
    """Run a chain and print how much the process has grown [bytes]; for a process of its own."""
    ours.warm_up()
    world = chain(n)
    sizes: list[int] = []

    def look(_: ours.IncrementalSmoother, k: int) -> None:
        if k % 1000 == 0 or k == n - 1:
            sizes.append(resident_bytes())

    run = ours.run(world, Plan(), look)
    print(json.dumps({'grown': sizes[-1] - sizes[0], 'peak': max(sizes) - sizes[0],
                      'seconds': float(np.sum(run.seconds))}))


def resident_bytes() -> int:
    """Return the size of the resident set of this process [bytes]."""
    pages = Path('/proc/self/statm').read_text(encoding='ascii').split()[1]
    return int(pages) * os.sysconf('SC_PAGE_SIZE')


def child(program: str, **environment: str) -> str:
    """Run a program in a new process and return what it prints."""
    return subprocess.run(
        [sys.executable, '-c', program], env=os.environ | environment, check=True,
        stdout=subprocess.PIPE, text=True).stdout
