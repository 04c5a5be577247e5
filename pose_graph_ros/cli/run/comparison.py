# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Two runs side by side: what `pose-graph report A B` makes a page of.

Times and places are those of run A; what run B has is moved there by its stamps and its offset.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
import math
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from pose_graph_ros.cli.drive import HELD_OUT, REFUSED, WEAKLY_BELIEVED
from pose_graph_ros.cli.run import Frame, number, rounded
from pose_graph_ros.cli.run.document import read_document, VERSION
from pose_graph_ros.cli.run.findings import Finding, in_order, MOST_SHOWN
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry.se2 import FloatArray, transform, wrap
from pose_graph_ros.core.geometry.trajectory import fit_motion
from pose_graph_ros.core.judgement.texts import short

SAME_TIME = 0.0015  # as times are rounded to milliseconds [s]
SAME_PLACE = 0.02  # as places are rounded to centimetres [m]
MOST_PLACES = 10  # where the paths differ most
PARAMETERS, NONE = 'Parameters that differ', '\u2013'
ERRORS = ('corrected path to truth', 'corrected path to fixes held out')


class Apart(NamedTuple):
    """How far the paths are apart at the times of A that B covers, shape (N,)."""

    t: FloatArray  # [s]
    places: FloatArray  # in A and in B, shape (2, N, 2) [m]
    distance: FloatArray  # [m]
    turn: FloatArray  # from A to B [rad]
    rms: float
    motion: FloatArray  # of B as a whole that brings it nearest to A, (3,)
    rms_after: float  # that motion


def compared(files: tuple[Path, Path]) -> dict[str, Any]:
    """Return the data of the page; raises FileFormatError if one is not the run.json of a run."""
    a, b = runs = [read_document(file) for file in files]
    for file, run in zip(files, runs, strict=True):
        if run.get('kind') != a.get('kind'):
            raise FileFormatError(f'{file}: expected two runs, or two solved graphs')
    later = (int(b['start_ns']) - int(a['start_ns'])) * 1e-9
    # runs of different days are laid over one another as they are
    together = -b['duration'] < later < a['duration']
    later = later if together else 0.0
    moved = np.subtract(b['offset'], a['offset'])
    paths = [_path(a, 0.0, np.zeros(2)), _path(b, later, moved)]
    apart = _apart(*paths) if together else None
    frame = Frame(0, np.zeros(2))
    judged = {table: [*_judged_otherwise(a, b, table, later, frame)]
              for table in ('fixes', 'closures')}
    lines = {'corrected': a['lines']['corrected'], 'other': {
        name: rounded(paths[1][k]) for k, name in enumerate('txy')}, 'odometry': None,
        'truth': a['lines']['truth']}
    figures, errors = list(_figures(a, b, apart)), None if apart is None else {
        'against': 'B', 't': rounded(apart.t), 'position': rounded(apart.distance),
        'heading': rounded(apart.turn, 4), 'sigma': None, 'odometry': None}
    return {
        'version': VERSION, 'kind': 'comparison', 'by_node': a.get('by_node', False),
        'title': f'{files[0].parent} and {files[1].parent}',
        'subtitle': '; '.join(f'{name}: {file}, {run["title"]}, {run["subtitle"]}'
                              for name, file, run in zip('AB', files, runs, strict=True)),
        **{key: a[key] for key in ('start', 'start_ns', 'axes', 'offset', 'states')},
        'duration': max(a['duration'], b['duration'] + later), 'facts': [],
        'findings': in_order(_findings(a, b, apart, judged, figures)), 'lines': lines,
        'ellipses': {name: [] for name in ('t', 'x', 'y', 'xx', 'xy', 'yy')}, **judged,
        'errors': errors, 'error_table': [], 'sources': [],
        'springs': [] if apart is None else _places(apart), 'updates': None, 'sparsity': [],
        'figures': figures, 'texts': list(frame.texts)}


def _path(run: Mapping[str, Any], later: float, moved: FloatArray) -> FloatArray:
    """Return t, x, y and the unwrapped heading of the corrected path, shape (4, N)."""
    path = run['lines']['corrected']
    t, x, y, theta = (np.array(path[name], dtype=float) for name in ('t', 'x', 'y', 'theta'))
    return np.array((t + later, x + moved[0], y + moved[1], np.unwrap(theta)))


