# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
More than 200 malformed messages on every topic, to the real node over DDS.

Each is a message of the drive with a broken value. Each must be counted, and none may change the
path: if its defect can be repaired the rest of it is correct, else it is rejected.
"""

from collections.abc import Callable
import math
import random

from circle import check_pose, drive, fix_at, odometry_at, path_error, START, true_pose
from harness import Client, imu, NodeProcess, pose
import numpy as np
import pytest
from sensor_msgs.msg import Imu

from pose_graph_ros.core.geometry import se2

COUNT = 210
"""Number of messages on each topic."""
BEFORE = 60.0
"""Time of the malformed odometry before the drive, since the engine rejects older odometry [s]."""
DRIVE = 20.0
TOPICS = ('odom', 'global_pose', 'fix', 'imu', 'loop_closure')

Break = Callable[[object, random.Random], None]

NUMBERS = (math.nan, math.inf, -math.inf, 1.7976931348623157e308, -1.0, 1e200, -1e-300)


def stamp(seconds: int, nanoseconds: int = 0) -> Break:
    def broken(message: object, _: random.Random) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
    return broken


def frame(name: str) -> Break:
    def broken(message: object, _: random.Random) -> None:
        message.header.frame_id = name
    return broken


STAMPS = (stamp(0), stamp(0, 1), stamp(-1, 5), stamp(-2**31), stamp(2**31 - 1, 999_999_999),
          stamp(2_100_000_000), stamp(1, 4_294_967_295))
FRAMES = tuple(map(frame, (
    'elsewhere', '/', 'x', '@', 'x99999999999999999999', '@9999999999999999.0', '@-1.0', 'x-1',
    'a' * 5000, 'Größe 地図', '@nan', '%s%n\\', ' map')))


def covariance(*path: str) -> tuple[Break, ...]:
    """Return what may be wrong with the covariance that attributes lead to."""
    def at(message: object) -> object:
        for name in path[:-1]:
            message = getattr(message, name)
        return message

    def all_of(make: Callable[[int, random.Random], object]) -> Break:
        def broken(message: object, generator: random.Random) -> None:
            owner = at(message)
            size = len(getattr(owner, path[-1]))
            setattr(owner, path[-1], np.asarray(make(size, generator), dtype=float))
        return broken

    def some_of(message: object, generator: random.Random) -> None:
        values = getattr(at(message), path[-1])
        for _ in range(generator.randint(1, 4)):
            values[generator.randrange(len(values))] = generator.choice(NUMBERS)

    def not_positive_definite(size: int, generator: random.Random) -> np.ndarray:
        side = math.isqrt(size)
        return np.where(np.eye(side) > 0.0, 0.01, generator.choice((0.02, -1.0, 5.0))).ravel()

    def asymmetric(size: int, generator: random.Random) -> np.ndarray:
        side = math.isqrt(size)
        return (0.01 * np.eye(side)
                + 0.001 * generator.random() * np.triu(np.ones((side, side)), 1)).ravel()

    constant = (all_of(lambda size, _, number=number: np.full(size, number))
                for number in (*NUMBERS, 0.0))
    return (*constant, some_of, some_of, some_of, all_of(not_positive_definite),
            all_of(asymmetric), all_of(lambda size, _: 1e-300 * np.eye(math.isqrt(size)).ravel()))


def quaternion(*path: str) -> tuple[Break, ...]:
    def broken(message: object, generator: random.Random) -> None:
        for name in path:
            message = getattr(message, name)
        number = generator.choice((*NUMBERS[:4], 1e200))
        setattr(message, generator.choice('xyzw'), number)

    def zero(message: object, _: random.Random) -> None:
        for name in path:
            message = getattr(message, name)
        message.x = message.y = message.z = message.w = 0.0

    return broken, zero


def position(message: object, generator: random.Random) -> None:
    setattr(message.pose.pose.position, generator.choice('xy'),
            generator.choice((*NUMBERS[:4], 1e200, -1e10)))


def twist(message: object, generator: random.Random) -> None:
    setattr(message.twist.twist.linear, generator.choice('xyz'), generator.choice(NUMBERS[:4]))
    message.twist.twist.angular.z = generator.choice(NUMBERS)


def place(message: object, generator: random.Random) -> None:
    name = generator.choice(('latitude', 'longitude', 'altitude'))
    setattr(message, name, generator.choice((
        *NUMBERS[:4], 1e200, 90.0001 if name == 'latitude' else -361.0)
        if name != 'altitude' else (math.inf, 1e200, -1e300)))


def no_fix(message: object, _: random.Random) -> None:
    message.status.status = -1


def unknown(message: object, generator: random.Random) -> None:
    message.position_covariance_type = generator.choice((0, 200))
    if message.position_covariance_type == 0:
        message.position_covariance = np.full(9, math.nan)


def no_orientation(message: object, _: random.Random) -> None:
    message.orientation_covariance[0] = -1.0


BREAKS: dict[str, tuple[Break, ...]] = {
    'odom': (*STAMPS, *FRAMES, *covariance('pose', 'covariance'),
             *covariance('twist', 'covariance'), *quaternion('pose', 'pose', 'orientation'),
             position, position, twist, twist),
    'global_pose': (*STAMPS, *FRAMES, *covariance('pose', 'covariance'),
                    *quaternion('pose', 'pose', 'orientation'), position, position),
    'fix': (*STAMPS, *FRAMES, *covariance('position_covariance'), place, place, no_fix, unknown),
    'imu': (*STAMPS, *FRAMES, *covariance('orientation_covariance'), *quaternion('orientation'),
            no_orientation),
    'loop_closure': (*STAMPS, *FRAMES, *covariance('pose', 'covariance'),
                     *quaternion('pose', 'pose', 'orientation'), position, position)}


def right_message(topic: str, index: int, generator: random.Random) -> object:
    """Return a valid message."""
    seconds = generator.uniform(0.5, DRIVE - 1.0)
    if topic == 'odom':
        return odometry_at(-BEFORE + 0.25 * index)
    if topic == 'global_pose':
        return pose(START + seconds, *true_pose(seconds).tolist())
    if topic == 'fix':
        return fix_at(seconds)
    if topic == 'imu':
        return imu(START + seconds, true_pose(seconds)[2])
    other = generator.uniform(0.5, DRIVE - 1.0)
    seen = se2.between(true_pose(other), true_pose(seconds))
    return pose(START + seconds, *seen.tolist(), frame=f'@{START + other:.9f}')


def malformed(topic: str) -> list[object]:
    """Return the malformed messages of a topic, always the same; some come twice."""
    generator = random.Random(TOPICS.index(topic) + 1)
    messages: list[object] = []
    for index in range(COUNT):
        if index % 20 == 19:
            messages.append(messages[-1])
            continue
        message = right_message(topic, index, generator)
        BREAKS[topic][index % len(BREAKS[topic])](message, generator)
        messages.append(message)
    return messages


@pytest.mark.parametrize('node', [(
    '-p', 'sources:=[odom, global_pose, fix, imu]', '-p', 'datum:=[48.1, 11.6]',
    '-p', 'odom.noise:=twist')], indirect=True)
def test_every_malformed_message_is_counted_and_none_shows(node: NodeProcess) -> None:
    with Client(int(node.env['ROS_DOMAIN_ID']), more={'imu/data': Imu}) as client:
        publishers = {**{topic: getattr(client, topic) for topic in TOPICS if topic != 'imu'},
                      'imu': client.more['imu/data']}
        # what comes with the stamps of 1970 is then older
        client.odom.publish(odometry_at(-BEFORE - 1.0))
        client.wait_processed(1)
        for messages in zip(*(malformed(topic) for topic in TOPICS), strict=True):
            for topic, message in zip(TOPICS, messages, strict=True):
                publishers[topic].publish(message)
                client.spin_for(0.001)
        client.wait_processed(COUNT * len(TOPICS) + 1)
        assert node.process.poll() is None
        assert int(client.values['processed']) == COUNT * len(TOPICS) + 1
        for topic in TOPICS:
            assert client.values[f'received.{topic}'] == str(COUNT + (topic == 'odom'))

        drive(client, DRIVE)
        client.wait_answered(START + DRIVE - 0.1)
        answer = client.optimize()
        assert answer.success, answer.message
        values = client.values
        assert path_error(client) < 0.02
        assert len(client.poses) > 150
        check_counts(values)
        check_outputs(client)
        assert node.process.poll() is None
        assert 'Traceback' not in node.stderr()


def check_counts(values: dict[str, str]) -> None:
    """Check that every message of every topic was accepted or rejected, or waits."""
    total = 0
    for topic in TOPICS:
        counts = {key.partition('.')[2]: int(value) for key, value in values.items()
                  if key.startswith(f'{topic}.') and value.isdigit()}
        # these come beside the answer
        for key in list(counts):
            if key in ('jump', 'sorted', 'without_lever_arm', 'default_covariance', 'believed',
                       'believed_weakly', 'doubted', 'waiting', 'scale') or (
                    key.startswith('repaired_')):
                del counts[key]
        assert len(counts) > 4, counts
        total += sum(counts.values()) - int(values[f'received.{topic}'])
    assert total + int(values['pending']) == 0
    assert 'internal_error' not in ''.join(values)
    assert 'malformed' not in ''.join(values)
    for count in ('odom.not_finite', 'odom.too_large', 'odom.zero_stamp', 'odom.stamp_leap',
                  'global_pose.wrong_frame', 'fix.no_fix', 'fix.out_of_range',
                  'imu.no_orientation', 'loop_closure.wrong_frame', 'loop_closure.not_finite',
                  'fix.duplicate_stamp', 'global_pose.default_covariance'):
        assert int(values.get(count, '0')) > 0, count


def check_outputs(client: Client) -> None:
    """Check that all published numbers are finite."""
    for message in (*client.poses, *client.filtered):
        check_pose(message.pose)
    for message in client.filtered:
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        assert np.all(np.isfinite((linear.x, linear.y, linear.z, angular.z)))
        assert np.all(np.isfinite(message.twist.covariance))
    for message in client.fixes:
        assert np.all(np.isfinite((message.latitude, message.longitude, message.altitude)))
        assert np.all(np.isfinite(message.position_covariance))
    for path in client.paths:
        assert np.all(np.isfinite([(item.pose.position.x, item.pose.position.y,
                                    item.pose.orientation.z, item.pose.orientation.w)
                                   for item in path.poses]))
    for transform in client.transforms:
        translation, rotation = transform.transform.translation, transform.transform.rotation
        assert np.all(np.isfinite((translation.x, translation.y, rotation.z, rotation.w)))
    for name, value in client.values.items():
        assert value not in ('nan', '-nan'), name
