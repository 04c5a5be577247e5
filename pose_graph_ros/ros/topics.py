# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The topics of the node: those that it reads, a check of all before it is configured, and doubts.

Where a topic has two types, or a quality of service is wrong, rclpy and the middleware say too
little to find out which parameter to correct. The same goes for topics that nobody publishes, or
others as well, and for frames that are not those of the parameters.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
import time
from typing import Any, TYPE_CHECKING

from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)

from pose_graph_ros.adapters.conversions import frame
from pose_graph_ros.adapters.sources import (
    DEFAULT_SOURCES,
    Kind,
    KNOWN_SOURCES,
    OUTPUTS,
    Source,
    source_list,
)
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.ros.arrivals import EXPECTED
from pose_graph_ros.ros.transforms import (
    other_publishers,
    STATIC_TOPIC,
    TF_TYPE,
    TFMessage,
    TOPIC,
)

if TYPE_CHECKING:
    from pose_graph_ros.ros.session import Session

# Profiles are reliable if they do not say otherwise.
# The queue is deep since no odometry may be lost. A best-effort reader matches reliable and
# best-effort writers.
SENSOR_QOS = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
CLOSURE_QOS = QoSProfile(depth=100)     # a loop closure is rare and must not get lost
JUDGE_TOPIC = '~/judge'
INPUTS = {
    'initialpose': (Kind.GLOBAL_POSE.message_type, QoSProfile(depth=1)),
    'set_pose': (Kind.GLOBAL_POSE.message_type, QoSProfile(depth=1)),
    JUDGE_TOPIC: ('diagnostic_msgs/msg/KeyValue', QoSProfile(depth=100))}
"""Messages and quality of service by topic, but for the sources."""
if TFMessage is not None:   # late subscribers receive the newest message of every broadcaster
    INPUTS[STATIC_TOPIC] = TF_TYPE, QoSProfile(
        depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)

OUTPUT = 'the output'
OVERRIDES = 'qos_overrides.'  # prefix of the parameters for the quality of service
CHOICES = {
    policy.__name__.removeprefix('QoS').removesuffix('Policy').lower():
    [name.lower() for name in policy.__members__ if name != 'UNKNOWN']
    for policy in (QoSHistoryPolicy, QoSReliabilityPolicy)}
"""Policies that can be overridden, with their values; `depth`, a number, is the third."""


def check_topics(node: Node, values: Mapping[str, Any], overrides: Mapping[str, Any]) -> None:
    """
    Raise a `ConfigError` if the node cannot have its topics as they are set.

    Each topic, after remaps, must have one type and not be both published and read; overrides of
    the quality of service must be such that rclpy can take them.
    """
    used: dict[str, tuple[str, str, bool]] = {}
    entities: set[tuple[str, str]] = set()
    for user, name, kind, published in _endpoints(values):
        topic = node.resolve_topic_name(name)
        first, other, output = used.setdefault(topic, (user, kind, published))
        if other != kind:
            raise ConfigError(f'{user}: expected a topic of {kind}, got {topic}, which {first} '
                              f'has with {other}')
        if output != published:
            raise ConfigError(
                f'{user}: expected a topic that the node does not publish, got {topic}, which is '
                f'{first}{_renamed(node, first)}')
        entities.add((topic, 'publisher' if published else 'subscription'))
    for name, value in sorted(overrides.items()):
        if name.startswith(OVERRIDES):
            _check_override(name, value, entities)


def _renamed(node: Node, output: str) -> str:
    """Return what to type so that an output has a topic of its own."""
    for name, (topic, *_) in OUTPUTS.items():
        if output == f'{OUTPUT} {topic}':
            other = f'{node.get_fully_qualified_name()}/{name}'
            return (f': move that by {name}:={other} with ros2 launch, or by -p outputs.{name}:='
                    f'{other} with ros2 run, instead of a remap, which can move both')
    return ''


def _endpoints(values: Mapping[str, Any]) -> Iterator[tuple[str, str, str, bool]]:
    """Yield who uses a topic, the topic, the type of its messages, and whether it is an output."""
    for name, (topic, type_name, _) in OUTPUTS.items():
        yield f'{OUTPUT} {topic}', values[f'outputs.{name}'], type_name, True
    yield f'{OUTPUT} {TOPIC}', TOPIC, TF_TYPE, True
    for topic, (type_name, _) in INPUTS.items():
        yield f'the input {topic}', topic, type_name, False
    for source in source_list(values):
        yield f'parameter {source.name}.topic', source.topic, source.kind.message_type, False


def _check_override(name: str, value: object, entities: set[tuple[str, str]]) -> None:
    topic, _, rest = name.removeprefix(OVERRIDES).partition('.')
    entity, _, policy = rest.partition('.')
    if (topic, entity) not in entities:
        return  # of another node, in a file for several
    if policy == 'depth':
        expected, good = 'a whole number from 0 on', type(value) is int and 0 <= value < 2**31
    elif policy in CHOICES:
        expected = f'one of {", ".join(CHOICES[policy])}'
        good = str(value).lower() in CHOICES[policy]
    else:
        expected, value, good = f'depth, {" or ".join(CHOICES)} as the policy', policy, False
    if not good:
        raise ConfigError(f'parameter {name}: expected {expected}, got {value!r}')


