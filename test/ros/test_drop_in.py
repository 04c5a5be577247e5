# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A migrated set-up of robot_localization on a robot: the same names, and a pose that is true."""

from contextlib import closing, suppress
from pathlib import Path
import re
import shlex

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')
pytest.importorskip('robot_localization.srv', reason=(
    'robot_localization is not there: dev/setup.sh --test builds its types with g++ and cmake'))
pytest.importorskip('pose_graph_ros.cli.migrate', reason='there is no pose-graph migrate yet')

from circle import PLANE, START, true_pose
from geographic_msgs.msg import GeoPoint
from harness import Client, fix, imu, NodeProcess, odometry, RELIABLE, stamp_ns, yaw
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.node import NodeNameNonExistentError
from robot_localization import srv
from sensor_msgs.msg import Imu

from pose_graph_ros.adapters import launch_arguments
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.geometry import se2

TREE = Path(__file__).resolve().parents[2]
DEFAULTS = {name: default for name, (default, _) in launch_arguments.arguments(TREE).items()}

FILTER = '''
    frequency: 30.0
    two_d_mode: true
    publish_tf: true
    map_frame: map
    odom_frame: odom
    base_link_frame: base_link
    odom0: odom
    odom0_config: [false, false, false, false, false, false,
                   true, true, true, false, false, true, false, false, false]
    imu0: imu
    imu0_config: [false, false, false, false, false, true,
                  false, false, false, false, false, false, false, false, false]
'''
# in the form of Nav2's tutorial on navigation by GPS: a filter for odom -> base_link, one for
# map -> odom, and navsat_transform between the receiver and the latter
DUAL = f'''
ekf_filter_node_odom:
  ros__parameters:{FILTER}
    world_frame: odom
ekf_filter_node_map:
  ros__parameters:{FILTER}
    world_frame: map
    odom1: odometry/gps
    odom1_config: [true, true, false, false, false, false,
                   false, false, false, false, false, false, false, false, false]
navsat_transform:
  ros__parameters:
    delay: 3.0
    zero_altitude: true
    broadcast_utm_transform: true
    publish_filtered_gps: true
    use_odometry_yaw: true
    wait_for_datum: false
'''
# what the two nodes that are replaced have there, by their sources and the remaps of the tutorial
PUBLISHED = {'/odometry/global': 'nav_msgs/msg/Odometry', '/tf': 'tf2_msgs/msg/TFMessage',
             '/odometry/gps': 'nav_msgs/msg/Odometry',
             '/gps/filtered': 'sensor_msgs/msg/NavSatFix',
             '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
             '/tf_static': 'tf2_msgs/msg/TFMessage'}
READ = {'/odom': 'nav_msgs/msg/Odometry', '/imu': 'sensor_msgs/msg/Imu',
        '/odometry/gps': 'nav_msgs/msg/Odometry', '/odometry/global': 'nav_msgs/msg/Odometry',
        '/set_pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
        '/gps/fix': 'sensor_msgs/msg/NavSatFix', '/tf': 'tf2_msgs/msg/TFMessage',
        '/tf_static': 'tf2_msgs/msg/TFMessage'}
OFFERED = {'/set_pose': 'SetPose', '/toggle': 'ToggleFilterProcessing', '/datum': 'SetDatum',
           '/toLL': 'ToLL', '/fromLL': 'FromLL', '/setUTMZone': 'SetUTMZone'}
OFFERED = {name: f'robot_localization/srv/{kind}' for name, kind in OFFERED.items()} | {
    '/enable': 'std_srvs/srv/Empty', '/reset': 'std_srvs/srv/Empty'}
GONE = {
    ('published', '/odometry/gps'): 'it was for the other of the two: fixes go into the graph',
    ('published', '/tf_static'): 'the frame utm: the map is a plane without zones',
    ('read', '/odometry/gps'): 'see above',
    ('read', '/odometry/global'): 'one node does the work of the two',
    ('read', '/odom'): 'wheels and gyroscope are in odometry/local, of the filter that stays',
    ('read', '/tf'): 'only /tf_static places antennas and gyroscopes',
    ('offered', '/setUTMZone'): 'the map is a plane without zones'}


def started_with(folder: Path) -> list[str]:
    """Return the arguments of the node by the file and the launch call that migrate writes."""
    (folder / 'dual.yaml').write_text(DUAL)
    out = folder / 'pose_graph.yaml'
    assert main(['migrate', str(folder / 'dual.yaml'), '-o', str(out)]) == 0
    (call,) = re.findall(r'ros2 launch pose_graph_ros pose_graph.launch.py (.*)', out.read_text())
    typed = dict(word.split(':=', 1) for word in shlex.split(call))
    assert typed.keys() <= DEFAULTS.keys()
    given = DEFAULTS | typed
    words = ['--params-file', launch_arguments.parameter_file(given)]
    for name, value in launch_arguments.parameters(given).items():
        words += ['-p', f'{name}:={value}']
    return words


