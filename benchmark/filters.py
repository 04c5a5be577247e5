# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Ours beside the filters of others, online, on the same odometry and fixes.

    python -m benchmark.filters --robot-localization FOLDER --fusioncore FOLDER

A folder holds a program `filter` of the caller's, around the filter of the other project; either
may be missing. The program reads lines of words, and answers each line that begins with
`odometry` or `end` by a line. Stamps are in seconds, poses in metres and radians in the frame of
the fixes, whose axes are east and north.

    start X Y YAW                      the true pose at the first odometry, to be used or not
    noise X Y YAW                      the true variances of the errors of odometry per second,
                                       instead of those claimed below; without this line the
                                       program has its documented process noise
    gate D                             largest Mahalanobis distance of a fix; without this line
                                       the program has its documented gate, or none
    odometry T VX VY VYAW XX YY WW     the mean twist since the last such line, in the frame of
                                       the robot, and variances of it as a driver claims them
    fix T X Y XX XY YY                 a fix, and its covariance
    end

    X Y YAW XX XY YY                   the pose at an odometry by all lines up to it, and the
                                       covariance of its position; or `none`
    seconds S                          processor time that the filter alone has taken
"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
import itertools
import os
from pathlib import Path
import subprocess
import sys
import time

import numpy as np

from benchmark.belief.__main__ import seeds
from benchmark.belief.engine import config, DEFAULTS
from benchmark.belief.odometry import drive, KINDS, RECORDED
from benchmark.belief.scenarios import during, length, OUTAGE_S, Scenario, SCENARIOS
from benchmark.drives import Drive, rms, SECOND
from benchmark.files import DATA
from benchmark.recordings import drain
from benchmark.report import environment, markdown
from benchmark.section import about, say, Table
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import OdometrySource, POSITIONS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import OdometrySample, Position
from pose_graph_ros.core.warm_up import warm_up

SETTLED_S = 60.0
"""What is before does not count."""
LATER_S, LEAST_OUTAGE_S = 10.0, 30.0
"""Time after an outage [s], and the shortest gap between fixes that is one [s]."""
CLAIMED = 0.05**2, 0.05**2, 0.02**2
"""Variances of a twist as a driver claims them [m^2/s^2, m^2/s^2, rad^2/s^2]."""
UPDATE_NS = SECOND // 11
"""Between updates of ours: of the node, a bit less as stamps of odometry at 10 Hz vary."""
GATE = 3.72
"""Mahalanobis distance of two numbers that 99.9 % are below."""
ROWS = {name: one for name, one in SCENARIOS.items() if not name.startswith('two')} | {
    'silence': Scenario(lambda drive, _: drive.only(
        ~during(drive, min(0.25 * length(drive), 600.0), OUTAGE_S)))}
"""Those with one receiver, and an outage after which all is right."""
DRIVES = tuple(name for name in KINDS | RECORDED if name != 'constant')
OURS, FUSIONCORE, EKF = 'ours', 'FusionCore', 'robot_localization'
TOLD = ', told'
COLUMNS = OURS, FUSIONCORE, EKF, OURS + TOLD, EKF + TOLD, EKF + TOLD + ', gate'
AS_DOCUMENTED = COLUMNS[:3]


@dataclass(frozen=True, slots=True)
class Online:
    """The pose at each stamp of odometry, by what had come until then."""

    poses: FloatArray
    """Shape (N, 3), NaN where there is none."""
    covariances: FloatArray
    """Of the positions, shape (N, 2, 2)."""
    seconds: float
    """Of the processor."""


@dataclass(frozen=True, slots=True)
class Case:
    """One scenario on one drive, with the programs of the peers by name."""

    seed: int
    scenario: str
    drive: str
    data: Path
    programs: dict[str, Path]


@dataclass(frozen=True, slots=True)
class Figures:
    """What came of a filter; NaN where there is none."""

    rms: float
    p95: float
    back: float
    """Error just after the first fix after the longest outage [m]."""
    later: float
    """Error some time after that [m]."""
    nees: float
    median_nees: float
    ms: float
    """Of the processor, per second of data."""
    first: float
    """When there was a pose for the first time [s]."""


