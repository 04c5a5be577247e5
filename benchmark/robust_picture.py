# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw a recording with its closures: what was believed, and what was not."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
import numpy as np

from benchmark.robust_closures import Recording, Run, TRUE
from pose_graph_ros.cli.picture import BLUE, GREEN, GREY, INK, PURPLE, VERMILION
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import fit_motion, Trajectory

SIZE, DPI = (13.0, 6.5), 100
"""Of the picture [inch], and dots per inch."""


def draw(recording: Recording, run: Run, file: Path) -> None:
    """
    Draw the paths on the truth, and beside them the closures between their true ends.

    Parameters
    ----------
    recording : Recording
    run : Run
        What came of it.
    file : Path

    """
    figure = Figure(figsize=SIZE, dpi=DPI, facecolor='white', layout='constrained')
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    truth = recording.truth
    for path, colour, name in (
            (Trajectory(recording.stamps_ns, recording.odometry), PURPLE, 'odometry alone'),
            (run.path, BLUE, 'corrected path')):
        left.plot(*_placed(path, truth)[:, :2].T, color=colour, linewidth=1.6, label=name)
    for axes in (left, right):
        axes.plot(*truth.poses[:, :2].T, color=INK, linewidth=0.8, linestyle=(0, (6, 4)),
                  label='truth')
        axes.set_aspect('equal')
        axes.spines[['top', 'right']].set_visible(False)
        axes.tick_params(colors=GREY, labelsize=9)
    wrong = recording.errors() > TRUE
    for chosen, colour, style, name in (
            (~run.kept & wrong, GREY, (0, (3, 3)), 'wrong, refused'),
            (run.kept & ~wrong, GREEN, 'solid', 'right, believed'),
            (~run.kept & ~wrong, '#E69F00', (0, (3, 3)), 'right, refused'),
            (run.kept & wrong, VERMILION, 'solid', 'wrong, believed')):
        _closures(right, truth.at(recording.ends[chosen])[..., :2], colour, style,
                  f'{name}: {int(np.sum(chosen))}')
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=9, loc='upper left', bbox_to_anchor=(0.0, -0.05),
                    ncols=3)
    figure.savefig(file)


def _closures(
    axes: Axes, ends: np.ndarray, colour: str, style: str | tuple[int, tuple[int, int]],
    name: str,
) -> None:
    axes.add_collection(LineCollection(list(ends), colors=colour, linestyles=[style],
                                       linewidths=1.0, label=name))


def _placed(path: Trajectory, truth: Trajectory) -> np.ndarray:
    """Return the poses of a path, laid over the truth."""
    inside = truth.covers(path.stamps_ns)
    pose = fit_motion(path.poses[inside, :2], truth.at(path.stamps_ns[inside])[:, :2])
    return np.asarray(se2.compose(pose, path.poses))
