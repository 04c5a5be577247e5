# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Draw a drive: a map of all paths, and below it (or beside a tall one) their errors over time.

A simulated one is a map alone: the true path, and what was measured there.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MultipleLocator
import numpy as np

from pose_graph_ros.cli.evaluation import distances, Drive, evaluate, place_odometry
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.offline.simulation.graph import SimulatedGraph
from pose_graph_ros.offline.simulation.recording import Recording

# After Okabe and Ito, so that people with any kind of colour vision can distinguish them.
BLUE, ORANGE, VERMILION, GREEN, PURPLE = '#0072B2', '#E69F00', '#D55E00', '#009E73', '#B583A4'
INK, GREY, GRID, SHADE = '#222222', '#666666', '#E2E2E2', '#F0F0F0'
WIDTH, DPI = 16.0, 100  # width of the picture [inch] and resolution [dots per inch]
LEFT, RIGHT, TOP, BETWEEN, BOTTOM = 0.8, 0.3, 0.95, 1.05, 0.6  # margins of the panels [inch]
LEGEND_WIDTH, ERROR_HEIGHT = 2.9, 2.5  # of the legend and of the plot of errors [inch]
MAP_HEIGHTS = (4.5, 9.0)  # smallest and largest height of the map [inch]
TALL, TALL_HEIGHT, TALL_WIDTHS = 1.15, 8.4, (4.5, 7.5)
"""Smallest ratio of height to width for a map beside the errors; its height and widths [inch]."""
OUTAGE_S = 5.0  # an outage is a time without fixes above this [s] and above 10 median periods
MIN_FIXES = 3  # with fewer fixes no outages are shown
SECOND = 10**9  # one second [ns]
MOST_POINTS = 20_000
"""Of a line or a kind of marks: more take hundreds of MB, and do not show."""
TICK_SPACING = 1.6  # largest spacing of the grid of the map [inch]
TWO_DIGITS = 10.0  # errors below this are shown with two digits after the point [m]
LOG_RATIO = 4.0  # if errors of odometry exceed others by this factor, the axis is logarithmic
SKY = '#56B4E9'  # also after Okabe and Ito; markers that wait are blue as well
LOOPS = (
    ('loop closures', (State.BELIEVED,), GREEN, '-', 5),
    ('loop closures\nbelieved weakly', (State.WEAKLY_BELIEVED,), GREEN, '--', 5),
    ('loop closures that wait,\nnot used', (State.WAITING,), SKY, '--', 2),
    ('doubted or refused\nloop closures, not used', (State.DOUBTED,), GREY, '--', 2))
"""Names of loop closures in the legend, states, colours, lines, and their order in depth."""
DOUBTED_FIXES: dict[str, Any] = {
    'color': GREY, 'marker': 'x', 'linestyle': 'none', 'markersize': 5.5, 'markeredgewidth': 1.1}
LOG_FLOOR = 0.05  # lower end of a logarithmic error axis [m]
LONG_SIDE, OTHER_SIDE = 8.0, (4.0, 8.0)  # of the map [inch]
LEGEND = 0.9  # height of title and legend [inch]