Found = tuple[Case, dict[str, Figures]]


def true_noise(drive: Drive) -> FloatArray:
    """Return the mean square error of odometry per second: of steps of 1 s, of heading in 10 s."""
    def errors(lasting: int) -> FloatArray:
        stamps = np.arange(drive.odometry.stamps_ns[0], drive.odometry.stamps_ns[-1],
                           lasting * SECOND)
        stamps = stamps[drive.truth.covers(stamps)]
        steps, true = (se2.between(path.at(stamps)[:-1], path.at(stamps)[1:])
                       for path in (drive.odometry, drive.truth))
        return np.asarray(np.mean(np.square(se2.between(true, steps)), axis=0) / lasting)
    return np.append(errors(1)[:2], errors(10)[2])


def lines(drive: Drive, settings: Iterable[str] = ()) -> str:
    """Return what a program reads."""
    stamps, poses = drive.odometry.stamps_ns, drive.odometry.poses
    since = np.append(1.0, np.diff(stamps) / SECOND)
    twists = iter(se2.between(np.concatenate((poses[:1], poses[:-1])), poses) / since[:, None])
    written = [f'start {words(drive.truth.at(stamps[0]))}', *settings]
    for _, event in drive.events():
        at = f'{event.stamp_ns / SECOND:.6f}'
        if isinstance(event, OdometrySample):
            written.append(f'odometry {at} {words(next(twists))} {words(CLAIMED)}')
        elif isinstance(event, Position):
            covariance = event.covariance[[0, 0, 1], [0, 1, 1]]
            written.append(f'fix {at} {words(event.position)} {words(covariance)}')
    return '\n'.join([*written, 'end', ''])


def words(values: Iterable[float]) -> str:
    """Return numbers as words."""
    return ' '.join(f'{value:.9g}' for value in values)


def ask(program: Path, text: str) -> Online:
    """Run a program on its lines."""
    done = subprocess.run([program], input=text, stdout=subprocess.PIPE, text=True, check=True)
    *answers, end = (line.split() for line in done.stdout.splitlines())
    rows = np.array([line if len(line) == 6 else [np.nan] * 6 for line in answers], dtype=float)
    return Online(rows[:, :3], rows[:, [[3, 4], [4, 5]]], float(end[1]))


def ours(drive: Drive, odometry: OdometrySource = DEFAULTS) -> Online:
    """Run ours, which updates ten times a second as the node does, and knows no start."""
    backend, spent = PoseGraphBackend(config(POSITIONS, odometry)), 0.0
    rows, due_ns = [], 0
    for source, event in drive.events():
        begin = time.thread_time()
        if not isinstance(event, OdometrySample):
            backend.add_measurement(event, source)
            spent += time.thread_time() - begin
            continue
        backend.add_odometry(event)
        is_due = event.stamp_ns >= due_ns
        if is_due:
            due_ns = event.stamp_ns + UPDATE_NS
            backend.update()
        estimate = backend.estimate(with_path=False)
        if is_due:
            drain(backend)
        spent += time.thread_time() - begin
        rows.append(
            np.append(estimate.T_map_base, estimate.covariance[:2, :2])
            if estimate is not None and estimate.alignment is AlignmentState.ALIGNED
            else np.full(7, np.nan))
    found = np.array(rows)
    return Online(found[:, :3], found[:, 3:].reshape(-1, 2, 2), spent)


