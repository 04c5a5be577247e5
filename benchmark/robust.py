# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure what wrong loop closures and wrong fixes do to the path, with default settings.

Paths with loop closures alone are compared with the truth after the best rigid motion. A closure
is wrong if it is more than 3 m off; odometry has the noise of the default model, in M3500 and its
kind that of the edges of the file. Of the settings, only `robust` is changed, where a column says
so. Simulated drives are those of `pose-graph simulate`. The only recording of place recognition is
B25b; wrong fixes of plaza 1 are made of its truth. Times are those of one machine that may have
had other work; ratios in *Beside GTSAM* are of runs right after one another. What cannot be
decided stays wrong here too: closures that agree with one another within the error that odometry
could have, and fixes that are dragged away no faster than odometry may drift.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
import subprocess
from tempfile import TemporaryDirectory
import time
from typing import NamedTuple

from matplotlib.collections import LineCollection
import numpy as np

from benchmark import fixes, robust_timing, solve, worlds as graphs
from benchmark.recordings import (
    B25B,
    FAR,
    feed,
    hidden_graph,
    M3500,
    read_recording,
    Recording,
    rms,
    Run,
    SECOND,
    TRUE,
    while_driving,
)
from benchmark.report import panels
from benchmark.section import about, Options, Section, Table
from benchmark.wrong_closures import LEAST_WRONG, of_world, simulated, wide_gates, with_false
from pose_graph_ros.cli.believe import believe
from pose_graph_ros.cli.picture import BLUE, GREEN, GREY, INK, PURPLE, VERMILION
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.config import Robust, SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, composed, FloatArray
from pose_graph_ros.core.geometry.trajectory import fit_motion, Trajectory
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.io.g2o import read_g2o
from pose_graph_ros.core.judgement.closures import floored, FLOORS
from pose_graph_ros.offline.simulation.settings import FalseClosures

TITLE = 'Wrong measurements'
B25B_RMS, RECALL, WORST, NEAR = 1.4, 0.8, 1.1, 1.25
"""What is asked for: rms [m], share of the right closures, ratio to odometry while driving, and
ratio of the rms to that with only right closures."""
CLOSURES = ('closures, of which right', 'odometry', 'all', 'only right', 'judged', 'kept wrong',
            'kept far off', 'recall', 'newest', 'worst path', 'update mean / p99 / max [ms]',
            'idle max [ms]', 'all calls [s]')


GROUPS = FalseClosures(singles=60, groups=8, size=8)
"""Wrong closures that are added to a simulated drive."""
METHODS = 'GNC-TLS', 'GNC-GM', 'Cauchy', 'DCS'
"""Of the script around GTSAM."""
FLOORED = ('GNC-TLS',)
"""Methods that also get the closures with floors."""
REPEATS = 3
AS_GOOD, FASTER = 1.01, 5.0
"""What is asked: rms over that of GTSAM's GNC, with one hundredth for rounding, and times."""
CONFIG = SolverConfig(max_iterations=200)
"""As `pose-graph solve` has it."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A run with default settings, and its figures."""

    run: Run
    rms: float
    odometry: float
    right: float
    """With only the right closures [m]."""
    wrong_kept: int
    far_kept: int
    recall: float
    newest: float
    worst: float
    n_right: int


