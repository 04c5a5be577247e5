# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files with the corrected path: read by other readers, and held to other computations."""

import argparse
import csv
import json
from pathlib import Path
from xml.etree import ElementTree

from bag_of_messages import write_bag
from circle_bag import circle, fixes, odometry
import numpy as np
import pyproj
import pytest
from tum_files import read_tum

from pose_graph_ros.cli.arguments import FORMATS, replay
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.geometry import se2

DATUM = 50.7, 7.1, 0.3
ALTITUDE = 60.0
GPX, KML = '{http://www.topografix.com/GPX/1/1}', '{http://www.opengis.net/kml/2.2}'


@pytest.fixture(scope='module')
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replay in a map with a turned x axis, with all formats."""
    folder = tmp_path_factory.mktemp('exports')
    write_bag(folder / 'bag & co', (*odometry(), *fixes(np.zeros(2))))
    assert main(['replay', str(folder / 'bag & co'), '-o', str(folder), '--export', 'all',
                 '-p', f'datum:={list(DATUM)}']) == 0
    return folder


def geodetic(path: np.ndarray) -> np.ndarray:
    """Return latitudes and longitudes by another way: a turn, then geocentric coordinates."""
    latitude, longitude, yaw = DATUM
    phi, lam = np.radians(latitude), np.radians(longitude)
    e = np.cos(yaw) * path[:, 0] - np.sin(yaw) * path[:, 1]
    n = np.sin(yaw) * path[:, 0] + np.cos(yaw) * path[:, 1]
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    north = np.array([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)])
    to_centre = pyproj.Transformer.from_crs('EPSG:4979', 'EPSG:4978', always_xy=True)
    origin = np.array(to_centre.transform(longitude, latitude, ALTITUDE))
    points = origin + np.outer(e, east) + np.outer(n, north)
    lon, lat, _ = to_centre.transform(*points.T, direction='INVERSE')
    return np.column_stack((lat, lon))


def test_gpx_kml_and_geojson_have_the_path_on_the_earth(results) -> None:
    path = read_tum(results / 'path.tum')
    expected = geodetic(path.poses)
    times = [str(np.datetime64(stamp, 'ns').astype('datetime64[ms]')) + 'Z'
             for stamp in path.stamps_ns.tolist()]
    points = ElementTree.parse(results / 'path.gpx').getroot().findall(f'.//{GPX}trkpt')
    gpx = np.array([(float(each.attrib['lat']), float(each.attrib['lon'])) for each in points])
    assert [each.findtext(f'{GPX}time') for each in points] == times
    root = ElementTree.parse(results / 'path.kml').getroot()
    assert root.findtext(f'.//{KML}name') == 'bag & co'
    assert root.findtext(f'.//{KML}begin') == times[0]
    assert root.findtext(f'.//{KML}end') == times[-1]
    text = root.findtext(f'.//{KML}coordinates')
    assert text is not None
    kml = np.array([list(map(float, each.split(','))) for each in text.split()])[:, ::-1]
    feature, = json.loads((results / 'path.geojson').read_text(encoding='utf-8'))['features']
    geojson = np.array(feature['geometry']['coordinates'])[:, ::-1]
    assert feature['properties']['coordinateProperties']['times'] == times
    for found in (gpx, kml, geojson):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


def test_the_table_has_path_and_covariances(results) -> None:
    with (results / 'path.csv').open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    path = read_tum(results / 'path.tum')
    assert [round(int(row['stamp'].replace('.', ''))) for row in rows] == path.stamps_ns.tolist()
    poses = np.array([[float(row[key]) for key in ('x', 'y', 'yaw')] for row in rows])
    np.testing.assert_array_equal(poses[:, :2], path.poses[:, :2])
    np.testing.assert_allclose(poses[:, 2], path.poses[:, 2], atol=1e-12)
    for row in rows:
        xx, xy, xt, yy, yt, tt = (
            float(row[key]) for key in ('xx', 'xy', 'xyaw', 'yy', 'yyaw', 'yawyaw'))
        assert np.all(np.linalg.eigvalsh([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]) > 0.0)
        assert 0.0 < xx < 0.1


def test_the_full_path_is_that_of_odometry_through_the_nodes(results, tmp_path) -> None:
    path, full = read_tum(results / 'path.tum'), read_tum(results / 'path_full.tum')
    np.testing.assert_array_equal(full.stamps_ns, circle().stamps_ns)
    np.testing.assert_array_equal(full.at(path.stamps_ns), path.poses)
    true = se2.compose(np.array((0.0, 0.0, -DATUM[2])), circle().poses)
    far = [np.max(np.hypot(*(each.at(full.stamps_ns) - true).T[:2])) for each in (path, full)]
    assert far[1] < 0.005
    assert far[0] > 0.01    # a chord of 1 m is 12 mm inside of the circle
    graph = tmp_path / 'graph.g2o'
    graph.write_text(''.join(
        f'EDGE_SE2 {k} {k + 1} 0.01 0 0 400 0 0 400 0 2500\n' for k in range(300)))
    assert main(['replay', str(graph), '-o', str(tmp_path), '--export', 'tum_full']) == 0
    assert len(read_tum(tmp_path / 'path_full.tum')) == 301 > len(read_tum(tmp_path / 'path.tum'))


def test_evo_reads_tum_and_kitti(results) -> None:
    evo = pytest.importorskip('evo.tools.file_interface', reason='evo is not there')
    path = read_tum(results / 'path.tum')
    tum = evo.read_tum_trajectory_file(results / 'path.tum')
    kitti = evo.read_kitti_poses_file(results / 'path.kitti')
    np.testing.assert_allclose(tum.timestamps, path.stamps_ns * 1e-9, rtol=0.0, atol=1e-6)
    for read in (tum, kitti):
        assert read.check()[0]
        np.testing.assert_array_equal(read.positions_xyz[:, :2], path.poses[:, :2])
        np.testing.assert_allclose(
            [np.arctan2(pose[1, 0], pose[0, 0]) for pose in read.poses_se3], path.poses[:, 2],
            atol=1e-9)


def test_without_a_datum_there_is_no_place_on_the_earth(tmp_path, capsys) -> None:
    write_bag(tmp_path / 'bag', odometry())
    words = ['replay', str(tmp_path / 'bag'), '-o', str(tmp_path / 'out'), '--export']
    assert main([*words, 'csv,gpx']) == 2
    assert capsys.readouterr().err.startswith(
        'error: --export gpx: the place of the map on the Earth is unknown; give fixes (--fix')
    assert not (tmp_path / 'out').exists()
    # a datum alone does not tell where the robot was; what can be written is written
    assert main([*words, 'csv,gpx', '-p', 'datum:=[50.7, 7.1]']) == 2
    assert 'the place of the map on the Earth is unknown' in capsys.readouterr().err
    assert (tmp_path / 'out' / 'path.csv').exists()
    assert main([*words, 'all']) == 0
    assert {path.name for path in (tmp_path / 'out').iterdir()} == {
        'path.tum', 'path_full.tum', 'path.csv', 'path.kitti', 'graph.g2o', 'drive.png',
        'summary.json', 'run.json'}


def test_covariances_are_empty_where_nodes_have_left_the_graph(tmp_path) -> None:
    write_bag(tmp_path / 'bag', (*odometry(), *fixes(np.zeros(2))))
    assert main(['replay', str(tmp_path / 'bag'), '-o', str(tmp_path), '--export', 'csv',
                 '-p', 'window.nodes:=8']) == 0
    with (tmp_path / 'path.csv').open(encoding='utf-8') as file:
        known = [row['xx'] != '' for row in csv.DictReader(file)]
    content = json.loads((tmp_path / 'summary.json').read_text(encoding='utf-8'))
    assert known == [k >= content['frozen_nodes'] for k in range(81)]


def test_formats_are_named_once_and_unknown_ones_refused() -> None:
    parser = argparse.ArgumentParser(exit_on_error=False)
    replay(parser)
    given = {text: parser.parse_args(['bag', '--export', text]).export.formats
             for text in ('all', 'csv, gpx,csv')}
    assert given == {'all': FORMATS, 'csv, gpx,csv': ('csv', 'gpx')}
    with pytest.raises(argparse.ArgumentError, match="'gpx2' is no format; expected all or"):
        parser.parse_args(['bag', '--export', 'csv,gpx2'])