def draw_drive(drive: Drive, file: Path, title: str) -> None:
    """
    Draw a drive as a picture with a width of 1600 pixels, and write it to a file.

    Parameters
    ----------
    file : Path, its suffix (`.png`, `.svg`, `.pdf`) determines the format

    """
    odometry = place_odometry(drive)
    low, high = _limits(drive, odometry)
    ratio = float((high - low)[1] / (high - low)[0])
    if ratio > TALL:
        size = np.array([np.clip(TALL_HEIGHT / ratio, *TALL_WIDTHS), TALL_HEIGHT])
        height = TOP + TALL_HEIGHT + BOTTOM
        left, error_height = LEFT + size[0] + BETWEEN, 0.6 * TALL_HEIGHT
    else:
        width = WIDTH - LEFT - RIGHT - LEGEND_WIDTH
        size = np.array([width, np.clip(width * ratio, *MAP_HEIGHTS)])
        height = TOP + size[1] + BETWEEN + ERROR_HEIGHT + BOTTOM
        left, error_height = LEFT, ERROR_HEIGHT
    figure = Figure(figsize=(WIDTH, height), dpi=DPI, facecolor='white')
    FigureCanvasAgg(figure)
    plan = _add_axes(figure, (LEFT, height - TOP - size[1], *size))
    errors = _add_axes(figure, (left, BOTTOM, WIDTH - RIGHT - left, error_height))
    _draw_map(plan, drive, odometry)
    metres_per_inch = float(np.max((high - low) / size))
    middle, half = 0.5 * (low + high), 0.5 * metres_per_inch * size
    plan.set(xlim=(middle[0] - half[0], middle[0] + half[0]),
             ylim=(middle[1] - half[1], middle[1] + half[1]))
    for axis in (plan.xaxis, plan.yaxis):
        axis.set_major_locator(MultipleLocator(_nice_step(TICK_SPACING * metres_per_inch)))
    _draw_errors(errors, drive, odometry)
    figure.text(LEFT / WIDTH, 1.0 - 0.2 / height, title, fontsize=18, fontweight='bold',
                color=INK, va='top', parse_math=False)
    figure.text(
        LEFT / WIDTH, 1.0 - 0.57 / height, _facts(drive), fontsize=12, color=GREY, va='top')
    # the renderer keeps all pixels that a piece of a line touches, each time it does
    with rc_context({'agg.path.chunksize': 1000}):
        figure.savefig(file)


def _add_axes(figure: Figure, box: tuple[float, float, float, float]) -> Axes:
    """Add a panel with a box (left, bottom, width, height) in inches."""
    width, height = figure.get_size_inches()
    left, bottom, box_width, box_height = box
    axes = figure.add_axes((left / width, bottom / height, box_width / width, box_height / height))
    axes.spines[['top', 'right']].set_visible(False)
    axes.spines[['left', 'bottom']].set_color(GREY)
    axes.tick_params(which='both', colors=GREY, labelsize=11)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    return axes


def _limits(drive: Drive, odometry: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return two corners of the map; odometry and fixes far from the other paths are cut off."""
    paths = [drive.corrected, *([] if drive.truth is None else [drive.truth])]
    near = np.concatenate([path.poses[:, :2] for path in paths])
    stray = np.concatenate((odometry.poses[:, :2], drive.fix_positions))
    if len(near) == 0:
        near = stray if len(stray) else np.zeros((1, 2))
    low, high = near.min(axis=0), near.max(axis=0)
    margin = max(0.2 * float(np.max(high - low)), 5.0)
    shown = np.concatenate((near, np.clip(stray, low - margin, high + margin)))
    low, high = shown.min(axis=0), shown.max(axis=0)
    pad = max(0.03 * float(np.max(high - low)), 1.0)
    return low - pad, high + pad


def _nice_step(step: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20 and so on that is at most the step, at least 1."""
    power = 10.0 ** np.floor(np.log10(max(step, 1.0)))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= max(step, 1.0)))


def _facts(drive: Drive) -> str:
    """Return the subtitle: duration, length and numbers of measurements."""
    path = max(drive.corrected, drive.odometry, key=len)
    steps = np.diff(path.poses[:, :2], axis=0)
    numbers = {kind: int(np.sum(chosen)) for kind, chosen in drive.fix_kinds.items()}
    doubted, waiting = (
        int(np.sum(drive.loops(state))) for state in (State.DOUBTED, State.WAITING))
    parts = [f'{numbers.pop("used")} fixes used' + ''.join(
        f', {number} {kind}' for kind, number in numbers.items() if number > 0),
        f'{len(drive.loop_stamps_ns) - doubted - waiting} loop closures' + ''.join(
            f', {number} {what}' for number, what in ((doubted, 'not used'), (waiting, 'waiting'))
            if number > 0)]
    if len(path) > 1:
        parts[:0] = (f'{(path.stamps_ns[-1] - path.stamps_ns[0]) / SECOND:.0f} s',
                     f'{np.sum(np.hypot(steps[:, 0], steps[:, 1])):.0f} m')
    return '   ·   '.join(parts)


