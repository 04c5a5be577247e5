# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses on a topic of a bag are read from each of the types that hold them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pose_graph_ros.adapters.bag_inputs import POSE, POSE_TYPES, poses_on
from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.adapters.conversions import PLANAR

TYPES = message_types()
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
    return folder


@pytest.mark.parametrize('kind', POSE_TYPES)
def test_valid_poses_are_read_by_stamp(kind: str, folder: Path) -> None:
    with open_bag(folder) as bag:
        topic = '/' + kind.rpartition('/')[2]
        found = list(poses_on(bag, topic))
    assert [each.stamp_ns for each in found] == [20, 10, 20]
    np.testing.assert_allclose([each.pose for each in found], [
        [x, 2.0, np.pi / 2] for x in (1.0, 3.0, 5.0)])