def _apart(a: FloatArray, b: FloatArray) -> Apart | None:
    """Return how far two paths are apart; None if they do not overlap in time."""
    here = a[:, (a[0] >= b[0, 0] - SAME_TIME) & (a[0] <= b[0, -1] + SAME_TIME)]
    if here.shape[1] == 0:
        return None
    x, y, theta = (np.interp(here[0], b[0], column) for column in b[1:])
    places = np.array((here[1:3].T, np.column_stack((x, y))))
    distance = np.hypot(*(places[1] - places[0]).T)
    motion = fit_motion(places[1], places[0])
    after = np.hypot(*(transform(motion, places[1]) - places[0]).T)
    return Apart(here[0], places, distance, wrap(theta - here[3]), _rms(distance), motion,
                 _rms(after))


def _rms(values: FloatArray) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _places(apart: Apart) -> list[dict[str, Any]]:
    """Return where the paths differ most, no two within 5 % of the time, as springs."""
    found, far = list[dict[str, Any]](), apart.distance.copy()
    near = 0.05 * float(apart.t[-1] - apart.t[0])
    while len(found) < MOST_PLACES and np.max(far) > SAME_PLACE:
        k = int(np.argmax(far))
        far[np.abs(apart.t - apart.t[k]) <= near] = 0.0
        here, there = ({'t': float(apart.t[k]), 'x': float(x), 'y': float(y)}
                       for x, y in np.round(apart.places[:, k], 2).tolist())
        found.append({
            'rank': len(found) + 1, 'source': 'A and B', 'kind': 'difference',
            'name': f'at {apart.t[k]:.1f}', 'energy': number(apart.distance[k]), 'expected': None,
            'from': here, 'to': there,
            'text': f'the headings differ by {short(math.degrees(abs(apart.turn[k])))} deg'})
    return found


# --- what is believed

def _judged_otherwise(a: Mapping[str, Any], b: Mapping[str, Any], table: str, later: float,
                      frame: Frame) -> Iterator[dict[str, Any]]:
    """Yield the measurements of each source that one run uses and the other does not, as in B."""
    ends = ('t', 't') if table == 'fixes' else ('t0', 't1')

    def times_of(each: Mapping[str, Any], later: float) -> FloatArray:
        """Return the times of both ends, and the how many-th with these it is, shape (N, 3)."""
        seen, rows = Counter[tuple[float, float]](), list[tuple[float, float, int]]()
        for key in zip(each[ends[0]], each[ends[1]], strict=True):
            seen[key] += 1
            rows.append((key[0] + later, key[1] + later, seen[key]))
        return np.array(rows)

    for one in a[table]:
        other = next((each for each in b[table] if each['source'] == one['source']), None)
        if other is None or 0 in (len(one['state']), len(other['state'])):
            continue
        gaps, partner = (np.asarray(each) for each in KDTree(
            times_of(other, later)).query(times_of(one, 0.0)))
        before, after = np.array(one['state']), np.take(other['state'], partner)
        rows = np.flatnonzero(
            (gaps < SAME_TIME) & ((before <= WEAKLY_BELIEVED) != (after <= WEAKLY_BELIEVED))
            & (before != HELD_OUT) & (after != HELD_OUT)).tolist()
        if len(rows) > 0:
            columns = {name: [values[k] for k in rows] for name, values in one.items()
                       if isinstance(values, list)}
            whys = [frame.text(' '.join(
                f'{name}: {run["texts"][why].rstrip(".") if why >= 0 else run["states"][state]}.'
                for name, run, why, state in (
                    ('A', a, one['why'][k], before[k]),
                    ('B', b, other['why'][partner[k]], after[k])))) for k in rows]
            yield {'source': one['source'], 'left_out': 0, **columns,
                   'state': after[rows].tolist(), 'why': whys}


# --- figures

def _figures(a: Mapping[str, Any], b: Mapping[str, Any],
             apart: Apart | None) -> Iterator[dict[str, Any]]:
    """Yield tables of what both runs tell, with what changed from A to B."""
    def rows(named: list[dict[str, Any]], without: str = NONE) -> list[list[str]]:
        """Return what is known in both, or in one: its name, in A, in B, and the change."""
        return [[name, *(values := [each.get(name, without) for each in named]), _change(*values)]
                for name in dict.fromkeys(name for each in named for name in each)]

    runs = (a, b)
    yield {'title': 'Run', 'rows': rows([
        {each['label']: each['value'] for each in run['facts'] if each['label'] != 'error'}
        | _update_times(run) for run in runs])}
    errors = rows([{f'{each["name"]}, {what}': f'{short(each[key], 3)} {each["unit"]}'
                    for each in run['error_table'] for key, what in (
                        ('rms', 'rms'), ('p95', '95 %'))} for run in runs])
    if apart is not None:
        far, turn = float(np.hypot(*apart.motion[:2])), math.degrees(abs(apart.motion[2]))
        errors += [['A to B, rms', '', f'{short(apart.rms, 3)} m', ''],
                   ['A to B, largest', '', f'{short(float(np.max(apart.distance)), 3)} m', ''],
                   [f'A to B, rms, if B is moved by {short(far)} m and {short(turn)} deg', '',
                    f'{short(apart.rms_after, 3)} m', '']]
    yield {'title': 'Errors', 'rows': errors}
    yield {'title': 'Sources', 'rows': rows([dict(_of_sources(run)) for run in runs])}
    if all('parameters' in run for run in runs):
        told = [{name: str(value) for name, value in run['parameters'].items()} for run in runs]
        yield {'title': PARAMETERS,
               'rows': [row for row in rows(told, 'by default') if row[1] != row[2]]}


