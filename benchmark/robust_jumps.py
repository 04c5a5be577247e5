# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry that jumps, as wheels slip or the robot is carried, with right and wrong closures."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmark import streets
from benchmark.metrics import Metric
from benchmark.robust_closures import feed, Recording, rms, Run, SECOND, TRUE
from benchmark.robust_worlds import of_world, OFFICE, place_recognition, Recogniser, with_false
from benchmark.section import say, Section, Table
from benchmark.worlds import integrate
from pose_graph_ros.core.config import Robust
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.verdicts import Judged, Verdict

JUMPS = ((1.0, 0.0, 0.0), (3.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 0.0, 0.3), (0.0, 0.0, 1.0))
"""What odometry measures besides [m, m, rad]."""
WHEN = 0.6
"""Share of the drive at which it jumps."""
SPEED, TURN = 1.0, 0.5
"""Of a jump [m/s], [rad/s]."""
NEAR = 60 * SECOND
"""Distance from a jump to the interval that is told, within which it counts as found [ns]."""


def jumped(
    recording: Recording, jump: tuple[float, float, float],
) -> tuple[Recording, int]:
    """
    Return a recording whose odometry jumps once, and the stamp before the jump [ns].

    Parameters
    ----------
    recording : Recording
    jump : tuple of three floats, after the motion of a step [m, m, rad]

    """
    k = int(WHEN * len(recording.stamps_ns))
    steps = se2.between(recording.odometry[:-1], recording.odometry[1:])
    steps[k] = se2.compose(steps[k], np.array(jump))
    at = int(recording.stamps_ns[k])
    wait = round(max(np.hypot(*jump[:2]) / SPEED, abs(jump[2]) / TURN) * SECOND)
    stamps, ends, arrival = (
        np.where(times > at, times + wait, times)
        for times in (recording.stamps_ns, recording.ends, recording.arrival_ns))
    return replace(
        recording, stamps_ns=stamps, odometry=integrate(np.zeros(3), steps), ends=ends,
        truth=Trajectory(stamps, recording.truth.at(recording.stamps_ns)),
        arrival_ns=arrival), at


def drives(seed: int) -> dict[str, Callable[[], Recording]]:
    """Return drives by name; each is made when it is called."""
    def office(single: int, groups: int) -> Recording:
        return place_recognition(
            replace(OFFICE, n=3000), Recogniser('', 150, single, groups), 1.0, seed)
    return {
        'office': lambda: office(0, 0),
        'office, 30 % single wrong ones': lambda: office(64, 0),
        'office, groups of wrong ones': lambda: office(0, 8),
        'city': lambda: of_world(streets.city(1000, seed)),
        'city, 30 % random': lambda: with_false(of_world(streets.city(1000, seed)), 0.3, 1, seed)}


def section(*, quick: bool) -> Section:
    """Measure jumps in several drives."""
    result = Section(
        'Jumps of odometry', 'One jump at 0.6 of the drive. Errors are rms of the path [m]: of '
        'odometry, with all closures, with default settings, and with these without the jump. '
        'Found: an interval that is told as doubted lies around the jump, or within 60 s; others: '
        'further ones. Small jumps are within what odometry claims, and need not be found.')
    table = Table('', ('drive, seed, jump', 'odometry', 'all', 'judged', 'without the jump',
                       'right kept', 'wrong kept', 'found', 'others'))
    invented = 0
    for seed in range(1 if quick else 3):
        for name, make in drives(seed).items():
            recording = make()
            run = feed(recording, recording.config(Robust.JUDGED))
            invented += len(_doubts(run))
            clean = rms(run.path, recording.truth)
            _add(table, f'{name}, {seed}, none', recording, run, clean=clean, at=-1)
            for jump in JUMPS:
                slipped, at = jumped(recording, jump)
                run = feed(slipped, slipped.config(Robust.JUDGED))
                _add(table, f'{name}, {seed}, {jump[0]:g} m {jump[2]:g} rad', slipped, run,
                     clean=clean, at=at)
    result.metrics.append(Metric('jumps found where there is none', invented, target=0.0))
    result.tables.append(table)
    return result


def _doubts(run: Run) -> list[Verdict]:
    return [each for each in run.backend.verdicts() if each.kind is Judged.ODOMETRY]


def _add(
    table: Table, name: str, recording: Recording, run: Run, *, clean: float, at: int,
) -> None:
    everything = feed(recording, recording.config(Robust.NONE))
    right, truth = recording.errors() <= TRUE, recording.truth
    doubts = [(each.reference_ns or 0, each.stamp_ns) for each in _doubts(run)]
    found = [begin - NEAR <= at <= end + NEAR for begin, end in doubts]
    paths = (Trajectory(recording.stamps_ns, recording.odometry), everything.path, run.path)
    table.add(name, *(f'{rms(path, truth):.2f}' for path in paths), f'{clean:.2f}',
              f'{np.sum(run.kept & right)} of {np.sum(right)}', f'{np.sum(run.kept & ~right)}',
              'yes' if any(found) else 'no', str(len(found) - sum(found)))
    say('  ' + ' | '.join(table.rows[-1]))
