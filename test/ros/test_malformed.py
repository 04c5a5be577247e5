# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
More than 200 malformed messages on every topic, as the node reads them.

Each is a message of the drive with a broken value. Each must be counted, and none may change the
path: if its defect can be repaired the rest of it is correct, else it is rejected.
"""

from collections.abc import Iterator
import math
import random
from typing import Any

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

NUMBERS = (math.nan, math.inf, -math.inf, 1.7976931348623157e308, 1e200)
STAMPS = ((0, 0), (0, 1), (-1, 5), (-2**31, 0), (2**31 - 1, 999_999_999), (2_100_000_000, 0),
          (1, 4_294_967_295))
FRAMES = (
    'elsewhere', '/', 'x', '@', 'x99999999999999999999', '@9999999999999999.0', '@-1.0', 'x-1',
    'a' * 5000, 'Größe 地図', '@nan', '%s%n\\', ' map')


def leaves(message: Any) -> Iterator[tuple[Any, str]]:
    """Yield each field of a message that is no message, with what it belongs to."""
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types'):
            yield from leaves(value)
        else:
            yield message, name


def broken_covariance(size: int, generator: random.Random) -> np.ndarray:
    side, number = math.isqrt(size), generator.choice((*NUMBERS, -1.0, -1e-300, 0.0))
    good = np.diag(np.full(side, 0.01))
    some = good.ravel().copy()
    some[[generator.randrange(size) for _ in range(generator.randint(1, 4))]] = number
    not_positive_definite = np.where(good > 0.0, 0.01, generator.choice((0.02, -1.0, 5.0)))
    asymmetric = good + 0.001 * np.triu(np.ones((side, side)), 1)
    no_answer = np.concatenate(([-1.0], good.ravel()[1:]))
    return np.ravel(generator.choice((
        np.full(size, number), some, some, not_positive_definite, asymmetric, 1e-298 * good,
        np.zeros(size), no_answer)))


def damage(message: Any, generator: random.Random) -> None:
    """Put a value that is none into any field of a message."""
    found = list(leaves(message))
    found += 4 * [each for each in found if each[1].endswith('covariance')]
    owner, name = generator.choice(found)
    value = getattr(owner, name)
    if owner is message.header.stamp:
        owner.sec, owner.nanosec = generator.choice(STAMPS)
    elif isinstance(value, str):
        setattr(owner, name, generator.choice(FRAMES))
    elif isinstance(value, float):
        setattr(owner, name, generator.choice(NUMBERS))
    elif isinstance(value, int):
        setattr(owner, name, -1 if name == 'status' else generator.choice((0, 200)))
    else:
        setattr(owner, name, broken_covariance(len(value), generator))


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
        damage(message, generator)
        messages.append(message)
    return messages


def test_every_malformed_message_is_counted_and_none_shows() -> None:
    values = checked({'sources': ['odom', 'global_pose', 'fix', 'imu'], 'datum': [48.1, 11.6],
                      'odom.noise': 'twist'})
    received, backend = Input(values, lambda _: ()), PoseGraphBackend(backend_config(values))

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
    for topic in TOPICS:
        assert received.arrivals[topic].count == COUNT + (topic == 'odom')
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
    n_received = sum(each.count for each in received.arrivals.values())
    assert total + backend.n_waiting == n_received, counts
    assert not {'internal_error', 'malformed'} & {answer for _, answer in counts}
    for name, answer in (
            ('odom', 'not_finite'), ('odom', 'too_large'), ('odom', 'zero_stamp'),
            ('odom', 'stamp_leap'), ('global_pose', 'wrong_frame'), ('fix', 'no_fix'),
            ('fix', 'out_of_range'), ('imu', 'no_orientation'), ('loop_closure', 'wrong_frame'),
            ('loop_closure', 'not_finite'), ('fix', 'duplicate_stamp'),
            ('global_pose', 'default_covariance')):
        assert counts[name, answer] > 0, (name, answer)
