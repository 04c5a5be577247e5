# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw what was simulated: a map of the true path, odometry, closures, fixes and global poses."""

from dataclasses import dataclass
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
import numpy as np

from pose_graph_ros.cli.picture import BLUE, GREEN, GREY, GRID, INK, ORANGE, thinned
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.offline.simulation.graph import SimulatedGraph
from pose_graph_ros.offline.simulation.recording import Recording

LONG_SIDE, OTHER_SIDE = 8.0, (4.0, 8.0)  # of the map [inch]
LEGEND, DPI = 0.9, 100  # height of title and legend [inch]; resolution [dots per inch]


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
        _draw_map(axes, scene)
        axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal', xlim=(low[0], high[0]),
                 ylim=(low[1], high[1]))
        figure.suptitle(title, x=0.02, ha='left', color=INK, fontweight='bold')
        figure.legend(*axes.get_legend_handles_labels(), loc='outside lower left', ncols=3,
                      frameon=False, labelcolor=INK, fontsize=10)
        figure.savefig(file)


def _draw_map(axes: Axes, scene: Scene) -> None:
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
