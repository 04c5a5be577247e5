# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw compared trajectories: a map of all, and beside it their errors and NEES over time."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from scipy.stats import chi2

from pose_graph_ros.cli.picture import BLUE, GREEN, GREY, GRID, INK, ORANGE, thinned, VERMILION
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.trajectories.comparison import Comparison
from pose_graph_ros.core.trajectories.sequence import Key
from pose_graph_ros.core.trajectories.statistics import PROBABILITY

COLOURS = (BLUE, VERMILION, GREEN, ORANGE, '#CC79A7', '#56B4E9')
SIZE, DPI = (16.0, 8.5), 100  # of the picture [inch] and resolution [dots per inch]
LONGEST_NAME = 44
LOG_RATIO, LOG_FLOOR = 10.0, 0.1
"""Largest ratio of a NEES to its quantile on a linear axis; lower end of a logarithmic one."""


def draw_comparison(
    results: Sequence[Comparison], names: Sequence[str], reference: str, file: Path,
) -> None:
    """
    Write a picture of compared trajectories.

    Parameters
    ----------
    names : sequence of str, of the estimates
    reference : str, its name
    file : Path, of a kind that matplotlib writes

    """
    panels = ['ate', 'heading', 'rpe'] + ['nees'] * any(result.nees for result in results)
    with rc_context({'font.size': 11, 'axes.edgecolor': GREY, 'axes.labelcolor': INK,
                     'xtick.color': GREY, 'ytick.color': GREY, 'svg.fonttype': 'none'}):
        figure = Figure(figsize=SIZE, dpi=DPI, layout='constrained')
        FigureCanvasAgg(figure)
        axes = figure.subplot_mosaic([['map', panel] for panel in panels])
        for each in axes.values():
            each.grid(color=GRID)
            each.set_axisbelow(True)
            each.spines[['top', 'right']].set_visible(False)
        for panel in panels[1:]:
            axes[panel].sharex(axes[panels[0]])
        _draw_map(axes['map'], results, names, reference)
        begin = min(int(result.keys[0]) for result in results)
        for k, result in enumerate(results):
            at = (result.keys - begin) * 1e-9 if result.key is Key.STAMP else result.keys
            _draw_errors(axes, result, np.asarray(at), COLOURS[k % len(COLOURS)])
        for panel, title in (('ate', 'position error [m]'), ('heading', 'heading error [deg]'),
                             ('rpe', 'relative error [m]'), ('nees', 'NEES of the position')):
            if panel in axes:
                axes[panel].set_title(title, loc='left', fontweight='bold', color=INK)
                axes[panel].set_ylim(0.0, 1.08 * axes[panel].dataLim.y1 or 1.0)
        if 'nees' in axes:
            _draw_expectation(axes['nees'], results)
        axes[panels[-1]].set_xlabel(
            'time [s]' if results[0].key is Key.STAMP else f'pose by {results[0].key.value}')
        figure.savefig(file)


def _draw_map(
    axes: Axes, results: Sequence[Comparison], names: Sequence[str], reference: str,
) -> None:
    largest = max(results, key=lambda result: len(result.keys))
    truth = thinned(largest.reference)
    axes.plot(truth[:, 0], truth[:, 1], color=INK, linewidth=4.0, alpha=0.3,
              solid_capstyle='round', label=_short(reference))
    for k, (name, result) in enumerate(zip(names, results, strict=True)):
        ate = result.statistics()['ate']
        path = thinned(result.estimate)
        axes.plot(path[:, 0], path[:, 1], color=COLOURS[k % len(COLOURS)], linewidth=1.4,
                  label=_short(name) + (
                      '' if ate is None else f', ATE {short(ate.rmse, 3)} m rms'))
    axes.set_aspect('equal', adjustable='datalim')
    axes.set_xlabel('x [m]')
    axes.set_ylabel('y [m]')
    axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), frameon=False, labelcolor=INK)


def _draw_errors(
    axes: dict[str, Axes], result: Comparison, at: FloatArray, colour: str,
) -> None:
    """Draw the errors of one estimate over time [s], or over ids."""
    def line(panel: str, positions: FloatArray, values: FloatArray) -> None:
        axes[panel].plot(thinned(positions), thinned(values), color=colour, linewidth=1.2)

    line('ate', at, np.hypot(result.ate[:, 0], result.ate[:, 1]))
    line('heading', at, np.rad2deg(np.abs(result.ate[:, 2])))
    line('rpe', at[result.rpe_ends], np.hypot(result.rpe[:, 0], result.rpe[:, 1]))
    if result.nees:
        line('nees', at, result.nees['position'])


def _draw_expectation(axes: Axes, results: Sequence[Comparison]) -> None:
    """Draw what the NEES of a position is on average, and its 95 % quantile."""
    quantile = float(chi2.ppf(PROBABILITY, 2))
    axes.axhline(2.0, color=INK, linewidth=1.0)
    axes.axhline(quantile, color=INK, linewidth=1.0, linestyle='--')
    axes.set_title(f'solid: expected, dashed: {100.0 * PROBABILITY:g} % are below', loc='right',
                   color=GREY, fontsize=10)
    largest = max((float(np.nanmax(result.nees['position'])) for result in results
                   if result.nees and not np.all(np.isnan(result.nees['position']))), default=0.0)
    if largest > LOG_RATIO * quantile:
        axes.set_yscale('log')
        axes.set_ylim(LOG_FLOOR, 2.0 * largest)


def _short(name: str) -> str:
    return name if len(name) <= LONGEST_NAME else f'...{name[3 - LONGEST_NAME:]}'
