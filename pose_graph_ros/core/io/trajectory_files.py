# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Read trajectories in the formats that users have them in, found out from the file itself.

    TUM      stamp x y z qx qy qz qw                    stamps in seconds
    KITTI    r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z  poses in order, without stamps
    CSV      a header with names, then as it says; see `columns_of`
    g2o      the hidden nodes, by id

Of poses in space, position and heading in a plane are taken. The heading is the angle of the
rotated first axis of that plane.
"""

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.io.csv_columns import Columns, columns_of
from pose_graph_ros.core.io.g2o import read_g2o
from pose_graph_ros.core.trajectories.sequence import in_order, Key, PoseSequence

PLANES = {'xy': (0, 1), 'xz': (2, 0), 'yz': (1, 2)}
"""First and second axis of a plane, so that its angle is that about the third axis."""
TUM_NUMBERS, KITTI_NUMBERS = 8, 12
TUM = Columns(TUM_NUMBERS, (1, 2, 3), quaternion=(4, 5, 6, 7), stamp=0, nanoseconds=False)
SECOND = 10**9  # [ns]
DIGITS_OF_NANOSECONDS = 15
"""Least number of digits of a whole number that is a stamp in nanoseconds, if none says so."""
MOST_STAMP_NS = 2**62  # the difference of two still fits
LEAST_NORM = 1e-6  # of a quaternion
GRAPH_TAGS = ('VERTEX', 'EDGE', 'FIX')

Line = tuple[int, list[str]]


def read_trajectory(path: Path, plane: str = 'xy') -> PoseSequence:
    """
    Return the trajectory in a text file, by stamp, by id or in order.

    Parameters
    ----------
    plane : str, a key of `PLANES`, of poses in space

    Raises
    ------
    FileFormatError
        If the file is none of the formats, or has no pose; the message names file and line.

    """
    try:
        lines = path.read_text(encoding='utf-8-sig').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f'{path}: cannot be read as text ({error})') from error
    first = next((number for number, line in enumerate(lines) if line.strip()
                  and not line.lstrip().startswith('#')), None)
    if first is None:
        raise FileFormatError(f'{path}: holds no pose')
    if path.suffix == '.g2o' or lines[first].lstrip().startswith(GRAPH_TAGS):
        return _read_graph(path)
    columns = columns_of(path, lines, first)
    if columns is not None:
        rows = _split(path, lines, columns.begin, columns.count, columns.separator)
        return _of_columns(path, rows, columns, plane)
    count = len(lines[first].split())
    rows = _split(path, lines, first, count)
    if count == TUM_NUMBERS:
        return _of_columns(path, rows, TUM, plane)
    if count == KITTI_NUMBERS:
        matrices = _numbers(path, rows, range(KITTI_NUMBERS)).reshape(-1, 3, 4)
        poses = planar(matrices[:, :, 3], matrices[:, :, :3], plane)
        return in_order(np.arange(len(poses)), poses, Key.INDEX)
    raise FileFormatError(
        f'{path}:{first + 1}: expected {TUM_NUMBERS} numbers (TUM), {KITTI_NUMBERS} (KITTI), or '
        f'a CSV file with a header, got {count} words')


def planar(positions: FloatArray, rotations: FloatArray, plane: str = 'xy') -> FloatArray:
    """
    Return poses in a plane, shape (N, 3) [m, m, rad].

    Parameters
    ----------
    positions : ndarray, shape (N, 3) [m]
    rotations : ndarray, shape (N, 3, 3)
    plane : str, a key of `PLANES`

    """
    a, b = PLANES[plane]
    headings = np.arctan2(rotations[:, b, a], rotations[:, a, a])
    return np.column_stack((positions[:, a], positions[:, b], se2.wrap(headings)))


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """Return rotation matrices, shape (N, 3, 3), of quaternions x, y, z, w, norm > 0, (N, 4)."""
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def _read_graph(path: Path) -> PoseSequence:
    # poses that are composed from edges need no information, so that its order does not matter
    file = read_g2o(path, 'isam')
    poses = file.graph.dimension == 3
    return in_order(file.ids[poses], file.graph.poses[poses], Key.ID)


def _of_columns(path: Path, rows: list[Line], columns: Columns, plane: str) -> PoseSequence:
    """Return the trajectory in a table."""
    if len(rows) == 0:
        raise FileFormatError(f'{path}: holds no pose')
    positions = np.zeros((len(rows), 3))
    positions[:, :len(columns.position)] = _numbers(path, rows, columns.position)
    if columns.quaternion:
        quaternions = _numbers(path, rows, columns.quaternion)
        norms = np.linalg.norm(quaternions, axis=1)
        if not np.all(norms > LEAST_NORM):
            line = rows[int(np.argmin(norms > LEAST_NORM))][0]
            raise FileFormatError(f'{path}:{line}: a quaternion must not be zero')
        poses = planar(positions, rotation_matrices(quaternions), plane)
    else:
        poses = np.column_stack((positions[:, :2], np.full(len(rows), np.nan)))
        if columns.heading:
            poses[:, 2] = se2.wrap(_numbers(path, rows, columns.heading, finite=False)[:, 0])
    covariances = _numbers(path, rows, columns.covariance, finite=False).reshape(
        -1, 3, 3) if columns.covariance else None
    if columns.stamp is not None:
        stamps = _stamps(path, rows, columns.stamp, columns.nanoseconds)
        return in_order(stamps, poses, Key.STAMP, covariances)
    if columns.id is not None:
        ids = _numbers(path, rows, [columns.id])[:, 0].astype(np.int64)
        return in_order(ids, poses, Key.ID, covariances)
    return in_order(np.arange(len(rows)), poses, Key.INDEX, covariances)


def _split(
    path: Path, lines: list[str], begin: int, count: int, separator: str | None = None,
) -> list[Line]:
    """Return number and words of the lines that are not empty and no comments."""
    rows = []
    for number, line in enumerate(lines[begin:], begin + 1):
        text = line.strip()
        if text == '' or text.startswith('#'):
            continue
        words = text.split(separator)
        if len(words) != count:
            raise FileFormatError(f'{path}:{number}: expected {count} values, got {len(words)}')
        rows.append((number, words))
    return rows


def _numbers(
    path: Path, rows: list[Line], columns: Sequence[int], *, finite: bool = True,
) -> FloatArray:
    """Return the numbers in some columns, shape (N, len(columns)); nothing is NaN."""
    table = np.empty((len(rows), len(columns)))
    for k, (line, words) in enumerate(rows):
        try:
            table[k] = [float(words[column].strip() or 'nan') for column in columns]
        except ValueError as error:
            raise FileFormatError(f'{path}:{line}: {error}') from error
    if finite and not np.all(np.isfinite(table)):
        line = rows[int(np.argmin(np.all(np.isfinite(table), axis=1)))][0]
        raise FileFormatError(f'{path}:{line}: holds a number that is missing or not finite')
    return table


def _stamps(path: Path, rows: list[Line], column: int, nanoseconds: bool | None) -> IntArray:
    """Return stamps [ns], exactly as they are written; None finds out whether they are in ns."""
    texts = [words[column].strip() for _, words in rows]
    if nanoseconds is None:
        nanoseconds = texts[0].isdecimal() and len(texts[0]) >= DIGITS_OF_NANOSECONDS
    stamps = np.empty(len(rows), dtype=np.int64)
    for k, text in enumerate(texts):
        try:
            stamp = int(text) if nanoseconds else _seconds(text)
            if abs(stamp) > MOST_STAMP_NS:
                raise OverflowError
            stamps[k] = stamp
        except (ValueError, OverflowError, ArithmeticError) as error:
            raise FileFormatError(f'{path}:{rows[k][0]}: {text!r} is no stamp') from error
    return stamps


def _seconds(text: str) -> int:
    """Return seconds in decimal notation [ns]."""
    whole, _, fraction = text.partition('.')
    if whole.isdecimal() and (fraction.isdecimal() or fraction == '') and len(fraction) <= 9:
        return int(whole) * SECOND + int(fraction.ljust(9, '0'))
    return round(Decimal(text) * SECOND)
