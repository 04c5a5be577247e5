# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The lines of a g2o, TORO or iSAM file as columns of numbers; `g2o` says what they mean.

All lines of a tag are converted together. Only if that fails are they checked one by one, for the
number of the first line that is wrong and the reason.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NoReturn

import numpy as np

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, FACTORS

# Tags with the format that the caller names, see `edge2_order`.
AMBIGUOUS = ('EDGE2', 'ODOMETRY')
# Tags of kinds of edges that have one of their own.
OWN_TAGS: dict[FactorKind, str] = {kind: factor.tag for kind, factor in FACTORS.items()
                                 if factor.tag not in {'', 'EDGE_SE2'}}
# Numbers of ids and of values behind each tag; FIX is followed by any number of ids.
LAYOUT = {
    'VERTEX_SE2': (1, 3),
    'VERTEX2': (1, 3),
    'VERTEX': (1, 3),
    'EDGE_SE2': (2, 9),
    'EDGE2': (2, 9),
    'ODOMETRY': (2, 9),
    'EDGE': (2, 9),
    'EDGE_PRIOR_SE2': (1, 9),
    'EDGE_PRIOR_SE2_XY': (1, 5),
    'OBSERVED_SE2_OFFSET': (1, 12),
    'VERTEX_XY': (1, 2),
    **{tag: (2, len(FACTORS[kind].rows) * (len(FACTORS[kind].rows) + 3) // 2)
       for kind, tag in OWN_TAGS.items()},
    'LANDMARK': (2, 5),
}
_SWITCHES = ('VERTEX_SWITCH', 'EDGE_SWITCH_PRIOR')
_GZIP = b'\x1f\x8b'


@dataclass(slots=True)
class Lines:
    """The lines with one tag."""

    ids: IntArray  # shape (K, number of ids)
    numbers: FloatArray  # shape (K, number of values)
    lines: IntArray  # numbers of the lines in the file, from 1 on

    def __len__(self) -> int:
        return len(self.lines)

    def rows(self, rows: IntArray | slice) -> 'Lines':
        """Return some of the lines."""
        return Lines(self.ids[rows], self.numbers[rows], self.lines[rows])

    @classmethod
    def joined(cls, tables: Iterable['Lines']) -> 'Lines':
        """Return the lines of several tags with the same layout."""
        tables = list(tables)
        return cls(np.concatenate([each.ids for each in tables]),
                   np.concatenate([each.numbers for each in tables]),
                   np.concatenate([each.lines for each in tables]))


@dataclass(frozen=True, slots=True)
class GraphText:
    """A file as columns of numbers."""

    path: Path
    rows: dict[str, Lines]  # by tag, for all of `LAYOUT`
    fixes: Lines  # ids behind `FIX`, one a row
    skipped: dict[str, int]  # number of lines with other tags

    def where(self, line: int) -> str:
        """Return the name of the file with that of a line."""
        return f'{self.path}:{line}'


def read_text(path: Path) -> str:
    """Return the text of a file, also of one that gzip has compressed."""
    try:
        content = path.read_bytes()
        if content.startswith(_GZIP):
            import gzip  # noqa: PLC0415

            content = gzip.decompress(content)
        return content.decode('utf-8')
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise FileFormatError(f'{path}: cannot be read as text ({error})') from error


def read_lines(path: Path) -> GraphText:
    """Return what is in a file; FileFormatError with file and line if a line is malformed."""
    return lines_of(path, read_text(path))


def lines_of(path: Path, text: str) -> GraphText:
    """Return what is in the text of a file, as `read_lines`."""
    found: dict[str, tuple[list[list[str]], list[int]]] = {tag: ([], []) for tag in LAYOUT}
    fixes: tuple[list[list[str]], list[int]] = ([], [])
    skipped: dict[str, list[list[str]]] = {}
    for line, content in enumerate(text.splitlines(), 1):
        words = content.split()
        if len(words) == 0 or words[0][0] == '#':
            continue
        tag = words[0]
        if tag == 'EDGE_SE2_SWITCHABLE':
            tag, words = 'EDGE_SE2', ['EDGE_SE2', *words[1:3], *words[4:]]
        if tag in found:
            rows, lines = found[tag]
            rows.append(words)
            lines.append(line)
        elif tag == 'FIX':
            for word in words[1:]:
                fixes[0].append(['FIX', word])
                fixes[1].append(line)
        elif tag not in _SWITCHES:
            skipped.setdefault(tag, []).append([str(line), *words[1:2]])
    _forget_landmarks(fixes, skipped)
    if not any(lines for _, lines in found.values()):
        _raise_empty(path, skipped)
    try:
        tables = {tag: _lines(*each, *LAYOUT[tag]) for tag, each in found.items()}
        fixed = _lines(*fixes, 1, 0)
    except (ValueError, OverflowError):
        _raise_first(path, {**found, 'FIX': fixes})
    return GraphText(path, tables, fixed, {tag: len(each) for tag, each in skipped.items()})


def _lines(words: list[list[str]], lines: list[int], n_ids: int, n_numbers: int) -> Lines:
    """Return lines as arrays; raise ValueError or OverflowError if one is malformed."""
    n = len(words)
    if any(len(each) != 1 + n_ids + n_numbers for each in words):
        raise ValueError
    columns = [*zip(*words, strict=True)] if n > 0 else [()] * (1 + n_ids + n_numbers)
    ids = np.array([[*map(int, column)] for column in columns[1:1 + n_ids]], dtype=np.int64)
    numbers = np.fromiter(map(float, chain.from_iterable(columns[1 + n_ids:])), np.float64,
                          n * n_numbers)
    if not np.all(np.isfinite(numbers)):
        raise ValueError
    return Lines(np.ascontiguousarray(ids.T), np.ascontiguousarray(
        numbers.reshape(n_numbers, n).T), np.array(lines, dtype=np.int64))


def _raise_first(path: Path, found: dict[str, tuple[list[list[str]], list[int]]]) -> NoReturn:
    """Raise FileFormatError for the first line that is malformed."""
    for line, words in sorted((line, words) for rows, lines in found.values()
                              for line, words in zip(lines, rows, strict=True)):
        tag = words[0]
        layout = LAYOUT.get(tag, (1, 0))
        try:
            _lines([words], [line], *layout)
        except (ValueError, OverflowError) as error:
            raise FileFormatError(
                f'{path}:{line}: {tag} is followed by {sum(layout)} numbers, got '
                f'{len(words) - 1}: {" ".join(words[1:])}; ids are integers of 64 bits, the '
                f'others finite'
            ) from error
    raise AssertionError('no line is malformed')


def _forget_landmarks(
    fixes: tuple[list[list[str]], list[int]], skipped: dict[str, list[list[str]]],
) -> None:
    """Remove the FIX of vertices that were skipped."""
    names = {words[1] for tag, found in skipped.items() if tag.startswith('VERTEX')
             for words in found if len(words) > 1}
    kept = [k for k, (_, name) in enumerate(fixes[0]) if name not in names]
    fixes[0][:], fixes[1][:] = [fixes[0][k] for k in kept], [fixes[1][k] for k in kept]


def _raise_empty(path: Path, skipped: dict[str, list[list[str]]]) -> NoReturn:
    for tag, found in skipped.items():
        if 'SE3' in tag or tag in {'VERTEX3', 'EDGE3'}:
            raise FileFormatError(f'{path}:{found[0][0]}: {tag} is of a graph in space (3D), '
                                  f'which is not supported: graphs are planar (SE2)')
        raise FileFormatError(
            f'{path}:{found[0][0]}: tag {tag!r} is not known, and there is no line with one of '
            f'{", ".join(LAYOUT)}')
    raise FileFormatError(f'{path}: holds no vertex and no edge')
