# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write the page of a fleet: drives as rows to sort and to filter, the worst first, and why.

It links to the reports of the drives, which are beside it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import quote

import numpy as np

from pose_graph_ros.cli import finite, html_page
from pose_graph_ros.cli.fleet.table import CONVERGED, FAILED, NOT_CONVERGED
from pose_graph_ros.cli.html_page import duration_text, length_text
from pose_graph_ros.core.io.atomic_files import write_files
from pose_graph_ros.core.judgement.texts import short

Row = Mapping[str, Any]
Place = Sequence[float]
"""x and y [m]."""
STATUSES = (FAILED, NOT_CONVERGED, CONVERGED)  # worst first
MOST = 10_000  # drives on the page
MAP = (100, 64)  # width and height of a small one, in its own units; so they are in fleet.js
SHOWN = (
    'name', 'bag', 'status', 'warnings', 'notices', 'duration_s', 'length_m', 'truth_rms_m',
    'truth_p95_m', 'truth_heading_rms_deg', 'held_out_rms_m', 'held_out_p95_m', 'fixes_believed',
    'fixes_doubted', 'closures_believed', 'closures_doubted', 'chi2_per_degree', 'nees_position',
    'nees_pose', 'total_s', 'peak_memory_mb', 'parameters')  # of a row, as it is


def in_order(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return rows, the worst first: by status, warnings, notices, error, and name."""
    def rank(row: Row) -> tuple[Any, ...]:
        errors = [row[key] for key in ('truth_rms_m', 'held_out_rms_m') if row[key] is not None]
        return (STATUSES.index(row['status']), -(row['warnings'] or 0), -(row['notices'] or 0),
                -errors[0] if len(errors) > 0 else 0.0, row['name'])

    return sorted((finite(dict(row)) for row in rows), key=rank)


def write_overview(rows: Sequence[Row], out: Path, map_of: Callable[[Row], Sequence[Place]], *,
                   title: str, subtitle: str, points: Sequence[Row] = ()) -> Path:
    """
    Write the page of drives, and of the points of a sweep, best first; return its path.

    `map_of` is asked for some places along the path of a drive that is shown.
    """
    ordered, path = in_order(rows), out / 'index.html'
    data = {'title': title, 'subtitle': subtitle, 'facts': [
        {'label': label, 'value': value, 'note': note} for label, value, note in _facts(ordered)],
        # so long that times are minutes and seconds
        'duration': max([120.0, *_known(ordered, 'duration_s')]),
        'rows': [_told(row) | _map(map_of(row)) for row in ordered[:MOST]], 'all': len(ordered),
        'points': finite([dict(point) for point in points])}
    made = html_page.page(data, f'{title} - pose-graph fleet', ('base', 'fleet'))
    write_files({path: made.encode('utf-8')})
    return path


def _known(rows: Sequence[Row], key: str) -> list[float]:
    return [row[key] for row in rows if row[key] is not None]


def _facts(rows: Sequence[Row]) -> Iterator[tuple[str, str, str]]:
    """Yield label, value and note of what stands at the head of the page."""
    new = sum(bool(row['is_new']) for row in rows)
    failed, stuck = (sum(row['status'] == status for row in rows) for status in STATUSES[:2])
    kept = len(rows) - new - failed
    yield 'drives', str(len(rows)), '' if kept == 0 else f'{new} run now, {kept} kept from before'
    yield 'failed', str(failed), f'{stuck} not converged' if stuck > 0 else ''
    yield 'with warnings', str(sum((row['warnings'] or 0) > 0 for row in rows)), ''
    yield 'duration', duration_text(sum(_known(rows, 'duration_s'))), 'of all'
    yield 'distance', length_text(sum(_known(rows, 'length_m'))), 'of all'
    for key, what in (('truth_rms_m', 'the truth'), ('held_out_rms_m', 'fixes held out')):
        if len(errors := _known(rows, key)) > 0:
            yield 'error', f'{short(median(errors))} m rms', (
                f'to {what}, median of {len(errors)} drives')


def _told(row: Row) -> dict[str, Any]:
    """Return what the page has of a drive; what is unknown is left out."""
    failed, converged = (row['status'] == status for status in ('failed', 'converged'))
    told = {
        **{key: row[key] for key in SHOWN}, 'why': row['reason' if failed else 'finding'],
        'level': 'failed' if failed else 'warning' if not converged else row['level'] or 'good',
        'link': _link(row['folder'] or '')}
    stamp = np.datetime64(row['start_ns'] or 0, 'ns')
    if stamp >= np.datetime64('2000'):  # before, stamps count from any beginning
        told['start'] = str(stamp)[:16].replace('T', ' ')
    return {key: float(f'{value:.5g}') if isinstance(value, float) else value
            for key, value in told.items() if value not in (None, '')}


def _map(places: Sequence[Place]) -> dict[str, Any]:
    """Return a path in units of a small map, and its size [m]."""
    path = np.array(places, dtype=float).reshape(-1, 2)
    path = path[np.all(np.isfinite(path), axis=1)]
    if len(path) == 0:
        return {}
    low, high = path.min(axis=0), path.max(axis=0)
    scale = max(*((high - low) / MAP), 1e-3)  # [m]
    drawn = 0.5 * np.array(MAP) + (path - 0.5 * (low + high)) * [1.0, -1.0] / scale
    return {'map': ' '.join(f'{x:.0f},{y:.0f}' for x, y in drawn.tolist()),
            'size': (high - low).tolist()}


def _link(folder: str) -> str:
    """Return the address of a report relative to the page; none for one that is not below it."""
    parts = folder.split('/')
    return '' if {'', '.', '..'} & set(parts) else '/'.join(
        quote(part, safe='', errors='surrogateescape') for part in (*parts, 'report.html'))