def _draw_map(axes: Axes, drive: Drive, odometry: Trajectory) -> None:
    """Draw all paths and measurements, with median and rms of the errors in the legend."""
    rows = {row.name: row for row in evaluate(drive)}
    reference = next(
        (name for name in ('truth', 'fixes held out', 'fixes used')
         if f'corrected path to {name}' in rows), '')

    def label(name: str) -> str:
        row = rows.get(f'{name} to {reference}')
        if row is None:
            return name
        digits = 2 if row.rms < TWO_DIGITS else 1
        return f'{name}\nmedian {row.median:.{digits}f} m, rms {row.rms:.{digits}f} m'

    path = drive.corrected
    axes.plot(*thinned(path.poses[:, :2]).T, color=BLUE, linewidth=3.4, solid_capstyle='round',
              zorder=3, label=label('corrected path'))
    if drive.truth is not None:
        axes.plot(*thinned(drive.truth.poses[:, :2]).T, color=INK, linewidth=0.8,
                  linestyle=(0, (6, 4)), zorder=4, label='truth')
    axes.plot(*thinned(odometry.poses[:, :2]).T, color=PURPLE, linewidth=1.3, zorder=1,
              label=label('odometry alone'))
    used, doubted, held_out = (
        thinned(drive.fix_positions[chosen]) for chosen in drive.fix_kinds.values())
    if len(used):
        axes.plot(*used.T, 'o', color=ORANGE, markersize=4.5, markeredgewidth=0, alpha=0.55,
                  zorder=2, label=label('fixes'))
    if len(doubted):
        axes.plot(*doubted.T, **DOUBTED_FIXES, zorder=2, label=label('doubted fixes').replace(
            'doubted fixes', 'doubted fixes, not used'))
    if len(held_out):
        axes.plot(*held_out.T, 'D', color='none', markeredgecolor=VERMILION, markersize=4.5,
                  markeredgewidth=0.9, zorder=2, label='fixes held out')
    inside = np.all(path.covers(drive.loop_stamps_ns), axis=1)
    for name, states, colour, line, order in LOOPS:
        shown = inside & drive.loops(*states)
        if np.any(shown):
            ends = path.at(thinned(drive.loop_stamps_ns[shown]))[..., :2]
            apart = np.full((len(ends), 1, 2), np.nan)
            axes.plot(*np.concatenate((ends, apart), axis=1).reshape(-1, 2).T, linestyle=line,
                      color=colour, linewidth=1.2, marker='o', markerfacecolor='none',
                      markersize=7, markeredgewidth=1.3, zorder=order, label=name)
    if len(path):
        for name, pose, marker in (('start', path.poses[0], 'o'), ('end', path.poses[-1], 's')):
            axes.plot(*pose[:2], marker, color='white', markeredgecolor=INK, markersize=10,
                      markeredgewidth=2.0, zorder=6)
            axes.annotate(
                name, pose[:2], (0, 12 if name == 'start' else -12), textcoords='offset points',
                ha='center', va='bottom' if name == 'start' else 'top', fontsize=13,
                fontweight='bold', color=INK, zorder=7,
                path_effects=[withStroke(linewidth=3.5, foreground='white')])
    axes.set_xlabel(f'{drive.map_axes[0]} [m]', fontsize=12, color=INK)
    axes.set_ylabel(f'{drive.map_axes[1]} [m]', fontsize=12, color=INK)
    legend = axes.legend(
        loc='upper left', bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=12,
        labelspacing=0.9, borderaxespad=0.0, labelcolor=INK, alignment='left',
        title=f'distance to {reference}' if reference else None, title_fontsize=12)
    legend.get_title().set_color(GREY)