def figures(drive: Drive, online: Online) -> Figures:
    """Return what a filter's poses came to."""
    stamps = drive.odometry.stamps_ns
    since = (stamps - stamps[0]) / SECOND
    known = np.isfinite(online.poses[:, 0]) & drive.truth.covers(stamps)
    off = np.full((len(stamps), 2), np.nan)
    off[known] = (online.poses[known] - drive.truth.at(stamps[known]))[:, :2]
    error, settled = np.hypot(*off.T), known & (since >= SETTLED_S)
    nees = 0.5 * np.einsum('ni,ni->n', off[settled], np.linalg.solve(
        online.covariances[settled], off[settled, :, None])[..., 0])
    fixes = np.sort([event.stamp_ns for source, event in drive.events() if source != 'odom'])
    longest = int(np.argmax(np.diff(fixes)))
    back = later = np.nan
    if fixes[longest + 1] - fixes[longest] >= LEAST_OUTAGE_S * SECOND:
        back, later = error[np.minimum(len(stamps) - 1, np.searchsorted(
            stamps, fixes[longest + 1] + np.array((0, round(LATER_S * SECOND)))))]
    return Figures(rms(error[settled]), float(np.percentile(error[settled], 95.0)), back, later,
                   float(np.mean(nees)), float(np.median(nees)),
                   1e3 * online.seconds / length(drive), float(since[known][0]))


def measure(case: Case) -> Found:
    """Run ours and the peers on a case."""
    clean = drive(case.drive, case.seed, case.data)
    changed = ROWS[case.scenario].change(clean, np.random.default_rng((case.seed, 2)))
    told = f'noise {words(true_noise(clean))}'
    settings: dict[str, tuple[str, list[str]]] = {
        FUSIONCORE: (FUSIONCORE, []), EKF: (EKF, []), EKF + TOLD: (EKF, [told]),
        COLUMNS[-1]: (EKF, [told, f'gate {GATE}'])}
    runs = {name: ask(case.programs[peer], lines(changed, given))
            for name, (peer, given) in settings.items() if peer in case.programs}
    runs[OURS] = ours(changed)
    if case.drive in KINDS:
        runs[OURS + TOLD] = ours(changed, KINDS[case.drive].settings())
    return case, {name: figures(changed, runs[name]) for name in COLUMNS if name in runs}


def page(found: Sequence[Found], command: str) -> str:
    """
    Return the tables as Markdown.

    Cells are medians over the seeds, and least and largest. Errors are those of the newest
    position at each stamp of odometry, by what had come until then, from {SETTLED_S:.0f} s on
    [m]. The best of those that are configured as documented is bold. In the summary ratios are
    errors of a peer over ours, geometric mean (least) over all drives and seeds: above 1 ours is
    nearer to the truth.
    """
    columns = [name for name in COLUMNS if any(name in figures for _, figures in found)]
    peers = [name for name in columns if name != OURS]
    summary = Table('Ratios of the online rms to ours', (
        'scenario', 'cases', 'ours is first in', *peers))
    rows: dict[tuple[str, str], list[dict[str, Figures]]] = {}
    by_scenario: dict[str, list[dict[str, Figures]]] = {name: [] for name in ROWS}
    for case, one in sorted(found, key=lambda each: (
            list(ROWS).index(each[0].scenario), DRIVES.index(each[0].drive))):
        rows.setdefault((case.scenario, case.drive), []).append(one)
        by_scenario[case.scenario].append(one)
    for scenario, ones in by_scenario.items():
        if len(ones) > 0:
            first = sum(one[OURS].rms == min(
                one[name].rms for name in AS_DOCUMENTED if name in one) for one in ones)
            summary.rows.append((scenario, str(len(ones)), str(first), *(_ratio(
                [one[name].rms / one[OURS].rms for one in ones if name in one])
                for name in peers)))
    shown: dict[str, Callable[[Figures], tuple[float, ...]]] = {
        'Online rms [m]': lambda one: (one.rms,),
        '95 % of the errors are below [m]': lambda one: (one.p95,),
        'Error at the first fix after the longest outage [m]': lambda one: (one.back,),
        f'Error {LATER_S:.0f} s after that [m]': lambda one: (one.later,)}
    tables = [summary, *(Table(caption, ('scenario', 'odometry', *columns))
                         for caption in (*shown, 'NEES of positions, mean / median'))]
    for (scenario, name), ones in rows.items():
        for table, take in zip(tables[1:-1], shown.values(), strict=True):
            values = {column: np.array([take(one[column]) for one in ones]).ravel()
                      for column in columns if column in ones[0]}
            if np.isfinite(values[OURS]).all():
                table.rows.append((scenario, name, *_cells(values, columns)))
        tables[-1].rows.append((scenario, name, *(
            f'{np.median([one[column].nees for one in ones]):.2f} / '
            f'{np.median([one[column].median_nees for one in ones]):.2f}'
            if column in ones[0] else '' for column in columns)))
    every = Table('Over all cases', ('median (least to largest)', *columns), [
        (caption, *(_spread(np.array([getattr(one[column], field) for _, one in found
                                      if column in one])) for column in columns))
        for caption, field in (('processor time per second of data [ms]', 'ms'),
                               ('first pose in the map after [s]', 'first'))])
    return '\n'.join(['## Tables', '', *environment(command), '',
                      about(page), '', *itertools.chain(*map(markdown, [*tables, every]))])


