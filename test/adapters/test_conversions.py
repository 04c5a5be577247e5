# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages in: what is read, and how what cannot be used is answered."""

from dataclasses import replace
import math

from harness import fix, imu, odometry, pose, transform
import pytest
from sensor_msgs.msg import Range as RangeMessage
from tf2_msgs.msg import TFMessage

from pose_graph_ros.adapters import conversions
from pose_graph_ros.adapters.conversions import Datum, StaticFrames, Surroundings
from pose_graph_ros.adapters.parameters import checked, checked_together
from pose_graph_ros.adapters.sources import MessageReader, ODOMETRY, Source
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.measurements import (
    Answer,
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    OdometrySample,
)

SOURCE = Source('any', ODOMETRY, 'any')
BY = Surroundings('map', 'base_link', Datum(), StaticFrames())


def test_odometry_is_read_whatever_the_length_of_its_quaternion() -> None:
    message = odometry(12.5, 1.0, -2.0, 2.5)
    message.pose.pose.orientation.z *= 3.0
    message.pose.pose.orientation.w *= 3.0
    sample = conversions.odometry(message, SOURCE, BY)
    assert sample.stamp_ns == 12_500_000_000
    assert sample.pose == pytest.approx([1.0, -2.0, 2.5])


@pytest.mark.parametrize('frame', ['map', '/map', ''])
def test_a_global_pose_in_the_map_is_taken(frame: str) -> None:
    given = conversions.global_pose(pose(1.0, 0.0, 0.0, 0.0, frame), SOURCE, BY)
    assert isinstance(given, GlobalPose)


@pytest.mark.parametrize(('frame', 'node', 'time'), [
    ('x42', 42, None), ('@1695.250000000', None, 1_695_250_000_000),
    ('@1695', None, 1_695_000_000_000), ('@1695.25', None, 1_695_250_000_000),
    ('@1700000000.123456789', None, 1_700_000_000_123_456_789)])
def test_the_reference_of_a_loop_closure(frame: str, node: int | None, time: int | None) -> None:
    closure = conversions.loop_closure(pose(2000.0, 1.0, 0.0, 0.0, frame), SOURCE, BY)
    assert isinstance(closure, LoopClosure)
    assert (closure.reference_node, closure.reference_ns) == (node, time)


@pytest.mark.parametrize('frame', [
    '', 'x', '@', 'x-1', '@-1.0', '@1.0e3', 'base_link', 'x1x', ' x1', '@1.1234567890', 'x1\n'])
def test_any_other_frame_of_a_loop_closure_is_refused(frame: str) -> None:
    answer = conversions.loop_closure(pose(2000.0, 1.0, 0.0, 0.0, frame), SOURCE, BY)
    assert isinstance(answer, Answer)
    assert answer.reason == 'wrong_frame'


def test_the_twist_of_odometry_tells_speed_and_noise() -> None:
    message = odometry(1.0, 0.0, 0.0, 0.0, speed=-3.0)
    message.twist.twist.linear.y = 4.0
    assert conversions.odometry(message, SOURCE, BY).speed == pytest.approx(5.0)
    assert conversions.odometry(message, SOURCE, BY).twist_variance is None
    message.twist.covariance[0], message.twist.covariance[35] = 0.01, 0.02
    sample = conversions.odometry(message, SOURCE, BY)
    assert sample.twist_variance.tolist() == [0.01, 0.0, 0.02]


@pytest.mark.parametrize('number', [math.nan, math.inf, -1.0, 1.7e308])
def test_a_twist_that_says_nothing_is_left_out(number: float) -> None:
    message = odometry(1.0, 0.0, 0.0, 0.0, speed=number)
    message.twist.covariance[0], message.twist.covariance[7] = 1.0, number
    sample = conversions.odometry(message, SOURCE, BY)
    assert isinstance(sample, OdometrySample)
    assert math.isfinite(sample.speed)
    assert sample.twist_variance is None


def test_an_imu_tells_the_heading_from_east() -> None:
    source = replace(SOURCE, yaw_offset=3.0, time_offset_ns=-500_000_000)
    measurement = conversions.heading(imu(2.5, 1.0, variance=0.04), source, replace(
        BY, datum=Datum((50.0, 7.0, 0.25))))
    assert isinstance(measurement, HeadingOnly)
    assert measurement.stamp_ns == 2_000_000_000
    assert measurement.heading == pytest.approx(3.75 - 2.0 * math.pi)
    assert measurement.variance == 0.04


def test_an_imu_without_an_orientation_is_refused() -> None:
    message = imu(1.0, 0.0)
    message.orientation_covariance[0] = -1.0
    assert conversions.heading(message, SOURCE, BY).reason == 'no_orientation'
    message = imu(1.0, 0.0)
    message.orientation.w = message.orientation.z = 0.0
    assert conversions.heading(message, SOURCE, BY).reason == 'not_finite'


def range_message(beacon: str, distance: float, variance: float = 0.0) -> RangeMessage:
    message = RangeMessage(min_range=0.1, max_range=50.0, range=distance, variance=variance)
    message.header.stamp.sec, message.header.frame_id = 3, beacon
    return message


