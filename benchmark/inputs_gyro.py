# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a gyroscope is worth while there are no fixes: simulated drives, and a public bag."""

from itertools import pairwise
import math
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from benchmark import drives
from benchmark.drives import Drive, Kind, SECOND
from benchmark.metrics import Metric
from benchmark.section import say, Section, Table
from pose_graph_ros.adapters.bag_inputs import choose_inputs, read_inputs
from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import source_list
from pose_graph_ros.cli.replay import run_measurements
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, GyroSource, MeasurementSource, OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import fit_motion, Trajectory
from pose_graph_ros.core.measurements import (
    Answer,
    Fix,
    Measurement,
    OdometrySample,
    Position,
    YawRate,
)

GYRO = GyroSource(sigma_rate=5e-4, sigma_bias=0.02, sigma_bias_walk=2e-5, sigma_turn=1e-3)
BEGIN, END = 100.0, 160.0
"""Of the outage [s]."""
STEADY = Kind('wheels as told', speed=2.0, duration=END + 1.0, odometry_rate=20.0, sigma=0.5,
              rest=8.0)
DRIFTING = Kind('wheels that drift by 2 mrad/m', speed=2.0, duration=END + 1.0,
                odometry_rate=20.0, sigma=0.5, rest=8.0, drift=2e-3)
TIMES_BETTER = 3.0
NEES = 0.8, 1.3
HUSKY = Path('robot', 'husky_test1_ros2')
# The bag has no transforms: the y axis of its IMU points up, as gravity shows.
LYING = SimpleNamespace(transforms=[SimpleNamespace(
    header=SimpleNamespace(frame_id='base_link'), child_frame_id='imu_link',
    transform=SimpleNamespace(
        translation=SimpleNamespace(x=0.0, y=0.0, z=0.0),
        rotation=SimpleNamespace(x=math.sqrt(0.5), y=0.0, z=0.0, w=math.sqrt(0.5))))])
LEFT_OUT = (0.4, 5), (5.0, 4), (15.0, 4), (30.0, 4), (60.0, 3)
"""Length of each part without fixes [s], and of how many parts one has none."""
Events = list[tuple[str, OdometrySample | Measurement]]


class Outage(NamedTuple):
    """Errors in the outage of one drive."""

    heading: float
    """Root mean square [rad]."""
    heading_nees: float
    """Of the heading, mean."""
    pose_nees: float
    """Of the pose, at the end."""
    distance: float
    """Error of the position at the end [m]."""


def outages(runs: int) -> Section:
    """Measure heading and pose in outages of the fixes, with a gyroscope and without."""
    section = Section(
        'A gyroscope', f'Drives of {END:.0f} s at 2 m/s that begin with 8 s of rest; odometry and '
        'gyroscope at 20 Hz, fixes of 0.5 m at 1 Hz but for the last 60 s. The errors are those '
        'that the engine is told, but for the drift of the wheels. Root mean square of the error '
        'of the heading during the outage, of the position at its end; NEES of the heading (mean '
        'over the outage) and of the newest pose (at its end) with their standard errors. Asked '
        f'for: the heading {TIMES_BETTER:.0f} times better with drifting wheels, and NEES of '
        f'{NEES[0]} to {NEES[1]} where all errors are as told.')
    table = Table('', ('drive', 'heading by', 'heading [mrad]', 'position [m]', 'NEES of heading',
                       'NEES of pose', 'worse with it', 'runs'))
    for kind in (DRIFTING, STEADY):
        found = {name: [_outage(kind, seed, gyro=name != 'wheels') for seed in range(runs)]
                 for name in ('wheels', 'gyroscope')}
        alone, both = (np.array([each.heading for each in found[name]]) for name in found)
        for name, each in found.items():
            heading, nees, pose, distance = np.array(each).T
            worse = f'{np.sum(both > alone)}' if name != 'wheels' else ''
            table.add(kind.name, name, f'{1e3 * _rms(heading):.1f}', f'{_rms(distance):.2f}',
                      *(f'{np.mean(v):.2f} ± {np.std(v) / np.sqrt(runs):.2f}'
                        for v in (nees, pose)), worse, str(runs))
            say('  ' + ' | '.join(table.rows[-1]))
            if kind is STEADY and name != 'wheels':
                for what, value in (('heading', np.mean(nees)), ('pose', np.mean(pose))):
                    section.metrics += [
                        Metric(f'gyroscope, NEES of the {what}, from above', float(value),
                               target=NEES[1]),
                        Metric(f'gyroscope, NEES of the {what}, from below', float(value),
                               target=NEES[0], higher_is_better=True)]
        if kind is DRIFTING:
            section.metrics.append(Metric(
                'gyroscope, heading in an outage of 60 s, times better', _rms(alone) / _rms(both),
                target=TIMES_BETTER, higher_is_better=True))
    section.tables.append(table)
    return section


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _outage(kind: Kind, seed: int, *, gyro: bool) -> Outage:
    drive = drives.simulate(kind, seed, OdometryNoise())
    if gyro:
        drive = drives.with_gyro(drive, GYRO, seed)
    begin_ns = int(drive.stamps_ns[0]) + round(BEGIN * SECOND)
    events = [event for event in drive.events()
              if not isinstance(event, Position) or event.stamp_ns < begin_ns]
    backend = PoseGraphBackend(BackendConfig(
        measurements={'fix': MeasurementSource()}, gyros={'gyro': GYRO}))
    errors = [_error(backend, drive) for stamp_ns in drives.feed(backend, events, 1.0)
              if stamp_ns >= begin_ns]
    off, covariance = (np.array(each) for each in zip(*errors, strict=True))
    return Outage(
        _rms(off[:, 2]), float(np.mean(off[:, 2]**2 / covariance[:, 2, 2])),
        float(off[-1] @ np.linalg.solve(covariance[-1], off[-1])) / 3.0,
        float(np.hypot(*off[-1, :2])))