def _ratio(values: Sequence[float]) -> str:
    return f'{np.exp(np.mean(np.log(values))):.2f} ({min(values):.2f})' if values else ''


def _spread(values: FloatArray) -> str:
    spread = f' ({np.min(values):.3g} to {np.max(values):.3g})' if len(values) > 1 else ''
    return f'{np.median(values):.3g}{spread}'


def _cells(values: dict[str, FloatArray], columns: Iterable[str]) -> list[str]:
    best = min((name for name in AS_DOCUMENTED if name in values),
               key=lambda name: float(np.median(values[name])))
    return [(f'**{_spread(values[name])}**' if name == best else _spread(values[name]))
            if name in values else '' for name in columns]


def main() -> None:
    """Measure what the command line asks for, and write the page after each case."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmark.filters', description='Compare ours with filters of others '
        'online. FOLDER holds a program "filter", which the docstring of the module is about.')
    parser.add_argument('--robot-localization', type=Path, metavar='FOLDER')
    parser.add_argument('--fusioncore', type=Path, metavar='FOLDER')
    parser.add_argument('--seeds', nargs='+', type=seeds, default=[seeds('100-102')],
                        metavar='N', help='as 7 or 100-102, which is the default')
    parser.add_argument('--scenarios', nargs='+', choices=ROWS, default=ROWS)
    parser.add_argument('--drives', nargs='+', choices=DRIVES, default=DRIVES)
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes')
    parser.add_argument('--data', type=Path, default=DATA, metavar='DIR',
                        help='folder with public data; what is not there is skipped')
    parser.add_argument('-o', dest='out', type=Path, metavar='FILE', help='also write the page')
    options = parser.parse_args()
    programs = {name: folder / 'filter' for name, folder in (
        (EKF, options.robot_localization), (FUSIONCORE, options.fusioncore)) if folder is not None}
    for program in programs.values():
        if not os.access(program, os.X_OK):
            parser.error(f'{program}: expected a program')
    drives = [name for name in options.drives
              if name in KINDS or (options.data / RECORDED[name]).is_dir()]
    cases = itertools.starmap(Case, itertools.product(
        itertools.chain(*options.seeds), options.scenarios, drives, [options.data], [programs]))
    of_machine = {'--data': 'DIR', '-o': 'FILE', '--fusioncore': 'FOLDER',
                  '--robot-localization': 'FOLDER'}
    command = ' '.join(['python -m benchmark.filters', *(
        of_machine.get(before, word) for before, word in itertools.pairwise(sys.argv))])
    found: list[Found] = []
    with ProcessPoolExecutor(options.jobs, initializer=warm_up) as pool:
        for case, one in pool.map(measure, cases):
            found.append((case, one))
            say(f'{case.scenario} {case.drive} {case.seed}: ' + ', '.join(
                f'{name} {each.rms:.3g}' for name, each in one.items()))
            if options.out is not None:
                options.out.write_text(page(found, command), encoding='utf-8')
    print(page(found, command))


if __name__ == '__main__':
    main()
