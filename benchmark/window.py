# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure a graph of which only a window is kept: speed, consistency, memory.

Each section can be made alone, and says at its end by which command it was. Times are those of
one machine that may have had other work; ratios are of runs right after one another.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmark import day, hall, ours, samples
from benchmark.course import CLOSURES, Course, FIXES, SECOND, START_NS, WINDOWS
from benchmark.drives import feed, nees, rms
from benchmark.metrics import RATIO
from benchmark.runs import interleaved, Plan, Run, sample_steps, timing, Tool
from benchmark.section import about, Options, Section
from benchmark.worlds import chain, laps, World
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    LOOP_CLOSURES,
    MeasurementSource,
    POSITIONS,
    Robust,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import Measurement, OdometrySample

TITLE = 'A graph that forgets'
LAG = 200
NODES, QUICK_NODES = 5000, 1200
PER_LAP = 150
"""Nodes of a lap: closures to the lap before are inside the lag."""
RATIO_ASKED = 10.0
NO_LARGER = 1.01
"""Ratio of errors up to which they count as no larger."""
EVERY = 97
"""Steps between samples: no multiple of the period of the fixes, nor of the closures."""
TOGETHER = 20
"""Nodes that we let go at a time, as the back end does."""
SLOW = 2.0
"""What takes longer is run once [s]."""
TIMES = ('world', 'tool', 'mean', 'p50', 'p99', 'max', 'ratio mean', 'p50', 'p99', 'runs', 'note')
ERRORS = ('world', 'tool', 'newest to truth m, mrad', 'window to truth m',
          'newest to optimum mm: rms', 'max', 'window to optimum mm: rms', 'max', 'samples')

SEEDS, QUICK_SEEDS = 20, 3
UPDATE_EVERY = 1.0
"""[s]"""
REFINEMENTS = 4
"""Most iterations after an update."""
SETTLED = 60.0
"""Time from which errors count: a lap [s]."""
LOOK_EVERY = 10
"""Updates from one pose whose error counts to the next."""
NEAR = 1.03
NEES = 0.9, 1.2
SHORT = '90 s', '90 s sparse'
LEFT = 105.0
"""Age from which on a node has left these windows, their groups and updates included [s]."""
COURSE = Course(
    300.0, length=60.0, odometry_rate=10.0, fix_period=2.0, closure_period=5.0,
    closure_sigma=(0.2, 0.2, 0.05))
DRIVES = {
    'fixes and closures': COURSE,
    'rare fixes, and closures': replace(COURSE, fix_period=30.0),
    'fixes alone': replace(COURSE, closure_period=0.0),
    'closures, some to what has left': replace(COURSE, laps_back=(1, 1, 1, 1, 3)),
    'closures alone': replace(COURSE, fix_period=0.0)}
