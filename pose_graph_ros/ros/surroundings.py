# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What around the node is probably not as it was meant: topics, frames, and other publishers."""

from collections import Counter, defaultdict
from collections.abc import Iterator
import time
from typing import TYPE_CHECKING

from rclpy.node import Node

from pose_graph_ros.adapters.conversions import frame
from pose_graph_ros.adapters.sources import DEFAULT_SOURCES, Kind, KNOWN_SOURCES, OUTPUTS, Source
from pose_graph_ros.ros.arrivals import QUIET

if TYPE_CHECKING:
    from pose_graph_ros.ros.session import Session

UNNAMED = '_NODE_NAME_UNKNOWN_'  # by rmw, until the middleware has found out
MOST_SUGGESTED = 3
Doubt = tuple[str, str, str]
"""Of what, which value of it, and a sentence."""


def doubts(session: 'Session') -> Iterator[Doubt]:
    """Yield what is to be said now; of the topics, once there was time to start all drivers."""
    topics: defaultdict[str, list[Source]] = defaultdict(list)
    for source in session.input.reader.sources.values():
        topics[session.node.resolve_topic_name(source.topic)].append(source)
    for topic, users in topics.items():
        yield from _shared(topic, users)
        if time.monotonic() - session.activated_at > QUIET:
            for source in users:
                yield from _unpublished(session, topic, source)
    for source in session.input.reader.sources.values():
        yield from _frames(session, source)
    for name, (default, *_) in OUTPUTS.items():
        yield from _published_by_others(session, name, default)


def other_publishers(node: Node, topic: str) -> list[str]:
    """Return the full names of the other nodes that publish a topic, which may be like its own."""
    names = Counter(
        f'{info.node_namespace.rstrip("/")}/{info.node_name}'
        for info in node.get_publishers_info_by_topic(topic) if info.node_name != UNNAMED)
    names -= Counter([node.get_fully_qualified_name()])
    return sorted(names)


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
    there = f'; there is {", ".join(sorted(others)[:MOST_SUGGESTED])}' if len(others) > 0 else ''
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
