# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Row: what the node calls along a chain, the methods of the back end, each timed by itself."""

from collections import defaultdict
from collections.abc import Callable
import time

import numpy as np

from benchmark.metrics import Metric
from benchmark.runs import MICROSECOND, quiet
from benchmark.section import Options, say, Section, Table
from benchmark.worlds import chain, World
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, NodePolicy, OdometrySource
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample

PERIOD_NS = 100_000_000
"""Of the odometry, and of the timer of the updates."""
CONFIG = BackendConfig(
    nodes=NodePolicy(minimum_travel_distance=0.5, minimum_interval=0.0),
    odometry={'odom': OdometrySource(reorder_window=0.0)})
"""Each sample makes a node, as in the other rows."""
CALLS = ('add_odometry', 'add_measurement', 'update, nothing new', 'update, a global pose',
         'refine, to the end')


def measure(options: Options) -> Section:
    """Measure chains of 1 000 to 100 000 nodes."""
    section = Section(
        'Chain through the back end',
        'What the node does with the same chain: a hidden node by `PoseGraphBackend.add_odometry` '
        'at 10 Hz, each global pose by `add_measurement`, `update` at its timer of 10 Hz, and '
        '`refine` in the time that is left. The rows above time only what the first three call of '
        'the smoother: `extend` and `update`. An update also computes chi2 of all constraints.')
    table = Table('Time of a call [us]', ('world', 'call', 'calls', 'mean', 'p50', 'p99', 'max'))
    section.tables.append(table)
    for n in (1000, 10000) if options.quick else (1000, 10000, 100000):
        world = chain(n)
        if not options.wants(world.name):
            continue
        say(f'  {world.name}')
        drive(chain(100))
        runs = [drive(world) for _ in range(options.repeats)]
        for call in CALLS:
            rows = np.array([(len(run[call]), np.mean(run[call]), *np.percentile(
                run[call], (50, 99)), np.max(run[call])) for run in runs])
            calls, mean, p50, p99, most = np.median(rows, axis=0).tolist()
            table.add(world.name, call, f'{calls:.0f}', *(
                f'{value / MICROSECOND:.1f}' for value in (mean, p50, p99, most)))
        total = np.median([sum(map(sum, run.values())) for run in runs]) / n / MICROSECOND
        section.metrics.append(Metric(f'back_end/{world.name}/all calls, mean', total, ' us'))
    return section


def drive(world: World) -> dict[str, list[float]]:
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
                    (int(observed.node[m]) + 1) * PERIOD_NS, observed.mean[m], covariance[m]),
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