def _error(backend: PoseGraphBackend, drive: Drive) -> tuple[FloatArray, FloatArray]:
    """Return the error of the newest pose, and its covariance."""
    estimate = backend.estimate(with_path=False)
    assert estimate is not None
    off = estimate.T_map_base - drive.truth[np.searchsorted(drive.stamps_ns, estimate.stamp_ns)]
    off[2] = se2.wrap(off[2])
    return off, estimate.covariance


def husky(data: Path) -> Section:
    """
    Measure a public bag with a gyroscope, where the data is there.

    Parameters
    ----------
    data : Path, folder with public data

    """
    section = Section(
        'A gyroscope in a public bag', 'A Husky on a car park (395 s, 359 m), whose wheels, '
        'gyroscope and fixes are independent. There is no truth. Fixes are left out for parts of '
        'the drive; root mean square of the distance of the path to these fixes.')
    if not (data / HUSKY).is_dir():
        section.notes.append('The data is not there.')
        return section
    events = _husky_events(data / HUSKY, gyro=True)
    table = Table('', ('fixes left out for', 'wheels [m]', 'wheels and gyroscope [m]'))
    for length, parts in LEFT_OUT:
        table.add(f'{length:g} s, one part of {parts}', *(
            f'{_left_out(data / HUSKY, events, length, parts, gyro=gyro):.2f}'
            for gyro in (False, True)))
        say('  ' + ' | '.join(table.rows[-1]))
    paths = _paths(events)
    places = paths[0].poses[:, :2]
    table.add('all: the motion alone, under its best rigid fit', *(
        f'{_rms(np.hypot(*(se2.transform(pose, path) - places).T)):.2f}'
        for path in (each.at(paths[0].stamps_ns)[:, :2] for each in paths[1:])
        for pose in [fit_motion(path, places)]))
    say('  ' + ' | '.join(table.rows[-1]))
    section.tables += [table, _courses(paths)]
    section.notes.append(
        'Wheels and gyroscope agree on the course five to fifteen times better than the fixes '
        'agree with either: over tens of seconds the fixes wander by metres, which neighbours '
        'share. So fixes that are left out between neighbours show how closely a path follows '
        'them, not how good it is: the heading by a gyroscope follows them less.')
    return section


def _husky_values(*, gyro: bool) -> dict[str, object]:
    sources = ['odom', 'fix', 'gyro'] if gyro else ['odom', 'fix']
    return checked({'sources': sources, 'odom.topic': '/husky_velocity_controller/odom',
                    'fix.topic': '/fix'})


