# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Text of files with a path on the Earth: GeoJSON (RFC 7946), KML 2.2 and GPX 1.1.

Positions are WGS 84 degrees with ten decimals, 0.01 mm. They have no altitude, which is not
estimated. Times are UTC, to the millisecond.
"""

from collections.abc import Iterator
import json
from xml.sax.saxutils import escape

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.io.tum import PART

_XML = '<?xml version="1.0" encoding="UTF-8"?>'
CREATOR = 'pose_graph_ros'


def _points(stamps_ns: IntArray, places: FloatArray) -> Iterator[tuple[str, str, str]]:
    """Yield latitude, longitude and time of each point as texts."""
    for begin in range(0, len(stamps_ns), PART):
        part = slice(begin, begin + PART)
        times = np.datetime_as_string(
            stamps_ns[part].astype('datetime64[ns]'), unit='ms', timezone='UTC')
        for (latitude, longitude), time in zip(places[part].tolist(), times, strict=True):
            yield f'{latitude:.10f}', f'{longitude:.10f}', str(time)


def gpx_lines(stamps_ns: IntArray, places: FloatArray, name: str) -> Iterator[str]:
    """
    Yield the lines of a GPX file with one track.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (N,) [ns]
    places : ndarray, shape (N, 2), latitude and longitude [degrees]
    name : str, of the track

    """
    yield _XML
    yield (f'<gpx version="1.1" creator="{CREATOR}" '
           'xmlns="http://www.topografix.com/GPX/1/1">')
    yield f'<trk><name>{escape(name)}</name><trkseg>'
    for latitude, longitude, time in _points(stamps_ns, places):
        yield f'<trkpt lat="{latitude}" lon="{longitude}"><time>{time}</time></trkpt>'
    yield '</trkseg></trk></gpx>'


def kml_lines(stamps_ns: IntArray, places: FloatArray, name: str) -> Iterator[str]:
    """
    Yield the lines of a KML file with one line on the ground and its time span.

    Parameters
    ----------
    stamps_ns, places, name : as for `gpx_lines`; at least one point

    """
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
    """
    Yield the lines of a GeoJSON file: one LineString with the time of each position.

    Parameters
    ----------
    stamps_ns, places, name : as for `gpx_lines`; of a single point two equal ones are made

    """
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
