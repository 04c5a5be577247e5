# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of a drive along a circle, with odometry that is too long and exact fixes."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from pose_graph_ros.adapters.bags import Bag, Inputs, reader_of
from pose_graph_ros.cli.drive import measured_in
from pose_graph_ros.cli.replay import Replayed, run
from pose_graph_ros.cli.simulate import fix_messages, Message, odometry_messages
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory

SECOND = 10**9
VARIANCES = (1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-3)
JAZZY, NOETIC = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
NOETIC.register(get_types_from_msg(
    'geometry_msgs/TransformStamped[] transforms\n', 'tf2_msgs/msg/TFMessage'))


def circle(seconds: int = 40) -> Trajectory:
    """Drive along a circle with a radius of 10 m at 2 m/s, a little more than once."""
    stamps = 1_700_000_000 * SECOND + np.arange(0, seconds * SECOND, SECOND // 10)
    angle = np.arange(len(stamps)) * 0.02
    return Trajectory(stamps, np.column_stack(
        (10.0 * np.sin(angle), 10.0 * (1.0 - np.cos(angle)), se2.wrap(angle))))


def odometry() -> list[Message]:
    """The circle in a frame of its own, 1 % too long and turning a little too far."""
    path = circle()
    steps = se2.between(path.poses[:-1], path.poses[1:]) * (1.01, 1.01, 1.002)
    poses = [np.array([3.0, -4.0, 2.0])]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return list(odometry_messages(
        '/odom', 'odom', Trajectory(path.stamps_ns, np.array(poses)), VARIANCES))


def fixes(arm: np.ndarray) -> list[Message]:
    """Exact positions of an antenna with a lever arm, twice a second."""
    path = circle()
    places = se2.transform(path.poses[::5], arm)
    geodetic = TangentPlane(50.7, 7.1, 60.0).to_geodetic(places, 60.0)
    return list(fix_messages('/gps/fix', path.stamps_ns[::5], geodetic, 0.1))


def write_ros1(
    path: Path, messages: Iterable[Message], form: Rosbag1Writer.CompressionFormat | None = None,
) -> Path:
    """Write messages of ROS 2 as a ROS 1 bag, in the order of their stamps."""
    writer = Rosbag1Writer(path)
    if form is not None:
        writer.set_compression(form)
    with writer:
        connections = {}
        for topic, kind, stamp, message in sorted(messages, key=lambda item: item[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=NOETIC)
            data = JAZZY.cdr_to_ros1(JAZZY.serialize_cdr(message, kind), kind)
            writer.write(connections[topic], stamp, data)
    return path


def write_compressed(path: Path, messages: Iterable[Message], mode: CompressionMode) -> Path:
    """Write messages as a rosbag2 that is compressed by zstd, in the order of their stamps."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, stamp, message in sorted(messages, key=lambda item: item[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=JAZZY)
            writer.write(connections[topic], stamp, JAZZY.serialize_cdr(message, kind))
    return path


def replayed_bag(bag: Bag, inputs: Inputs, values: dict[str, Any]) -> Replayed:
    """What `pose-graph replay` makes of a bag."""
    measurements = measured_in(bag, inputs, reader_of(bag, values), Counter(), held_out=False)
    return run((each[:2] for each in measurements), values)