def _draw_errors(axes: Axes, drive: Drive, odometry: Trajectory) -> None:
    """Draw distances over time to the truth, else to the fixes, else to the corrected path."""
    paths = [path for path in (odometry, drive.corrected) if len(path)]
    begin = min((int(path.stamps_ns[0]) for path in paths), default=0)
    end = max((int(path.stamps_ns[-1]) for path in paths), default=SECOND)
    odometry_style = {'color': PURPLE, 'linewidth': 1.2, 'zorder': 2}
    fixes_style = {'color': ORANGE, 'marker': 'o', 'markersize': 3, 'markeredgewidth': 0,
                  'linestyle': 'none', 'alpha': 0.6, 'zorder': 1}
    corrected_style = {'color': BLUE, 'linewidth': 2.2, 'zorder': 3}
    held_out_style = {'color': 'none', 'marker': 'D', 'markeredgecolor': VERMILION,
                     'markersize': 4, 'linestyle': 'none', 'zorder': 4}
    truth, result, held_out = drive.truth, drive.corrected, drive.fix_held_out
    stamps, positions = drive.fix_stamps_ns, drive.fix_positions
    doubted = drive.fix_kinds['doubted']
    lines: list[tuple[Trajectory, IntArray, FloatArray, dict[str, Any]]]
    if truth is not None:
        target = 'the truth'
        lines = [(odometry, truth.stamps_ns, truth.poses[:, :2], odometry_style),
                 (truth, stamps[~doubted], positions[~doubted], fixes_style),
                 (truth, stamps[doubted], positions[doubted], {**DOUBTED_FIXES, 'zorder': 1}),
                 (result, truth.stamps_ns, truth.poses[:, :2], corrected_style)]
    elif len(stamps) == 0:
        target = 'the corrected path'
        lines = [(odometry, result.stamps_ns, result.poses[:, :2], odometry_style)]
    else:
        target = 'the fixes'
        lines = [(odometry, stamps, positions, odometry_style),
                 (result, stamps, positions, corrected_style),
                 (result, stamps[held_out], positions[held_out], held_out_style)]

    highest = []
    for path, line_stamps, line_positions, style in lines:
        covered, errors = distances(path, line_stamps, line_positions)
        axes.plot((thinned(covered) - begin) * 1e-9, thinned(errors), **style)
        highest.append(float(np.percentile(errors, 99.0)) if len(errors) else 0.0)
    axes.set_xlim(0.0, max((end - begin) * 1e-9, 1.0))
    if highest[0] > LOG_RATIO * max(highest[1:], default=0.0) > 0.0:
        axes.set_yscale('log')
        axes.set_ylim(LOG_FLOOR, 1.5 * highest[0])
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    else:
        axes.set_ylim(0.0, max(1.15 * max(highest), 0.1))
    axes.set_xlabel('time [s]', fontsize=12, color=INK)
    axes.set_ylabel('distance [m]', fontsize=12, color=INK)
    axes.set_title(f'distance to {target}', loc='left', fontsize=13, fontweight='bold', color=INK)
    for outage in _outages(drive, begin, end):
        axes.axvspan(*outage, color=SHADE, zorder=0)
        axes.set_title('shaded: no fixes used', loc='right', fontsize=12, color=GREY)


