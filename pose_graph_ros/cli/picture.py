# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Draw a drive: a map of all paths, and below it (or beside a tall one) their errors over time.

A simulated one has the truth in place of a corrected path. A graph is drawn before and after its
optimisation.
"""

from pathlib import Path
from textwrap import fill
from typing import Any

from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter
import numpy as np

from pose_graph_ros.cli import drive as drives
from pose_graph_ros.cli.drive import distances, Drive, extent
from pose_graph_ros.cli.solved_graph import SolvedGraph
from pose_graph_ros.cli.truth import is_known
from pose_graph_ros.core.geometry import geodesy, trajectory
from pose_graph_ros.core.geometry.se2 import BoolArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.offline.simulation.recording import Recording, SimulatedGraph
from pose_graph_ros.offline.simulation.settings import CLOSURES, FIXES, POSES

# After Okabe and Ito, so that people with any kind of colour vision can distinguish them.
BLUE, ORANGE, VERMILION, GREEN, PURPLE = '#0072B2', '#E69F00', '#D55E00', '#009E73', '#B583A4'
SKY, INK, GREY, GRID, SHADE = '#56B4E9', '#222222', '#666666', '#E2E2E2', '#F0F0F0'
LOOPS = (  # states, name in the legend, colour, line, and order in depth
    ((drives.BELIEVED,), 'loop closures', GREEN, '-', 5),
    ((drives.WEAKLY_BELIEVED,), 'loop closures\nbelieved weakly', GREEN, '--', 5),
    ((drives.WAITING,), 'loop closures that wait,\nnot used', SKY, '--', 2),
    ((drives.DOUBTED, drives.REFUSED), 'doubted or refused\nloop closures, not used', GREY, '--',
     2))
USED_FIXES: dict[str, Any] = {
    'color': ORANGE, 'marker': 'o', 'linestyle': 'none', 'markeredgewidth': 0, 'alpha': 0.6}
DOUBTED_FIXES: dict[str, Any] = {
    'color': GREY, 'marker': 'x', 'linestyle': 'none', 'markersize': 5.5, 'markeredgewidth': 1.1}
HELD_OUT_FIXES: dict[str, Any] = {
    'color': 'none', 'marker': 'D', 'linestyle': 'none', 'markersize': 4.5,
    'markeredgecolor': VERMILION, 'markeredgewidth': 0.9}
STYLE: Any = {
    'font.size': 12, 'text.color': INK, 'axes.labelcolor': INK, 'axes.edgecolor': GREY,
    'xtick.color': GREY, 'ytick.color': GREY, 'grid.color': GRID, 'axes.grid': True,
    'axes.axisbelow': True, 'axes.spines.top': False, 'axes.spines.right': False,
    'legend.frameon': False, 'svg.fonttype': 'none',
    # the renderer keeps all pixels that a piece of a line touches, each time it does
    'agg.path.chunksize': 1000}
ERRORS = ListedColormap(colormaps['YlOrRd'](np.linspace(0.3, 1.0, 256)))
LEAST_ERROR = 0.1  # at least this error has the darkest colour [sigma]
MOST_LINES = 5000  # of each kind that an SVG picture has as lines, not as pixels


SIMULATED = {'doubted fixes, not used': 'fixes moved by a jump',
             'doubted or refused\nloop closures, not used': 'false loop closures'}
"""Names in the legend of what was simulated, by those of a drive."""


def draw_drive(drive: Drive, file: Path, title: str, names: dict[str, str] | None = None) -> None:
    """
    Draw a drive as a picture with a width of 1600 pixels, and write it to a file.

    In the legend some names may be other ones.
    """
    paths = [drive.corrected, *([] if drive.truth is None else [drive.truth])]
    near = np.concatenate([path.poses[:, :2] for path in paths])
    stray = np.concatenate((drive.placed_odometry.poses[:, :2], drive.fix_positions))
    if len(near) == 0:
        near = stray if len(stray) else np.zeros((1, 2))
    low, high = near.min(axis=0), near.max(axis=0)
    margin = max(0.2 * float(np.max(high - low)), 5.0)
    # what strays far from what must be in it is cut off
    shown = np.concatenate((near, np.clip(stray, low - margin, high + margin)))
    low, high = shown.min(axis=0), shown.max(axis=0)
    pad = max(0.03 * float(np.max(high - low)), 1.0)
    low, high = low - pad, high + pad
    wide, tall = (high - low).tolist()
    with rc_context(STYLE):
        is_tall, height = tall > 1.15 * wide, float(np.clip(12.0 * tall / wide, 4.5, 9.0))
        figure = Figure(figsize=(16.0, 10.0 if is_tall else height + 4.5), dpi=100,
                        layout='constrained')
        plan, errors = (figure.subplots(1, 2, width_ratios=(1.0, 1.5)) if is_tall else
                        figure.subplots(2, 1, height_ratios=(height, 2.5)))
        _draw_map(plan, drive)
        plan.set_aspect('equal', anchor='NW')
        plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        if names is None:
            # beside a tall map there is the title of the errors
            facts = fill(_facts(drive), 44) if is_tall else _facts(drive)
            plan.set_title(facts, loc='left', fontsize=12, color=GREY)
        handles, labels = plan.get_legend_handles_labels()
        for name, other in (names or {}).items():
            labels = [label.replace(name, other) for label in labels]
        figure.legend(handles, labels, loc='outside right upper', labelspacing=0.9,
                      alignment='left', title=_compared(drive)[1])
        _draw_errors(errors, drive)
        figure.suptitle(title, x=0.01, ha='left', fontsize=18, fontweight='bold', parse_math=False)
        figure.savefig(file)


def _facts(drive: Drive) -> str:
    """Return the subtitle: duration, length and numbers of measurements."""
    path = max(drive.corrected, drive.odometry, key=len)
    numbers = {kind: int(np.sum(chosen)) for kind, chosen in drive.fix_kinds.items()
               if kind != 'refused'}
    doubted, waiting = (int(np.sum(np.isin(drive.loop_states, states)))
                        for states in ((drives.DOUBTED, drives.REFUSED), (drives.WAITING,)))
    parts = [f'{numbers.pop("used")} fixes used' + ''.join(
        f', {number} {kind}' for kind, number in numbers.items() if number > 0),
        f'{len(drive.loop_stamps_ns) - doubted - waiting} loop closures' + ''.join(
            f', {number} {what}' for number, what in ((doubted, 'not used'), (waiting, 'waiting'))
            if number > 0)]
    if len(path) > 1:
        duration, distance = extent(path)
        parts[:0] = f'{duration:.0f} s', f'{distance:.0f} m'
    return '   ·   '.join(parts)


def _compared(drive: Drive) -> tuple[str, str | None]:
    """Return what paths are compared with in the legend, and the title of that."""
    names = {row.name for row in drive.rows}
    for name in ('truth', 'fixes held out', 'fixes used'):
        if f'odometry alone to {name}' in names or f'corrected path to {name}' in names:
            return name, f'distance to {name}'
    return '', None


def _draw_map(axes: Axes, drive: Drive) -> None:
    """Draw all paths and measurements, with median and rms of the errors in the legend."""
    rows, (reference, _) = {row.name: row for row in drive.rows}, _compared(drive)

    def label(name: str) -> str:
        if (row := rows.get(f'{name} to {reference}')) is None:
            return name
        digits = 2 if row.rms < 10.0 else 1
        return f'{name}\nmedian {row.median:.{digits}f} m, rms {row.rms:.{digits}f} m'

    path = drive.corrected if drive.truth is None or len(drive.corrected) > 0 else drive.truth
    if len(drive.corrected) > 0:
        axes.plot(*thinned(path.poses[:, :2]).T, color=BLUE, linewidth=3.4,
                  solid_capstyle='round', zorder=3, label=label('corrected path'))
    if drive.truth is not None:
        axes.plot(*thinned(drive.truth.poses[:, :2]).T, color=INK, linewidth=0.8,
                  linestyle=(0, (6, 4)), zorder=4, label='truth')
    axes.plot(*thinned(drive.placed_odometry.poses[:, :2]).T, color=PURPLE, linewidth=1.3,
              zorder=1, label=label('odometry alone'))
    kinds = drive.fix_kinds
    for chosen, style, name in (
            (kinds['used'], {**USED_FIXES, 'markersize': 4.5}, label('fixes')),
            (kinds['doubted'], DOUBTED_FIXES, label('doubted fixes').replace(
                'doubted fixes', 'doubted fixes, not used')),
            (kinds['held out'], HELD_OUT_FIXES, 'fixes held out')):
        if np.any(chosen):
            axes.plot(*thinned(drive.fix_positions[chosen]).T, **style, zorder=2, label=name)
    inside = np.all(path.covers(drive.loop_stamps_ns), axis=1)
    for states, name, colour, line, order in LOOPS:
        shown = inside & np.isin(drive.loop_states, states)
        if np.any(shown):
            ends = path.at(thinned(drive.loop_stamps_ns[shown]))[..., :2]
            apart = np.full((len(ends), 1, 2), np.nan)
            axes.plot(*np.concatenate((ends, apart), axis=1).reshape(-1, 2).T, linestyle=line,
                      color=colour, linewidth=1.2, marker='o', markerfacecolor='none',
                      markersize=7, markeredgewidth=1.3, zorder=order, label=name)
    for name, pose, marker, side in zip(('start', 'end'), path.poses[[0, -1]] if len(path) else (),
                                        'os', (1, -1), strict=False):
        axes.plot(*pose[:2], marker, color='white', markeredgecolor=INK, markersize=10,
                  markeredgewidth=2.0, zorder=6)
        axes.annotate(name, pose[:2], (0, 12 * side), textcoords='offset points', ha='center',
                      va='bottom' if side > 0 else 'top', fontsize=13, fontweight='bold', zorder=7,
                      path_effects=[withStroke(linewidth=3.5, foreground='white')])
    axes.set(xlabel=f'{drive.map_axes[0]} [m]', ylabel=f'{drive.map_axes[1]} [m]')


def _draw_errors(axes: Axes, drive: Drive) -> None:
    """Draw distances over time to the truth, else to the fixes, else to the corrected path."""
    truth, result, odometry = drive.truth, drive.corrected, drive.placed_odometry
    paths = [path for path in (odometry, result) if len(path)]
    begin = min((int(path.stamps_ns[0]) for path in paths), default=0)
    end = max((int(path.stamps_ns[-1]) for path in paths), default=10**9)
    of_odometry = {'color': PURPLE, 'linewidth': 1.2, 'zorder': 2}
    of_result = {'color': BLUE, 'linewidth': 2.2, 'zorder': 3}
    stamps, positions = drive.fix_stamps_ns, drive.fix_positions
    doubted, held_out = drive.fix_kinds['doubted'], drive.fix_kinds['held out']
    if truth is not None:
        target, true = 'the truth', (truth.stamps_ns, truth.poses[:, :2])
        known = is_known(truth, stamps)
        lines = [(odometry, *true, of_odometry),
                 (truth, stamps[known & ~doubted], positions[known & ~doubted],
                  {**USED_FIXES, 'markersize': 3}),
                 (truth, stamps[known & doubted], positions[known & doubted], DOUBTED_FIXES),
                 (result, *true, of_result)]
    elif len(stamps) == 0:
        target = 'the corrected path'
        lines = [(odometry, result.stamps_ns, result.poses[:, :2], of_odometry)]
    else:
        target = 'the fixes'
        lines = [(odometry, stamps, positions, of_odometry),
                 (result, stamps, positions, of_result),
                 (result, stamps[held_out], positions[held_out], HELD_OUT_FIXES)]
    highest = []
    for path, line_stamps, line_positions, style in lines:
        covered, errors = distances(path, line_stamps, line_positions)
        axes.plot((thinned(covered) - begin) * 1e-9, thinned(errors), **style)
        highest.append(float(np.percentile(errors, 99.0)) if len(errors) else 0.0)
    axes.set_xlim(0.0, max((end - begin) * 1e-9, 1.0))
    if highest[0] > 4.0 * max(highest[1:], default=0.0) > 0.0:
        axes.set_yscale('log')
        axes.set_ylim(0.05, 1.5 * highest[0])
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    else:
        axes.set_ylim(0.0, max(1.15 * max(highest), 0.1))
    axes.set(xlabel='time [s]', ylabel='distance [m]')
    axes.set_title(f'distance to {target}', loc='left', fontsize=13, fontweight='bold')
    used = np.sort(drive.fix_stamps_ns[drive.fix_kinds['used']])
    used = used[(used > begin) & (used < end)]
    # no fixes were used for 5 s and 10 median periods
    edges = (np.concatenate(([begin], used, [end])) - begin) * 1e-9
    pauses = np.diff(edges)
    long = len(used) >= 3 and pauses > max(5.0, 10.0 * float(np.median(pauses)))
    for k in np.flatnonzero(long).tolist():
        axes.axvspan(float(edges[k]), float(edges[k + 1]), color=SHADE, zorder=0)
        axes.set_title('shaded: no fixes used', loc='right', fontsize=12, color=GREY)


def thinned(points: np.ndarray) -> np.ndarray:
    """Return every n-th point, at most 20 000: more take hundreds of MB, and do not show."""
    return points[::max(-(-len(points) // 20_000), 1)]


def draw_simulated(simulated: SimulatedGraph | Recording, file: Path, title: str) -> None:
    """Draw what was simulated: what is false or moved looks as if it were doubted."""
    truth = simulated.truth
    if isinstance(simulated, SimulatedGraph):
        odometry = trajectory.Trajectory(truth.stamps_ns, simulated.start)
        ends = truth.stamps_ns[np.column_stack((simulated.loops.i, simulated.loops.j))]
        group, stamps = simulated.group, truth.stamps_ns[simulated.observed.i]
        measured = simulated.observed.mean[:, :2]
        wrong = np.isin(np.arange(len(measured)), simulated.wrong)
    else:
        odometry = simulated.odometry
        fixes, poses, closures = (simulated.measured[topic] for topic in (FIXES, POSES, CLOSURES))
        ends, group, measured = closures.stamps_ns, closures.wrong, poses.values[:, :2]
        if len(fixes.values) > 0:
            plane = geodesy.TangentPlane(*fixes.values[0].tolist())
            measured = np.concatenate((plane.to_map(*fixes.values.T), measured))
        stamps = np.append(fixes.stamps_ns, poses.stamps_ns)
        wrong = np.append(fixes.wrong, poses.wrong) >= 0
    nothing = trajectory.Trajectory(np.empty(0, dtype=np.int64), np.empty((0, 3)))
    fix_states, loop_states = (np.where(false, drives.DOUBTED, drives.BELIEVED)
                               for false in (wrong, group >= 0))
    draw_drive(Drive(odometry, nothing, truth, stamps, measured, fix_states, [''] * len(
        stamps), ends, loop_states, [''] * len(ends)), file, title, SIMULATED)


def draw_solved(solved: SolvedGraph, file: Path, title: str) -> None:
    """Draw a graph before and after its optimisation, closures coloured by their error after."""
    wide, tall = np.maximum(np.ptp(solved.after[:, :2], axis=0), 1e-9).tolist()
    used = solved.off[solved.is_closure & ~solved.is_doubted]
    # a few that are far off would make all others look alike
    most = max([LEAST_ERROR, *(np.percentile(used, [99.0]) if len(used) > 0 else ())])
    shades = ScalarMappable(Normalize(0.0, most), ERRORS)
    beside = tall > 0.6 * wide
    with rc_context(STYLE):
        size = (16.0, 9.0) if beside else (16.0, float(np.clip(30.0 * tall / wide + 3.0, 8.0, 20)))
        figure = Figure(figsize=size, dpi=100, layout='constrained')
        plans = figure.subplots(*((1, 2) if beside else (2, 1)))
        for plan, poses, name, chi2 in (
                (plans[0], solved.before, 'as read', solved.chi2_before),
                (plans[1], solved.after, 'optimised', solved.result.chi2)):
            _draw_graph(plan, solved, poses, shades)
            plan.set_title(f'{name}: chi2 {chi2:.6g}', loc='left', fontsize=13, fontweight='bold')
        handles, labels = plans[1].get_legend_handles_labels()
        figure.legend(handles, labels, loc='outside lower left', ncols=5)
        if len(used) > 0:
            figure.colorbar(shades, ax=plans, shrink=0.7, aspect=40, extend='max').set_label(
                'error of a constraint after the optimisation [sigma]')
        figure.suptitle(title, x=0.01, ha='left', fontsize=18, fontweight='bold', parse_math=False)
        figure.savefig(file)


def _draw_graph(axes: Axes, solved: SolvedGraph, poses: Poses, shades: ScalarMappable) -> None:
    """Draw all constraints of a graph at some poses, the worst on top."""
    factors, off, used = solved.factors, solved.off, ~solved.is_doubted
    to_landmarks = solved.is_closure & ~solved.is_pose[factors.j]
    looks: tuple[tuple[str, BoolArray, dict[str, Any]], ...] = (
        ('odometry', solved.is_odometry, {'colors': BLUE, 'linewidths': 1.0, 'zorder': 2}),
        ('doubted loop closures, not used', solved.is_doubted, {
            'colors': GREY, 'linewidths': 0.9, 'linestyles': '--', 'zorder': 1, 'alpha': 0.8}),
        ('sightings of landmarks', to_landmarks & used, {'linewidths': 0.7, 'zorder': 3}),
        ('loop closures', solved.is_closure & ~to_landmarks & used,
         {'linewidths': 1.3, 'zorder': 4}))
    for name, chosen, look in looks:
        rows = np.flatnonzero(chosen)
        rows = rows[np.argsort(off[rows], kind='stable')]
        if len(rows) > 0:
            axes.add_collection(LineCollection(
                [*poses[np.column_stack((factors.i[rows], factors.j[rows])), :2]], label=name,
                rasterized=len(rows) > MOST_LINES,
                **{'colors': shades.to_rgba(off[rows]), **look}))
    measured = factors.mean[np.isin(
        factors.kind, (FactorKind.GLOBAL_POSE, FactorKind.POSITION)), :2]
    for name, places, marker in (('landmarks', poses[~solved.is_pose, :2], 's'),
                                 ('measured positions', measured, 'o')):
        if len(places) > 0:
            axes.plot(*thinned(places).T, marker, color=ORANGE, markersize=3, label=name,
                      markeredgewidth=0, zorder=5)
    axes.autoscale_view()
    axes.set_aspect('equal', adjustable='datalim')
    axes.set(xlabel='x [m]', ylabel='y [m]')
