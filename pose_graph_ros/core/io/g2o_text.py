# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The lines of a g2o, TORO or iSAM file as columns of numbers; `g2o` says what they mean.

All lines of a tag are converted together. Only if that fails are they checked one by one, for the
number of the first line that is wrong and the reason.
"""

from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.graph.constraints import FactorKind, FACTORS


class Tag(NamedTuple):
    """What is behind a tag: ids, an offset if it has one, mean, upper triangle of information."""

    n_ids: int
    rows: int   # of the mean: the first one, two or three coordinates
    kind: FactorKind | None = None  # None if ids or information tell
    has_information: bool = True
    has_offset: bool = False
    order: str = ''     # of the information: `toro`, `isam`, or row by row

    @property
    def n_numbers(self) -> int:
        """Number of the values behind the ids."""
        return (3 * self.has_offset + self.rows
                + self.has_information * self.rows * (self.rows + 1) // 2)


# Tags with the format that the caller names, see `edge2_order`.
AMBIGUOUS = ('EDGE2', 'ODOMETRY')
_EDGE_SE2, _VERTEX = Tag(2, 3), Tag(1, 3, has_information=False)
TAGS = {
    'FIX': Tag(1, 0, has_information=False),    # of each of its ids, as if it stood alone
    'VERTEX_SE2': _VERTEX, 'VERTEX2': _VERTEX, 'VERTEX': _VERTEX,
    'VERTEX_XY': Tag(1, 2, has_information=False),
    'EDGE_SE2': _EDGE_SE2,
    'EDGE': _EDGE_SE2._replace(order='toro'),
    **dict.fromkeys(AMBIGUOUS, _EDGE_SE2),
    **{factor.tag: Tag(2, len(factor.rows), kind) for kind, factor in FACTORS.items()
       if factor.tag not in {'', 'EDGE_SE2'}},
    'LANDMARK': Tag(2, 2, FactorKind.POINT, order='isam'),
    'EDGE_PRIOR_SE2': Tag(1, 3),
    'EDGE_PRIOR_SE2_XY': Tag(1, 2),
    'OBSERVED_SE2_OFFSET': Tag(1, 3, has_offset=True),
}
MEASURED = [tag for tag, layout in TAGS.items() if layout.has_information]
_SWITCHES = ('VERTEX_SWITCH', 'EDGE_SWITCH_PRIOR')
_GZIP = b'\x1f\x8b'


# Records of the lines with one tag: ids, numbers behind them, and the number of the line in the
# file, from 1 on.
Lines = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class GraphText:
    """A file as columns of numbers."""

    path: Path
    rows: dict[str, Lines]  # by tag, for all of `TAGS`
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

            try:
                content = gzip.decompress(content)
            except Exception as error:  # of gzip, of zlib or of struct
                raise OSError(error) from error
        return content.decode('utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f'{path}: cannot be read as text ({error})') from error


def lines_of(path: Path, text: str) -> GraphText:
    """Return what is in the text of a file; FileFormatError with the line if one is malformed."""
    # of each line the words, and its number behind them
    found: dict[str, list[list[Any]]] = {tag: [] for tag in TAGS}
    skipped: dict[str, list[list[str]]] = {}
    for line, content in enumerate(text.splitlines(), 1):
        words = content.split()
        if len(words) == 0 or words[0][0] == '#':
            continue
        tag = words[0]
        if tag == 'EDGE_SE2_SWITCHABLE':
            tag, words = 'EDGE_SE2', ['EDGE_SE2', *words[1:3], *words[4:]]
        if tag in found:
            found[tag] += ([[*words, line]] if tag != 'FIX' else
                           [[tag, word, line] for word in words[1:]])
        elif tag not in _SWITCHES:
            skipped.setdefault(tag, []).append([str(line), *words[1:2]])
    # without those of vertices that were skipped
    names = {words[1] for tag, some in skipped.items() if tag.startswith('VERTEX')
             for words in some if len(words) > 1}
    found['FIX'] = [words for words in found['FIX'] if words[1] not in names]
    if not any(some for tag, some in found.items() if tag != 'FIX'):
        _raise_empty(path, skipped)
    try:
        tables = {tag: _lines(some, TAGS[tag]) for tag, some in found.items()}
    except (ValueError, OverflowError):
        _raise_first(path, found)
    return GraphText(path, tables, {tag: len(each) for tag, each in skipped.items()})


def _lines(words: list[list[Any]], tag: Tag) -> Lines:
    """Return lines as arrays; raise ValueError or OverflowError if one is malformed."""
    n, n_ids, n_numbers = len(words), tag.n_ids, tag.n_numbers
    if any(len(each) != 2 + n_ids + n_numbers for each in words):
        raise ValueError
    columns = [*zip(*words, strict=True)] if n > 0 else [()] * (2 + n_ids + n_numbers)
    table = np.empty(n, [('ids', 'i8', (n_ids,)), ('numbers', 'f8', (n_numbers,)), ('line', 'i8')])
    table['ids'] = np.array([[*map(int, column)] for column in columns[1:1 + n_ids]], np.int64).T
    table['numbers'] = np.fromiter(map(float, chain.from_iterable(columns[1 + n_ids:-1])),
                                   np.float64, n * n_numbers).reshape(n_numbers, n).T
    table['line'] = columns[-1]
    if not np.all(np.isfinite(table['numbers'])):
        raise ValueError
    return table


def _raise_first(path: Path, found: dict[str, list[list[Any]]]) -> NoReturn:
    """Raise FileFormatError for the first line that is malformed."""
    for words in sorted(chain.from_iterable(found.values()), key=itemgetter(-1)):
        tag = TAGS[words[0]]
        try:
            _lines([words], tag)
        except (ValueError, OverflowError) as error:
            raise FileFormatError(
                f'{path}:{words[-1]}: {words[0]} is followed by {tag.n_ids + tag.n_numbers} '
                f'numbers, got {len(words) - 2}: {" ".join(words[1:-1])}; ids are integers of 64 '
                'bits, the others finite') from error
    raise AssertionError('no line is malformed')


def _raise_empty(path: Path, skipped: dict[str, list[list[str]]]) -> NoReturn:
    for tag, found in skipped.items():
        if 'SE3' in tag or tag in {'VERTEX3', 'EDGE3'}:
            raise FileFormatError(
                f'{path}:{found[0][0]}: {tag} is of a graph in space (3D), which is not '
                'supported: graphs are planar (SE2). Of a robot on level ground, write x, y and '
                'yaw as VERTEX_SE2 and EDGE_SE2; solve others with g2o or GTSAM')
    for tag, found in skipped.items():
        raise FileFormatError(
            f'{path}:{found[0][0]}: tag {tag!r} is not known, and there is no line with one of '
            f'{", ".join(TAGS)}')
    raise FileFormatError(f'{path}: holds no vertex and no edge')
