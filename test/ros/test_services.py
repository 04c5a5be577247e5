# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services and poses that are set: the real node over DDS."""

import math
from pathlib import Path
import re

from circle import drive, odometry_at, odometry_pose, path_error, START, true_pose
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import Client, LATCHED, NodeProcess, PATIENCE, pose, RELIABLE, yaw
import numpy as np
import pytest
from std_srvs.srv import SetBool
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.core.geometry import se2


def newest(client: Client) -> np.ndarray:
    """Return the pose that the node publishes with the newest odometry."""
    message = client.poses[-1].pose.pose
    return np.array([message.position.x, message.position.y, yaw(message.orientation)])


def go_on(client: Client, begin: float, end: float) -> None:
    """Publish odometry, exact, and nothing else."""
    already = int(client.values['processed'])
    for step in range(round(begin * 10), round(end * 10)):
        client.odom.publish(odometry_at(step / 10.0))
        client.spin_for(0.01)
    client.wait_processed(already + round((end - begin) * 10))
    client.wait_answered(START + end - 0.1)


def test_a_reset_begins_a_new_graph(client: Client) -> None:
    drive(client, 8.0)
    assert client.optimize().success
    answer = client.trigger('reset')
    assert answer.success
    assert 'hidden nodes are gone' in answer.message
    assert 'next good fix' in answer.message
    client.spin_until(lambda: 'hidden_nodes' not in client.values, 'it is reset')
    client.spin_until(lambda: len(client.paths[-1].poses) == 0, 'the path is taken back')
    drive(client, 20.0, begin=10.0)
    assert client.optimize().success
    assert client.paths[-1].poses[0].header.stamp.sec == START + 10.0
    # the map begins at the first fix now
    first = client.paths[-1].poses[0].pose.position
    assert math.hypot(first.x, first.y) < 1e-2


def test_a_pause_lets_nothing_in_and_the_outputs_go_on(client: Client) -> None:
    pause = client.node.create_client(SetBool, 'pose_graph/pause')
    drive(client, 10.0)
    assert client.optimize().success
    answer = client.call(pause, SetBool.Request(data=True))
    assert answer.success
    assert answer.message.startswith('paused')
    assert client.call(pause, SetBool.Request(data=True)).message == 'paused already'
    nodes, accepted = client.values['hidden_nodes'], client.values['odom.accepted']
    count = len(client.poses)
    drive(client, 13.0, begin=10.0, paced=True)
    client.spin_until(lambda: len(client.poses) - count >= 30, 'every message is answered')
    np.testing.assert_allclose(newest(client), true_pose(12.9), atol=1e-2)
    assert client.values['hidden_nodes'] == nodes
    assert client.values['odom.accepted'] == accepted
    assert client.values['odom.paused'] == '30'
    assert client.diagnostics[-1].status[0].message.startswith('Paused')
    assert client.call(pause, SetBool.Request(data=False)).success
    drive(client, 20.0, begin=13.0)
    assert client.optimize().success
    assert path_error(client) < 1e-2
    assert int(client.values['hidden_nodes']) > int(nodes)


def test_a_reset_and_optimize_while_there_is_nothing(client: Client) -> None:
    answer = client.trigger('optimize')
    assert not answer.success
    assert answer.message == 'there is no odometry yet'
    assert client.trigger('reset').success


@pytest.mark.parametrize(('topic', 'frame'), [
    ('initialpose', 'map'), ('set_pose', 'odom'), ('initialpose', 'base_link')])
def test_a_pose_is_set_in_the_frame_that_it_names(
    client: Client, topic: str, frame: str,
) -> None:
    setter = client.node.create_publisher(PoseWithCovarianceStamped, topic, RELIABLE)
    client.spin_until(lambda: setter.get_subscription_count() > 0, f'{topic} is heard')
    drive(client, 8.0)
    assert client.optimize().success
    before = true_pose(7.9)
    wanted = np.array([100.0, -40.0, 2.0])
    origin = {'map': np.zeros(3), 'base_link': before,
              'odom': se2.compose(before, se2.inverse(odometry_pose(7.9)))}[frame]
    setter.publish(pose(START + 7.9, *se2.between(origin, wanted).tolist(), frame=frame,
                        variances=(0.04, 0.04, 0.01)))
    client.spin_until(lambda: client.values.get('set_pose.accepted') == '1', 'it is set')
    go_on(client, 8.0, 9.0)
    moved = se2.between(before, true_pose(8.9))
    np.testing.assert_allclose(newest(client), se2.compose(wanted, moved), atol=0.02)
    assert client.poses[-1].pose.covariance[0] < 0.2
    # what was before stays where it was
    assert client.optimize().success
    assert math.hypot(client.paths[-1].poses[0].pose.position.x,
                      client.paths[-1].poses[0].pose.position.y) < 0.05


