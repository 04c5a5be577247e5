# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure what the engine makes of measurements as they come: late, correlated, wrong.

    .venv/bin/python -m benchmark.inputs --out docs/benchmarks/inputs

The normalised estimation error squared (NEES) of a pose is e^T C^-1 e / 3, with e its error and C
the covariance that was claimed for it: 1 in the mean if the claim is right.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
import time

import numpy as np

from benchmark import drives, inputs_gyro, kept_sections, report
from benchmark.drives import Kind
from benchmark.files import DATA
from benchmark.metrics import Metric
from benchmark.section import say, Section, Table
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    CovariancePolicy,
    Loss,
    MeasurementSource,
    OdometryNoise,
    POSITIONS,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import (
    Answer,
    GlobalPose,
    Measurement,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.sources.validation import validate

SECTIONS = 'nees', 'gyro', 'husky', 'arrival', 'outliers', 'plaza', 'door', 'stamps', 'cost'
NEES = 0.8, 1.3
"""What is asked for."""
WEAK = 1.5
"""The upper bound with 30 fixes, which show little of their errors."""
UPDATE_EVERY = 0.5
PLAZA = Path('robot', 'plaza1')

MOWER = Kind('mower, 1 m/s, fixes of 1 m at 1 Hz')
CAR = Kind('car, 15 m/s, fixes of 1 m at 1 Hz', speed=15.0, odometry_rate=20.0)
SHORT = Kind('mower, fixes at 10 Hz whose errors live for 5 s', duration=60.0, period=0.1, tau=5.0)
GNSS = Kind('mower, fixes at 2 Hz, errors live for 60 s, a tenth white', duration=300.0,
            period=0.5, tau=60.0, white_share=0.1)
FURTHER = tuple(
    Kind(f'mower, a fix every {period:.0f} s, errors live for {tau:.0f} s', duration=duration,
         period=period, tau=tau, white_share=0.05)
    for duration, tau in ((600.0, 10.0), (600.0, 60.0), (900.0, 300.0)) for period in (1.0, 5.0))
BRIEF = Kind('mower, 30 fixes at 1 Hz', duration=30.0), *(
    Kind(f'mower, 30 fixes at 1 Hz whose errors live for {tau:.0f} s', duration=30.0, tau=tau,
         white_share=0.05) for tau in (10.0, 60.0, 300.0))


def uncertainty(runs: int, cases: Sequence[str] = ()) -> Section:
    """
    Measure the NEES of the newest pose.

    Parameters
    ----------
    runs : int, seeded ones of each drive
    cases : sequence of str, only drives and treatments whose names hold one of these; all if empty

    """
    section = Section(
        'Is the claimed uncertainty right?',
        'The newest pose at the end of a drive, over seeded runs; NEES with its standard error. '
        f'Asked for: NEES of {NEES[0]} to {NEES[1]} for white errors, for correlated ones that '
        'are treated so (*a bias* is told the true time constant), and with the default, without '
        f'a parameter being set; at most {WEAK} with 30 fixes.')
    table = Table('', ('drive', 'fixes treated as', 'NEES', 'error, rms [m]', 'claimed [m]',
                       'unaligned', 'tau found [s]', 'runs'))
    defaults = {'white': MeasurementSource(), 'default': POSITIONS}
    for kind, treatments in (
            (MOWER, defaults), (CAR, defaults),
            (SHORT, _treatments(SHORT)), (GNSS, _treatments(GNSS)),
            (BRIEF[0], defaults), *((kind, defaults | {'a bias': _told(kind)})
                                    for kind in (*BRIEF[1:], *FURTHER))):
        for name, source in treatments.items():
            if len(cases) > 0 and not any(case in f'{kind.name}, {name}' for case in cases):
                continue
            nees, error, claimed, taus, missing = [], [], [], [], 0
            for seed in range(runs):
                drive = drives.simulate(kind, seed, OdometryNoise())
                backend = drives.new_backend(source)
                for _ in drives.feed(backend, drive.events(), UPDATE_EVERY):
                    pass
                backend.update()
                estimate = backend.estimate()
                assert estimate is not None
                if estimate.alignment is not AlignmentState.ALIGNED:
                    missing += 1
                    continue
                off = estimate.T_map_base - drive.truth[-1]
                off[2] = se2.wrap(off[2])
                nees.append(off @ np.linalg.solve(estimate.covariance, off) / 3.0)
                error.append(off[0]**2 + off[1]**2)
                claimed.append(np.trace(estimate.covariance[:2, :2]))
                taus.append(backend.reports()['fix'].errors.tau)
            mean, chance = float(np.mean(nees)), float(np.std(nees)) / np.sqrt(len(nees))
            table.add(kind.name, name, f'{mean:.2f} ± {chance:.2f}',
                      f'{np.sqrt(np.mean(error)):.2f}', f'{np.sqrt(np.mean(claimed)):.2f}',
                      str(missing), f'{np.median(taus):.1f}', str(runs))
            say('  ' + ' | '.join(table.rows[-1]))
            beside = name == 'a bias' and kind in (*BRIEF, *FURTHER)
            if (name == 'white' and kind.tau > 0.0) or beside:
                continue
            section.metrics += [
                Metric(f'{kind.name}, {name}: NEES, from above', mean,
                       target=WEAK if kind in BRIEF else NEES[1]),
                Metric(f'{kind.name}, {name}: NEES, from below', mean, target=NEES[0],
                       higher_is_better=True)]
    section.tables.append(table)
    return section


def _treatments(kind: Kind) -> dict[str, MeasurementSource]:
    return {
        'white': MeasurementSource(), 'default': POSITIONS,
        'a bias': _told(kind)}


def _told(kind: Kind) -> MeasurementSource:
    return MeasurementSource(correlation_time=kind.tau)


def arrival(runs: int) -> Section:
    """Measure what delays, disorder and duplicates change."""
    section = Section(
        'Does the order of arrival matter?',
        'The same drive with its fixes prompt, and late. Largest difference of a position from '
        'the prompt run, after the last update and after the closing optimisation. Asked for: '
        'a few millimetres, and 1e-9 m.')
    table = Table('', ('drive', 'fixes', 'before closing [m]', 'after closing [m]'))
    for kind, source in ((MOWER, MeasurementSource()),
                         (SHORT, MeasurementSource(correlation_time=SHORT.tau)),
                         (Kind('mower, a tenth of the fixes wrong', outliers=0.1),
                          MeasurementSource(loss=Loss.CAUCHY))):
        worst: dict[str, list[tuple[float, float]]] = {}
        for seed in range(runs):
            drive = drives.simulate(kind, seed, OdometryNoise())
            prompt = _paths(drives.new_backend(source), drive.events())
            for name, events in _late(drive.events(), np.random.default_rng(seed)).items():
                paths = _paths(drives.new_backend(source), events)
                worst.setdefault(name, []).append(tuple(  # type: ignore[arg-type]
                    _distance(*pair) for pair in zip(prompt, paths, strict=True)))
        for name, values in worst.items():
            before, after = np.max(values, axis=0)
            table.add(kind.name, name, f'{before:.1e}', f'{after:.1e}')
            section.metrics += [
                Metric(f'{kind.name}, {name}: before closing', float(before), ' m', target=5e-3),
                Metric(f'{kind.name}, {name}: after closing', float(after), ' m', target=1e-9)]
            say(f'{kind.name}, {name}: {before:.1e} {after:.1e}')
    section.tables.append(table)
    return section


Event = OdometrySample | Measurement


def _late(events: list[Event], rng: np.random.Generator) -> dict[str, list[Event]]:
    """Return the same events in other orders of arrival."""
    def ordered(delays: list[float]) -> list[Event]:
        key = [event.stamp_ns + delay * drives.SECOND
               for event, delay in zip(events, delays, strict=True)]
        return [events[k] for k in np.argsort(key, kind='stable')]

    fix = [not isinstance(event, OdometrySample) for event in events]
    twice = ordered([30.0 * rng.random() if late else 0.0 for late in fix])
    again = [event for event in events if not isinstance(event, OdometrySample)]
    return {
        'late by 1 s': ordered([float(late) for late in fix]),
        'late by up to 60 s, in any order': ordered(
            [60.0 * rng.random() if late else 0.0 for late in fix]),
        'odometry in disorder within 0.2 s': ordered(
            [0.0 if late else 0.2 * rng.random() for late in fix]),
        'late by up to 30 s, and all of them twice': twice + again}


def _paths(backend: PoseGraphBackend, events: list[Event]) -> tuple[Trajectory, Trajectory]:
    for _ in drives.feed(backend, events, UPDATE_EVERY):
        pass
    backend.finish()
    for _ in range(3):
        backend.update()
    before = backend.estimate()
    backend.optimize()
    after = backend.estimate()
    assert before is not None
    assert after is not None
    return before.path, after.path


def _distance(one: Trajectory, other: Trajectory) -> float:
    assert np.array_equal(one.stamps_ns, other.stamps_ns)
    return float(np.max(np.hypot(*(one.poses - other.poses)[:, :2].T)))


def outliers(runs: int) -> Section:
    """Measure what a loss does against wrong fixes."""
    section = Section(
        'Wrong fixes', 'Fixes of 1 m at 1 Hz of which some are up to 50 m off, with the '
        'covariance of the others. Position error of the closed path, rms over nodes and runs.')
    table = Table('', ('share of wrong fixes', *(loss.value for loss in Loss)))
    for share in (0.0, 0.05, 0.2):
        cells = []
        for loss in Loss:
            squares = []
            for seed in range(runs):
                drive = drives.simulate(
                    Kind('', outliers=share), seed, OdometryNoise())
                path = _paths(drives.new_backend(MeasurementSource(loss=loss)), drive.events())[1]
                truth = Trajectory(drive.stamps_ns, drive.truth).at(path.stamps_ns)
                squares.append(np.mean(np.sum((path.poses - truth)[:, :2]**2, axis=1)))
            cells.append(f'{np.sqrt(np.mean(squares)):.2f} m')
        table.add(f'{100 * share:.0f} %', *cells)
        say(f'{share}: {cells}')
    section.tables.append(table)
    return section


def plaza(runs: int, data: Path) -> Section:
    """
    Measure a lawn mower's drive, where the data is there.

    Parameters
    ----------
    runs : int, seeded ones of each delay
    data : Path, folder with public data

    """
    folder = data / PLAZA
    section = Section(
        'A lawn mower', 'Plaza 1 (1933 s, 1.86 km): dead reckoning at 5 Hz, fixes made from the '
        'truth with seeded noise of 1 m at 1 Hz. Position error of the closed path. Asked for: '
        '0.35 m, also with fixes that come 1 s late.')
    if not folder.is_dir():
        section.notes.append('The data is not there.')
        return section
    odometry, truth = (np.genfromtxt(folder / name, delimiter=',', skip_header=1)
                       for name in ('odom.csv', 'gt.csv'))
    truth = truth[np.append(True, np.diff(np.round(truth[:, 0] * 1e9)) > 0)]
    reference = Trajectory(np.round(truth[:, 0] * 1e9).astype(np.int64), truth[:, 1:4])
    samples = [OdometrySample(round(row[0] * 1e9), row[1:4]) for row in odometry]
    table = Table('', ('fixes', 'rms [m]', 'newest pose while driving, rms [m]'))
    for delay in (0.0, 1.0, 60.0):
        closed, newest = [], []
        for seed in range(runs):
            rng = np.random.default_rng(seed)
            stamps = np.arange(samples[0].stamp_ns + drives.SECOND, reference.stamps_ns[-1],
                               drives.SECOND)
            where = reference.at(stamps)[:, :2] + rng.normal(0.0, 1.0, (len(stamps), 2))
            fixes: list[Event] = [Position(int(stamp), position, np.eye(2), np.zeros(2))
                                  for stamp, position in zip(stamps, where, strict=True)]
            events = [*samples, *fixes]
            late = [delay * isinstance(event, Position) for event in events]
            order = np.argsort([event.stamp_ns + d * drives.SECOND
                                for event, d in zip(events, late, strict=True)], kind='stable')
            backend = drives.new_backend(MeasurementSource())
            for _ in drives.feed(backend, [events[k] for k in order], UPDATE_EVERY):
                estimate = backend.estimate()
                if (estimate is not None and estimate.alignment is AlignmentState.ALIGNED
                        and reference.covers(estimate.path.stamps_ns[-1])):
                    at = reference.at(estimate.path.stamps_ns[-1])
                    newest.append(np.sum((estimate.T_map_base - at)[:2]**2))
            backend.optimize()
            estimate = backend.estimate()
            assert estimate is not None
            inside = reference.covers(estimate.path.stamps_ns)
            off = estimate.path.poses[inside] - reference.at(estimate.path.stamps_ns[inside])
            closed.append(np.mean(np.sum(off[:, :2]**2, axis=1)))
        rms = float(np.sqrt(np.mean(closed)))
        table.add(f'{delay:.0f} s late', f'{rms:.3f}', f'{np.sqrt(np.mean(newest)):.3f}')
        section.metrics.append(Metric(f'plaza 1, {delay:.0f} s late', rms, ' m', target=0.35))
        say(f'plaza, {delay} s: {rms:.3f}')
    section.tables.append(table)
    return section


BAD = {
    'all zero': np.zeros((3, 3)), 'zero yaw': np.diag((1.0, 1.0, 0.0)),
    'NaN': np.full((3, 3), np.nan), 'NaN yaw': np.diag((1.0, 1.0, np.nan)),
    'infinite': np.diag((np.inf, np.inf, np.inf)),
    'infinite x and y, yaw 0.01': np.diag((np.inf, np.inf, 0.01)),
    'infinite yaw': np.diag((1.0, 1.0, np.inf)),
    '1.8e308': np.diag((1.8e308, 1.8e308, 1.8e308)), '-1': np.diag((-1.0, -1.0, -1.0)),
    'negative x': np.diag((-1.0, 1.0, 0.01)),
    'NaN beside the diagonal': np.array(((1.0, np.nan, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.01))),
    'asymmetric': np.array(((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.01))),
    'correlation beyond 1': np.array(((1.0, 3.0, 0.0), (3.0, 1.0, 0.0), (0.0, 0.0, 0.01))),
    '1e-30': 1e-30 * np.eye(3), '1e12': 1e12 * np.eye(3)}


def door() -> Section:
    """Tabulate what becomes of bad covariances."""
    section = Section(
        'Bad covariances', 'What the door makes of a global pose with a bad covariance of x, y '
        'and yaw, with default settings, and where repair is off.')
    table = Table('', ('covariance', 'repaired', 'taken as', 'sigmas taken', 'not repaired'))
    for name, cov in BAD.items():
        given = GlobalPose(1, np.zeros(3), cov)
        mended = validate(given, CovariancePolicy())
        refused = validate(given, CovariancePolicy(repair=False))
        no = refused.reason if isinstance(refused, Answer) else 'taken'
        if isinstance(mended, Answer):
            table.add(name, f'refused: {mended.reason}', '', '', no)
            continue
        taken = mended.measurement
        variances = (np.diagonal(taken.covariance) if isinstance(taken, GlobalPose | Position)
                     else np.array([getattr(taken, 'variance')]))  # noqa: B009
        table.add(name, ', '.join(mended.repairs) or 'sound', type(taken).__name__,
                  ', '.join(f'{s:.3g}' for s in np.sqrt(variances)), no)
    section.tables.append(table)
    return section


def stamps() -> Section:
    """Tabulate what becomes of bad stamps."""
    section = Section(
        'Bad stamps', 'What the engine answers after 10 s of odometry at 10 Hz. (The node refuses '
        'odometry whose stamp leaps by more than a minute beforehand.)')
    table = Table('', ('what comes', 'stamp', 'answer'))
    newest, tenth = 11 * drives.SECOND, drives.SECOND // 10

    def odometry(stamp_ns: int) -> OdometrySample:
        return OdometrySample(stamp_ns, np.array((stamp_ns * 1e-9, 0.0, 0.0)))

    def fix(stamp_ns: int) -> Position:
        return Position(stamp_ns, np.zeros(2), np.eye(2), np.zeros(2))

    for name, stamp_ns, make in (
            ('odometry', 0, odometry), ('odometry', -1, odometry), ('odometry', newest, odometry),
            ('odometry, in the window', newest - tenth // 2, odometry),
            ('odometry, before the window', newest - 5 * drives.SECOND - 1, odometry),
            ('odometry, an hour ahead', newest + 3600 * drives.SECOND, odometry),
            ('odometry, beyond the clock', 2**63 - 1, odometry),
            ('fix', 0, fix), ('fix', -1, fix), ('fix, before any odometry', 1, fix),
            ('fix, late', newest - 5 * drives.SECOND, fix),
            ('fix, the same again', newest - 5 * drives.SECOND, fix),
            ('fix, newer than odometry', newest + tenth, fix),
            ('fix, an hour ahead', newest + 3600 * drives.SECOND, fix)):
        backend = drives.new_backend(MeasurementSource())
        for stamp in range(drives.SECOND, newest + 1, tenth):
            backend.add_odometry(odometry(stamp))
        event = make(stamp_ns)
        if name.endswith('again'):
            backend.add_measurement(fix(stamp_ns), 'fix')
        answer = (backend.add_odometry(event) if isinstance(event, OdometrySample)
                  else backend.add_measurement(event, 'fix'))
        table.add(name, f'{stamp_ns * 1e-9:g} s', answer.reason or answer.status.value)
    section.tables.append(table)
    return section


def cost() -> Section:
    """Time what one message costs."""
    section = Section('Cost', 'Mean time of one call, in a drive of 20 000 samples at 100 Hz.')
    drive = drives.simulate(
        Kind('', duration=200.0, odometry_rate=100.0, period=0.1), 0, OdometryNoise())
    backend = drives.new_backend(MeasurementSource())
    spent = {'odometry sample': [0.0, 0], 'fix': [0.0, 0], 'update at 2 Hz': [0.0, 0]}
    due = 0
    for event in drive.events():
        name = 'odometry sample' if isinstance(event, OdometrySample) else 'fix'
        begin = time.perf_counter()
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            backend.add_measurement(event, 'fix')
        spent[name][0] += time.perf_counter() - begin
        spent[name][1] += 1
        if event.stamp_ns >= due:
            begin = time.perf_counter()
            backend.update()
            spent['update at 2 Hz'][0] += time.perf_counter() - begin
            spent['update at 2 Hz'][1] += 1
            due = event.stamp_ns + drives.SECOND // 2
    table = Table('', ('what', 'us'))
    for name, (seconds, count) in spent.items():
        table.add(name, f'{1e6 * seconds / count:.0f}')
    section.tables.append(table)
    return section


def main(arguments: list[str]) -> int:
    """Run all sections and write the page; return 1 if a figure is not what is asked for."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.inputs', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=100, metavar='N',
                        help='seeded runs of each drive (default %(default)s)')
    parser.add_argument('--data', type=Path, default=DATA, metavar='DIR',
                        help='folder with public data; what is not there is skipped')
    parser.add_argument('--out', type=Path, default=Path('build/benchmark/inputs'), metavar='DIR')
    parser.add_argument('--only', choices=SECTIONS, action='append',
                        help='only these sections; others of the page stay')
    parser.add_argument('--case', action='append', default=[], metavar='TEXT',
                        help='of the section nees, only drives and treatments with one of these '
                        'in their names; other rows of the page stay')
    options = parser.parse_args(arguments)
    few = max(options.runs // 20, 1)
    made = {'nees': lambda: uncertainty(options.runs, options.case),
            'gyro': lambda: inputs_gyro.outages(max(options.runs * 2 // 5, 2)),
            'husky': lambda: inputs_gyro.husky(options.data),
            'arrival': lambda: arrival(few), 'outliers': lambda: outliers(few),
            'plaza': lambda: plaza(few, options.data),
            'door': door, 'stamps': stamps, 'cost': cost}
    for name in options.only or SECTIONS:
        sections = kept_sections.merged(options.out, {name: made[name]()}, SECTIONS,
                                        rows=len(options.case) > 0)
    return report.conclude(sections, options.out, 'benchmark.inputs', ['--out', str(options.out)],
                           title='Measurements as they come', about=__doc__)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
