# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables and a picture of what both parts of the soak have found."""

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from benchmark.report import markdown
from benchmark.section import Table
from benchmark.soak.life import EXPECTED
from pose_graph_ros.cli.picture import BLUE, GREEN, GREY, ORANGE, SKY, STYLE, VERMILION

ENGINE, NODE, PICTURE = 'engine.jsonl', 'node.jsonl', 'soak.png'
Row = dict[str, Any]
ENGINE_COLUMNS = {
    'hour': 'hours', 'resident MB': 'resident', 'engine MB': 'held',
    'nodes of the path': 'nodes',
    'in the graph': 'kept', 'update mean ms': 'update_mean', 'p99': 'update_p99',
    'max': 'update_max', 'cliques': 'update_work', 'copy of the path ms': 'path',
    'copy of the state ms': 'checkpoint', 'journal MB': 'journal', 'restarts': 'kills',
    'recovery s': 'recovery', 'newest rms m': 'rms', 'path rms m': 'path_rms',
    'without answer': 'lost',
    'another answer after a restart': 'forgotten', 'refused, not meant': 'unexpected'}
NODE_COLUMNS = {
    'minute': 'minutes', 'resident MB': 'resident', 'its age min': 'age', 'sent': 'sent',
    'not received': 'lost', 'poses': 'poses', 'without a pose': 'unanswered',
    'latency p50 ms': 'latency_p50', 'p99': 'latency_p99', 'max': 'latency_max',
    'lines of log': 'lines', 'errors': 'errors', 'crashes': 'crashes', 'nodes lost': 'missing',
    'error m': 'error', 'journal MB': 'journal'}


def rows(file: Path) -> list[Row]:
    """Return what a part has found; nothing if it was not run."""
    if not file.exists():
        return []
    return [json.loads(line) for line in file.read_text('utf-8').splitlines()]


def write(folder: Path) -> str:
    """Draw the picture into a folder, and return the tables."""
    engine, node = rows(folder / ENGINE), rows(folder / NODE)
    draw(engine, node, folder / PICTURE)
    lines = [*_table('By hour of work', engine, ENGINE_COLUMNS),
             *_table('By minute', node, NODE_COLUMNS)]
    if len(engine) > 0:
        last = engine[-1]
        refused = {key: n for key, n in last['answers'].items() if key in EXPECTED}
        lines += [f'{last["hours"]:.0f} hours of work in {last["seconds"] / 3600:.2f} h, of which '
                  f'{last["cpu"] / 3600:.2f} h of the processor. Refused as meant: {refused}. '
                  f'Largest move of a path by a restart: {last["moved"]:.1e}. Logged: '
                  f'{sum(last["logged"].values())} lines.', '']
    if len(node) > 0:
        last = node[-1]
        lines += [f'Disturbances: {last["actions"]}. Waited for in vain: '
                  f'{last["stuck"] or "nothing"}. Longest time for the disk: '
                  f'{max(row["journal_lag"] for row in node):.2f} s.', '']
    return '\n'.join(lines)


def _table(caption: str, found: Sequence[Row], columns: dict[str, str]) -> list[str]:
    """Return a table of at most eight of the rows, the first and the last among them."""
    table = Table(caption, tuple(columns))
    for k in sorted(set(np.linspace(0, len(found) - 1, 8).round().astype(int)) if found else ()):
        table.rows.append(tuple(_cell(found[k][key]) for key in columns.values()))
    return markdown(table)


def _cell(value: float) -> str:
    return str(value) if isinstance(value, int) else f'{value:.4g}'


def draw(engine: Sequence[Row], node: Sequence[Row], file: Path) -> None:
    """Draw a row of panels for each part."""
    with rc_context(STYLE):
        figure = Figure(figsize=(16.0, 8.5), dpi=100, layout='constrained')
        above, below = figure.subplots(2, 4)
        _panels(above, engine, 'hours', 'hours of work', (
            ('resident memory [MB]', {'of the process': ('resident', BLUE), 'of it the engine': (
                'held', SKY)}, False),
            ('time of an update [ms]', {'mean': ('update_mean', BLUE), 'p99': (
                'update_p99', SKY), 'max': ('update_max', GREY)}, True),
            ('journal [MB], recovery [s]', {'largest file': ('journal', BLUE), 'last recovery': (
                'recovery', ORANGE)}, False),
            ('error, rms [m]', {'newest pose': ('rms', ORANGE), 'whole path': (
                'path_rms', BLUE)}, False)))
        _panels(below, node, 'minutes', 'minutes with the node', (
            ('resident memory [MB]', {'of the node': ('resident', BLUE)}, False),
            ('latency of a pose [ms]', {'p50': ('latency_p50', BLUE), 'p99': (
                'latency_p99', SKY), 'max': ('latency_max', GREY)}, True),
            ('so far', {'messages': ('sent', BLUE), 'lines of log': ('lines', GREEN),
                        'not received': ('lost', VERMILION)}, True),
            ('error of the newest pose [m]', {'median': ('error', BLUE), 'max': (
                'error_max', GREY)}, True)))
        for axes, title in ((above, 'A month through the engine, with restarts'),
                            (below, 'An hour through the node over DDS, disturbed')):
            axes[0].set_title(title, loc='left', fontsize=14, fontweight='bold')
        figure.savefig(file)


def _panels(axes: Any, found: Sequence[Row], key: str, label: str, panels: Sequence[
        tuple[str, dict[str, tuple[str, str]], bool]]) -> None:
    """Fill a row of panels: what each shows, its curves, and whether by logarithms."""
    x = np.array([row[key] for row in found], dtype=float)
    panel: Axes
    for panel, (name, curves, is_wide) in zip(axes, panels, strict=True):
        for curve, (column, colour) in curves.items():
            y = np.array([row[column] for row in found], dtype=float)
            panel.plot(x, y, color=colour, label=curve, marker='.' if len(x) < 100 else '')
        panel.set(xlabel=label, ylabel=name)
        if is_wide:
            panel.set_yscale('symlog', linthresh=1.0)
        panel.set_ylim(bottom=0.0)
        panel.legend(loc='best', fontsize=10)
