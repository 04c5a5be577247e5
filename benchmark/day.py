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
import time
from typing import Any

import numpy as np

from benchmark.course import Course, SECOND, START_NS, WINDOWS
from benchmark.parts import child, resident_bytes
from benchmark.section import about, Options, say, Section, Table
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.warm_up import warm_up

RATE = 50.0
"""Of odometry [Hz]."""
HOURS = 24.0
GROWN, SLOWER = 1.05, 1.25
"""Ratios of the last hour to the first up to which memory and time count as flat."""
UPDATE_EVERY = 0.5
"""Between two updates, as in the node [s]."""
REFINEMENTS = 4
"""Most iterations between two updates."""
CALLS = 'odom', 'fix', 'loop_closure', 'update', 'refine'


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
    off = estimate.T_map_base - course.truth_at(estimate.stamp_ns)
    return float(np.sum(off[:2]**2))


def _hour(
    backend: PoseGraphBackend, hours: float, updates: list[float], squares: list[float],
    means: dict[str, float],
) -> Hour:
    gc.collect()
    graph, head = backend.graph, backend.graph.memory.head
    return Hour(
        hours, 1e-6 * resident_bytes(), graph.n_nodes, len(graph.factors.edges),
        len(graph.factors.observed),
        8e-6 * float(head[tb.POOL_F_END]) + 4e-6 * float(head[tb.POOL_I_END]),
        float(np.sqrt(np.mean(squares))), means, 1e3 * float(np.percentile(updates, 99)),
        1e3 * max(updates),
        {f'{source} {answer}': n for (source, answer), n in backend.counts.items()})


def in_process(course: Course, window: str, part: float) -> list[Hour]:
    """Drive a course in a new process; return what became of each part of it [h]."""
    program = f'from benchmark.day import main\nmain({asdict(course)!r}, {window!r}, {part!r})'
    return [Hour(**json.loads(line)) for line in child(program).splitlines()]


def main(course: dict[str, Any], window: str, part: float) -> None:
    """Drive a course and print what became of each part, as JSON; for a process of its own."""
    warm_up()
    for hour in drive(Course(**course), BackendConfig(**WINDOWS[window]), part):
        say(f'  {hour}')
        print(json.dumps(asdict(hour)))


HALL = {'length': 200.0, 'laps_back': (1, 2, 5, 20, 100), 'closure_period': 5.0, 'aside': 0.1}
"""A closed hall, whose places are recognised however long ago they were seen."""
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    'window of 10 minutes': ('600 s', {}), 'hall, with thinning': ('thinning 2 m', HALL)}
"""Window, and what differs from the default course."""


def section(options: Options) -> Section:
    """
    Drive for hours.

    Odometry at {RATE:.0f} Hz, fixes at 5 Hz, a loop closure every 10 s (in the hall every 5 s, up
    to 100 laps back), an update every half second, with default settings, each drive in a process
    of its own. Resident memory of the process after a garbage collection, with Python, NumPy and
    compiled code; mean times of calls. Flat means: the last hour at most {GROWN:g} times the
    memory and {SLOWER:g} times the time of an update of the first.
    """
    hours = options.hours or (0.4 if options.quick else HOURS)
    found = Section('A day', about(section))
    times = found.table(
        'By hour', 'drive', 'hour', 'resident MB', 'nodes', 'edges', 'observed', 'cliques MB',
        *(f'{call} us' for call in CALLS), 'update p99 ms', 'max', 'rms m')
    for name, (window, changed) in CASES.items():
        if options.wants(name):
            course = Course(3600.0 * hours, odometry_rate=RATE, **changed)
            _fill(found, name, times, in_process(course, window, min(1.0, hours / 4.0)))
    return found


def _fill(found: Section, name: str, times: Table, hours: list[Hour]) -> None:
    """Add rows and figures of a drive."""
    for k in sorted({0, 1, 2, len(hours) // 2, len(hours) - 1} & set(range(len(hours)))):
        hour = hours[k]
        times.add(name, f'{hour.hours:g}', f'{hour.resident:.1f}', str(hour.nodes),
                  str(hour.edges), str(hour.observed), f'{hour.pool:.2f}',
                  *(f'{hour.mean[call]:.0f}' for call in CALLS), f'{hour.p99:.1f}',
                  f'{hour.longest:.0f}', f'{hour.rms:.3f}')
    first, last = hours[0], hours[-1]
    refused = {answer: n for answer, n in last.answers.items() if 'accepted' not in answer}
    found.notes.append(f'{name}, answers: {last.answers}' if refused else
                       f'{name}: all measurements were accepted.')
    for what, ratio, most in (
            ('memory', last.resident / first.resident, GROWN),
            ('mean update', last.mean['update'] / first.mean['update'], SLOWER)):
        found.ask(f'{name}: {what}, hour {last.hours:g} over hour {first.hours:g}', ratio,
                  most=most)
    found.ask(f'{name}: memory at the end', last.resident, ' MB')
