# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph replay --bag`: the original messages with path, odometry and TF of the result."""

from pathlib import Path
from typing import Any

from bag_of_messages import write_bag
from circle_bag import circle, fixes, odometry, write_ros1
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from tum_files import read_tum

from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.adapters.conversions import planar_pose, stamp_ns
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import Message
from pose_graph_ros.core.geometry import se2

TYPES = message_types()
TF = 'tf2_msgs/msg/TFMessage'
FIRST = int(circle().stamps_ns[0])


def transform(parent: str, child: str) -> Any:
    header = TYPES['std_msgs/msg/Header'](TYPES['builtin_interfaces/msg/Time'](1, 2), parent)
    return TYPES['geometry_msgs/msg/TransformStamped'](
        header, child, TYPES['geometry_msgs/msg/Transform'](
            TYPES['geometry_msgs/msg/Vector3'](1.0, 2.0, 3.0),
            TYPES['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)))


def recorded() -> list[Message]:
    """A drive, with transforms, of which one is that of another localisation."""
    return [*odometry(), *fixes(np.zeros(2)),
            ('/tf', TF, FIRST + 1, TYPES[TF]([transform('odom', 'base_link')])),
            ('/tf', TF, FIRST + 2, TYPES[TF]([transform('map', 'odom')])),
            ('/tf', TF, FIRST + 3, TYPES[TF]([transform('odom', 'a'), transform('map', 'odom')])),
            ('/tf_static', TF, FIRST + 4, TYPES[TF]([transform('base_link', 'camera')])),
            ('/odometry/filtered', 'nav_msgs/msg/Odometry', FIRST, odometry()[0][3])]


@pytest.mark.parametrize('ros1', [False, True])
def test_the_new_bag_has_all_messages_and_the_result(tmp_path, ros1, capsys) -> None:
    if ros1:
        bag = write_ros1(tmp_path / 'bag.bag', recorded())
    else:
        write_bag(bag := tmp_path / 'bag', recorded())
    assert main(['replay', str(bag), '-o', str(tmp_path / 'out'), '--odom', '/odom',
                 '--bag', str(tmp_path / 'new')]) == 0
    assert '483 messages copied, 2 left out, 400 poses of odometry' in capsys.readouterr().out
    path = read_tum(tmp_path / 'out' / 'path.tum')
    with open_bag(tmp_path / 'new') as new:
        found: dict[str, list[Any]] = {topic: [] for topic in new.topics}
        for message in new.messages(list(new.topics)):
            found[message.topic].append(message)
    with open_bag(bag) as old:
        for topic in ('/odom', '/gps/fix', '/tf_static'):
            before = list(old.messages([topic]))
            assert [each.recorded_ns for each in found[topic]] == [
                each.recorded_ns for each in before]
            if not ros1:
                assert [each.raw for each in found[topic]] == [each.raw for each in before]
    sent = found['/path'][0].decode()
    assert [stamp_ns(each) for each in sent.poses] == path.stamps_ns.tolist()
    corrected = [each.decode() for each in found['/odometry/filtered']]
    poses = {stamp_ns(each): planar_pose(each.pose.pose) for each in corrected}
    at_nodes = np.array([poses[stamp] for stamp in path.stamps_ns.tolist()])
    np.testing.assert_allclose(at_nodes, path.poses, atol=1e-9)
    # between the nodes it is better than straight lines: the circle has a sagitta of 1 cm
    truth = circle()
    every = np.array([poses[stamp] for stamp in truth.stamps_ns.tolist()])
    np.testing.assert_allclose(every[:, :2], truth.poses[:, :2] + at_nodes[0, :2], atol=0.02)
    covariance = np.array(corrected[200].pose.covariance).reshape(6, 6)
    assert 0.0 < covariance[0, 0] < 0.1
    # odometry, moved by the transform, is the corrected pose
    moves = {stamp_ns(item): planar_pose_of(item.transform) for each in found['/tf']
             for item in each.decode().transforms if item.header.frame_id == 'map'}
    assert len(moves) == 400
    for _, _, stamp, message in odometry()[::40]:
        pose = planar_pose(message.pose.pose)
        assert pose is not None
        np.testing.assert_allclose(se2.wrapped(
            se2.compose(moves[stamp], pose) - poses[stamp]), 0.0, atol=1e-9)
    others = [(item.header.frame_id, item.child_frame_id) for each in found['/tf']
              for item in each.decode().transforms if item.header.frame_id != 'map']
    assert others == [('odom', 'base_link'), ('odom', 'a')]


def planar_pose_of(item: Any) -> np.ndarray:
    """Return a planar transform as a pose."""
    return np.array([item.translation.x, item.translation.y,
                     2.0 * np.arctan2(item.rotation.z, item.rotation.w)])


def test_static_transforms_from_before_a_span_are_kept(tmp_path) -> None:
    write_bag(tmp_path / 'bag', recorded())
    words = ['replay', str(tmp_path / 'bag'), '-o', str(tmp_path / 'out'), '--odom', '/odom',
             '--from', '10', '--until', '20', '--bag', str(tmp_path / 'new')]
    assert main(words) == 0
    with open_bag(tmp_path / 'new') as new:
        static, = new.messages(['/tf_static'])
        assert static.recorded_ns == FIRST + 10 * 10**9
        assert new.topics['/odom'].count == new.topics['/odometry/filtered'].count == 100
    assert main(words) == 2     # nothing is overwritten


def test_types_of_their_own_are_copied_from_ros_1_and_ros_2(tmp_path) -> None:
    name, text = 'my_msgs/msg/Level', 'std_msgs/Header header\nfloat64 level\n'
    for store, writes in ((Stores.ROS1_NOETIC, 'one'), (Stores.ROS2_JAZZY, 'two')):
        types = get_typestore(store)
        types.register(get_types_from_msg(text, name))
        kinds = types.types
        stamp = kinds['builtin_interfaces/msg/Time'](3, 4)
        numbers = (7,) if store is Stores.ROS1_NOETIC else ()
        message = kinds[name](kinds['std_msgs/msg/Header'](*numbers, stamp, 'tank'), 1.5)
        path = write_own(tmp_path / writes, types, name, message, store is Stores.ROS1_NOETIC)
        with open_bag(path) as source, BagWriter(tmp_path / f'{writes}_copy') as copy:
            for each in source.messages(['/level']):
                copy.copy(each)
        with open_bag(tmp_path / f'{writes}_copy') as read:
            found, = [each.decode() for each in read.messages(['/level'])]
        assert (found.level, found.header.frame_id) == (1.5, 'tank')
        assert stamp_ns(found) == 3 * 10**9 + 4


def write_own(folder: Path, types: Any, name: str, message: Any, ros1: bool) -> Path:
    """Write one message as a bag."""
    path = folder.with_suffix('.bag') if ros1 else folder
    with (Writer1(path) if ros1 else Writer2(
            path, version=9, storage_plugin=StoragePlugin.MCAP)) as writer:
        connection = writer.add_connection('/level', name, typestore=types)
        data = types.serialize_ros1(message, name) if ros1 else types.serialize_cdr(message, name)
        writer.write(connection, 5, data)
    return path
