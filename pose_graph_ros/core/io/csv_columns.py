# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Find the columns of a trajectory in a table by the names in its header.

The header is the first line, or the last comment before numbers with commas or semicolons between
them; the separator is a comma, a semicolon, a tabulator or spaces. Units, as in `x [m]`, `x_m` or
`yaw_rad (nan if none)`, and upper case do not matter. Names that are known, others are ignored:

    stamp       stamp, timestamp, time, t; in seconds, or in nanoseconds if named so (stamp_ns,
                `[ns]`) or if a whole number of at least 15 digits
    id          id, if there is no stamp; without both, poses are in order
    position    x, y and maybe z; also tx, pos_x, p_x, position_x, p_rs_r_x (EuRoC), east, north
    heading     theta, yaw, heading [rad]; or a quaternion qx qy qz qw, also q_x, q_rs_x (EuRoC),
                orientation_x; without either, headings are unknown
    covariance  xx xy xyaw yy yyaw yawyaw, also with cov_ before them, and theta for yaw
"""

from dataclasses import dataclass
from pathlib import Path
import re

from pose_graph_ros.core.exceptions import FileFormatError

POSITION = {
    axis: (axis, f't{axis}', f'p{axis}', f'pos_{axis}', f'p_{axis}', f'position_{axis}',
           f'p_rs_r_{axis}', *other)
    for axis, other in (('x', ('east',)), ('y', ('north',)), ('z', ('up',)))}
QUATERNION = {axis: (f'q{axis}', f'q_{axis}', f'q_rs_{axis}', f'orientation_{axis}',
                     f'quat_{axis}')
              for axis in 'xyzw'}
HEADING = ('theta', 'yaw', 'heading')
STAMP = ('stamp', 'timestamp', 'time', 't')
COVARIANCE = ('xx', 'xy', 'xyaw', 'yy', 'yyaw', 'yawyaw')
FULL = (0, 1, 2, 1, 3, 4, 2, 4, 5)  # of a symmetric matrix, by the order of COVARIANCE
NUMBER = re.compile(r'[-+.\d]|nan|inf', re.IGNORECASE)
UNIT = re.compile(r'(_(s|sec|ns|nsec|m|rad))?(\s*[\[(].*)?$')


@dataclass(frozen=True, slots=True)
class Columns:
    """Where things stand in a table."""

    count: int
    """Of all columns."""
    position: tuple[int, ...]
    """Of x and y, and of z if there is one."""
    heading: tuple[int, ...] = ()
    """Of the heading [rad]; empty if there is none."""
    quaternion: tuple[int, ...] = ()
    """Of x, y, z, w; empty if there is none."""
    covariance: tuple[int, ...] = ()
    """Of the nine elements of the covariance of x, y and heading; empty if there is none."""
    stamp: int | None = None
    """Of the stamp; None if there is none."""
    id: int | None = None
    """Of the id of the node; None if there is none."""
    nanoseconds: bool | None = None
    """Whether stamps are in nanoseconds, not in seconds; None if nothing says so."""
    separator: str | None = None
    """None are spaces."""
    begin: int = 0
    """Index of the first line that may have numbers."""


def columns_of(path: Path, lines: list[str], first: int) -> Columns | None:
    """
    Return the columns by the header; None if there is none, and white space between the numbers.

    Parameters
    ----------
    first : int, index of the first line that is not empty and no comment

    Raises
    ------
    FileFormatError
        If there is a header without x and y, or commas without a header.

    """
    is_header = NUMBER.match(lines[first].lstrip()) is None
    at = first if is_header else _comment_before(lines, first)
    separator = next((each for each in ',;\t' if each in lines[first]), None)
    if not is_header and separator in {None, '\t'}:
        return None
    if at is None:
        raise FileFormatError(f'{path}:{first + 1}: a table needs a header with the names of its '
                              f'columns, such as stamp{separator}x{separator}y{separator}yaw')
    texts = lines[at].strip().lstrip('#').strip().split(separator)
    names = [UNIT.sub('', text.strip().strip('"').lower(), count=1) for text in texts]
    xyz = [_find(names, POSITION[axis]) for axis in 'xyz']
    if None in xyz[:2]:
        raise FileFormatError(f'{path}:{at + 1}: the header names no x and y: '
                              f'{", ".join(name.strip() for name in texts)}')
    quaternion = [_find(names, QUATERNION[axis]) for axis in 'xyzw']
    heading = _find(names, HEADING)
    short = [name.removeprefix('cov_').replace('theta', 'yaw') for name in names]
    covariance = [_find(short, (name,)) for name in COVARIANCE]
    stamp = _find(names, STAMP)
    return Columns(
        len(names), tuple(each for each in xyz if each is not None),
        () if heading is None or None not in quaternion else (heading,),
        _all_or_none(quaternion), _all_or_none([covariance[k] for k in FULL]), stamp,
        _find(names, ('id',)), None if stamp is None else _in_nanoseconds(texts[stamp]), separator,
        at + 1)


def _comment_before(lines: list[str], first: int) -> int | None:
    """Return the index of the last comment before a line."""
    return next((k for k in range(first - 1, -1, -1) if lines[k].lstrip().startswith('#')), None)


def _find(names: list[str], known: tuple[str, ...]) -> int | None:
    return next((k for k, name in enumerate(names) if name in known), None)


def _all_or_none(columns: list[int | None]) -> tuple[int, ...]:
    found = tuple(column for column in columns if column is not None)
    return found if len(found) == len(columns) else ()


def _in_nanoseconds(text: str) -> bool | None:
    """Return what the name of a stamp says of its unit."""
    unit = re.search(r'[\[(_ ](ns|nsec|nanoseconds|s|sec|seconds)\W*$', text.strip().lower())
    return None if unit is None else unit[1].startswith('n')
