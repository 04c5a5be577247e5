# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure what wrong loop closures and wrong fixes do to the path, with default settings.

    .venv/bin/python -m benchmark.robust --out docs/benchmarks/robust
    .venv/bin/python -m benchmark.robust --quick --only places
    .venv/bin/python -m benchmark.robust --recording graph.g2o truth.g2o stamps.txt

Paths with loop closures alone are compared with the truth after the best rigid motion. A closure
is wrong if it is more than 3 m off; odometry has the noise of the default model, in M3500 and its
kind that of the edges of the file. Of the settings, only `robust` is changed, where a column says
so. Each section can be made alone, and says at its end by which command it was.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
import shlex
import sys

import numpy as np

from benchmark import (
    kept_sections,
    report,
    robust_fixes,
    robust_peers,
    robust_picture,
    robust_timing,
    streets,
)
from benchmark.files import DATA
from benchmark.metrics import Metric
from benchmark.robust_closures import (
    FAR,
    feed,
    read_recording,
    Recording,
    rms,
    Run,
    TRUE,
    while_driving,
)
from benchmark.robust_worlds import (
    circumstances,
    LOOSE,
    MEDIUM,
    of_world,
    OFFICE,
    OUTDOORS,
    place_recognition,
    STRICT,
    wide_gates,
    with_false,
)
from benchmark.section import say, Section, Table
from pose_graph_ros.core.config import Robust
from pose_graph_ros.core.geometry.trajectory import Trajectory

PLACES = ('false_loops/B25b_0.150.g2o', 'false_loops/Bicocca25b_GT_GPS.g2o',
          'false_loops/B25b_timestamps.txt')
