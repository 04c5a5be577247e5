# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert the messages of all sources to measurements, in the node and offline; no rclpy."""

from collections.abc import Mapping
import math
from typing import Any

import numpy as np

from pose_graph_ros.adapters import conversions
from pose_graph_ros.adapters.conversions import (
    frame,
    Message,
    planar_twist,
    stamp_ns,
    StaticFrames,
    twist_variance,
)
from pose_graph_ros.adapters.fixes import datum_of, FixReader
from pose_graph_ros.adapters.sources import (
    CLOCK_JUMP_NS,
    Kind,
    NANOSECONDS,
    Source,
    source_list,
)
from pose_graph_ros.core.geometry.se2 import compose_one, exp_one, FloatArray, Pose
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected, YawRate
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper


class MessageReader:
    """Converts the messages of all sources to measurements, by the checked parameters."""

    def __init__(
        self, values: Mapping[str, Any], frames: StaticFrames | None = None,
        keeper: TimeKeeper | None = None,
    ) -> None:
        self.sources = {source.name: source for source in source_list(values)}  # sources by name
        self.keeper = keeper or TimeKeeper(
            [name for name, source in self.sources.items() if source.kind.is_odometry],
            CLOCK_JUMP_NS)
        self._map_frame = frame(values['map_frame'])
        base_frame = frame(values['base_link_frame'])
        self.frames = StaticFrames() if frames is None else frames
        self.datum = datum_of(values)
        self.fixes = {
            source.name: FixReader(source, self.datum, self.frames, base_frame)
            for source in self.sources.values() if source.kind is Kind.FIX}
        self._readers: dict[str, FixReader | GyroReader | TwistReader] = {**self.fixes}
        for name, source in self.sources.items():
            if source.kind in {Kind.GYRO, Kind.TWIST}:
                kind = GyroReader if source.kind is Kind.GYRO else TwistReader
                self._readers[name] = kind(source, self.frames, base_frame)

    def configure(self, values: Mapping[str, Any]) -> None:
        """
        Use other time offsets, lever arms, yaw offsets and mountings for messages from now on.

        Sources, topics, frames, datum, static transforms and counts stay.
        """
        for source in source_list(values):
            before = self.sources[source.name]
            self.keeper.shift(source.name, source.time_offset_ns - before.time_offset_ns)
            self.sources[source.name] = source
            if source.name in self._readers:
                self._readers[source.name].source = source

    def read(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Return the measurement in a message of a source, or the reason for rejecting it."""
        measurement = self.convert(name, message)
        if isinstance(measurement, Answer):
            return measurement
        return self.keeper.judge(name, measurement).refusal or measurement

    def convert(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Return the same without a judgement of its stamp."""
        measurement = self._convert(self.sources[name], message)
        if not isinstance(measurement, Answer) and (
                # the seconds have 31 bits, of which one hour is left for offsets
                measurement.stamp_ns > (2**31 - 3600) * NANOSECONDS):
            return rejected('stamp_out_of_range', f'{measurement.stamp_ns} ns')
        return measurement

    def _convert(self, source: Source, message: Message) -> OdometrySample | Measurement | Answer:
        offset_ns = source.time_offset_ns
        match source.kind:
            case Kind.ODOMETRY:
                return conversions.odometry_sample(
                    message, offset_ns, with_twist=source.integrates_twist)
            case Kind.GLOBAL_POSE:
                return conversions.global_pose(message, (self._map_frame,), offset_ns)
            case Kind.IMU:
                return conversions.heading(message, self.datum.yaw, source.yaw_offset, offset_ns)
            case Kind.FIX | Kind.TWIST | Kind.GYRO:
                return self._readers[source.name].read(message)
            case Kind.LOOP_CLOSURE:
                return conversions.loop_closure(message, offset_ns)


class GyroReader:
    """Converts the Imu messages of one source to yaw rates of the robot."""

    def __init__(self, source: Source, frames: StaticFrames, base_frame: str) -> None:
        self.source = source  # may be replaced at any time
        self._frames, self._base_frame = frames, base_frame

    def read(self, message: Message) -> YawRate | Answer:
        """Return the yaw rate in a sensor_msgs/Imu, or the reason for rejecting it."""
        values = message.angular_velocity_covariance
        if values[0] == -1.0:   # by the definition of the message
            return rejected('no_angular_velocity', 'the sensor reports no angular velocity')
        velocity, stamp = message.angular_velocity, stamp_ns(message, self.source.time_offset_ns)
        mounting, name = self.source.mounting, frame(message.header.frame_id)
        if mounting != 'tf' or name in ('', self._base_frame):
            rate, variance = -velocity.z if mounting == 'down' else velocity.z, values[8]
        else:
            found = self._frames.transform(name, self._base_frame)
            if found is None:
                return rejected('unknown_frame', (
                    f'no transform from {name!r} to {self._base_frame!r} on /tf_static: publish '
                    f'it, or set {self.source.name}.mounting'))
            up = found[0][2]
            rate = float(up @ (velocity.x, velocity.y, velocity.z))
            variance = up @ np.asarray(values, dtype=float).reshape(3, 3) @ up
        if not math.isfinite(rate):
            return rejected('not_finite', (
                f'angular velocity ({velocity.x}, {velocity.y}, {velocity.z})'))
        return YawRate(stamp, float(rate), float(variance) if variance > 0.0 else 0.0)


class TwistReader:
    """
    Converts the TwistWithCovarianceStamped messages of one source to odometry.

    Its poses are twists integrated in the order of arrival. They are for outputs between two
    estimates; the engine integrates the twists anew in the order of their stamps.
    """

    def __init__(self, source: Source, frames: StaticFrames, base_frame: str) -> None:
        self.source = source  # may be replaced at any time
        self._frames, self._base_frame = frames, base_frame
        self._stamp_ns = 0
        self._pose, self._twist = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

    def read(self, message: Message) -> OdometrySample | Answer:
        """Return the odometry by a twist, or the reason for rejecting it."""
        twist = planar_twist(message.twist.twist)
        if isinstance(twist, Answer):
            return twist
        name = frame(message.header.frame_id)
        if name not in ('', self._base_frame):
            found = self._frames.transform(name, self._base_frame)
            if found is None:
                return rejected('wrong_frame', (
                    f'expected frame {self._base_frame!r} or one with a transform to it on '
                    f'/tf_static, got {name!r}'))
            twist = _at_base(twist, *found)
        stamp = stamp_ns(message, self.source.time_offset_ns)
        if stamp > self._stamp_ns:
            time = (stamp - self._stamp_ns) * 1e-9 if self._stamp_ns > 0 else 0.0
            x, y, turn = (0.5 * (one + other) * time
                          for one, other in zip(self._twist, twist, strict=True))
            self._pose = compose_one(self._pose, exp_one((x, y, turn)))
            self._stamp_ns, self._twist = stamp, twist
        return OdometrySample(stamp, np.array(self._pose), math.hypot(twist[0], twist[1]),
                              twist_variance(message.twist.covariance), twist)


def _at_base(twist: Pose, rotation: FloatArray, place: FloatArray) -> Pose:
    """Return the twist of the robot from that of a sensor at a place in its frame."""
    x, y, rate = twist
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    return (c * x - s * y + rate * float(place[1]), s * x + c * y - rate * float(place[0]), rate)