def test_the_frame_of_a_range_names_the_beacon_and_perhaps_the_antenna() -> None:
    given = MessageReader(checked({
        'sources': ['odom', 'tags'], 'tags.type': 'range', 'tags.time_offset': 0.5,
        'tags.beacons': ['door 1.5 -2', 'window 3 4e1']}))
    one = given.read('tags', range_message('door', 7.5, 0.25))
    assert (one.stamp_ns, one.beacon, one.distance, one.variance) == (
        3_500_000_000, 'door', 7.5, 0.25)
    assert (one.place.tolist(), one.lever_arm.tolist()) == ([1.5, -2.0], [0.0, 0.0])
    given.frames.receive(TFMessage(transforms=[transform('base_link', 'tag', (0.75, -0.25, 1.0))]))
    other = given.read('tags', range_message('tag/hall', 7.5))
    assert (other.beacon, other.place, other.lever_arm.tolist()) == ('hall', None, [0.75, -0.25])
    assert given.surroundings.without_lever_arm['tags'] == 1
    for refused, reason in ((range_message('', 1.0), 'wrong_frame'),
                            (range_message('door', math.nan), 'not_finite'),
                            (range_message('door', math.inf), 'not_finite'),
                            (range_message('door', 51.0), 'out_of_range')):
        assert given.read('tags', refused).reason == reason


@pytest.mark.parametrize('text', ['door', 'door 1', 'door 1 x', 'door 1 nan', 'door 1 2 3', ''])
def test_a_beacon_without_name_and_place_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r'tags\.beacons: expected name, x and y'):
        checked_together({
            'sources': ['odom', 'tags'], 'tags.type': 'range', 'tags.beacons': [text]})


def reader(**values: object) -> MessageReader:
    return MessageReader(checked({
        name.replace('__', '.'): value for name, value in values.items()}))


def test_the_stamps_of_a_source_are_shifted_but_not_those_that_are_not_set() -> None:
    shifted = reader(sources=['odom', 'global_pose', 'fix', 'imu'], odom__time_offset=0.25,
                     global_pose__time_offset=-0.5, fix__time_offset=1.5, imu__time_offset=0.125,
                     loop_closure__time_offset=-1.0)
    for name, message, stamp_ns in (
            ('odom', odometry(10.0, 0.0, 0.0, 0.0), 10_250_000_000),
            ('global_pose', pose(10.0, 0.0, 0.0, 0.0), 9_500_000_000),
            ('fix', fix(10.0, 48.0, 11.0), 11_500_000_000),
            ('imu', imu(10.0, 0.0), 10_125_000_000),
            ('loop_closure', pose(10.0, 0.0, 0.0, 0.0, '@5.0'), 9_000_000_000)):
        measurement = shifted.read(name, message)
        assert measurement.stamp_ns == stamp_ns, name
        if name == 'loop_closure':
            assert measurement.reference_ns == 4_000_000_000
    assert shifted.read('odom', odometry(0.0, 0.0, 0.0, 0.0)).stamp_ns == 0
    assert shifted.read('fix', fix(0.0, 48.0, 11.0)).reason == 'zero_stamp'


def test_odometry_with_the_stamp_of_another_time_is_refused_unless_it_goes_on() -> None:
    one = reader()

    def answers(*seconds: float) -> list[str]:
        return [getattr(one.read('odom', odometry(at, 0.0, 0.0, 0.0)), 'reason', 'read')
                for at in seconds]

    assert answers(1e9, 1e9 + 59.0, 1e9 + 58.0) == 3 * ['read']
    assert answers(2e9, 1e9 + 60.0, 5.0, 5.1, 2e9, 2e9, 2e9) == [
        'stamp_leap', 'read', *(5 * ['stamp_leap'])]
    assert answers(1e9 + 61.0) == ['read']
    # it had been away, and is again
    for begin in (1.1e9, 1e9):
        assert answers(*(begin + 0.125 * step for step in range(11))) == (
            8 * ['stamp_leap'] + 3 * ['read'])


@pytest.mark.parametrize('offset', [-3600.0, -90.0, 0.5, 90.0, 3600.0])
def test_another_time_offset_is_no_leap_of_the_stamps(offset: float) -> None:
    values = checked({'sources': ['odom', 'imu']})
    one = MessageReader(values)
    one.configure({**values, 'odom.time_offset': 0.0})
    assert one.read('odom', odometry(1e9, 0.0, 0.0, 0.0)).stamp_ns == 10**18
    one.configure({**values, 'odom.time_offset': offset, 'imu.yaw_offset': 0.25})
    for at in (1e9 + 0.1, 1e9 + 0.2):
        sample = one.read('odom', odometry(at, 0.0, 0.0, 0.0))
        assert sample.stamp_ns == pytest.approx(1e9 * (at + offset), abs=1e3)
    assert one.read('odom', odometry(1e9 + 70.0, 0.0, 0.0, 0.0)).reason == 'stamp_leap'
    assert one.read('imu', imu(1e9, 0.5)).heading == pytest.approx(0.75)
