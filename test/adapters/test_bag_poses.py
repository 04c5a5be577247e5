# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses on a topic of a bag are read from each of the types that hold them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pose_graph_ros.adapters.bag_poses import PATH, POSE, POSE_TYPES, poses_on, read_poses
from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import BagError, open_bag
from pose_graph_ros.adapters.conversions import PLANAR

TYPES = message_types()
STRING = 'std_msgs/msg/String'
COVARIANCE = np.zeros((6, 6))
COVARIANCE[PLANAR] = [[1.0, 2.0, 3.0], [2.0, 5.0, 4.0], [3.0, 4.0, 6.0]]


def make(name: str, *values: Any) -> Any:
    return TYPES[name if '/' in name else f'geometry_msgs/msg/{name}'](*values)


def header(stamp: int) -> Any:
    time = make('builtin_interfaces/msg/Time', *divmod(stamp, 10**9))
    return make('std_msgs/msg/Header', time, 'map')


def pose(x: float, w: float = 1.0) -> Any:
    # turned by a right angle, with a norm other than 1
    return make('Pose', make('Point', x, 2.0, 9.0), make('Quaternion', 0.0, 0.0, w, w))


def message(kind: str, stamp: int, inner: Any) -> Any:
    if kind == POSE:
        return make(kind, header(stamp), inner)
    covered = make('PoseWithCovariance', inner, COVARIANCE.ravel())
    if kind != POSE_TYPES[0]:
        return make(kind, header(stamp), covered)
    twist = make('Twist', make('Vector3', 0.0, 0.0, 0.0), make('Vector3', 0.0, 0.0, 0.0))
    return make(kind, header(stamp), 'base', covered, make(
        'TwistWithCovariance', twist, COVARIANCE.ravel()))


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('poses') / 'bag'
    with BagWriter(folder) as bag:
        for kind in POSE_TYPES:
            for stamp, inner in ((20, pose(1.0)), (10, pose(3.0)), (15, pose(3.0, 0.0)),
                                 (16, pose(np.nan)), (20, pose(5.0))):
                bag.write('/' + kind.rpartition('/')[2], kind, 100, message(kind, stamp, inner))
        for xs in ((7.0,), (1.0, 3.0)):
            poses = [message(POSE, 10 * k, pose(x)) for k, x in enumerate(xs, 1)]
            bag.write('/path', PATH, 100, make(PATH, header(5), poses))
        bag.write('/none', PATH, 100, make(PATH, header(5), []))
        bag.write('/text', STRING, 100, make(STRING, 'hello'))
    return folder


@pytest.mark.parametrize('kind', POSE_TYPES)
def test_valid_poses_are_read_by_stamp(kind: str, folder: Path) -> None:
    with open_bag(folder) as bag:
        topic = '/' + kind.rpartition('/')[2]
        found = read_poses(bag, topic)
        assert len(list(poses_on(bag, topic))) == 3
    assert found.keys.tolist() == [10, 20]
    np.testing.assert_allclose(found.poses, [[3.0, 2.0, np.pi / 2], [1.0, 2.0, np.pi / 2]])
    assert found.dropped == 1
    if kind == POSE:
        assert found.covariances is None
    else:
        np.testing.assert_array_equal(found.covariances, [COVARIANCE[PLANAR]] * 2)


def test_of_paths_the_last_one_counts(folder: Path) -> None:
    with open_bag(folder) as bag:
        found = read_poses(bag, '/path')
    assert found.keys.tolist() == [10, 20]
    assert found.poses[:, 0].tolist() == [1.0, 3.0]


@pytest.mark.parametrize(('topic', 'words'), [
    ('/nowhere', 'no topic /nowhere; expected one of nav_msgs'),
    ('/text', 'type std_msgs/msg/String of /text'), ('/none', 'no valid pose on /none')])
def test_other_topics_are_refused(topic: str, words: str, folder: Path) -> None:
    with open_bag(folder) as bag, pytest.raises(BagError, match=words):
        read_poses(bag, topic)