def test_a_migrated_set_up_has_the_same_names_and_follows_a_drive(tmp_path: Path) -> None:
    (tmp_path / 'log').mkdir()
    with NodeProcess(tmp_path / 'log', started_with(tmp_path)) as process, closing(
            Client(int(process.env['ROS_DOMAIN_ID']), odom='odometry/local')) as client:
        compass = client.node.create_publisher(Imu, 'imu', RELIABLE)
        found: list[Odometry] = []
        client.node.create_subscription(Odometry, 'odometry/global', found.append, RELIABLE)
        client.wait_prepared()
        client.spin_until(lambda: all(each.get_subscription_count() > 0 for each in (
            client.odom, client.fix, compass)), 'the inputs are read')
        client.wait_matched()
        check_names(client)
        drive(client, compass, 60.0)
        client.spin_until(lambda: len(found) > 0 and stamp_ns(found[-1]) * 1e-9 > START + 59.8,
                          'the last pose comes')
        check_truth(client, found)


def check_names(client: Client) -> None:
    """Compare topics and services with those of robot_localization's nodes."""
    def own(kind: str) -> dict[str, list[str]]:
        of = {'published': client.node.get_publisher_names_and_types_by_node,
              'read': client.node.get_subscriber_names_and_types_by_node,
              'offered': client.node.get_service_names_and_types_by_node}[kind]
        found: dict[str, list[str]] = {}
        for node in ('pose_graph', '/'), ('_services', '/pose_graph'):
            with suppress(NodeNameNonExistentError):    # whose news has not come yet
                found.update(of(*node))
        return found
    for kind, theirs in (('published', PUBLISHED), ('read', READ), ('offered', OFFERED)):
        # on a busy machine names are heard of one after the other
        client.spin_until(lambda kind=kind, theirs=theirs: all(
            own(kind).get(name) == [type_name] for name, type_name in theirs.items()
            if (kind, name) not in GONE), f'all is {kind}')
        assert not [name for name in theirs if (kind, name) in GONE and name in own(kind)]
    assert own('read')['/odometry/local'] == ['nav_msgs/msg/Odometry']


def drive(client: Client, compass: object, end: float) -> None:
    """Stand for 3 s, then drive circles, with odometry that drifts, a receiver and a compass."""
    random, count = np.random.default_rng(5), 0
    for step in range(round(end * 10)):
        seconds = step / 10.0
        truth = true_pose(max(seconds - 3.0, 0.0))
        client.odom.publish(odometry(
            START + seconds, *drifting(seconds), 2.0 if seconds > 3.0 else 0.0))
        count += 1
        if step % 2 == 0:
            compass.publish(imu(START + seconds, truth[2] + random.normal(0.0, 0.02), 4e-4))
        if step % 5 == 0:
            place = truth[:2] + random.normal(0.0, 0.3, 2)
            latitude, longitude, _ = PLANE.to_geodetic(place, PLANE.altitude)
            client.fix.publish(fix(START + seconds, latitude, longitude, 0.3))
        client.spin_for(0.004)
        if step == 25:
            # a robot that Nav2 is to move knows where it is before it moves
            client.wait_values({'alignment': 'aligned'})
    client.wait_values({'odom.accepted': str(count)})


def drifting(seconds: float) -> list[float]:
    """Return the pose of odometry that turns 4 % too far, and is 2 % too long."""
    way = 2.0 * 1.02 * max(seconds - 3.0, 0.0)
    angle = way / 20.0 * 1.04 / 1.02
    radius = way / angle if angle > 0.0 else 0.0
    return [radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle]


def check_truth(client: Client, found: list[Odometry]) -> None:
    """Compare pose, fix and transform with the truth, in a map that begins at the first fix."""
    service = client.node.create_client(srv.FromLL, 'fromLL')
    origin = client.call(service, srv.FromLL.Request(ll_point=GeoPoint(
        latitude=PLANE.latitude, longitude=PLANE.longitude))).map_point

    def error(message: object, x: float, y: float) -> float:
        true_x, true_y, _ = true_pose(stamp_ns(message) * 1e-9 - START - 3.0)
        return float(np.hypot(x - true_x, y - true_y))

    apart = {'odometry/global': [
        error(each, each.pose.pose.position.x - origin.x, each.pose.pose.position.y - origin.y)
        for each in found]}
    apart['gps/filtered'] = [error(each, *PLANE.to_map(
        each.latitude, each.longitude, each.altitude)) for each in client.fixes]
    apart['/tf'] = [error(each, x - origin.x, y - origin.y) for each in client.transforms
                    for place in [each.transform.translation] for x, y, _ in [se2.compose(
                        np.array([place.x, place.y, yaw(each.transform.rotation)]),
                        np.array(drifting(stamp_ns(each) * 1e-9 - START)))]]
    for name, errors in apart.items():
        assert len(errors) > 500, name
        # driven for 10 s, until the end
        assert np.quantile(errors[-450:], 0.95) < 0.6, name
    ends = drifting(60.0)
    assert np.hypot(*(np.array(ends) - true_pose(57.0))[:2]) > 4.0, 'of odometry alone'
