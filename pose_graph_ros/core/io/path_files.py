# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text of files with a path: KITTI, CSV with covariances, TUM, and GeoJSON, KML and GPX."""

from collections.abc import Iterator
import json
import math
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import Covariances, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory

PART = 10_000  # rows that are written at once
_XML = '<?xml version="1.0" encoding="UTF-8"?>'
CREATOR = 'pose_graph_ros'


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
