# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text of files with a path: KITTI, CSV with covariances, TUM, and GeoJSON, KML and GPX."""

from array import array
from collections.abc import Iterator, Mapping
from decimal import Decimal
import json
import math
from pathlib import Path
import re
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry.se2 import Covariances, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import LARGEST_COORDINATE

PART = 10_000  # rows that are written at once
_XML = '<?xml version="1.0" encoding="UTF-8"?>'
CREATOR = 'pose_graph_ros'
TUM = 'stamp', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'
_SAME = {'t': 'stamp', 'time': 'stamp', 'timestamp': 'stamp', 'lat': 'latitude',
         'lon': 'longitude', 'altitude': 'z', 'theta': 'yaw'}
"""Other names of columns."""
_UNITS = {'stamp': 's sec seconds', 'latitude': 'deg degree degrees \u00b0',
          'longitude': 'deg degree degrees \u00b0', 'yaw': 'rad radian radians',
          **dict.fromkeys(('x', 'y', 'z'), 'm metre metres meter meters')}
_LARGEST = {'stamp': 2**63 / 1e9, 'latitude': 90.0, 'longitude': 360.0}


def _rows(*columns: npt.NDArray[Any]) -> Iterator[tuple[Any, ...]]:
    """Yield rows as plain numbers, in parts: a list of all of them takes ten times the memory."""
    for begin in range(0, len(columns[0]), PART):
        yield from zip(*(column[begin:begin + PART].tolist() for column in columns), strict=True)


def kitti_lines(path: Trajectory) -> Iterator[str]:
    """Yield a line for each pose: the upper three rows of its 4x4 matrix; there are no stamps."""
    headings = path.poses[:, 2]
    for (x, y, _), c, s in _rows(path.poses, np.cos(headings), np.sin(headings)):
        yield f'{c!r} {-s!r} 0 {x!r} {s!r} {c!r} 0 {y!r} 0 0 1 0'