WITHOUT = 'unlimited, without what a window refuses'
SETTINGS: dict[str, dict[str, MeasurementSource]] = {
    'all believed': {FIXES: MeasurementSource(),
                     CLOSURES: replace(LOOP_CLOSURES, robust=Robust.NONE)},
    'default': {FIXES: POSITIONS, CLOSURES: LOOP_CLOSURES}}


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one run."""

    newest: float
    """Position of the newest pose, rms over all steps [m]."""
    heading: float
    """Its heading, rms over all steps [rad]."""
    window: float
    """Positions of the window, rms over the samples [m]."""
    off_newest: FloatArray
    """Distance of the newest pose to the optimum of the unlimited graph, by sample [m]."""
    off_window: FloatArray
    """Distances of the poses of the window to it, of all samples [m]."""


def _errors(world: World, run: Run) -> Errors:
    """Compare a run with the truth, and with the optima of the unlimited graph."""
    assert world.truth is not None
    off = run.newest - world.truth[:len(run.newest)]
    to_truth, window = [], []
    for k, poses in run.samples.items():
        best = ours.optimum(world, k, world.truth[:k + 1], run.tool)[2]
        kept = slice(k + 1 - len(poses), k + 1)
        to_truth.append((poses - world.truth[kept])[:, :2])
        window.append(np.hypot(*(poses - best[kept])[:, :2].T))
    return Errors(rms(off[:, :2]), rms(se2.wrap(off[:, 2])), rms(np.concatenate(to_truth)),
                  np.array([each[-1] for each in window]), np.concatenate(window))


def peers(options: Options) -> Section:
    """
    Compare with GTSAM's fixed-lag smoothers: time of a step, errors of newest and window.

    A lag of {LAG} nodes, {n} steps. Ours lets {TOGETHER} nodes go at a time, as the back end does
    in groups, so it keeps {LAG} to 220; also one at a time, as GTSAM. The newest pose is read
    after each step, and that is part of its time, as is letting the oldest node go; of GTSAM the
    building of factors is not counted. Tools run one after the other in one process, figures are
    medians over the runs, ratios are GTSAM's time over ours. *Chain*: odometry and a global pose
    (or only a position) on every tenth node. *Laps*: {PER_LAP} nodes a lap, a closure to the lap
    before on every fifth node. Errors are of all steps (newest pose to truth) or of samples; the
    optimum is that of the unlimited graph at that step, each tool under its own error model. Asked
    for: at least {RATIO_ASKED:.0f} times as fast as the incremental one in the mean, at no larger
    error.
    """
    n = QUICK_NODES if options.quick else NODES
    found = Section("Beside GTSAM's fixed-lag smoothers", about(peers, n=n))
    found.table('Time of a step [us]', *TIMES)
    found.table('Errors', *ERRORS)
    tools: dict[str, Tool] = dict((ours.kept(LAG, TOGETHER), ours.kept(LAG, 1),
                                   ours.kept(ours.NEVER)))
    if options.gtsam:
        # the rest of the benchmark can be used without GTSAM
        from benchmark.gtsam_peer import CAREFUL, FAST  # noqa: PLC0415

        tools |= {each.name: replace(each, lag=LAG) for each in (FAST, CAREFUL)}
    plan = Plan(sample_steps(n, EVERY), options.limit)
    for world in (chain(n), chain(n, 'position'), laps(n, PER_LAP)):
        _add(found, world, interleaved(world, tools, plan, options.repeats, SLOW))
    return found


def _add(found: Section, world: World, runs: dict[str, list[Run]]) -> None:
    """Add the rows and figures of a world."""
    first = next(iter(runs))
    judged = {name: _errors(world, of_tool[0]) for name, of_tool in runs.items()}
    label = world.name
    for name, of_tool in runs.items():
        steps = of_tool[0].steps
        figures = timing(of_tool, steps, LAG + 1)
        ratios = ('', '', '')
        if name.startswith('GTSAM'):
            both = figures[:3] / timing(runs[first], steps, LAG + 1)[:3]
            ratios = tuple(f'{ratio:.1f}' for ratio in both)
            found.ask(f'{world.name}/times as fast as {name}', both[0], 'x', RATIO,
                      least=RATIO_ASKED)
        mean, p50, p99, longest, _ = figures
        found.tables[0].add(label, name, f'{mean:.1f}', f'{p50:.1f}', f'{p99:.0f}',
                            f'{longest:.0f}', *ratios, str(len(of_tool)), of_tool[0].note)
        item = judged[name]
        found.tables[1].add(
            label, name, f'{item.newest:.4f}, {1e3 * item.heading:.2f}', f'{item.window:.4f}',
            *(f'{1e3 * figure(off):.2g}' for off in (item.off_newest, item.off_window)
              for figure in (rms, np.max)), str(len(item.off_newest)))
        label = ''
    gtsam = [name for name in runs if name.startswith('GTSAM')]
    if len(gtsam) == 0:
        return
    best = min(gtsam, key=lambda name: judged[name].newest)
    for what in ('newest', 'window'):
        found.ask(f'{world.name}/error of the {what} to the truth over that of {best}',
                  getattr(judged[first], what) / getattr(judged[best], what), most=NO_LARGER)
        mine, theirs = (rms(getattr(judged[name], f'off_{what}')) for name in (first, best))
        found.ask(f'{world.name}/distance of the {what} to the optimum over that of {best}',
                  mine / theirs, most=NO_LARGER)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Errors of the newest pose over a drive."""

    squared: float
    """Of the position, mean [m^2]."""
    nees: float
    """Mean; nan if there is none."""
    kept: int
    """Nodes in the graph at its end."""


def _run(course: Course, config: BackendConfig, oldest: float = np.inf) -> Outcome:
    """
    Drive a course, and compare the newest pose with the truth on the way.

    Parameters
    ----------
    course : Course
    config : BackendConfig
    oldest : float, closures to what is older are left out [s]

    """
    backend = PoseGraphBackend(config)
    squared, found = list[float](), list[float]()
    # without fixes the map is the frame in which odometry begins
    start = _start(course) if course.fix_period == 0.0 else None
    events = (event for event in course.events() if _age(event[1]) <= oldest)
    for n_updates, stamp_ns in enumerate(feed(backend, events, UPDATE_EVERY), 1):
        for _ in range(REFINEMENTS):
            if backend.refine().finished:
                break
        estimate = backend.estimate(with_path=False)
        if (estimate is None or n_updates % LOOK_EVERY > 0
                or stamp_ns < START_NS + SETTLED * SECOND
                or (start is None and estimate.alignment is not AlignmentState.ALIGNED)):
            continue
        true = course.truth_at(estimate.stamp_ns)
        if start is not None:
            true = se2.compose(start, true)
        off = estimate.T_map_base - true
        off[2] = se2.wrap(off[2])
        squared.append(float(off[0]**2 + off[1]**2))
        found.append(nees(off, estimate.covariance))
    return Outcome(float(np.mean(squared)), float(np.mean(found)), backend.graph.n_nodes)


