# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What run.json looks like, as docs/tools/report.md says it, and whether an object does."""

from collections.abc import Iterator, Mapping
import math
from typing import Any

NUMBER, TEXT, COUNT = 'number', 'text', 'count'


class Maybe:
    """Something that may be null."""

    def __init__(self, kind: Any) -> None:
        self.kind = kind


class Columns:
    """An object of equally long arrays."""

    def __init__(self, **columns: Any) -> None:
        self.columns = columns


PATH = Columns(t=NUMBER, x=NUMBER, y=NUMBER)
RATIOS = {'ratio': Maybe(NUMBER), 'low': Maybe(NUMBER), 'high': Maybe(NUMBER)}
PLACE = {'t': NUMBER, 'x': NUMBER, 'y': NUMBER}
SCHEMA = {
    'version': COUNT, 'title': TEXT, 'subtitle': TEXT, 'start': Maybe(TEXT), 'start_ns': TEXT,
    'duration': NUMBER, 'axes': [TEXT], 'offset': [NUMBER],
    'facts': [{'label': TEXT, 'value': TEXT, 'note': TEXT}],
    'findings': [{'level': TEXT, 'text': TEXT, 'anchor': TEXT, 'at': [[NUMBER]]}],
    'lines': {'corrected': Columns(t=NUMBER, x=NUMBER, y=NUMBER, theta=NUMBER), 'odometry': PATH,
              'truth': Maybe(PATH)},
    'ellipses': Columns(t=NUMBER, x=NUMBER, y=NUMBER, xx=NUMBER, xy=NUMBER, yy=NUMBER),
    'fixes': [Columns(
        source=None, left_out=None, t=NUMBER, x=NUMBER, y=NUMBER, state=COUNT, why=NUMBER,
        id=TEXT, d=Maybe(NUMBER), at=NUMBER)],
    'closures': [Columns(
        source=None, left_out=None, t0=NUMBER, t1=NUMBER, x0=NUMBER, y0=NUMBER, x1=NUMBER,
        y1=NUMBER, state=COUNT, why=NUMBER, id=TEXT, d=Maybe(NUMBER))],
    'states': [TEXT], 'texts': [TEXT],
    'errors': Maybe(Columns(
        against=None, t=NUMBER, position=NUMBER, heading=Maybe(NUMBER), sigma=Maybe(NUMBER),
        odometry=Maybe(NUMBER))),
    'error_table': [{'name': TEXT, 'count': COUNT, 'median': NUMBER, 'rms': NUMBER,
                     'p95': NUMBER, 'maximum': NUMBER, 'unit': TEXT}],
    'sources': [{
        'name': TEXT, 'kind': TEXT, 'count': COUNT, 'used': COUNT, 'rows': [{
            'name': TEXT, 'unit': TEXT, 'count': COUNT, 'sigma': NUMBER, 'expected': NUMBER,
            'found': NUMBER, **RATIOS}],
        'energy': {'expected': NUMBER, 'found': NUMBER, 'quantile95_share': NUMBER}, **RATIOS,
        'redundancy': NUMBER, 'independent': NUMBER, 'verdict': TEXT,
        'unused': {'count': COUNT, 'median_distance': Maybe(NUMBER)},
        'histogram': Maybe({'edges': [NUMBER], 'count': [COUNT]}),
        'series': {'t': [NUMBER], 'rows': [[Maybe(NUMBER)]]},
        'autocorrelation': Maybe({
            'lag': [NUMBER], 'value': [NUMBER], 'band': NUMBER, 'time': Maybe(NUMBER),
            'fitted': Maybe([NUMBER]), 'in_use': Maybe(NUMBER)}),
        'scale': NUMBER}],
    'springs': [{
        'rank': COUNT, 'name': TEXT, 'source': TEXT, 'kind': TEXT, 'energy': NUMBER,
        'expected': NUMBER, 'from': Maybe(PLACE), 'to': Maybe(PLACE),
        'text': TEXT}],
    'updates': Maybe({
        't': [NUMBER], 'nodes': [COUNT], 'ms': [NUMBER], 'chi2': [NUMBER], 'count': COUNT,
        'period': NUMBER}),
    'sparsity': [{'title': TEXT, 'size': COUNT, 'nonzeros': COUNT, 'fill': COUNT, 'bins': COUNT,
                  'cells': [[COUNT]]}],
    'parameters': None}


def problems(value: Any, kind: Any = SCHEMA, where: str = 'run') -> Iterator[str]:
    """Yield what is not as the schema has it."""
    if kind is None:
        return
    if isinstance(kind, Maybe):
        if value is not None:
            yield from problems(value, kind.kind, where)
    elif kind == TEXT:
        if not isinstance(value, str):
            yield f'{where}: {value!r} is no text'
    elif kind in (NUMBER, COUNT):
        if not _is_number(value, kind):
            yield f'{where}: {value!r} is no {kind}'
    elif isinstance(kind, list):
        every = value if isinstance(value, list) else []
        yield from () if isinstance(value, list) else (f'{where}: no list',)
        for at, each in enumerate(every):
            yield from problems(each, kind[0], f'{where}[{at}]')
    elif isinstance(kind, Columns):
        yield from _table_problems(value, kind.columns, where)
    elif not isinstance(value, Mapping) or set(value) != set(kind):
        keys = set(value) ^ set(kind) if isinstance(value, Mapping) else value
        yield f'{where}: unexpected or missing: {keys}'
    else:
        yield from (each for key in kind for each in problems(
            value[key], kind[key], f'{where}.{key}'))


def _is_number(value: Any, kind: str) -> bool:
    types = int if kind == COUNT else int | float
    return isinstance(value, types) and not isinstance(value, bool) and math.isfinite(value) and (
        kind != COUNT or value >= 0)


def _table_problems(value: Any, columns: Mapping[str, Any], where: str) -> Iterator[str]:
    if not isinstance(value, Mapping) or set(value) != set(columns):
        yield f'{where}: expected {sorted(columns)}, got {value if value is None else set(value)}'
        return
    sizes = set()
    for name, kind in columns.items():
        if kind is None:
            yield from problems(
                value[name], COUNT if name == 'left_out' else TEXT, f'{where}.{name}')
        elif value[name] is not None or not isinstance(kind, Maybe):
            yield from problems(value[name], [kind], f'{where}.{name}')
            sizes.add(len(value[name]))
    if len(sizes) > 1:
        yield f'{where}: columns of lengths {sizes}'