def _husky_events(bag_path: Path, *, gyro: bool) -> Events:
    values = _husky_values(gyro=gyro)
    reader = MessageReader(values)
    reader.frames.receive(LYING)
    with open_bag(bag_path) as bag:
        inputs = choose_inputs(bag, source_list(values), {}, 0)
        read = [(source, reader.read(source, message.decode()))
                for source, message, _ in read_inputs(bag, inputs)]
    return [(source, each) for source, each in read if not isinstance(each, Answer)]


def _left_out(
    bag_path: Path, events: Events, length: float, parts: int, *, gyro: bool,
) -> float:
    """Return the root mean square of the distance to the fixes that are left out [m]."""
    squares: list[float] = []
    if not gyro:
        events = [each for each in events if not isinstance(each[1], YawRate)]
    fixes = [each for _, each in events if isinstance(each, Fix)]
    # some at the beginning are always used
    begin_ns = fixes[0].stamp_ns + 15 * SECOND
    for part in range(parts):
        out = [fix for fix in fixes if fix.stamp_ns > begin_ns
               and int((fix.stamp_ns - begin_ns) / (length * SECOND)) % parts == part]
        stamps = {fix.stamp_ns for fix in out}
        backend, _ = run_measurements(
            ((source, each) for source, each in events
             if not (isinstance(each, Fix) and each.stamp_ns in stamps)),
            _husky_values(gyro=gyro))
        estimate = backend.estimate()
        assert estimate is not None
        for fix in out:
            if estimate.path.covers(fix.stamp_ns):
                off = estimate.path.at(fix.stamp_ns)[:2] - fix.placed().position
                squares.append(float(off @ off))
    return math.sqrt(np.mean(squares))


def _paths(events: Events) -> tuple[Trajectory, Trajectory, Trajectory]:
    """Return the path of the fixes, that by wheels, and that with the turns by the gyroscope."""
    odometry = [each for _, each in events if isinstance(each, OdometrySample)]
    rates = [each for _, each in events if isinstance(each, YawRate)]
    fixes = [each for _, each in events if isinstance(each, Fix)]
    stamps, wheels = (np.array([getattr(each, name) for each in odometry])
                      for name in ('stamp_ns', 'pose'))
    turned = np.append(0.0, np.cumsum([
        (one.rate + two.rate) / 2e9 * (two.stamp_ns - one.stamp_ns)
        for one, two in pairwise(rates)]))
    steps = se2.between(wheels[:-1], wheels[1:])
    steps[:, 2] = np.diff(np.interp(stamps, [each.stamp_ns for each in rates], turned))
    gyro = np.zeros((len(stamps), 3))
    for k, step in enumerate(steps):
        gyro[k + 1] = se2.compose(gyro[k], step)
    fix_stamps = np.array([each.stamp_ns for each in fixes])
    inside = (fix_stamps >= stamps[0]) & (fix_stamps <= stamps[-1])
    places = np.array([np.append(each.placed().position, 0.0) for each in fixes])
    return (Trajectory(fix_stamps[inside], places[inside]), Trajectory(stamps, wheels),
            Trajectory(stamps, gyro))


def _courses(paths: tuple[Trajectory, Trajectory, Trajectory]) -> Table:
    """Return how much the paths of fixes, wheels and gyroscope differ in changes of the course."""
    table = Table(
        'Changes of the course between consecutive chords: root mean square of differences.',
        ('chords of', 'fixes and wheels [rad]', 'fixes and gyroscope [rad]',
         'wheels and gyroscope [rad]'))
    first_ns, last_ns = (int(f(path.stamps_ns[k] for path in paths))
                         for f, k in ((max, 0), (min, -1)))
    for seconds in (5, 10, 20, 30):
        ends = np.arange(first_ns, last_ns, seconds * SECOND)
        chords = [np.diff(path.at(ends)[:, :2], axis=0) for path in paths]
        # where the robot stands there is no course
        driven = np.hypot(*chords[1].T) > 0.7 * seconds
        course = [np.diff(np.arctan2(chord[:, 1], chord[:, 0])) for chord in chords]
        both = driven[1:] & driven[:-1]
        table.add(f'{seconds} s', *(
            f'{_rms(se2.wrap(course[i] - course[j])[both]):.3f}'
            for i, j in ((0, 1), (0, 2), (1, 2))))
        say('  ' + ' | '.join(table.rows[-1]))
    return table
