# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories are read from the formats that users have, or refused with file and line."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.trajectory_files import PLANES, read_trajectory
from pose_graph_ros.core.io.tum import write_tum
from pose_graph_ros.core.trajectories.sequence import Key, PoseSequence

EUROC = ('#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], '
         'q_RS_z [], v_RS_R_x [m s^-1]\n')


def read(path: Path, text: str, plane: str = 'xy') -> PoseSequence:
    path.write_text(text, encoding='utf-8')
    return read_trajectory(path, plane)


def test_what_is_written_as_tum_reads_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = Trajectory(np.cumsum(rng.integers(1, 10**12, 50)) + 1_700_000_000_123_456_789,
                      se2.wrapped(rng.normal(size=(50, 3)) * (1e3, 1e3, 3.0)))
    write_tum(path, tmp_path / 'path.tum')
    text = (tmp_path / 'path.tum').read_text(encoding='ascii')
    again = read(tmp_path / 'tabs.tum', text.replace(' ', '\t'))
    found = read_trajectory(tmp_path / 'path.tum')
    np.testing.assert_array_equal(found.poses, again.poses)
    np.testing.assert_array_equal(found.keys, path.stamps_ns)
    np.testing.assert_array_equal(found.poses[:, :2], path.poses[:, :2])
    np.testing.assert_allclose(found.poses[:, 2], path.poses[:, 2], atol=1e-12)
    assert (found.key, found.covariances, found.dropped) == (Key.STAMP, None, 0)


@pytest.mark.parametrize('plane', PLANES)
def test_kitti_poses_of_a_camera_move_in_their_plane(plane: str, tmp_path: Path) -> None:
    a, b = PLANES[plane]
    axis = np.eye(3)[3 - a - b]
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5], [3.0, -1.0, -2.0]])
    lines = []
    for x, y, theta in poses:
        rotation = Rotation.from_rotvec(theta * axis).as_matrix()
        position = x * np.eye(3)[a] + y * np.eye(3)[b] + 7.0 * axis
        lines.append(' '.join(map(repr, np.column_stack((rotation, position)).ravel().tolist())))
    found = read(tmp_path / '00.txt', '\n'.join(lines), plane)
    np.testing.assert_allclose(found.poses, poses, atol=1e-12)
    assert found.keys.tolist() == [0, 1, 2]
    assert found.key is Key.INDEX


@pytest.mark.parametrize('text', [
    'stamp,x,y,theta\n1.5,1,2,0.5\n2.25,3,4,-0.5\n',
    't_s;y_m;x_m;frame;yaw_rad(nan if none)\n1.5;2;1;map;0.5\n2.25;4;3;map;-0.5\n',
    '# of today\n# time [s], x [m], y, yaw\n1.5,1,2,0.5\n\n# a comment\n2.25,3,4,-0.5\n',
    'time\tx\ty\tyaw\n1.5\t1\t2\t0.5\n2.25\t3\t4\t-0.5\n',
    'Timestamp X Y Heading\n2.25 3 4 -0.5\n1.5 1 2 0.5\n1.5 9 9 9\n',
    'stamp_ns,x,y,yaw\n1500000000,1,2,0.5\n2250000000,3,4,-0.5\n',
])
def test_a_header_says_what_the_columns_are(text: str, tmp_path: Path) -> None:
    found = read(tmp_path / 'path.csv', text)
    assert found.keys.tolist() == [1_500_000_000, 2_250_000_000]
    np.testing.assert_allclose(found.poses, [[1.0, 2.0, 0.5], [3.0, 4.0, -0.5]])
    assert found.dropped == text.count('9 9 9')


def test_euroc_has_nanoseconds_and_quaternions(tmp_path: Path) -> None:
    half = 0.25
    line = f'1403636579758555392,1,2,3,{np.cos(half)},0,0,{np.sin(half)},0.1\n'
    found = read(tmp_path / 'data.csv', EUROC + line)
    assert found.keys.tolist() == [1403636579758555392]
    np.testing.assert_allclose(found.poses, [[1.0, 2.0, 0.5]])


