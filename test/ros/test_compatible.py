# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services of robot_localization, called by its types as other nodes call them."""

from collections.abc import Iterator
import math
import sys
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from circle import drive, PLANE
from geometry_msgs.msg import Point
from harness import Client, NodeProcess, odometry, pose, yaw
from local_node import LocalNode
import numpy as np
from std_srvs.srv import Empty

from pose_graph_ros.ros.node import PoseGraphNode

try:
    from geographic_msgs.msg import GeoPoint
    from robot_localization import srv
except ImportError:
    srv = None

ARGUMENTS = ('-p', 'compatible:=robot_localization')
typed = pytest.mark.skipif(srv is None, reason=(
    'robot_localization is not there: dev/setup.sh --test builds its types with g++ and cmake'))
# Nav2's followers ask for points on the ground, with an altitude of 0
PLACES = [(48.1, 11.6), (48.1005, 11.5993), (48.09, 11.61), (48.25, 11.4)]


@pytest.fixture(scope='module')
def _shared_node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Start the node of these tests."""
    with NodeProcess(tmp_path_factory.mktemp('node'), ARGUMENTS) as process:
        yield process


def in_map(latitude: float, longitude: float, height: float, angle: float = 0.0) -> np.ndarray:
    """Return x and y of a point on the Earth by the textbook's formulas, by a turned datum."""
    def geocentric(latitude: float, longitude: float, height: float) -> np.ndarray:
        a, e2 = 6378137.0, 0.0066943799901413165
        n = a / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
        return np.array([(n + height) * math.cos(latitude) * math.cos(longitude),
                         (n + height) * math.cos(latitude) * math.sin(longitude),
                         (n * (1.0 - e2) + height) * math.sin(latitude)])
    phi, lam = math.radians(PLANE.latitude), math.radians(PLANE.longitude)
    east = np.array([-math.sin(lam), math.cos(lam), 0.0])
    north = np.array([-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam),
                      math.cos(phi)])
    away = geocentric(math.radians(latitude), math.radians(longitude), height) - geocentric(
        phi, lam, PLANE.altitude)
    x, y = east @ away, north @ away
    return np.array([math.cos(angle) * x + math.sin(angle) * y,
                     math.cos(angle) * y - math.sin(angle) * x])


def call(client: Client, kind: str, name: str, **fields: object) -> Any:
    """Call a service of robot_localization."""
    service = client.node.create_client(getattr(srv, kind), name)
    return client.call(service, getattr(srv, kind).Request(**fields))


def from_ll(client: Client, latitude: float, longitude: float, altitude: float = 0.0) -> Point:
    """Ask for a point on the Earth in the map, as Nav2's FollowGPSWaypoints does."""
    return call(client, 'FromLL', 'fromLL', ll_point=GeoPoint(
        latitude=latitude, longitude=longitude, altitude=altitude)).map_point


@typed
def test_points_are_converted_to_the_millimetre_and_back(client: Client) -> None:
    drive(client, 3.0)
    for latitude, longitude in PLACES:
        expected = in_map(latitude, longitude, PLANE.altitude)
        for altitude in (0.0, 480.0, math.nan):
            found = from_ll(client, latitude, longitude, altitude)
            assert (found.x, found.y, found.z) == pytest.approx((*expected, 0.0), abs=1e-3)
        back = call(client, 'ToLL', 'toLL', map_point=found).ll_point
        assert in_map(back.latitude, back.longitude, back.altitude) == pytest.approx(
            expected, abs=1e-3)
        assert back.altitude == pytest.approx(PLANE.altitude)
    points = [GeoPoint(latitude=one, longitude=two) for one, two in PLACES]
    found = call(client, 'FromLLArray', 'fromLLArray', ll_points=points).map_points
    assert (found[-1].x, found[-1].y) == pytest.approx(tuple(expected), abs=1e-3)
    back = call(client, 'ToLLArray', 'toLLArray', map_points=found).ll_points
    assert [(point.latitude, point.longitude) for point in back] == [
        pytest.approx(place, abs=1e-9) for place in PLACES]
    assert call(client, 'FromLLArray', 'fromLLArray').map_points == []


@typed
def test_what_gps_filtered_says_is_where_the_robot_is(client: Client) -> None:
    drive(client, 3.0)
    client.optimize()
    # with odometry that comes when the estimate is in the map
    drive(client, 4.0, begin=3.0, paced=True)
    client.spin_until(lambda: len(client.fixes) > 0, 'a fix comes')
    newest, place = client.fixes[-1], client.poses[-1].pose.pose.position
    found = from_ll(client, newest.latitude, newest.longitude, newest.altitude)
    assert (found.x, found.y) == pytest.approx((place.x, place.y), abs=1e-4)