def judge(
    table: Table, recording: Recording, *, everything: bool = True, clean: float | None = None,
) -> Judged:
    """
    Run a recording with default settings and as comparisons, and add a row to a table.

    Parameters
    ----------
    table : Table
    recording : Recording
    everything : bool, whether to run it with all closures believed as well
    clean : float, optional
        The error with only the right closures, if it is known [m].

    """
    errors = recording.errors()
    right = errors <= TRUE
    run = feed(recording, recording.config(Robust.JUDGED))
    truth = recording.truth
    odometry = rms(Trajectory(recording.stamps_ns, recording.odometry), truth)
    only_right = clean or rms(
        feed(recording.only(right), recording.config(Robust.NONE)).path, truth)
    used = run.kept
    judged = Judged(
        run, rms(run.path, truth), odometry, only_right, int(np.sum(used & ~right)),
        int(np.sum(used & (errors > FAR))), float(np.mean(used[right])) if right.any() else 1.0,
        *while_driving(run, recording), int(np.sum(right)))
    all_of_them = (f'{rms(feed(recording, recording.config(Robust.NONE)).path, truth):.2f}'
                   if everything else '')
    ms = 1e3 * run.updates
    table.add(recording.name, f'{len(right)}, {judged.n_right}', f'{odometry:.2f}', all_of_them,
              f'{only_right:.2f}', f'{judged.rms:.2f}', str(judged.wrong_kept),
              str(judged.far_kept), f'{judged.recall:.3f}', f'{judged.newest:.2f}',
              f'{judged.worst:.2f}',
              f'{ms.mean():.1f} / {np.percentile(ms, 99.0):.0f} / {ms.max():.0f}',
              f'{1e3 * run.longest_idle:.0f}', f'{run.seconds:.1f}')
    return judged


def _read(options: Options, names: tuple[str, ...], section: Section) -> Recording | None:
    """Return a recording, None with a note if its files are not there."""
    files = [options.data / name for name in names]
    if all(path.exists() for path in files):
        return read_recording(*files)
    section.notes.append(f'{files[0].name}: the data is not there, skipped.')
    return None


def places(options: Options) -> Section:
    """
    Measure a recording of place recognition, where the files are there.

    Recordings, fed online in order. Errors are rms of the path [m], with no closure, with all,
    with only the right ones, and with default settings. Ratios to odometry while driving: rms of
    the newest pose over the drive, and the worst rms of the path so far (there odometry counts as
    at least 0.5 m off).
    """
    section = Section('Place recognition', about(places))
    table = section.table('', 'recording', *CLOSURES)
    recording = _read(options, B25B, section)
    if recording is not None:
        judged = judge(table, recording)
        section.ask(f'{recording.name}: rms', judged.rms, ' m', most=B25B_RMS)
        _ask(section, recording.name, judged)
        _draw(recording, judged.run, options.out / 'place_recognition.png')
        section.notes.append('![The path, and what was believed](place_recognition.png)')
    return section


def _ask(section: Section, name: str, judged: Judged) -> None:
    """Add what is asked for of all recordings."""
    section.ask(f'{name}: kept far off', judged.far_kept, most=0.0)
    section.ask(f'{name}: recall', judged.recall, least=RECALL)
    section.ask(f'{name}: newest pose, over that of odometry', judged.newest, most=WORST)


def _draw(recording: Recording, run: Run, file: Path) -> None:
    """Draw the paths on the truth, and beside them the closures between their true ends."""
    figure, (left, right) = panels('paths', 'loop closures', size=(6.5, 6.5))
    truth, wrong = recording.truth, recording.errors() > TRUE
    for path, colour, name in (
            (Trajectory(recording.stamps_ns, recording.odometry), PURPLE, 'odometry alone'),
            (run.path, BLUE, 'corrected path')):
        inside = truth.covers(path.stamps_ns)
        motion = fit_motion(path.poses[inside, :2], truth.at(path.stamps_ns[inside])[:, :2])
        left.plot(*se2.compose(motion, path.poses)[:, :2].T, color=colour, linewidth=1.6,
                  label=name)
    for chosen, colour, style, name in (
            (~run.kept & wrong, GREY, (0, (3, 3)), 'wrong, refused'),
            (run.kept & ~wrong, GREEN, 'solid', 'right, believed'),
            (~run.kept & ~wrong, '#E69F00', (0, (3, 3)), 'right, refused'),
            (run.kept & wrong, VERMILION, 'solid', 'wrong, believed')):
        right.add_collection(LineCollection(
            list(truth.at(recording.ends[chosen])[..., :2]), colors=colour, linestyles=[style],
            linewidths=1.0, label=f'{name}: {int(np.sum(chosen))}'))
    for axes in (left, right):
        axes.plot(*truth.poses[:, :2].T, color=INK, linewidth=0.8, linestyle=(0, (6, 4)),
                  label='truth')
        axes.set_aspect('equal')
        axes.legend(frameon=False, fontsize=9, loc='upper left', bbox_to_anchor=(0.0, -0.05),
                    ncols=3)
    figure.savefig(file)