def test_a_pose_that_is_set_before_there_is_odometry_waits_for_it(client: Client) -> None:
    setter = client.node.create_publisher(PoseWithCovarianceStamped, 'initialpose', RELIABLE)
    client.spin_until(lambda: setter.get_subscription_count() > 0, 'it is heard')
    setter.publish(pose(START, 0.0, 0.0, 0.0, frame='elsewhere'))
    client.spin_until(lambda: client.values.get('set_pose.wrong_frame') == '1', 'it is refused')
    message = pose(0.0, 7.0, 8.0, 1.0)
    message.pose.covariance = [0.0] * 36
    setter.publish(message)
    client.wait_received(setter)
    go_on(client, 0.0, 6.0)
    client.spin_until(lambda: client.values['alignment'] == 'aligned', 'the map is laid')
    assert client.optimize().success
    first = client.paths[-1].poses[0].pose
    assert math.hypot(first.position.x - 7.0, first.position.y - 8.0) < 1e-3
    assert abs(se2.wrap(yaw(first.orientation) - 1.0)) < 1e-3


def test_the_markers_show_the_graph_while_someone_looks(client: Client) -> None:
    drive(client, 10.0)
    assert client.optimize().success
    arrays: list[MarkerArray] = []
    client.node.create_subscription(MarkerArray, 'graph', arrays.append, LATCHED)
    client.spin_until(lambda: len(arrays) > 0 and len(arrays[-1].markers) > 1, 'they come')
    markers = arrays[-1].markers
    assert markers[0].action == Marker.DELETEALL
    assert {marker.header.frame_id for marker in markers} == {'map'}
    by_name = {marker.ns: marker for marker in markers[1:]}
    nodes = int(client.values['hidden_nodes'])
    assert len(by_name['hidden_nodes'].points) == nodes
    assert len(by_name['odometry'].points) == 2 * (nodes - 1)
    assert len(by_name['observed_nodes'].points) > 10
    client.spin_until(lambda: 'largest_energy.1' in client.values, 'they are named')
    assert re.fullmatch(r'(fix at \d+\.\d{3} s near x\d+|odom x\d+ - x\d+): [\d.e-]+'
                        r'(, without its loss [\d.e-]+)?', client.values['largest_energy.1'])
    for point in by_name['observed_nodes'].points:
        assert abs(math.hypot(point.x, point.y - 20.0) - 20.0) < 1e-2
    client.trigger('reset')
    client.spin_until(lambda: len(arrays[-1].markers) == 1, 'they are taken back')


