# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure what the engine makes of measurements as they come: late, correlated, wrong.

The normalised estimation error squared (NEES) of a pose is e^T C^-1 e / 3, with e its error and C
the covariance that was claimed for it: 1 in the mean if the claim is right.
"""

from dataclasses import dataclass

import numpy as np

from benchmark import drives
from benchmark.drives import Drive, Event, nees, off_truth, path_rms, rms, SECOND
from benchmark.section import about, Options, Section
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    GyroSource,
    Loss,
    MeasurementSource,
    POSITIONS,
)
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import OdometrySample, Position
from pose_graph_ros.offline.simulation.settings import Fixes, Gyro

TITLE = 'Measurements as they come'
RUNS = 100
NEES = 0.8, 1.3
"""What is asked for."""
WEAK = 1.5
"""The upper bound with 30 fixes, which show little of their errors."""
UPDATE_EVERY = 0.5
WALK = 5e-4, 0.02, 2e-5
"""Angle random walk, bias and its walk of a gyroscope [rad, s]."""
GYRO = GyroSource(sigma_rate=WALK[0], sigma_bias=WALK[1], sigma_bias_walk=WALK[2])
BEGIN, END = 100.0, 160.0
"""Of an outage [s]."""
DRIFT, TIMES_BETTER = 2e-3, 3.0


@dataclass(frozen=True, slots=True)
class Kind:
    """What is simulated."""

    name: str
    duration: float = 120.0
    """[s]"""
    period: float = 1.0
    """Of the fixes [s]."""
    tau: float = 0.0
    """Time constant of the errors of the fixes [s]; 0: white."""
    white_share: float = 0.0
    """Of the variance of the fixes, if they are correlated."""
    outliers: float = 0.0
    """Share of the fixes that are tens of metres off."""
    world: str = 'grid'

    def drive(self, seed: int) -> Drive:
        """Simulate a drive with fixes of 1 m."""
        fixes = Fixes(self.period, 1.0, 0.0) if self.tau == 0.0 else Fixes(
            self.period, self.white_share**0.5, (1.0 - self.white_share)**0.5, self.tau)
        drive = drives.simulated(seed, self.duration, self.world, fixes)
        rng = np.random.default_rng((seed, 2))
        return drive.moved(rng.random(len(drive.fixes)) < self.outliers,
                           rng.uniform(-50.0, 50.0, drive.fixes.shape))


CART = Kind('cart, 2 m/s, fixes of 1 m at 1 Hz')
CAR = Kind('car, 7 m/s, fixes of 1 m at 1 Hz', world='drive')
SHORT = Kind('cart, fixes at 10 Hz whose errors live for 5 s', duration=60.0, period=0.1, tau=5.0)
GNSS = Kind('cart, fixes at 2 Hz, errors live for 60 s, a tenth white', duration=300.0,
            period=0.5, tau=60.0, white_share=0.1)
FURTHER = tuple(
    Kind(f'cart, a fix every {period:.0f} s, errors live for {tau:.0f} s', duration=duration,
         period=period, tau=tau, white_share=0.05)
    for duration, tau in ((600.0, 10.0), (600.0, 60.0), (900.0, 300.0)) for period in (1.0, 5.0))
BRIEF = Kind('cart, 30 fixes at 1 Hz', duration=30.0), *(
    Kind(f'cart, 30 fixes at 1 Hz whose errors live for {tau:.0f} s', duration=30.0, tau=tau,
         white_share=0.05) for tau in (10.0, 60.0, 300.0))
DISTURBED = Kind('cart, a tenth of the fixes wrong', outliers=0.1)


def _backend(source: MeasurementSource) -> PoseGraphBackend:
    """Return an engine that takes the fixes as a source with these settings."""
    return PoseGraphBackend(BackendConfig(measurements={'fix': source}))


def uncertainty(options: Options) -> Section:
    """
    Measure the NEES of the newest pose.

    The newest pose at the end of a drive, over seeded runs; NEES with its standard error. Asked
    for: NEES of {NEES[0]} to {NEES[1]} for white errors, for correlated ones that are treated so
    (*a bias* is told the true time constant), and with the default, without a parameter being set;
    at most {WEAK} with 30 fixes.
    """
    section = Section('Is the claimed uncertainty right?', about(uncertainty))
    section.table('', 'drive', 'fixes treated as', 'NEES', 'error, rms [m]',
                  'claimed [m]', 'unaligned', 'tau found [s]', 'runs')
    runs = 2 if options.quick else options.runs or RUNS
    for kind in (CART, CAR, SHORT, GNSS, *BRIEF, *FURTHER):
        treatments = {'white': MeasurementSource(), 'default': POSITIONS}
        if kind.tau > 0.0:
            treatments['a bias'] = MeasurementSource(correlation_time=kind.tau)
        for name, source in treatments.items():
            if options.wants(f'{kind.name}, {name}'):
                _uncertainty(section, kind, name, source, runs)
    return section


def _uncertainty(
    section: Section, kind: Kind, name: str, source: MeasurementSource, runs: int,
) -> None:
    found, squares, claimed, taus, missing = [], [], [], [], 0
    for seed in range(runs):
        drive, backend = kind.drive(seed), _backend(source)
        for _ in drives.feed(backend, drive.events(), UPDATE_EVERY):
            pass
        backend.update()
        estimate = backend.estimate(with_path=False)
        if estimate is None or estimate.alignment is not AlignmentState.ALIGNED:
            missing += 1
            continue
        off, covariance = off_truth(backend, drive.truth)
        found.append(nees(off, covariance))
        squares.append(off[0]**2 + off[1]**2)
        claimed.append(np.trace(covariance[:2, :2]))
        taus.append(backend.reports()['fix'].errors.tau)
    mean, chance = float(np.mean(found)), float(np.std(found)) / np.sqrt(len(found))
    section.tables[0].add(
        kind.name, name, f'{mean:.2f} ± {chance:.2f}', f'{np.sqrt(np.mean(squares)):.2f}',
        f'{np.sqrt(np.mean(claimed)):.2f}', str(missing), f'{np.median(taus):.1f}', str(runs))
    beside = name == 'a bias' and kind in (*BRIEF, *FURTHER)
    if (name != 'white' or kind.tau == 0.0) and not beside:
        _ask_nees(section, f'{kind.name}, {name}: NEES', mean,
                  WEAK if kind in BRIEF else NEES[1])


def _ask_nees(section: Section, key: str, value: float, most: float) -> None:
    section.ask(f'{key}, from above', value, most=most)
    section.ask(f'{key}, from below', value, least=NEES[0])


def gyroscope(options: Options) -> Section:
    """
    Measure heading and pose in outages of the fixes, with a gyroscope and without.

    Drives of {END:.0f} s at up to 2 m/s that begin with rest; odometry at 20 Hz, a gyroscope at
    100 Hz, fixes of 0.5 m at 1 Hz but for the last 60 s. The errors are those that the engine is
    told, but for the drift of the wheels. Root mean square of the error of the heading during the
    outage, of the position at its end; NEES of the heading (mean over the outage) and of the
    newest pose (at its end) with their standard errors. Asked for: the heading {TIMES_BETTER:.0f}
    times better with drifting wheels, and NEES of {NEES[0]} to {NEES[1]} where all errors are as
    told.
    """
    section = Section('A gyroscope', about(gyroscope))
    table = section.table('', 'drive', 'heading by', 'heading [mrad]', 'position [m]',
                          'NEES of heading', 'NEES of pose', 'worse with it', 'runs')
    runs = 2 if options.quick else max((options.runs or RUNS) * 2 // 5, 2)
    for drift in (DRIFT, 0.0):
        kind = f'wheels that drift by {1e3 * drift:g} mrad/m' if drift else 'wheels as told'
        found = {name: np.array([_outage(drift, seed, gyro=name != 'wheels')
                                 for seed in range(runs)]) for name in ('wheels', 'gyroscope')}
        alone, both = (each[:, 0] for each in found.values())
        for name, each in found.items():
            heading, *claims, distance = each.T
            table.add(kind, name, f'{1e3 * rms(heading):.1f}', f'{rms(distance):.2f}',
                      *(f'{np.mean(v):.2f} ± {np.std(v) / np.sqrt(runs):.2f}' for v in claims),
                      f'{np.sum(both > alone)}' if name != 'wheels' else '', str(runs))
        if drift:
            section.ask('gyroscope, heading in an outage of 60 s, times better',
                        rms(alone) / rms(both), least=TIMES_BETTER)
        else:
            for what, values in zip(('heading', 'pose'), claims, strict=True):
                _ask_nees(section, f'gyroscope, NEES of the {what}', float(np.mean(values)),
                          NEES[1])
    return section


def _outage(drift: float, seed: int, *, gyro: bool) -> tuple[float, float, float, float]:
    """Return rms [rad] and NEES of the heading in the outage, NEES and error [m] at its end."""
    drive = drives.simulated(seed, END, fixes=Fixes(1.0, 0.5, 0.0), every=1, drift=drift,
                             gyro=Gyro(*WALK) if gyro else None)
    begin_ns = int(drive.odometry.stamps_ns[0]) + round(BEGIN * SECOND)
    events = [(source, event) for source, event in drive.events()
              if not isinstance(event, Position) or event.stamp_ns < begin_ns]
    backend = PoseGraphBackend(BackendConfig(
        measurements={'fix': MeasurementSource()}, gyros={'gyro': GYRO}))
    errors = [off_truth(backend, drive.truth) for stamp_ns in drives.feed(backend, events, 1.0)
              if stamp_ns >= begin_ns]
    off, covariance = (np.array(each) for each in zip(*errors, strict=True))
    return (rms(off[:, 2]), float(np.mean(off[:, 2]**2 / covariance[:, 2, 2])),
            nees(*errors[-1]), float(np.hypot(*off[-1, :2])))


def arrival(options: Options) -> Section:
    """
    Measure what delays, disorder and duplicates change.

    The same drive with its fixes prompt, and late. Largest difference of a position from the
    prompt run, after the last update and after the closing optimisation. Asked for: a few
    millimetres, and 1e-9 m.
    """
    section = Section('Does the order of arrival matter?', about(arrival))
    table = section.table('', 'drive', 'fixes', 'before closing [m]', 'after closing [m]')
    for kind, source in ((CART, MeasurementSource()),
                         (SHORT, MeasurementSource(correlation_time=SHORT.tau)),
                         (DISTURBED, MeasurementSource(loss=Loss.CAUCHY))):
        worst: dict[str, list[list[float]]] = {}
        for seed in range(_few(options)):
            events = kind.drive(seed).events()
            prompt = _paths(source, events)
            for name, late in _late(events, np.random.default_rng(seed)).items():
                worst.setdefault(name, []).append([
                    float(np.max(np.hypot(*(one.poses - other.poses)[:, :2].T)))
                    for one, other in zip(prompt, _paths(source, late), strict=True)])
        for name, values in worst.items():
            before, after = np.max(values, axis=0)
            table.add(kind.name, name, f'{before:.1e}', f'{after:.1e}')
            section.ask(f'{kind.name}, {name}: before closing', before, ' m', most=5e-3)
            section.ask(f'{kind.name}, {name}: after closing', after, ' m', most=1e-9)
    return section


def _few(options: Options) -> int:
    return 1 if options.quick else max((options.runs or RUNS) // 20, 1)


def _delayed(events: list[Event], delays: list[float]) -> list[Event]:
    """Return events in the order in which they come, each so much after its stamp [s]."""
    key = [event.stamp_ns + delay * SECOND
           for (_, event), delay in zip(events, delays, strict=True)]
    return [events[k] for k in np.argsort(key, kind='stable')]


def _late(events: list[Event], rng: np.random.Generator) -> dict[str, list[Event]]:
    """Return the same events in other orders of arrival."""
    fix = np.array([not isinstance(event, OdometrySample) for _, event in events])
    random = rng.random((3, len(events)))
    return {
        'late by 1 s': _delayed(events, fix.astype(float).tolist()),
        'late by up to 60 s, in any order': _delayed(events, (60.0 * random[0] * fix).tolist()),
        'odometry in disorder within 0.2 s': _delayed(events, (0.2 * random[1] * ~fix).tolist()),
        'late by up to 30 s, and all of them twice': [
            *_delayed(events, (30.0 * random[2] * fix).tolist()),
            *(events[k] for k in np.flatnonzero(fix))]}


def _paths(source: MeasurementSource, events: list[Event]) -> tuple[Trajectory, Trajectory]:
    """Return the paths before and after the closing optimisation."""
    backend = _backend(source)
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


def outliers(options: Options) -> Section:
    """
    Measure what a loss does against wrong fixes.

    Fixes of 1 m at 1 Hz of which some are up to 50 m off, with the covariance of the others.
    Position error of the closed path, rms over nodes and runs.
    """
    section = Section('Wrong fixes', about(outliers))
    table = section.table('', 'share of wrong fixes', *(loss.value for loss in Loss))
    for share in (0.0, 0.05, 0.2):
        made = [Kind('', outliers=share).drive(seed) for seed in range(_few(options))]
        table.add(f'{100 * share:.0f} %', *(f'{rms(np.array(each)):.2f} m' for each in (
            [path_rms(_paths(MeasurementSource(loss=loss), drive.events())[1], drive.truth)
             for drive in made] for loss in Loss)))
    return section


def plaza(options: Options) -> Section:
    """
    Measure a lawn mower's drive, where the data is there.

    Plaza 1 (1933 s, 1.86 km): dead reckoning at 5 Hz, fixes made from the truth with seeded noise
    of 1 m at 1 Hz. Position error of the closed path. Asked for: 0.35 m, also with fixes that come
    1 s late.
    """
    section = Section('A lawn mower', about(plaza))
    if not (options.data / drives.PLAZA).is_dir():
        section.notes.append('The data is not there.')
        return section
    table = section.table('', 'fixes', 'rms [m]', 'newest pose while driving, rms [m]')
    for delay in (0.0, 1.0, 60.0):
        closed, newest = [], []
        for seed in range(_few(options)):
            drive = drives.plaza(options.data, seed)
            events = drive.events()
            late = [delay * isinstance(event, Position) for _, event in events]
            backend = _backend(MeasurementSource())
            for _ in drives.feed(backend, _delayed(events, late), UPDATE_EVERY):
                estimate = backend.estimate(with_path=False)
                if (estimate is not None and estimate.alignment is AlignmentState.ALIGNED
                        and drive.truth.covers(estimate.stamp_ns)):
                    newest.append(off_truth(backend, drive.truth)[0][:2])
            backend.optimize()
            estimate = backend.estimate()
            assert estimate is not None
            closed.append(path_rms(estimate.path, drive.truth))
        error = rms(np.array(closed))
        table.add(f'{delay:.0f} s late', f'{error:.3f}', f'{rms(np.array(newest)):.3f}')
        section.ask(f'plaza 1, {delay:.0f} s late', error, ' m', most=0.35)
    return section


SECTIONS = {'nees': uncertainty, 'gyro': gyroscope, 'arrival': arrival, 'outliers': outliers,
            'plaza': plaza}