def worlds(options: Options) -> Section:
    """
    Measure simulated place recognition.

    Drives through a hall and a small Manhattan, from seeds, with right closures, {GROUPS.singles}
    single wrong ones and {GROUPS.groups} groups of {GROUPS.size} wrong ones that agree, of
    stretches that run in one direction. 2.5x, 5x: scatter of the right ones in sigmas that come
    with them.
    """
    section = Section('Simulated place recognition', about(worlds))
    table = section.table('', 'world, seed', *CLOSURES)
    for world, duration, over in (('hall', 2700.0, 2.5), ('grid', 1500.0, 5.0)):
        for seed in range(options.runs or 1):
            name = f'{world}, {over:g}x, seed {seed}'
            if options.wants(name):
                judged = judge(table, replace(simulated(
                    world, duration, seed, claimed=1.0 / over, false=GROUPS), name=name))
                section.ask(f'{name}: rms over that of only right ones',
                            judged.rms / judged.right, most=NEAR)
                _ask(section, name, judged)
    return section


def arrivals(_options: Options) -> Section:
    """
    Measure closures that come in other ways.

    One drive through the hall (2.5x), whose closures come in other ways.
    """
    section = Section('Other circumstances', about(arrivals))
    table = section.table('', 'circumstances', *CLOSURES)
    drive = simulated('hall', 2700.0, 10, claimed=0.4, false=GROUPS)
    rng, n = np.random.default_rng(1), len(drive.ends)
    for name, changed in (
            ('up to 60 s late, in any order', drive.ordered(
                drive.arrival_ns + rng.integers(0, 60 * SECOND, n))),
            ('all of them at the end, in any order', drive.ordered(
                drive.stamps_ns[-1] - rng.integers(1, SECOND, n))),
            ('only wrong ones', drive.only(drive.errors() > LEAST_WRONG))):
        judged = judge(table, replace(changed, name=name), everything=False)
        section.ask(f'{name}: kept far off', judged.far_kept, most=0.0)
        section.ask(f'{name}: rms over that of odometry', judged.rms / judged.odometry,
                    most=WORST)
    return section


def gates(options: Options) -> Section:
    """
    Measure a world in which wrong closures come first, where odometry could have drifted.

    A way round of 960 m before anything is seen again: the sigma of odometry is above 10 m. Five
    lone wrong closures, 10 to 25 m off, come first; 25 right ones on the second lap. Wrong ones
    that lie within three sigmas of the path even then cannot be told from right ones: asked is
    that the path is not worse than odometry while driving, and much better at the end.
    """
    section = Section('Wide gates', about(gates))
    table = section.table('', 'seed', *CLOSURES)
    for seed in range(options.runs or 1):
        judged = judge(table, replace(wide_gates(seed), name=str(seed)))
        key = f'wide gates, seed {seed}'
        section.ask(f'{key}: worst path while driving', judged.worst, most=WORST)
        section.ask(f'{key}: rms over that of odometry', judged.rms / judged.odometry, most=0.75)
    return section