# --- what around the node is probably not as it was meant

Doubt = tuple[str, str, str]  # of what, which value of it, and a sentence


def doubts(session: 'Session') -> Iterator[Doubt]:
    """Yield what is to be said now; of the topics, once there was time to start all drivers."""
    topics: defaultdict[str, list[Source]] = defaultdict(list)
    for source in session.input.reader.sources.values():
        topics[session.node.resolve_topic_name(source.topic)].append(source)
    for topic, users in topics.items():
        yield from _shared(topic, users)
        if time.monotonic() - session.activated_at > EXPECTED.quiet:
            for source in users:
                yield from _unpublished(session, topic, source)
    for source in session.input.reader.sources.values():
        yield from _frames(session, source)
    for name, (default, *_) in OUTPUTS.items():
        yield from _published_by_others(session, name, default)


def _shared(topic: str, users: list[Source]) -> Iterator[Doubt]:
    """Yield a doubt, but for a heading and a rate, which are both in an Imu."""
    kinds = [source.kind for source in users]
    if len(users) > 1 and sorted(kinds, key=str) != [Kind.GYRO, Kind.IMU]:
        names = ' and '.join(source.name for source in users)
        yield names, topic, (f'{names} listen to the same topic, {topic}, so that its messages '
                             f'count {len(users)} times: set {users[-1].name}.topic')


def _unpublished(session: 'Session', topic: str, source: Source) -> Iterator[Doubt]:
    """Of the default inputs but odometry, robots may have some alone."""
    node, name, wanted = session.node, source.name, source.kind.message_type
    usual = node.resolve_topic_name(KNOWN_SOURCES[name][1]) if name in KNOWN_SOURCES else ''
    expected = source.kind.is_odometry or topic != usual or (
        name not in DEFAULT_SOURCES and source.kind is not Kind.LOOP_CLOSURE)
    if session.input.received[name] > 0 or not expected:
        return
    types = {info.topic_type for info in node.get_publishers_info_by_topic(source.topic)}
    if wanted in types:
        return
    found = 'nobody publishes it' if len(types) == 0 else (
        f'its messages are {", ".join(sorted(types))}')
    own = {publisher.topic_name for publisher in node.publishers}
    others = [each for each, kinds in node.get_topic_names_and_types()
              if wanted in kinds and each not in own and node.count_publishers(each) > 0]
    there = f'; there is {", ".join(sorted(others)[:3])}' if len(others) > 0 else ''
    yield name, topic, f'{name} listens to {topic} for {wanted}, but {found}{there}'


def _frames(session: 'Session', source: Source) -> Iterator[Doubt]:
    name, out, estimate = source.name, session.out, session.worker.estimate
    if name not in session.input.frames:
        return
    parent, child = map(frame, session.input.frames[name])
    if source.kind is Kind.ODOMETRY:
        is_primary = estimate is not None and estimate.primary == name
        for what, found, parameter, expected, consequence in (
                ('frame_id', parent if is_primary else out.odom_frame, 'odom_frame',
                 out.odom_frame, 'no transform to it is published'),
                ('child_frame_id', child, 'base_link_frame', out.base_frame,
                 'its motion is taken for that of the robot')):
            if found == '':
                yield name, what, (f'{name} has no {what}: it is taken for {expected}, the '
                                   f'{parameter}')
            elif found != expected:
                yield name, found, (f'{name} has the {what} {found!r}, but the parameter '
                                    f'{parameter} is {expected!r}: set it, else {consequence}')
    elif parent == '':
        taken = {
            Kind.TWIST: f'it is taken for {out.base_frame}, the base_link_frame',
            Kind.GLOBAL_POSE: f'it is taken for {out.map_frame}, the map_frame',
            Kind.GYRO: '' if source.mounting != 'tf' else (
                f'it is taken for {out.base_frame}: set {name}.mounting'),
            Kind.FIX: '' if any(source.lever_arm) else (
                f'its antenna is taken to be in {out.base_frame}: set {name}.lever_arm'),
        }.get(source.kind, '')
        if taken != '':
            yield name, 'frame_id', f'{name} has no frame_id: {taken}'


def _published_by_others(session: 'Session', name: str, default: str) -> Iterator[Doubt]:
    node, topic = session.node, session.values[f'outputs.{name}']
    if default.startswith('/') or node.count_publishers(topic) < 2:  # /diagnostics is for all
        return
    others = other_publishers(node, topic)
    if len(others) > 0:
        resolved, own = node.resolve_topic_name(topic), node.get_fully_qualified_name()
        yield resolved, 'others', (
            f'{resolved} is published by {" and ".join(others)} as well: give one of them '
            f'another topic, of this node by {name}:={own}/{name} with ros2 launch or '
            f'-p outputs.{name}:={own}/{name} with ros2 run')