def test_a_graph_is_saved_and_another_node_goes_on_with_it(tmp_path: Path) -> None:
    """The second node loads the file, receives the rest of the drive, and has the whole path."""
    (tmp_path / 'b').mkdir()
    file = tmp_path / 'maps' / 'yard.g2o'
    arguments = ('-p', f'graph_file:={file}')
    with NodeProcess(tmp_path, arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        assert 'no graph to save' in client.trigger('save_graph').message
        drive(client, 20.0)
        assert client.optimize().success
        answer = client.trigger('save_graph')
        assert answer.success, answer.message
        assert 'yard.g2o' in answer.message
        nodes = int(client.values['hidden_nodes'])
        assert {path.name for path in file.parent.iterdir()} == {
            'yard.g2o', 'yard.json', 'yard.tum'}
        assert file.read_text().count('VERTEX_SE2') == nodes
        assert client.set_parameter('graph_file', str(tmp_path)) == (True, '')
        answer = client.trigger('save_graph')
        assert not answer.success
        assert 'folder' in answer.message
    with NodeProcess(tmp_path / 'b', arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        answer = client.trigger('load_graph')
        assert answer.success, answer.message
        client.spin_until(lambda: client.values.get('hidden_nodes') == str(nodes), 'it is there')
        client.spin_until(lambda: len(client.paths) > 0 and len(client.paths[-1].poses) >= nodes,
                          'its path comes')
        assert client.values['alignment'] == 'aligned'
        assert client.values['datum'].startswith('[48.1')
        assert not client.trigger('set_datum').success
        drive(client, 40.0, begin=20.0)
        assert client.optimize().success
        assert path_error(client) < 1e-3
        assert len(client.paths[-1].poses) > 1.9 * nodes
        assert 'odom.jump' not in client.values


def test_a_node_is_started_with_a_graph(tmp_path: Path) -> None:
    for folder in ('b', 'c'):
        (tmp_path / folder).mkdir()
    arguments = ('-p', f'graph_file:={tmp_path / "map"}', '-p', 'load_graph_on_start:=true')
    with NodeProcess(tmp_path, arguments[:2]) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        drive(client, 5.0)
        answer = client.trigger('save_graph')
        assert answer.success
        nodes = answer.message.split()[0]
    with NodeProcess(tmp_path / 'b', arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        client.spin_until(lambda: client.values.get('hidden_nodes') == nodes, 'it is there')
        assert client.values['datum'].startswith('[48.1')
        drive(client, 20.0, begin=5.0)
        assert client.optimize().success
        assert path_error(client) < 1e-3
        assert 'odom.jump' not in client.values
    (tmp_path / 'map.g2o').write_text('VERTEX_SE2 0 0 0 0\n')
    with NodeProcess(tmp_path / 'c', arguments) as node:
        assert node.process.wait(PATIENCE) == 2
        (line,) = node.stderr().splitlines()
        assert 'parameter load_graph_on_start: ' in line
        assert 'map.g2o: is damaged' in line


def test_the_first_start_of_a_robot_that_continues_its_graph(tmp_path: Path) -> None:
    arguments = ('-p', f'graph_file:={tmp_path / "maps" / "yard"}', '-p',
                 'load_graph_on_start:=true')
    with NodeProcess(tmp_path, arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        assert 'maps/yard yet: starting with an empty one' in node.stderr()
        drive(client, 5.0)
        answer = client.trigger('save_graph')
        assert answer.success
        nodes = answer.message.split()[0]   # the diagnostics may be a second older
    (tmp_path / 'second').mkdir()
    with NodeProcess(tmp_path / 'second', arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        client.spin_until(lambda: client.values.get('hidden_nodes') == nodes, 'it is there')
        assert 'yet' not in node.stderr()


def test_a_graph_that_cannot_be_loaded_is_refused_and_the_present_one_stays(
    tmp_path: Path,
) -> None:
    file = tmp_path / 'map.g2o'
    arguments = ('-p', f'graph_file:={file}', '-p', 'datum:=[48.1, 11.6]')
    with NodeProcess(tmp_path, arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        drive(client, 10.0)
        assert client.optimize().success
        assert client.trigger('save_graph').success
        nodes = client.values['hidden_nodes']
        side = file.with_suffix('.json')
        content = side.read_text()
        side.write_text(content[:-100])
        answer = client.trigger('load_graph')
        assert not answer.success
        assert 'map.json' in answer.message
        side.unlink()
        assert not client.trigger('load_graph').success
        assert client.set_parameter('graph_file', '') == (True, '')
        assert 'graph_file' in client.trigger('load_graph').message
        assert client.values['hidden_nodes'] == nodes
        assert client.values['resets'] == '0'
        side.write_text(content)
    (tmp_path / 'b').mkdir()
    arguments = ('-p', f'graph_file:={file}', '-p', 'datum:=[40.0, 11.6]')
    with NodeProcess(tmp_path / 'b', arguments) as node, \
            Client(int(node.env['ROS_DOMAIN_ID'])) as client:
        answer = client.trigger('load_graph')
        assert not answer.success
        assert 'another site' in answer.message
        assert client.values['resets'] == '0'