def grids(options: Options) -> Section:
    """
    Measure graphs with very many closures, to which wrong ones are added.

    M3500 and a simulated grid of its kind, with wrong closures anywhere; the share is that of all
    closures. *Groups*: ten at a time agree.
    """
    section = Section('Graphs with very many closures', about(grids))
    table = section.table('', 'graph', *CLOSURES)
    read = _read(options, M3500, section)
    mixes = ((0.1, 1), (0.3, 1), (0.5, 1), (0.1, 10), (0.3, 10), (0.5, 10))
    for base, seeds, chosen in (
            (read, 1 if options.quick else 5, mixes[2:5:2] if options.quick else mixes),
            (of_world(graphs.grid()), 1, mixes[2:5:2])):
        if base is None:
            continue
        named = {f'{base.name}, {_mix(*mix)}': mix for mix in chosen}
        wrong = {name: mix for name, mix in named.items() if options.wants(name)}
        if len(wrong) == 0:
            continue
        clean = judge(table, replace(base, name=f'{base.name}, none wrong'), everything=False)
        section.ask(f'{base.name}: rms over that of what the file says', clean.rms / clean.right,
                    most=1.05)
        for name, mix in wrong.items():
            runs = [judge(table, replace(
                with_false(base, *mix, seed), name=f'{name}, seed {seed}'), everything=False,
                clean=clean.right) for seed in range(seeds)]
            section.ask(f'{name}: rms over that without',
                        max(run.rms for run in runs) / clean.rms, most=1.05)
            section.ask(f'{name}: wrong ones kept', max(run.wrong_kept for run in runs), most=0.0)
            section.ask(f'{name}: right ones lost, of 500',
                        max(500.0 * (1.0 - run.recall) for run in runs), most=1.0)
    return section


def _mix(share: float, group: int) -> str:
    return f'{100 * share:.0f} % {"groups" if group > 1 else "single"}'


class Solved(NamedTuple):
    """What a tool makes of a graph."""

    poses: FloatArray | None
    """Shape (N, 3); None if it was cut."""
    kept: BoolArray
    """Of the closures; empty if the method does not tell."""
    seconds: float
    """Of the solver."""
    command: float = np.nan
    """Of the whole command, from its start to its end [s]."""


def peers(options: Options) -> Section:
    """
    Compare with GTSAM on the same graphs.

    Each tool gets one file with the same nodes, odometry and closures, starts from odometry, and
    knows that odometry is right. GTSAM: graduated non-convexity (GncLMOptimizer, 99 %) for
    truncated least squares and Geman-McClure, and Levenberg-Marquardt with a loss; *floors*:
    closures with at least 0.3 m and 0.05 rad, which ours has for its decision anyway. *Ours,
    batch*: `pose-graph solve --robust`. *Ours, online*: all calls of the back end over the whole
    drive. *Solver*: without reading files and starting a process (ours: kernels compiled, the
    median of {REPEATS}); *command*: the process from its start to its end. A command is cut after
    {options.limit:.0f} s. Asked of ours, batch: an rms of at most {AS_GOOD} times that of the best
    of GTSAM's GNC, of those that were not cut (if all were, of its losses), and {FASTER:.0f} times
    as fast as the fastest of them; one that is cut counts with the limit.
    """
    section = Section('Beside GTSAM', about(peers, options=options))
    section.table('', 'graph', 'tool', 'rms [m]', 'kept', 'kept wrong', 'lost right',
                  'solver [s]', 'command [s]')
    if not options.gtsam:
        section.notes.append('Without gtsam (`make bench` installs it).')
    base = _read(options, M3500, section) or of_world(graphs.grid())
    mixes = ((0.1, 1),) if options.quick else ((0.1, 1), (0.3, 1), (0.5, 1), (0.3, 10))
    found = [_read(options, B25B, section), *(
        replace(with_false(base, *mix, 0), name=f'{base.name}, {_mix(*mix)}') for mix in mixes),
        replace(simulated('hall', 2700.0, 0, claimed=0.4, false=GROUPS), name='hall, 2.5x')]
    for recording in found:
        if recording is not None and options.wants(recording.name):
            _compare(section, recording, options)
    return section


