# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The report: a folder with README.md, metrics.json and pictures.

The colours of the pictures are after Okabe and Ito, as in `pose_graph_ros.cli.picture`.
"""

from datetime import date
from importlib import metadata
from importlib.util import find_spec
import json
import os
from pathlib import Path
import platform
import re

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmark.section import Curve, Section, Table

COLOURS = {'ours': '#0072B2', 'GTSAM skip 10': '#E69F00', 'GTSAM skip 1': '#D55E00'}
INK, GREY, GRID = '#222222', '#666666', '#E2E2E2'
PANEL, DPI = (5.3, 3.1), 100
"""Size of a panel [inch] and dots per inch."""
VERSIONS = ('gtsam', 'numpy', 'scipy', 'numba')


def write(
    sections: list[Section], folder: Path, command: str, *, title: str, about: str,
    curves: list[Curve],
) -> Path:
    """
    Write the report, and return the path of README.md.

    Parameters
    ----------
    sections : list of Section
    folder : Path
    command : str, by which all of them are made
    title : str
    about : str
    curves : list of Curve

    """
    parts = [f'# {title}', '', *environment(command), '', about, '',
             '## Requirements', '', *_verdicts(sections)]
    picture = folder / 'step_time.png'
    if len(curves) > 0:
        _draw_step_time(curves, picture)
    if picture.exists():
        parts += [f'![Time of a step against the size of the graph]({picture.name})', '']
    for section in sections:
        parts += [f'## {section.title}', '', section.about, '']
        for table in section.tables:
            parts += markdown(table)
        parts += [*(f'- {note}' for note in section.notes), '']
    path = folder / 'README.md'
    path.write_text('\n'.join(parts).rstrip() + '\n', encoding='utf-8')
    figures = {metric.key: {'value': metric.value, 'unit': metric.unit, 'target': metric.target,
                            'reached': metric.reached}
               for section in sections for metric in section.metrics}
    (folder / 'metrics.json').write_text(json.dumps(figures, indent=1) + '\n', encoding='utf-8')
    return path


def environment(command: str) -> list[str]:
    """Return the day, the machine, versions, and by which command a page is made."""
    versions = [f'{name} {metadata.version(name)}' if find_spec(name) else f'without {name}'
                for name in VERSIONS]
    return [f'{date.today().isoformat()}, {_processor()}, {os.cpu_count()} cores, '
            f'{platform.system()} {platform.machine()}, Python {platform.python_version()}, '
            f'{", ".join(versions)}.', '', 'Made by', '', f'    {command}']


def _processor() -> str:
    """Return the name of the processor."""
    file = Path('/proc/cpuinfo')
    found = re.search('model name.*: (.*)', file.read_text() if file.exists() else '')
    return found[1] if found else platform.processor() or 'unknown processor'


def _verdicts(sections: list[Section]) -> list[str]:
    """Return the table of what was asked for."""
    table = Table('', ('requirement', 'measured', 'asked for'))
    for section in sections:
        if section.failed:
            table.rows.append((section.title, 'failed', section.notes[0]))
        for metric in section.metrics:
            if metric.target is not None:
                table.rows.append((metric.key, f'{metric.value:.4g}{metric.unit}',
                                   metric.status()))
    return markdown(table)


def markdown(table: Table) -> list[str]:
    """Return a table as lines of Markdown, none without rows."""
    if len(table.rows) == 0:
        return []
    lines = [f'**{table.caption}**', ''] if table.caption else []
    for cells in (table.header, ('---',) * len(table.header), *table.rows):
        lines.append('| ' + ' | '.join(cell.replace('|', '/') for cell in cells) + ' |')
    return [*lines, '']


def _draw_step_time(curves: list[Curve], file: Path) -> None:
    figure, (axes,) = panels('chain')
    for curve in curves:
        named = curve.tool in axes.get_legend_handles_labels()[1]
        axes.plot(curve.x, curve.y, color=COLOURS[curve.tool], linewidth=1.6,
                  label=None if named else curve.tool)
    axes.set(xscale='log', yscale='log', xlabel='nodes', ylabel='mean time of a step [us]')
    axes.legend(frameon=False, fontsize=9)
    figure.savefig(file)


def panels(*titles: str, size: tuple[float, float] = PANEL) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel of some size [inch] for each title, and the panels."""
    figure = Figure(figsize=(size[0] * len(titles), size[1]), dpi=DPI, facecolor='white',
                    layout='constrained')
    FigureCanvasAgg(figure)
    grid = []
    for k, title in enumerate(titles):
        axes = figure.add_subplot(1, len(titles), k + 1)
        axes.spines[['top', 'right']].set_visible(False)
        axes.spines[['left', 'bottom']].set_color(GREY)
        axes.tick_params(which='both', colors=GREY, labelsize=9)
        axes.grid(color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.set_title(title, loc='left', fontsize=11, fontweight='bold', color=INK)
        grid.append(axes)
    return figure, grid