def test_a_table_may_have_covariances_and_no_headings(tmp_path: Path) -> None:
    found = read(tmp_path / 'path.csv', 'stamp,x,y,yaw,xx,xy,xyaw,yy,yyaw,yawyaw\n'
                                        '0,0,0,0,1,2,3,4,5,6\n1,0,0,0,,,,,,\n')
    assert found.covariances is not None
    np.testing.assert_array_equal(found.covariances[0], [[1, 2, 3], [2, 4, 5], [3, 5, 6]])
    assert np.all(np.isnan(found.covariances[1]))
    found = read(tmp_path / 'marginals.csv', 'id,x,y,theta,cov_xx,cov_xy,cov_xtheta,cov_yy,'
                                             'cov_ytheta,cov_thetatheta\n4,1,2,0,1,2,3,4,5,6\n')
    assert (found.key, found.keys.tolist()) == (Key.ID, [4])
    np.testing.assert_array_equal(found.covariances, [[[1, 2, 3], [2, 4, 5], [3, 5, 6]]])
    found = read(tmp_path / 'gps.csv', 'x,y\n1,2\n3,4\n')
    assert found.key is Key.INDEX
    assert np.all(np.isnan(found.poses[:, 2]))
    assert found.covariances is None


def test_vertices_of_a_graph_have_ids_and_are_composed_where_they_are_missing(
    tmp_path: Path,
) -> None:
    found = read(tmp_path / 'a.g2o', 'VERTEX_SE2 7 1 2 0.5\nVERTEX_SE2 3 4 5 0\n'
                                     'VERTEX_XY 9 1 1\nEDGE_SE2 3 7 1 0 0 1 0 0 1 0 1\n')
    assert found.keys.tolist() == [3, 7]
    np.testing.assert_allclose(found.poses, [[4.0, 5.0, 0.0], [1.0, 2.0, 0.5]])
    assert found.key is Key.ID
    found = read(tmp_path / 'b.txt', 'EDGE2 0 1 1 0 1.5 50 0 0 50 0 100\n')
    np.testing.assert_allclose(found.poses, [[0.0, 0.0, 0.0], [1.0, 0.0, 1.5]])


@pytest.mark.parametrize(('text', 'words'), [
    ('', 'a.txt: holds no pose'),
    ('# only a comment\n', 'a.txt: holds no pose'),
    ('x,y\n', 'a.txt: holds no pose'),
    ('1 2 3\n', 'a.txt:1: expected 8 numbers'),
    ('0 0 0 0 0 0 0 1\n1 0 0 0 0 0\n', 'a.txt:2: expected 8 values, got 6'),
    ('# tum\n0 0 0 0 0 0 0 1\n1 0 a 0 0 0 0 1\n', "a.txt:3: could not convert .*'a'"),
    ('0 0 nan 0 0 0 0 1\n', 'a.txt:1: holds a number that is missing or not finite'),
    ('0 0 0 0 0 0 0 0\n', 'a.txt:1: a quaternion must not be zero'),
    ('later 0 0 0 0 0 0 1\n', 'a.txt:1: the header names no x and y'),
    ('0 0 0 0 0 0 0 1\nlater 0 0 0 0 0 0 1\n', "a.txt:2: 'later' is no stamp"),
    ('nan 0 0 0 0 0 0 1\n', "a.txt:1: 'nan' is no stamp"),
    ('1e400 0 0 0 0 0 0 1\n', "a.txt:1: '1e400' is no stamp"),
    ('9e9 0 0 0 0 0 0 1\n', "a.txt:1: '9e9' is no stamp"),
    ('1,2,3,4\n', 'a.txt:1: a table needs a header'),
    ('stamp,north\n0,0\n', 'a.txt:1: the header names no x and y: stamp, north'),
    ('stamp,x,y\n0,,1\n', 'a.txt:2: holds a number that is missing'),
    ('stamp_ns,x,y\n0.5,1,1\n', "a.txt:2: '0.5' is no stamp"),
    ('VERTEX_SE2 0 1\n', 'a.txt:1: VERTEX_SE2 is followed by 4 numbers'),
])
def test_what_is_no_trajectory_is_refused_with_its_line(
    text: str, words: str, tmp_path: Path,
) -> None:
    with pytest.raises(FileFormatError, match=words):
        read(tmp_path / 'a.txt', text)


def test_bytes_are_no_trajectory(tmp_path: Path) -> None:
    (tmp_path / 'a.tum').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(FileFormatError, match=r'a\.tum: cannot be read as text'):
        read_trajectory(tmp_path / 'a.tum')
