# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A long drive through the back end: resident memory and times, hour by hour.

Each drive is made in a process of its own, which prints a line of JSON for each part of the drive.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
import gc
import json
import os
import subprocess
import sys
import time
from typing import Any

import numpy as np

from benchmark.window_drive import Course, SECOND, START_NS
from benchmark.window_owners import holdings
from benchmark.window_settings import settings_of
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.warm_up import warm_up

UPDATE_EVERY = 0.5
"""Between two updates, as in the node [s]."""
REFINEMENTS = 4
"""Most iterations between two updates."""
CALLS = 'odom', 'fix', 'loop_closure', 'update', 'refine'
OWNERS = 12
"""What is told of the memory: so many owners."""


@dataclass(slots=True)
class Hour:
    """What became of a part of a drive."""

    hours: float
    """Time since the start at its end [h]."""
    resident: float
    """Resident memory of the process [MB]."""
    nodes: int
    edges: int
    observed: int
    pool: float
    """Memory of the cliques in use [MB]."""
    rms: float
    """Of the position of the newest pose, at the updates [m]."""
    mean: dict[str, float]
    """Mean time of a call [us]."""
    p99: float
    """Of an update [ms]."""
    longest: float
    """The longest update [ms]."""
    answers: dict[str, int]
    """Number of answers so far."""
    owners: dict[str, int]
    """Bytes by owner."""


def resident() -> float:
    """Return the resident memory of this process [MB]."""
    gc.collect()
    with open('/proc/self/statm', encoding='ascii') as file:
        return int(file.read().split()[1]) * os.sysconf('SC_PAGE_SIZE') * 1e-6


def drive(course: Course, config: BackendConfig, part: float) -> Iterator[Hour]:
    """
    Drive a course, and yield what became of each part of it.

    Parameters
    ----------
    course : Course
    config : BackendConfig
    part : float, length of a part [h]

    """
    backend = PoseGraphBackend(config)
    clock = time.perf_counter
    due, part_ns = 0, round(3600 * part * SECOND)
    end_ns = START_NS + part_ns
    spent, calls, updates, squares = Counter[str](), Counter[str](), list[float](), list[float]()
    for source, measurement in course.events():
        begin = clock()
        if isinstance(measurement, OdometrySample):
            backend.add_odometry(measurement, source)
        else:
            backend.add_measurement(measurement, source)
        spent[source] += clock() - begin
        calls[source] += 1
        if source != 'odom' or measurement.stamp_ns < due:
            continue
        due = measurement.stamp_ns + round(UPDATE_EVERY * SECOND)
        begin = clock()
        backend.update()
        updates.append(clock() - begin)
        backend.verdict_changes()
        begin = clock()
        for _ in range(REFINEMENTS):
            calls['refine'] += 1
            if backend.refine().finished:
                break
        spent['refine'] += clock() - begin
        squares.append(_squared_error(backend, course))
        if measurement.stamp_ns >= end_ns - SECOND // 2:
            spent['update'], calls['update'] = sum(updates), len(updates)
            yield _hour(backend, (end_ns - START_NS) / (3600 * SECOND), updates, squares,
                        {name: 1e6 * spent[name] / max(calls[name], 1) for name in CALLS})
            spent, calls, updates, squares = Counter(), Counter(), [], []
            end_ns += part_ns


def _squared_error(backend: PoseGraphBackend, course: Course) -> float:
    estimate = backend.estimate(with_path=False)
    if estimate is None:
        return 0.0
    true = course.truth(np.array([(estimate.stamp_ns - START_NS) / SECOND]))[0]
    return float(np.sum((estimate.T_map_base - true)[:2]**2))


def _hour(
    backend: PoseGraphBackend, hours: float, updates: list[float], squares: list[float],
    means: dict[str, float],
) -> Hour:
    graph = backend.graph
    head = graph.memory.head
    return Hour(
        hours, resident(), graph.n_nodes, graph.n_edges, graph.n_observed,
        8e-6 * float(head[tb.POOL_F_END]) + 4e-6 * float(head[tb.POOL_I_END]),
        float(np.sqrt(np.mean(squares))),
        means, 1e3 * float(np.percentile(updates, 99)), 1e3 * max(updates),
        {f'{source} {answer}': n for (source, answer), n in backend.counts.items()},
        dict(holdings(backend).most_common(OWNERS)))


def in_process(course: Course, window: str, part: float) -> Iterator[Hour]:
    """
    Drive a course in a new process, and yield what became of each part of it.

    Parameters
    ----------
    course : Course
    window : str, as in `window_settings`
    part : float, length of a part [h]

    """
    given = asdict(course)
    program = ('from benchmark.window_day import main\n'
               f'main({given!r}, {window!r}, {part!r})')
    with subprocess.Popen([sys.executable, '-c', program], stdout=subprocess.PIPE,
                          text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            yield Hour(**json.loads(line))
    if child.returncode != 0:
        raise RuntimeError(f'the drive ended with {child.returncode}')


def main(course: dict[str, Any], window: str, part: float) -> None:
    """Drive a course and print what became of each part, as JSON; for a process of its own."""
    warm_up()
    for hour in drive(Course(**course), BackendConfig(**settings_of(window)), part):
        print(json.dumps(asdict(hour)), flush=True)
