# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Is memory flat, is time: the sections on drives of hours, with their picture."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
import json
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np

from benchmark.metrics import ACCURACY, Metric
from benchmark.report import GREY, GRID, INK
from benchmark.section import say, Section, Table
from benchmark.window_day import CALLS, Hour, in_process
from benchmark.window_drive import Course
from benchmark.window_settings import UNLIMITED

HOURS = 24.0
GROWN, SLOWER = 1.05, 1.25
"""Ratios of the last hour to the first up to which memory and time count as flat."""
COLOURS = '#0072B2', '#E69F00', '#009E73', '#D55E00', '#CC79A7', '#56B4E9'
SIZE, DPI = (11.0, 3.4), 100
"""Of the picture [inch], and dots per inch."""
FILE, PICTURE = 'hours.json', 'hours.png'


@dataclass(frozen=True, slots=True)
class Case:
    """A drive of hours."""

    window: str
    """As in `window_settings`."""
    hours: float
    course: dict[str, object] = field(default_factory=dict)
    """What differs from the default course."""
    limited: bool = True
    """Whether it is asked to be flat."""


HALL = {'length': 200.0, 'laps_back': (1, 2, 5, 20, 100), 'closure_period': 5.0, 'aside': 0.1}
"""A closed hall, whose places are recognised however long ago they were seen."""
CASES = {
    'window of 10 minutes': Case('600 s', HOURS),
    'unlimited': Case(UNLIMITED, 2.0, limited=False),
    'hall, with thinning': Case('thinning 2 m', HOURS, HALL),
    'hall, correlated fixes, with thinning': Case(
        'thinning 2 m', 4.0, HALL | {'fix_tau': 20.0}),
    'hall, correlated fixes, unlimited': Case(
        UNLIMITED, 1.0, HALL | {'fix_tau': 20.0}, limited=False),
    'hall, unlimited': Case(UNLIMITED, 2.0, HALL, limited=False)}


def section(
    *, hours: float | None, cases: Sequence[str], folder: Path, rate: float = 50.0,
) -> Section:
    """
    Drive for hours.

    Parameters
    ----------
    hours : float, optional, length of the drives instead of their own [h]
    cases : sequence of str, only cases whose names hold one of these; all if empty
    folder : Path, where picture and figures go; those of other cases are kept
    rate : float, of odometry [Hz]

    """
    found = Section(
        'A day', f'Odometry at {rate:.0f} Hz, fixes at 5 Hz, a loop closure every 10 s (in the '
        'hall every 5 s, up to 100 laps back), an update every half second, with default '
        'settings, each drive in a process of its own; correlated fixes have a time constant of '
        '20 s. Resident memory of the process after a garbage collection, with Python, NumPy and '
        'compiled code; '
        f'mean times of calls. Flat means: the last hour at most {GROWN:g} times the memory and '
        f'{SLOWER:g} times the time of an update of the first.')
    file = folder / FILE
    kept: dict[str, list[dict[str, object]]] = (
        json.loads(file.read_text(encoding='utf-8')) if file.exists() else {})
    for name, case in CASES.items():
        if len(cases) > 0 and not any(part in name for part in cases):
            continue
        # written hour by hour, so that a drive may be cut short
        rows = kept[name] = []
        for hour in _drive(name, case, hours or case.hours, rate):
            rows.append(asdict(hour))
            file.write_text(json.dumps(kept, indent=1) + '\n', encoding='utf-8')
    made = {name: [Hour(**values) for values in rows]   # type: ignore[arg-type]
            for name, rows in kept.items() if name in CASES}
    _fill(found, made)
    _draw(made, folder / PICTURE)
    found.notes.append(f'![Memory and time by hour]({PICTURE})')
    return found


def _drive(name: str, case: Case, hours: float, rate: float) -> Iterator[Hour]:
    course = Course(3600.0 * hours, odometry_rate=rate, **case.course)  # type: ignore[arg-type]
    for hour in in_process(course, case.window, min(1.0, hours / 4.0)):
        say(f'  {name}: {hour.hours:.2f} h, {hour.resident:.1f} MB, {hour.nodes} nodes, update '
            f'{1e-3 * hour.mean["update"]:.2f} ms, rms {hour.rms:.2f} m')
        yield hour


def _fill(found: Section, made: dict[str, list[Hour]]) -> None:
    """Add tables and figures."""
    times = Table('By hour', ('drive', 'hour', 'resident MB', 'nodes', 'edges', 'observed',
                              'cliques MB', *(f'{call} us' for call in CALLS), 'update p99 ms',
                              'max', 'rms m'))
    owners = Table('What has grown since the first hour', ('drive', 'owner', 'first hour kB',
                                                           'last hour kB'))
    for name, hours in made.items():
        chosen = {0, 1, 2, len(hours) // 2, len(hours) - 1}
        for k in sorted(k for k in chosen if k < len(hours)):
            hour = hours[k]
            times.add(name, f'{hour.hours:g}', f'{hour.resident:.1f}', str(hour.nodes),
                      str(hour.edges), str(hour.observed), f'{hour.pool:.2f}',
                      *(f'{hour.mean[call]:.0f}' for call in CALLS), f'{hour.p99:.1f}',
                      f'{hour.longest:.0f}', f'{hour.rms:.3f}')
        first, last = hours[0], hours[-1]
        grown = {owner: size - first.owners.get(owner, 0) for owner, size in last.owners.items()}
        for owner in sorted(grown, key=lambda owner: -grown[owner])[:5]:
            owners.add(name, owner, f'{1e-3 * first.owners.get(owner, 0):.0f}',
                       f'{1e-3 * last.owners[owner]:.0f}')
        refused = {answer: n for answer, n in last.answers.items() if 'accepted' not in answer}
        found.notes.append(f'{name}, answers: {last.answers}' if refused else
                           f'{name}: all measurements were accepted.')
        if CASES[name].limited:
            found.metrics += [
                Metric(f'{name}: memory, hour {last.hours:g} over hour {first.hours:g}',
                       last.resident / first.resident, '', ACCURACY, GROWN),
                Metric(f'{name}: mean update, hour {last.hours:g} over hour {first.hours:g}',
                       last.mean['update'] / first.mean['update'], '', ACCURACY, SLOWER),
                Metric(f'{name}: memory at the end', last.resident, ' MB', ACCURACY)]
    found.tables = [times, owners]


def _draw(made: dict[str, list[Hour]], file: Path) -> None:
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor='white', layout='constrained')
    FigureCanvasAgg(figure)
    panels = {'resident memory [MB]': lambda hour: hour.resident,
              'mean time of an update [ms]': lambda hour: 1e-3 * hour.mean['update'],
              'nodes in the graph': lambda hour: hour.nodes}
    for axes, (title, value) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        for (name, hours), colour in zip(made.items(), COLOURS, strict=False):
            axes.plot([hour.hours for hour in hours], [value(hour) for hour in hours],
                      color=colour, linewidth=1.6, marker='.', markersize=4, label=name)
        axes.set_title(title, loc='left', fontsize=10, fontweight='bold', color=INK)
        axes.set_xlabel('hour', fontsize=9)
        axes.set_ylim(bottom=0.0, top=1.15 * float(np.max(axes.get_ylim())))
        axes.spines[['top', 'right']].set_visible(False)
        axes.tick_params(colors=GREY, labelsize=9)
        axes.grid(color=GRID, linewidth=0.8)
    figure.axes[0].legend(frameon=False, fontsize=8, loc='lower right')
    figure.savefig(file)
