# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert the messages of all sources to measurements, in the node and offline; no rclpy."""

from collections.abc import Mapping
from typing import Any

from pose_graph_ros.adapters import conversions
from pose_graph_ros.adapters.conversions import frame, Message
from pose_graph_ros.adapters.fixes import datum_of, FixReader
from pose_graph_ros.adapters.rates import GyroReader, TwistReader, VELOCITY_READERS
from pose_graph_ros.adapters.sources import (
    CLOCK_JUMP_NS,
    Kind,
    NANOSECONDS,
    Source,
    source_list,
)
from pose_graph_ros.adapters.static_frames import StaticFrames
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper

# Largest valid stamp: the seconds have 31 bits, of which one hour is left for offsets [ns].
LARGEST_STAMP_NS = (2**31 - 3600) * NANOSECONDS


class MessageReader:
    """
    Converts the messages of all sources to measurements.

    Parameters
    ----------
    values : mapping, all checked parameters
    frames : StaticFrames, optional, static transforms that are known already
    keeper : TimeKeeper, optional, that knows the time already

    Raises
    ------
    ConfigError
        If the datum is not a point on the Earth.

    """

    def __init__(
        self, values: Mapping[str, Any], frames: StaticFrames | None = None,
        keeper: TimeKeeper | None = None,
    ) -> None:
        self.sources = {source.name: source for source in source_list(values)}  # sources by name
        self.keeper = keeper or TimeKeeper(
            [name for name, source in self.sources.items() if source.kind.is_odometry],
            CLOCK_JUMP_NS)
        """The one judge of stamps."""
        self._map_frame = frame(values['map_frame'])
        base_frame = frame(values['base_link_frame'])
        self.frames = StaticFrames() if frames is None else frames
        """Static transforms of the robot, as received on /tf_static."""
        self.datum = datum_of(values)
        self.fixes = {
            source.name: FixReader(source, self.datum, self.frames, base_frame)
            for source in self.sources.values() if source.kind is Kind.FIX}
        self._velocities: dict[str, GyroReader | TwistReader] = {
            name: VELOCITY_READERS[source.kind](source, self.frames, base_frame)
            for name, source in self.sources.items() if source.kind in VELOCITY_READERS}

    def configure(self, values: Mapping[str, Any]) -> None:
        """
        Use other time offsets, lever arms, yaw offsets and mountings for messages from now on.

        Sources, topics, frames, datum, static transforms and counts stay.
        """
        for source in source_list(values):
            before = self.sources[source.name]
            self.keeper.shift(source.name, source.time_offset_ns - before.time_offset_ns)
            self.sources[source.name] = source
            if (reader := self._velocities.get(source.name)) is not None:
                reader.source = source
            if source.kind is Kind.FIX:
                self.fixes[source.name].source = source

    def read(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Return the measurement in a message of a source, or the reason for rejecting it."""
        measurement = self.convert(name, message)
        if isinstance(measurement, Answer):
            return measurement
        return self.keeper.judge(name, measurement).refusal or measurement

    def convert(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Return the same without a judgement of its stamp."""
        measurement = self._convert(self.sources[name], message)
        if not isinstance(measurement, Answer) and measurement.stamp_ns > LARGEST_STAMP_NS:
            return rejected('stamp_out_of_range', f'{measurement.stamp_ns} ns')
        return measurement

    def _convert(self, source: Source, message: Message) -> OdometrySample | Measurement | Answer:
        name, offset_ns = source.name, source.time_offset_ns
        match source.kind:
            case Kind.ODOMETRY:
                return conversions.odometry_sample(
                    message, offset_ns, with_twist=source.integrates_twist)
            case Kind.GLOBAL_POSE:
                return conversions.global_pose(message, self._map_frame, offset_ns)
            case Kind.FIX:
                return self.fixes[name].position(message)
            case Kind.IMU:
                return conversions.heading(message, self.datum.yaw, source.yaw_offset, offset_ns)
            case Kind.TWIST | Kind.GYRO:
                return self._velocities[name].read(message)
            case Kind.LOOP_CLOSURE:
                return conversions.loop_closure(message, offset_ns)