def _age(measurement: OdometrySample | Measurement) -> float:
    """Return how old the pose is that a closure leads to; 0 for other measurements [s]."""
    reference_ns = getattr(measurement, 'reference_ns', None)
    return 0.0 if reference_ns is None else (measurement.stamp_ns - reference_ns) / SECOND


def _start(course: Course) -> FloatArray:
    """Return the pose of the frame of the truth in that of odometry, shape (3,)."""
    times, poses, _ = next(iter(course.pieces()))
    return np.asarray(se2.compose(poses[0], se2.inverse(course.truth(times[:1])[0])))


def consistency(options: Options) -> Section:
    """
    Compare the newest pose with windows with that of the whole graph.

    Drives of {COURSE.duration:.0f} s at {COURSE.speed:g} m/s, laps of {COURSE.lap:.0f} s, with
    fixes of {COURSE.fix_sigma:g} m and closures to the lap before, {n} seeds each. Every tenth
    second the newest pose is compared with the truth. *NEES* is the mean over these drives; their
    errors hardly change within a drive, so that of 20 drives misses the mean of many by 0.1,
    whatever the estimator. *Without chance* is one more than the mean difference to that of the
    whole graph on the same drives, with its standard error. *All believed*: neither judged nor
    with a loss, errors known to be white; *default*: as the node does. Closures are of
    {COURSE.closure_sigma[0]:g} m and {COURSE.closure_sigma[2]:g} rad.
    """
    n = options.runs or (QUICK_SEEDS if options.quick else SEEDS)
    found = Section('Is the newest pose as good as with the whole graph?', about(consistency, n=n))
    found.table('', 'drive', 'settings', 'window', 'nodes kept', 'rms [m]', 'over unlimited',
                'NEES', 'without chance', 'drives')
    for name, course in DRIVES.items():
        for setting, sources in SETTINGS.items():
            if options.wants(f'{name}; {setting}'):
                _compare(found, f'{name}; {setting}',
                         [replace(course, seed=k) for k in range(n)], {'measurements': sources})
    return found


def _compare(
    found: Section, name: str, courses: list[Course], sources: dict[str, Any],
) -> None:
    """Add rows and figures of one kind of drive with one kind of settings."""
    before = fair = 0.0
    whole = np.empty(0)
    some_refused = max(courses[0].laps_back) * courses[0].lap > LEFT
    for window in ('unlimited', *[WITHOUT] * some_refused, *SHORT):
        is_fair = window == WITHOUT
        config = BackendConfig(**WINDOWS['unlimited' if is_fair else window], **sources)
        errors = [_run(course, config, LEFT if is_fair else np.inf) for course in courses]
        error = float(np.sqrt(np.mean([each.squared for each in errors])))
        before, fair = before or error, error if is_fair else fair
        claims = np.array([each.nees for each in errors])
        whole = claims if window == 'unlimited' else whole
        # of the same drives, so chance is the same
        mean = 1.0 + float(np.mean(claims - whole))
        chance = float(np.std(claims - whole)) / len(errors)**0.5
        nodes = np.mean([each.kept for each in errors])
        found.tables[0].add(
            *name.split('; '), window, f'{nodes:.0f}', f'{error:.4f}', f'{error / before:.4f}',
            f'{np.mean(claims):.2f}', f'{mean:.2f} ± {chance:.2f}', str(len(errors)))
        if window.startswith('unlimited'):
            continue
        key = f'{name}; {window}'
        if some_refused:
            found.ask(f'{key}: rms over {WITHOUT}', error / fair, most=NEAR)
        found.ask(f'{key}: rms over unlimited', error / before, most=NEAR)
        found.ask(f'{key}: NEES, from above', mean, most=NEES[1])
        found.ask(f'{key}: NEES, from below', mean, least=NEES[0])


SECTIONS: dict[str, Callable[[Options], Section]] = {
    'peers': peers, 'consistency': consistency, 'day': day.section, 'hall': hall.section,
    'samples': samples.section}