def thinned(points: np.ndarray) -> np.ndarray:
    """Return every n-th point, from the first on, so that there are not too many to draw."""
    return points[::max(-(-len(points) // MOST_POINTS), 1)]


def _outages(drive: Drive, begin: int, end: int) -> list[tuple[float, float]]:
    """Return begin and end of the outages of the fixes in the pose graph [s]."""
    used = np.sort(drive.fix_stamps_ns[drive.fix_kinds['used']])
    used = used[(used > begin) & (used < end)]
    if len(used) < MIN_FIXES:
        return []
    edges = (np.concatenate(([begin], used, [end])) - begin) * 1e-9
    pauses = np.diff(edges)
    long = pauses > max(OUTAGE_S, 10.0 * float(np.median(pauses)))
    return list(zip(edges[:-1][long].tolist(), edges[1:][long].tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class Scene:
    """What is drawn, in the map."""

    truth: FloatArray
    """True positions, shape (N, 2)."""
    odometry: FloatArray
    """Positions by odometry from the true start, shape (M, 2)."""
    ends: FloatArray
    """True positions of both ends of closures, shape (L, 2, 2)."""
    group: IntArray
    """Number of the group of false ones, -1: true, shape (L,)."""
    absolute: FloatArray
    """Fixes and global poses, shape (P, 2)."""
    wrong: BoolArray
    """Which of them are moved by a jump, shape (P,)."""


def scene_of_recording(drive: Recording) -> Scene:
    """Return what is to be drawn of a recording."""
    truth, odometry = drive.truth, drive.odometry
    begin = max(truth.stamps_ns[0], odometry.stamps_ns[0])
    moved = se2.compose(truth.at(begin), se2.inverse(odometry.at(begin)))
    ends = truth.at(np.clip(drive.loop_stamps_ns, truth.stamps_ns[0], truth.stamps_ns[-1]))
    fixes = np.empty((0, 2))
    if len(drive.fixes) > 0:
        fixes = TangentPlane(*drive.fixes[0].tolist()).to_map(*drive.fixes.T)
    return Scene(truth.poses[:, :2], se2.compose(moved, odometry.poses)[:, :2], ends[..., :2],
                 drive.loop_group, np.concatenate((fixes, drive.poses[:, :2])),
                 np.append(drive.fix_is_wrong, drive.pose_is_wrong))


def scene_of_graph(graph: SimulatedGraph) -> Scene:
    """Return what is to be drawn of a graph."""
    loops = graph.loops
    wrong = np.zeros(len(graph.observed), dtype=bool)
    wrong[graph.wrong] = True
    positions = graph.truth.poses[:, :2]
    return Scene(positions, graph.start[:, :2], positions[np.column_stack((loops.i, loops.j))],
                 graph.group, graph.observed.mean[:, :2], wrong)


def draw(scene: Scene, file: Path, title: str) -> None:
    """
    Write a picture of what was simulated.

    Parameters
    ----------
    file : Path, of a kind that matplotlib writes

    """
    near = scene.truth
    low, high = near.min(axis=0), near.max(axis=0)
    # odometry and fixes that are far away are cut off
    stray = np.concatenate((scene.odometry, scene.absolute, near))
    reach = 0.25 * float(np.max(high - low))
    low = np.maximum(stray.min(axis=0), low - reach)
    high = np.minimum(stray.max(axis=0), high + reach)
    pad = 0.03 * float(np.max(high - low)) + 1.0
    low, high = low - pad, high + pad
    size = LONG_SIDE * (high - low) / np.max(high - low)
    size = np.clip(size, *OTHER_SIDE)
    with rc_context({'font.size': 11, 'axes.edgecolor': GREY, 'axes.labelcolor': INK,
                     'xtick.color': GREY, 'ytick.color': GREY, 'svg.fonttype': 'none'}):
        figure = Figure(figsize=(size[0], size[1] + LEGEND), dpi=DPI, layout='constrained')
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        axes.grid(color=GRID)
        axes.set_axisbelow(True)
        axes.spines[['top', 'right']].set_visible(False)
        _draw_scene(axes, scene)
        axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal', xlim=(low[0], high[0]),
                 ylim=(low[1], high[1]))
        figure.suptitle(title, x=0.02, ha='left', color=INK, fontweight='bold')
        figure.legend(*axes.get_legend_handles_labels(), loc='outside lower left', ncols=3,
                      frameon=False, labelcolor=INK, fontsize=10)
        figure.savefig(file)


def _draw_scene(axes: Axes, scene: Scene) -> None:
    axes.plot(*thinned(scene.odometry).T, color=ORANGE, linewidth=1.0, zorder=2,
              label='odometry')
    right, wrong = scene.absolute[~scene.wrong], scene.absolute[scene.wrong]
    if len(right) > 0:
        axes.plot(*thinned(right).T, '.', color=GREY, markersize=3, zorder=3, alpha=0.6,
                  label='fixes, global poses')
    if len(wrong) > 0:
        axes.plot(*thinned(wrong).T, 'x', color=GREY, markersize=5, zorder=3,
                  label='those moved by a jump')
    axes.plot(*thinned(scene.truth).T, color=BLUE, linewidth=1.6, zorder=4, label='truth')
    true = scene.group < 0
    if np.any(true):
        axes.plot(*thinned(scene.ends[true, 1]).T, '.', color=GREEN, markersize=6, zorder=5,
                  label='true closures')
    numbers, sizes = np.unique(scene.group[~true], return_counts=True)
    in_group = np.isin(scene.group, numbers[sizes > 1])
    for chosen, style, name in ((~true & ~in_group, '--', 'false closures'),
                                (in_group, '-', 'false closures in groups')):
        if np.any(chosen):
            axes.add_collection(LineCollection(
                list(scene.ends[chosen]), colors=INK, linestyles=style, linewidths=0.9,
                zorder=6, label=name))
