# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The lines of a g2o, TORO or iSAM file as columns of numbers; `g2o` says what they mean.

All lines of a tag are converted together. Only if that fails are they checked one by one, for the
number of the first line that is wrong and the reason.
"""

from dataclasses import dataclass
import io
from operator import itemgetter
from pathlib import Path
from typing import Any, IO, NamedTuple, NoReturn
import warnings

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
_BLOCK = 1 << 20    # characters of a text whose lines are objects at a time
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


def read(path: Path) -> GraphText:
    """Return what is in a file, also of one that gzip has compressed; FileFormatError as below."""
    try:
        with path.open('rb') as file:
            content: IO[bytes] = file
            if file.peek(len(_GZIP)).startswith(_GZIP):
                import gzip  # noqa: PLC0415

                try:
                    content = io.BytesIO(gzip.decompress(file.read()))
                except Exception as error:  # of gzip, of zlib or of struct
                    raise OSError(error) from error
            return lines_of(path, io.TextIOWrapper(content, 'utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f'{path}: cannot be read as text ({error})') from error


def lines_of(path: Path, file: IO[str]) -> GraphText:
    """Return what is in a file of text; FileFormatError with the line if one is malformed."""
    tables: dict[str, list[Lines]] = {tag: [_lines([], [], tag)] for tag in TAGS}
    skipped: dict[str, list[list[str]]] = {}
    first = 1
    # so that not all lines are objects at once, nor the whole text is in memory
    while len(contents := file.readlines(_BLOCK)) > 0:
        # of each line the text, and its number
        found: dict[str, tuple[list[str], list[int]]] = {tag: ([], []) for tag in TAGS}
        for line, content in enumerate(contents, first):
            words = content.split(None, 1)
            tag = words[0] if len(words) > 0 else '#'
            if tag in found and tag != 'FIX':
                found[tag][0].append(content)
                found[tag][1].append(line)
            elif tag[0] == '#':
                pass
            elif tag == 'FIX':
                names = words[1].split() if len(words) > 1 else []
                found[tag][0].extend(f'FIX {name}' for name in names)
                found[tag][1].extend([line] * len(names))
            elif tag == 'EDGE_SE2_SWITCHABLE':
                words = content.split()
                found['EDGE_SE2'][0].append(' '.join(['EDGE_SE2', *words[1:3], *words[4:]]))
                found['EDGE_SE2'][1].append(line)
            elif tag not in _SWITCHES:
                skipped.setdefault(tag, []).append([str(line), *content.split(None, 2)[1:2]])
        first += len(contents)
        try:
            for tag, each in found.items():
                tables[tag].append(_lines(*each, tag))
        except (ValueError, OverflowError):
            _raise_first(path, found)
    rows = {tag: np.concatenate(tables.pop(tag)) for tag in TAGS}
    # without those of vertices that were skipped
    gone = {words[1] for tag, some in skipped.items() if tag.startswith('VERTEX')
            for words in some if len(words) > 1}
    rows['FIX'] = rows['FIX'][[str(name) not in gone for name in rows['FIX']['ids'][:, 0]]]
    if not any(len(some) for tag, some in rows.items() if tag != 'FIX'):
        _raise_empty(path, skipped)
    return GraphText(path, rows, {tag: len(each) for tag, each in skipped.items()})


def _lines(contents: list[str], lines: list[int], tag: str) -> Lines:
    """Return lines as arrays; raise ValueError or OverflowError if one is malformed."""
    n, n_ids, n_numbers = len(contents), TAGS[tag].n_ids, TAGS[tag].n_numbers
    table = np.empty(n, [('ids', 'i8', (n_ids,)), ('numbers', 'f8', (n_numbers,)), ('line', 'i8')])
    columns = [*zip(*(each.split(None, 1 + n_ids) for each in contents), strict=True)]
    if n > 0 and len(columns) != 1 + n_ids + (n_numbers > 0):
        raise ValueError
    for k, column in enumerate(columns[1:1 + n_ids]):
        table['ids'][:, k] = [*map(int, column)]
    if n > 0 and n_numbers > 0:
        # numbers of all lines at once, with what no number is behind each line
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            numbers = np.fromstring(' nan '.join([*columns[-1], '']), sep=' ')
        numbers = numbers.reshape(n, n_numbers + 1)
        if not np.all(np.isfinite(numbers) == (np.arange(n_numbers + 1) < n_numbers)):
            raise ValueError
        table['numbers'] = numbers[:, :-1]
    table['line'] = lines
    return table


def _raise_first(path: Path, found: dict[str, tuple[list[str], list[int]]]) -> NoReturn:
    """Raise FileFormatError for the first line that is malformed."""
    lines = [(line, tag, content) for tag, (contents, numbers) in found.items()
             for line, content in zip(numbers, contents, strict=True)]
    for line, tag, content in sorted(lines, key=itemgetter(0)):
        try:
            _lines([content], [line], tag)
        except (ValueError, OverflowError) as error:
            words = content.split()[1:]
            raise FileFormatError(
                f'{path}:{line}: {tag} is followed by {TAGS[tag].n_ids + TAGS[tag].n_numbers} '
                f'numbers, got {len(words)}: {" ".join(words)}; ids are integers of 64 '
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