def _compare(section: Section, recording: Recording, options: Options) -> None:
    """Run all tools on one graph."""
    run = feed(recording, recording.config(Robust.JUDGED))
    stamps, chain, loops, believed = hidden_graph(run)
    true = se2.between(recording.truth.at(stamps[loops.i]), recording.truth.at(stamps[loops.j]))
    right = np.hypot(*(loops.mean - true)[:, :2].T) <= TRUE
    errors: dict[str, float] = {}
    results: dict[str, Solved] = {}

    def add(tool: str, solved: Solved) -> None:
        results[tool] = solved
        cut, kept = solved.poses is None, solved.kept
        errors[tool] = np.inf if solved.poses is None else rms(
            Trajectory(stamps, solved.poses), recording.truth)
        counts = ('', '', '') if len(kept) == 0 else (
            str(np.sum(kept)), str(np.sum(kept & ~right)), str(np.sum(right & ~kept)))
        command = '' if np.isnan(solved.command) else f'{solved.command:.2f}'
        section.tables[0].add(
            recording.name, tool, 'cut' if cut else f'{errors[tool]:.2f}', *counts,
            'cut' if cut else f'{solved.seconds:.2f}', command)

    with TemporaryDirectory() as name:
        plain, raised = Path(name, 'plain.g2o'), Path(name, 'raised.g2o')
        start = composed(np.zeros(3), chain.mean)
        solve.write(plain, chain, loops, start)
        solve.write(raised, chain, floored(loops), start)
        add('ours, online', Solved(run.backend.graph.poses.copy(), believed, run.seconds))
        add('ours, batch', _ours(plain))
        for method in METHODS if options.gtsam else ():
            tool = f'GTSAM {method}' if 'GNC' in method else f'GTSAM LM, {method}'
            add(tool, _peer(method, plain, options.limit))
            if method in FLOORED:
                add(f'{tool}, floors', _peer(method, raised, options.limit))
    gnc = [tool for tool in results if 'GNC' in tool]
    if len(gnc) > 0:
        ended = [tool for tool in gnc if results[tool].poses is not None] or [
            tool for tool in results if tool.startswith('GTSAM')]
        best, ours = min(errors[tool] for tool in ended), results['ours, batch']
        for name in ('batch', 'online'):
            section.ask(f"{recording.name}: rms, {name}, over GTSAM's",
                        errors[f'ours, {name}'] / best, most=AS_GOOD)
        section.ask(f'{recording.name}: solver, times as fast',
                    min(results[tool].seconds for tool in gnc) / ours.seconds, 'x', least=FASTER)
        section.ask(f'{recording.name}: command, times as fast',
                    min(results[tool].command for tool in gnc) / ours.command, 'x', least=FASTER)


def _ours(file: Path) -> Solved:
    """Run `pose-graph solve --robust`, in this process and as a command."""
    times = []
    for _ in range(REPEATS):
        graph = read_g2o(file).graph
        graph.apply(GraphUpdate(fix=[0]))
        begin = time.perf_counter()
        beliefs = believe(graph, FLOORS)
        assert beliefs is not None
        graph.set_poses(beliefs.poses)
        graph.apply(GraphUpdate(
            remove=beliefs.closures[~beliefs.believed].tolist(),
            weigh=dict.fromkeys(
                beliefs.closures[beliefs.believed].tolist(), beliefs.scale**-2.0)))
        optimizer.optimize(graph, CONFIG)
        times.append(time.perf_counter() - begin)
    command = solve.run(solve.tool(file, file.with_name('ours.g2o'), '--robust=selection')).wall
    return Solved(graph.poses.copy(), beliefs.believed, float(np.median(times)), command)


def _peer(method: str, file: Path, limit: float) -> Solved:
    """Run a method of GTSAM as a command."""
    out = file.with_name('gtsam.g2o')
    try:
        done = solve.run(solve.peer(file, out, 'g2o', 'file', method), limit)
    except subprocess.TimeoutExpired:
        return Solved(None, np.empty(0, dtype=bool), limit, limit)
    return Solved(read_g2o(out).graph.poses, np.array(done.result['kept'], dtype=bool),
                  done.result['seconds'], done.wall)


SECTIONS: dict[str, Callable[[Options], Section]] = {
    'places': places, 'worlds': worlds, 'arrivals': arrivals, 'gates': gates, 'grids': grids,
    'timing': robust_timing.timing, 'fixes': fixes.section, 'peers': peers}