M3500 = 'graphs/input_M3500_g2o.g2o', 'graphs/manhattanOlson3500_groundtruth.txt'
B25B_RMS, RECALL, WORST = 1.4, 0.8, 1.1
"""What is asked for: rms [m], share of the right closures, ratio to odometry while driving."""
CLOSURES = ('closures, of which right', 'odometry', 'all', 'only right', 'judged', 'kept wrong',
            'kept far off', 'recall', 'newest', 'worst path', 'update mean / p99 / max [ms]',
            'idle max [ms]', 'all calls [s]')


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line asks for."""

    quick: bool
    data: Path
    recordings: tuple[tuple[Path, ...], ...]
    limit: float
    """After which a run of another tool is cut [s]."""
    out: Path
    fix_robust: Robust | None
    cases: tuple[str, ...]

    def wants(self, name: str) -> bool:
        """Return whether a drive or a graph is to be measured."""
        return len(self.cases) == 0 or any(case in name for case in self.cases)


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
    say('  ' + ' | '.join(table.rows[-1]))
    return judged


def places(options: Options) -> Section:
    """Measure recordings of place recognition, where the files are there."""
    section = Section(
        'Place recognition', 'Recordings, fed online in order. Errors are rms of the path [m], '
        'with no closure, with all, with only the right ones, and with default settings. Ratios '
        'to odometry while driving: rms of the newest pose over the drive, and the worst rms of '
        'the path so far (there odometry counts as at least 0.5 m off).')
    table = Table('', ('recording', *CLOSURES))
    given = [tuple(options.data / name for name in PLACES), *options.recordings]
    for files in given:
        if not all(path.exists() for path in files):
            section.notes.append(f'{files[0].name}: the data is not there, skipped.')
            continue
        recording = read_recording(*files)
        judged = judge(table, recording)
        if files == given[0]:
            section.metrics += [
                Metric(f'{recording.name}: rms', judged.rms, ' m', target=B25B_RMS),
                *_asked(recording.name, judged)]
            robust_picture.draw(recording, judged.run, options.out / 'place_recognition.png')
            section.notes.append('![The path, and what was believed](place_recognition.png)')
    section.tables.append(table)
    return section


def _asked(name: str, judged: Judged) -> list[Metric]:
    """Return what is asked for of all recordings."""
    return [Metric(f'{name}: kept far off', judged.far_kept, target=0.0),
            Metric(f'{name}: recall', judged.recall, target=RECALL, higher_is_better=True),
            Metric(f'{name}: newest pose, over that of odometry', judged.newest, target=WORST)]


def worlds(options: Options) -> Section:
    """Measure simulated place recognition."""
    section = Section(
        'Simulated place recognition', 'Drives through an office and a campus, from seeds, with '
        'right closures (scattered like Student\'s t), single wrong ones and groups of 4 to 12 '
        'wrong ones that agree, along parallel corridors. 1x, 2.5x, 5x: scatter of the right ones '
        'in sigmas that come with them.')
    table = Table('', ('world, seed', *CLOSURES))
    kinds = [(place, recogniser, over) for place in (OFFICE, OUTDOORS)
             for recogniser in (LOOSE, MEDIUM, STRICT) for over in (1.0, 2.5, 5.0)]
    for place, recogniser, over in (
            [(OFFICE, LOOSE, 2.5), (OUTDOORS, LOOSE, 5.0)] if options.quick else kinds):
        for seed in range(1 if options.quick else 2):
            recording = place_recognition(place, recogniser, over, seed)
            name = f'{recording.name}, seed {seed}'
            judged = judge(table, replace(recording, name=name), everything=seed == 0)
            section.metrics += [
                Metric(f'{name}: rms over that of only right ones', judged.rms / judged.right,
                       target=1.25), *_asked(name, judged)]
    section.tables.append(table)
    return section


def arrivals(options: Options) -> Section:
    """Measure one simulated drive whose closures come in other ways."""
    section = Section(
        'Other circumstances', 'One drive through the office (loose, 2.5x), whose closures come '
        'in other ways, or whose odometry is not as good as its noise model says.')
    table = Table('', ('circumstances', *CLOSURES))
    recording = place_recognition(OFFICE, LOOSE, 2.5, 10)
    kept: dict[str, np.ndarray] = {}
    for name, change in circumstances().items():
        if options.quick and 'wrong' not in name and 'order' not in name:
            continue
        judged = judge(table, replace(
            change(recording, np.random.default_rng(1)), name=name), everything=False)
        kept[name] = np.unique(change(recording, np.random.default_rng(1)).ends[judged.run.kept],
                               axis=0)
        section.metrics += [
            Metric(f'{name}: kept far off', judged.far_kept, target=0.0),
            Metric(f'{name}: rms over that of odometry', judged.rms / judged.odometry,
                   target=WORST)]
    first = kept.get('as they come')
    for name, ends in kept.items():
        if first is not None and ('late' in name or 'order' in name):
            section.metrics.append(Metric(
                f'{name}: closures that are decided otherwise', len(
                    set(map(tuple, first.tolist())) ^ set(map(tuple, ends.tolist()))),
                target=0.0))
    for factor in () if options.quick else (0.5, 2.0):
        place = replace(OFFICE, noise=factor * OFFICE.noise)
        name = f'odometry {factor:g} times as noisy as claimed'
        judged = judge(table, replace(place_recognition(place, LOOSE, 2.5, 10), name=name),
                       everything=False)
        section.metrics.append(Metric(f'{name}: kept far off', judged.far_kept, target=0.0))
    section.tables.append(table)
    return section


def gates(options: Options) -> Section:
    """Measure a world in which wrong closures come first, where odometry could have drifted."""
    section = Section(
        'Wide gates', 'A way round of 960 m before anything is seen again: the sigma of odometry '
        'is above 10 m. Five lone wrong closures, 10 to 25 m off, come first; 25 right ones on '
        'the second lap. Wrong ones that lie within three sigmas of the path even then cannot be '
        'told from right ones: asked is that the path is not worse than odometry while driving, '
        'and much better at the end.')
    table = Table('', ('seed', *CLOSURES))
    for seed in range(1 if options.quick else 5):
        judged = judge(table, replace(wide_gates(seed), name=str(seed)))
        section.metrics += [
            Metric(f'wide gates, seed {seed}: worst path while driving', judged.worst,
                   target=WORST),
            Metric(f'wide gates, seed {seed}: rms over that of odometry',
                   judged.rms / judged.odometry, target=0.75)]
    section.tables.append(table)
    return section


def grids(options: Options) -> Section:
    """Measure graphs with very many closures, to which wrong ones are added."""
    section = Section(
        'Graphs with very many closures', 'M3500 and a simulated grid of its kind, with wrong '
        'closures anywhere; the share is that of all closures. *Groups*: ten at a time agree.')
    table = Table('', ('graph', *CLOSURES))
    bases: list[tuple[Recording, int]] = [(of_world(streets.grid()), 1 if options.quick else 2)]
    files = [options.data / name for name in M3500]
    if all(path.exists() for path in files):
        bases.insert(0, (read_recording(*files), 1 if options.quick else 5))
    else:
        section.notes.append('M3500: the data is not there, skipped.')
    mixes = ((0.1, 1), (0.3, 1), (0.5, 1), (0.1, 10), (0.3, 10), (0.5, 10))
    for base, seeds in bases:
        wrong = {f'{base.name}, {100 * share:.0f} % {"groups" if group > 1 else "single"}':
                 (share, group) for share, group in (mixes[2:5:2] if options.quick else mixes)}
        wrong = {name: mix for name, mix in wrong.items() if options.wants(name)}
        if len(wrong) == 0:
            continue
        clean = judge(table, replace(base, name=f'{base.name}, none wrong'), everything=False)
        section.metrics.append(Metric(
            f'{base.name}: rms over that of what the file says', clean.rms / clean.right,
            target=1.05))
        for name, (share, group) in wrong.items():
            runs = [judge(table, replace(
                with_false(base, share, group, seed),
                name=f'{name}, seed {seed}'), everything=False, clean=clean.right)
                    for seed in range(seeds)]
            section.metrics += [
                Metric(f'{name}: rms over that without', max(
                    run.rms for run in runs) / clean.rms, target=1.05),
                Metric(f'{name}: wrong ones kept', max(run.wrong_kept for run in runs),
                       target=0.0),
                Metric(f'{name}: right ones lost, of 500', max(
                    500.0 * (1.0 - run.recall) for run in runs), target=1.0)]
    section.tables.append(table)
    return section


def peers(options: Options) -> Section:
    """Compare with GTSAM on the same graphs."""
    found = []
    files = [options.data / name for name in PLACES]
    if all(path.exists() for path in files):
        found.append(read_recording(*files))
    files = [options.data / name for name in M3500]
    base = (read_recording(*files) if all(path.exists() for path in files)
            else of_world(streets.grid()))
    mixes = ((0.1, 1),) if options.quick else ((0.1, 1), (0.3, 1), (0.5, 1), (0.3, 10))
    found += [replace(with_false(base, share, group, 0), name=f'{base.name}, {100 * share:.0f} % '
                      f'{"groups" if group > 1 else "single"}') for share, group in mixes]
    found.append(place_recognition(OUTDOORS, LOOSE, 2.5, 0))
    return robust_peers.section(
        [recording for recording in found if options.wants(recording.name)], limit=options.limit)


SECTIONS: dict[str, Callable[[Options], Section]] = {
    'places': places, 'worlds': worlds, 'arrivals': arrivals, 'gates': gates, 'grids': grids,
    'timing': lambda options: robust_timing.timing(quick=options.quick),
    'fixes': lambda options: robust_fixes.section(
        options.data, quick=options.quick, robust=options.fix_robust, cases=options.cases),
    'peers': peers}


LIMITS = Section(
    'What these figures do not show', 'The only recording of place recognition is B25b; the other '
    'drives with wrong closures are simulated, as are the wrong fixes of plaza 1, which are made '
    'of its truth. Times are those of one machine that may have had other work; ratios in '
    '*Beside GTSAM* are of runs right after one another. Other tools were looked for in PyPI and '
    'Debian: g2o-python 0.0.12 crashes where an information matrix is set (Python 3.11, NumPy 2), '
    'pyceres 2.6 has losses but nothing that chooses closures, and there is no kimera-rpgo. '
    'What cannot be decided stays wrong here too: closures that '
    'agree with one another within the error that odometry could have, and fixes that are dragged '
    'away no faster than odometry may drift.')


def _shown(arguments: list[str]) -> list[str]:
    """Return the arguments with names for folders, which are others elsewhere."""
    shown = list(arguments)
    for k in range(1, len(shown)):
        if shown[k - 1] in ('--data', '--out'):
            shown[k] = shown[k - 1][2:].upper()
    return shown


def main(arguments: list[str]) -> int:
    """Run the sections and write the page; return 1 if a figure is not what is asked for."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.robust', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--quick', action='store_true', help='few worlds, one seed: minutes')
    parser.add_argument('--only', choices=SECTIONS, action='append', help='only these sections')
    parser.add_argument('--data', type=Path, default=DATA, metavar='DIR',
                        help='folder with public data; what is not there is skipped')
    parser.add_argument('--recording', nargs=3, type=Path, action='append', default=[],
                        metavar=('GRAPH', 'TRUTH', 'STAMPS'),
                        help='a further recording of place recognition: two g2o files, and the '
                        'stamps of the nodes')
    parser.add_argument('--fix-robust', type=Robust, choices=tuple(Robust), metavar='ROBUST',
                        help='`robust` of fixes and poses: judged, loss or none, if not the '
                        'default')
    parser.add_argument('--case', action='append', default=[], metavar='TEXT',
                        help='of the sections fixes, grids and peers, only what has one of these '
                        'in its name; other rows of the page stay')
    parser.add_argument('--limit', type=float, default=60.0, metavar='S',
                        help='cut other tools after so many seconds (default: %(default)s)')
    parser.add_argument('--out', type=Path, default=Path('build/benchmark/robust'), metavar='DIR')
    chosen = parser.parse_args(arguments)
    options = Options(chosen.quick, chosen.data, tuple(map(tuple, chosen.recording)),
                      chosen.limit, chosen.out, chosen.fix_robust,
                      tuple(chosen.case))
    chosen.out.mkdir(parents=True, exist_ok=True)
    for name in chosen.only or SECTIONS:
        say(name)
        section = SECTIONS[name](options)
        section.notes.append(f'Made on {date.today().isoformat()} by `python -m '
                             f'benchmark.robust {shlex.join(_shown(arguments))}`.')
        sections = kept_sections.merged(
            options.out, {name: section}, tuple(SECTIONS), rows=len(options.cases) > 0)
    return report.conclude(
        [*sections, LIMITS], options.out, 'benchmark.robust', ['--data', 'DATA', '--out', 'OUT'],
        title='Wrong measurements', about=__doc__)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