@typed
@pytest.mark.parametrize('node', [ARGUMENTS], indirect=True)
def test_without_a_datum_nan_is_answered_and_the_log_says_why(
    node: NodeProcess, client: Client,
) -> None:
    found = from_ll(client, 48.1, 11.6)
    assert all(map(math.isnan, (found.x, found.y, found.z))), 'a robot would drive to 0'
    back = call(client, 'ToLL', 'toLL', map_point=Point()).ll_point
    assert all(map(math.isnan, (back.latitude, back.longitude, back.altitude)))
    assert 'fromLL: there is no datum yet' in node.stderr()
    assert 'toLL: there is no datum yet' in node.stderr()
    drive(client, 1.0)
    assert math.isnan(from_ll(client, 148.1, 11.6).x), 'not on Earth'
    assert 'fromLL: expected latitude in [-90, 90]' in node.stderr()
    point = call(client, 'ToLL', 'toLL', map_point=Point(x=math.nan)).ll_point
    assert math.isnan(point.altitude), 'no point at all'
    assert 'toLL: expected a point in the map, got [nan, 0.0]' in node.stderr()
    assert 'RuntimeWarning' not in node.stderr()


@typed
@pytest.mark.parametrize('node', [(*ARGUMENTS, '-r', 'datum:=site/datum')], indirect=True)
def test_a_datum_that_is_set_stays_and_is_refused_once_fixes_refer_to_another(
    node: NodeProcess, client: Client,
) -> None:
    def set_datum(latitude: float, angle: float) -> None:
        request = srv.SetDatum.Request()
        request.geo_pose.position.latitude = latitude
        request.geo_pose.position.longitude = PLANE.longitude
        request.geo_pose.orientation = odometry(0.0, 0.0, 0.0, angle).pose.pose.orientation
        client.call(client.node.create_client(srv.SetDatum, 'site/datum'), request)

    set_datum(95.0, 0.0)
    assert 'datum: refused: datum: expected latitude in [-90, 90]' in node.stderr()
    set_datum(40.0, 0.0)
    set_datum(PLANE.latitude, 0.5)  # no fix refers to the one before
    drive(client, 1.0, fixes=False)
    client.start_new_graph()
    drive(client, 3.0)
    expected = in_map(*PLACES[1], PLANE.altitude, 0.5)
    found = from_ll(client, *PLACES[1])
    assert (found.x, found.y) == pytest.approx(tuple(expected), abs=1e-3)
    set_datum(40.0, 0.0)
    assert 'datum: refused: 6 fixes in the graph refer to the datum [48.1' in node.stderr()
    assert from_ll(client, *PLACES[1]) == found


@typed
def test_the_pose_is_set_by_a_call(client: Client) -> None:
    drive(client, 1.0, fixes=False)
    call(client, 'SetPose', 'set_pose', pose=pose(0.0, 30.0, -4.0, 2.0))
    client.wait_values({'set_pose.accepted': '1'})
    drive(client, 1.2, begin=1.0, fixes=False, paced=True)
    newest = client.poses[-1].pose.pose
    assert math.hypot(newest.position.x - 30.0, newest.position.y + 4.0) < 1.0
    assert yaw(newest.orientation) == pytest.approx(2.0, abs=0.1)


@typed
def test_measurements_are_left_out_as_long_as_they_are_toggled_off(client: Client) -> None:
    drive(client, 1.0)
    assert call(client, 'ToggleFilterProcessing', 'toggle', on=False).status
    assert not call(client, 'ToggleFilterProcessing', 'toggle', on=False).status, 'it is off'
    client.wait_values({'paused': '1'})
    assert call(client, 'ToggleFilterProcessing', 'toggle', on=True).status
    client.wait_values({'paused': '0'})
    call(client, 'ToggleFilterProcessing', 'toggle', on=False)
    client.call(client.node.create_client(Empty, 'enable'), Empty.Request())
    client.wait_values({'paused': '0'})


@typed
def test_a_reset_starts_a_new_graph(client: Client) -> None:
    drive(client, 1.0)
    resets = int(client.values['resets'])
    client.call(client.node.create_client(Empty, 'reset'), Empty.Request())
    client.wait_values({'resets': str(resets + 1)})


def test_without_the_types_one_line_says_so_and_the_node_runs(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setitem(sys.modules, 'robot_localization', None)
    monkeypatch.setitem(sys.modules, 'robot_localization.srv', None)

    def make(context: Any) -> PoseGraphNode:
        node = PoseGraphNode(context=context, cli_args=['--ros-args', *ARGUMENTS])
        node.start()
        return node

    with LocalNode(tmp_path, make) as local:
        (said,) = [record.getMessage() for record in caplog.records if 'compatible' in record.msg]
        assert said.startswith('compatible: toLL, fromLL, datum, set_pose and toggle are not '
                               'offered, without the types of robot_localization: ')
        names = {service.srv_name for service in local.node.services}
        assert {'/reset', '/enable'} <= names
        assert '/fromLL' not in names
        local.node.close()
