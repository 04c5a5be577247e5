# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The report: a folder with README.md, metrics.json and pictures.

The colours of the pictures are after Okabe and Ito, as in `pose_graph_ros.cli.picture`.
"""

from datetime import date
from importlib import metadata
import json
import os
from pathlib import Path
import platform
import shlex

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np

from benchmark.metrics import Metric
from benchmark.online import EXCESS_FLOOR
from benchmark.section import Curve, say, Section, Table

COLOURS = {'ours': '#0072B2', 'ours, refined': '#009E73', 'GTSAM skip 10': '#E69F00',
           'GTSAM skip 1': '#D55E00'}
INK, GREY, GRID = '#222222', '#666666', '#E2E2E2'
PANEL, DPI = (5.3, 3.1), 100
"""Size of a panel [inch] and dots per inch."""
COLUMNS = 3
VERSIONS = ('gtsam', 'numpy', 'scipy', 'numba')


AGAINST_GTSAM = (
    'Times of steps are in microseconds. Ours is all that a caller from Python pays, an '
    'up-to-date estimate included; of GTSAM only `ISAM2.update` is counted. Runs of the '
    'tools are interleaved in one process, figures are medians over the runs. A ratio is '
    "GTSAM's time divided by ours. Excess is half of chi2 above the batch optimum of the "
    'graph so far, each tool under its own error model.')


def write(
    sections: list[Section], folder: Path, command: str, *,
    title: str = 'Benchmark: pose_graph_ros against GTSAM', remarks: str = AGAINST_GTSAM,
) -> Path:
    """
    Write the report.

    Returns
    -------
    Path
        Of README.md.

    """
    folder.mkdir(parents=True, exist_ok=True)
    curves = [curve for section in sections for curve in section.curves]
    parts = [f'# {title}', '', *_environment(command), '', remarks, '',
             '## Requirements', '', *_verdicts(sections)]
    for name, heading, draw in (
            ('step_time', 'Time of a step against the size of the graph', _draw_step_time),
            ('excess', 'Excess along the run', _draw_excess)):
        chosen = [curve for curve in curves if curve.picture == name.replace('_', ' ')]
        if len(chosen) > 0:
            draw(chosen, folder / f'{name}.png')
            parts += [f'## {heading}', '', f'![{heading}]({name}.png)', '']
    for section in sections:
        parts += [f'## {section.title}', '', section.about, '']
        for table in section.tables:
            parts += _markdown(table)
        for note in section.notes:
            parts += [f'- {note}']
        parts += [''] if section.notes else []
    path = folder / 'README.md'
    path.write_text('\n'.join(parts).rstrip() + '\n', encoding='utf-8')
    figures = {metric.key: {'value': metric.value, 'unit': metric.unit, 'target': metric.target,
                            'reached': metric.reached}
               for section in sections for metric in section.metrics}
    (folder / 'metrics.json').write_text(json.dumps(figures, indent=1) + '\n', encoding='ascii')
    return path


def conclude(
    sections: list[Section], folder: Path, module: str, arguments: list[str], *, title: str,
    about: str | None,
) -> int:
    """
    Write the report of a benchmark of its own; return 1 if a figure is not what is asked for.

    Parameters
    ----------
    sections : list of Section
    folder : Path
    module : str
        With its arguments, the command.
    arguments : list of str
    title : str
    about : str, optional
        The module's docstring, whose last paragraph becomes the remarks.

    """
    command = shlex.join(['python', '-m', module, *arguments])
    path = write(sections, folder, command, title=title,
                 remarks=(about or '').strip().split('\n\n')[-1].replace('\n', ' '))
    metrics = [metric for section in sections for metric in section.metrics]
    say(f'{summary(metrics)}; see {path}')
    return 0 if all(metric.reached for metric in metrics) else 1


def _environment(command: str) -> list[str]:
    versions = []
    for name in VERSIONS:
        try:
            versions.append(f'{name} {metadata.version(name)}')
        except metadata.PackageNotFoundError:
            versions.append(f'without {name}')
    return [f'{date.today().isoformat()}, {_processor()}, {os.cpu_count()} cores, '
            f'{platform.system()} {platform.machine()}, Python {platform.python_version()}, '
            f'{", ".join(versions)}.', '', 'Made by', '', f'    {command}']


def _processor() -> str:
    """Return the name of the processor."""
    try:
        for line in Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines():
            if line.startswith('model name'):
                return line.partition(':')[2].strip()
    except OSError:
        pass
    return platform.processor() or 'unknown processor'


def _verdicts(sections: list[Section]) -> list[str]:
    """Return the table of what was asked for."""
    table = Table('', ('requirement', 'measured', 'asked for'))
    for section in sections:
        if section.failed:
            table.add(section.title, 'failed', section.notes[-1])
        for metric in section.metrics:
            if metric.target is not None:
                table.add(metric.key, f'{metric.value:.4g}{metric.unit}', metric.status())
    return _markdown(table)


def summary(metrics: list[Metric]) -> str:
    """Return one line: how many of the requirements are reached."""
    asked = [metric for metric in metrics if metric.target is not None]
    return f'{sum(metric.reached for metric in asked)} of {len(asked)} figures reach what is asked'


def _markdown(table: Table) -> list[str]:
    if len(table.rows) == 0:
        return []
    lines = [f'**{table.caption}**', ''] if table.caption else []
    for cells in (table.header, ('---',) * len(table.header), *table.rows):
        lines.append('| ' + ' | '.join(cell.replace('|', '/') for cell in cells) + ' |')
    return [*lines, '']


def _draw_step_time(curves: list[Curve], file: Path) -> None:
    figure, (axes,) = _figure(1)
    labelled = set()
    for curve in curves:
        label = None if curve.tool in labelled else curve.tool
        labelled.add(curve.tool)
        axes.plot(curve.x, curve.y, color=COLOURS[curve.tool], linewidth=1.6, label=label)
    axes.set(xscale='log', yscale='log', xlabel='nodes', ylabel='mean time of a step [us]')
    axes.set_title('chain', loc='left', fontsize=11, fontweight='bold', color=INK)
    axes.legend(frameon=False, fontsize=9)
    figure.savefig(file)


def _draw_excess(curves: list[Curve], file: Path) -> None:
    panels = list(dict.fromkeys(curve.panel for curve in curves))
    figure, grid = _figure(len(panels))
    for panel, axes in zip(panels, grid, strict=True):
        for curve in curves:
            if curve.panel == panel:
                axes.plot(curve.x, np.maximum(curve.y, EXCESS_FLOOR), color=COLOURS[curve.tool],
                          linewidth=1.4, marker='.', markersize=4, label=curve.tool)
        axes.set(yscale='log', xlabel='step', ylabel='excess')
        axes.set_ylim(bottom=0.5 * EXCESS_FLOOR)
        axes.set_title(panel, loc='left', fontsize=11, fontweight='bold', color=INK)
    grid[0].legend(frameon=False, fontsize=9)
    figure.savefig(file)


def _figure(panels: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with so many panels, and the panels."""
    columns = min(panels, COLUMNS)
    rows = -(-panels // columns)
    figure = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows), dpi=DPI, facecolor='white',
                    layout='constrained')
    FigureCanvasAgg(figure)
    grid = []
    for k in range(panels):
        axes = figure.add_subplot(rows, columns, k + 1)
        axes.spines[['top', 'right']].set_visible(False)
        axes.spines[['left', 'bottom']].set_color(GREY)
        axes.tick_params(which='both', colors=GREY, labelsize=9)
        axes.grid(color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        grid.append(axes)
    return figure, grid
