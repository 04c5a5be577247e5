# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
More than 200 malformed messages on every topic, as the node reads them.

Each is a message of the drive with a broken value. Each must be counted, and none may change the
path: if its defect can be repaired the rest of it is correct, else it is rejected.
"""

from collections.abc import Callable
import math
import random

from circle import fix_at, odometry_at, START, true_pose
from harness import imu, pose
import numpy as np

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import backend_config
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.ros.input import Input

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


def test_every_malformed_message_is_counted_and_none_shows() -> None:
    values = checked({'sources': ['odom', 'global_pose', 'fix', 'imu'], 'datum': [48.1, 11.6],
                      'odom.noise': 'twist'})
    received, backend = Input(values, lambda _: None), PoseGraphBackend(backend_config(values))

    def use(name: str, message: object) -> None:
        for each in received.receive(name, message).released:
            received.post(each, add)

    def add(name: str, measurement: object) -> bool:
        (backend.add_odometry if isinstance(measurement, OdometrySample)
         else backend.add_measurement)(measurement, name)
        return True

    # what comes with the stamps of 1970 is then older
    use('odom', odometry_at(-BEFORE - 1.0))
    messages = {topic: malformed(topic) for topic in TOPICS}
    for index in range(COUNT):
        for topic in TOPICS:
            use(topic, messages[topic][index])
    assert received.received == {topic: COUNT + (topic == 'odom') for topic in TOPICS}
    for step in range(round(10 * DRIVE)):
        use('odom', odometry_at(step / 10.0))
        if step % 5 == 0:
            use('fix', fix_at(step / 10.0))
    backend.optimize()
    check_counts(received, backend)
    path = backend.estimate().path
    inside = path.stamps_ns >= START * 1e9
    truth = [true_pose(stamp * 1e-9 - START) for stamp in path.stamps_ns[inside]]
    assert np.max(np.hypot(*(path.poses[inside] - truth)[:, :2].T)) < 0.02
    assert np.all(np.isfinite(backend.estimate().covariance))


def check_counts(received: Input, backend: PoseGraphBackend) -> None:
    """Check that every message of every topic was accepted or rejected, or waits."""
    counts = backend.counts + received.rejected
    beside = ('jump', 'sorted', 'default_covariance', 'rotations')
    total = sum(count for (name, answer), count in counts.items() if name in TOPICS
                and answer not in beside and not answer.startswith('repaired_'))
    assert total + backend.n_waiting == received.received.total(), counts
    assert not {'internal_error', 'malformed'} & {answer for _, answer in counts}
    for name, answer in (
            ('odom', 'not_finite'), ('odom', 'too_large'), ('odom', 'zero_stamp'),
            ('odom', 'stamp_leap'), ('global_pose', 'wrong_frame'), ('fix', 'no_fix'),
            ('fix', 'out_of_range'), ('imu', 'no_orientation'), ('loop_closure', 'wrong_frame'),
            ('loop_closure', 'not_finite'), ('fix', 'duplicate_stamp'),
            ('global_pose', 'default_covariance')):
        assert counts[name, answer] > 0, (name, answer)