def csv_lines(path: Trajectory, covariances: Covariances) -> Iterator[str]:
    """
    Yield a header and a row for each pose: stamp [s], pose, upper triangle of its covariance.

    Covariances are in map axes; their cells are empty where they are NaN.
    """
    yield 'stamp,x,y,yaw,xx,xy,xyaw,yy,yyaw,yawyaw'
    rows, columns = np.triu_indices(3)
    for stamp, pose, upper in _rows(path.stamps_ns, path.poses, covariances[:, rows, columns]):
        numbers = [*map(repr, pose), *('' if math.isnan(x) else repr(x) for x in upper)]
        yield f'{seconds_text(stamp)},{",".join(numbers)}'


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory; stamps and positions read back bit for bit, headings to rounding."""
    path.write_text(tum_text(trajectory), encoding='ascii')


def tum_text(trajectory: Trajectory) -> str:
    """Return the text of a TUM file with a trajectory."""
    half = trajectory.poses[:, 2] / 2
    return ''.join(('# timestamp tx ty tz qx qy qz qw\n', *(
        f'{seconds_text(stamp)} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}\n'
        for stamp, (x, y, _), qz, qw in _rows(
            trajectory.stamps_ns, trajectory.poses, np.sin(half), np.cos(half)))))


def seconds_text(stamp_ns: int) -> str:
    """Return a stamp [ns] in seconds, with all its digits."""
    seconds, nanoseconds = divmod(abs(stamp_ns), 1_000_000_000)
    return f'{"-" if stamp_ns < 0 else ""}{seconds}.{nanoseconds:09d}'


def _points(stamps_ns: IntArray, places: FloatArray) -> Iterator[tuple[str, str, str]]:
    """Yield latitude, longitude and time of each point as texts."""
    for begin in range(0, len(stamps_ns), PART):
        part = slice(begin, begin + PART)
        times = np.datetime_as_string(
            stamps_ns[part].astype('datetime64[ns]'), unit='ms', timezone='UTC')
        for (latitude, longitude), time in zip(places[part].tolist(), times, strict=True):
            yield f'{latitude:.10f}', f'{longitude:.10f}', str(time)


def gpx_lines(stamps_ns: IntArray, places: FloatArray, name: str) -> Iterator[str]:
    """Yield the lines of a GPX file with one track, given latitudes and longitudes [degrees]."""
    yield _XML
    yield f'<gpx version="1.1" creator="{CREATOR}" xmlns="http://www.topografix.com/GPX/1/1">'
    yield f'<trk><name>{escape(name)}</name><trkseg>'
    for latitude, longitude, time in _points(stamps_ns, places):
        yield f'<trkpt lat="{latitude}" lon="{longitude}"><time>{time}</time></trkpt>'
    yield '</trkseg></trk></gpx>'


def kml_lines(stamps_ns: IntArray, places: FloatArray, name: str) -> Iterator[str]:
    """Yield the lines of a KML file: one line on the ground through all points, its time span."""
    begin, end = (next(_points(stamps_ns[k:], places[k:]))[2] for k in (0, len(stamps_ns) - 1))
    yield _XML
    yield '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
    yield f'<Placemark><name>{escape(name)}</name>'
    yield f'<TimeSpan><begin>{begin}</begin><end>{end}</end></TimeSpan>'
    yield '<LineString><tessellate>1</tessellate><coordinates>'
    for latitude, longitude, _ in _points(stamps_ns, places):
        yield f'{longitude},{latitude}'
    yield '</coordinates></LineString></Placemark></Document></kml>'


def geojson_lines(stamps_ns: IntArray, places: FloatArray, name: str) -> Iterator[str]:
    """Yield the lines of a GeoJSON file: one LineString with the time of each position."""
    if len(stamps_ns) == 1:  # a LineString has at least two
        stamps_ns, places = np.repeat(stamps_ns, 2), np.repeat(places, 2, axis=0)
    yield '{"type": "FeatureCollection", "features": [{"type": "Feature",'
    yield '"geometry": {"type": "LineString", "coordinates": ['
    last = len(stamps_ns) - 1
    for k, (latitude, longitude, _) in enumerate(_points(stamps_ns, places)):
        yield f'[{longitude}, {latitude}]{"," if k < last else ""}'
    yield f']}}, "properties": {{"name": {json.dumps(name)}, "coordinateProperties": {{"times": ['
    for k, (_, _, time) in enumerate(_points(stamps_ns, places)):
        yield f'"{time}"{"," if k < last else ""}'
    yield ']}}}]}'


class PathFile(NamedTuple):
    """Poses as they stand in a file, in the order of their stamps; NaN for what it has not."""

    stamps_ns: IntArray  # strictly increasing, shape (N,)
    places: FloatArray  # x, y, z [m], or latitude, longitude [degrees], altitude [m], (N, 3)
    headings: FloatArray  # (N,) [rad]
    is_on_earth: bool


def read_path(path: Path) -> PathFile:
    """
    Return what is in a TUM file, or in a .csv file whose columns a header names.

    Lines that are empty or begin with # are left out. Raises FileFormatError.
    """
    is_table, stamps_ns, values = path.suffix == '.csv', array('q'), array('d')
    header: tuple[str, ...] = () if is_table else TUM
    try:
        lines = path.read_text(encoding='utf-8-sig').splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(f'{path}: no text') from error
    for number, line in enumerate(lines, 1):
        where = f'{path}:{number}'
        if len(header) == 0 and line.strip() != '':
            header = _header(where, line)
        elif line.strip() != '' and not line.lstrip().startswith('#'):
            words = line.split(',' if is_table else None)
            if len(words) != len(header):
                raise FileFormatError(f'{where}: expected {len(header)} values, '
                                      f'{" ".join(header)[:80]}, got {len(words)}')
            stamp_ns, row = _row(where, dict(zip(header, words, strict=True)))
            stamps_ns.append(stamp_ns)
            values.extend(row)
    if len(stamps_ns) == 0:
        raise FileFormatError(f'{path}: holds no pose')
    stamps, first = np.unique(np.array(stamps_ns), return_index=True)
    table = np.array(values).reshape(-1, 4)[first]
    return PathFile(stamps, table[:, :3], table[:, 3], 'latitude' in header)


def _header(where: str, line: str) -> tuple[str, ...]:
    """Return the names of the columns, without units; none for a comment."""
    words = [re.split(r'[\s\[(]+', word.strip().lower(), maxsplit=1)
             for word in line.lstrip(' #').split(',')]
    names = tuple(_SAME.get(name, name) for name, *_ in words)
    if {'stamp', 'x', 'y'} <= {*names} or {'stamp', 'latitude', 'longitude'} <= {*names}:
        for name, (_, *rest) in zip(names, words, strict=True):
            unit = ''.join(rest).strip(' ])')
            if name in _UNITS and unit not in {'', *_UNITS[name].split()}:
                raise FileFormatError(f'{where}: expected {name} in {_UNITS[name].split()[0]}, '
                                      f'got {unit[:40]!r}')
        return names
    if line.lstrip().startswith('#'):
        return ()
    raise FileFormatError(f'{where}: expected a header with the columns stamp, x, y or stamp, '
                          f'latitude, longitude, got {line.strip()[:80]!r}')


def _row(where: str, words: Mapping[str, str]) -> tuple[int, list[float]]:
    """Return the stamp [ns], and place and heading in a line."""
    values = {}
    for name in (*TUM, 'latitude', 'longitude', 'yaw'):
        if name not in words:
            continue
        text, most = words[name].strip(), _LARGEST.get(name, LARGEST_COORDINATE)
        try:
            values[name] = float(text)
        except ValueError:
            values[name] = math.nan
        if not abs(values[name]) <= most:
            unit = ' in seconds' if name == 'stamp' else ''
            raise FileFormatError(f'{where}: expected {name}{unit}, a number of at most '
                                  f'{most:.3g}, got {text[:40]!r}')
    x, y, z, w = (values.get(name, math.nan) for name in TUM[4:])
    if x == y == z == w == 0.0:
        raise FileFormatError(f'{where}: the quaternion is zero')
    yaw = values.get('yaw', math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))
    at = ('latitude', 'longitude', 'z') if 'latitude' in words else TUM[1:4]
    return round(Decimal(words['stamp'].strip()) * 1_000_000_000), [
        *(values.get(name, math.nan) for name in at), yaw]