def _update_times(run: Mapping[str, Any]) -> dict[str, str]:
    ms = [] if run['updates'] is None else run['updates']['ms']
    return {f'update, {part} %': f'{short(float(np.percentile(ms, part)))} ms'
            for part in (50, 95) if len(ms) > 0}


def _of_sources(run: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what became of the measurements of each source, and its sigmas."""
    for each in run['sources']:
        name = each['name']
        yield f'{name}: used', str(each['used'])
        for table in (*run['fixes'], *run['closures']):
            for state in range(WEAKLY_BELIEVED, REFUSED + 1) if table['source'] == name else ():
                yield f'{name}: {run["states"][state]}', str(table['state'].count(state))
        for key, what in (('ratio', 'true over claimed sigma'), ('scale', 'sigmas multiplied by')):
            yield f'{name}: {what}', NONE if each[key] is None else short(each[key], 3)


def _change(one: str, other: str) -> str:
    """Return the difference of two numbers with the same unit, with its share of the first."""
    (size, unit), (after, new) = (_split(text) for text in (one, other))
    if size is None or after is None or unit != new or size == after:
        return ''
    change = after - size
    share = '' if size == 0.0 or abs(change) > 10.0 * abs(size) else (
        f' ({100.0 * change / abs(size):+.0f} %)')
    return f'{"+" if change > 0.0 else "-"}{short(abs(change), 3)}{unit}{share}'


def _split(text: str) -> tuple[float | None, str]:
    found = re.fullmatch(r'(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)( ?[a-z%]*(?: rms)?)', text)
    return (None, '') if found is None else (float(found[1]), found[2])


def _findings(a: Mapping[str, Any], b: Mapping[str, Any], apart: Apart | None,
              judged: Mapping[str, Any], figures: list[dict[str, Any]]) -> Iterator[Finding]:
    """Yield what changed, in sentences."""
    for name in ERRORS:
        rms = [row['rms'] for run in (a, b) for row in run['error_table'] if row['name'] == name]
        if len(rms) == 2 and rms[0] > 0.0:
            change = 100.0 * (rms[1] / rms[0] - 1.0)
            yield Finding('warning' if change > 10.0 else 'good' if change < -10.0 else 'notice',
                          f'{name}: {short(rms[1], 3)} m rms in B, {short(rms[0], 3)} m in A '
                          f'({change:+.0f} %)', 'figures')
    if apart is None:
        yield Finding('warning', 'the runs do not overlap in time, so that their paths cannot be '
                      'compared; each has the times since its own start', 'map')
    elif (most := float(np.max(apart.distance))) <= SAME_PLACE:
        yield Finding('good', 'the paths are the same', 'errors')
    else:
        when = round(float(apart.t[int(np.argmax(apart.distance))]), 3)
        moves = '' if apart.rms_after > 0.5 * apart.rms else (
            '; most of it is a motion of the whole path, which a different begin of the map makes')
        yield Finding('notice', f'the paths are {short(apart.rms, 3)} m rms apart, at most '
                      f'{short(most, 3)} m{moves}', 'errors', [(when, when)])
    for table, noun in (('closures', 'loop closures'), ('fixes', 'fixes')):
        for each in judged[table]:
            used = sum(state <= WEAKLY_BELIEVED for state in each['state'])
            told = [f'{count} {noun} that {how}' for count, how in (
                (len(each['state']) - used, 'A uses are not used in B'),
                (used, 'A does not use are used in B')) if count > 0]
            times = [time for end in ('t', 't0', 't1') for time in each.get(end, ())]
            yield Finding('notice', f'{each["source"]}: {" and ".join(told)}', 'map',
                          [(time, time) for time in times[:MOST_SHOWN]])
    names = [row[0] for each in figures if each['title'] == PARAMETERS for row in each['rows']]
    if len(names) > 0:
        what = 'parameter differs' if len(names) == 1 else 'parameters differ'
        yield Finding('notice', f'{len(names)} {what}: {", ".join(names[:5])}'
                      f'{", ..." if len(names) > 5 else ""}', 'figures')
