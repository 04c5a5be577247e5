# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each source's messages to what the engine takes; node and offline tools share it, no rclpy."""

from collections.abc import Mapping
from typing import Any

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected
from pose_graph_ros.ros import conversions
from pose_graph_ros.ros.conversions import frame, Message
from pose_graph_ros.ros.fixes import Datum, FixReader
from pose_graph_ros.ros.sources import Kind, NANOSECONDS, Source, source_list
from pose_graph_ros.ros.static_frames import StaticFrames

# Odometry whose stamp is so far [ns] from those before is taken for that of a clock gone wrong,
LEAP_NS = 60 * NANOSECONDS
# unless so many more messages in a row are: odometry had been away, or began with a wrong clock.
# As its poses are accumulated, those few are not missed.
LEAPS = 5
# The seconds of a stamp have 31 bits; some are left for the offsets of what is published [ns].
LARGEST_STAMP_NS = (2**31 - 3600) * NANOSECONDS


class MessageReader:
    """
    Turns the messages of all sources into measurements.

    Parameters
    ----------
    values : mapping
        All checked parameters.
    frames : StaticFrames
        Where the robot's frames are, if something is known already.

    Raises
    ------
    ConfigError
        If the datum is no point on the Earth.

    """

    def __init__(self, values: Mapping[str, Any], frames: StaticFrames | None = None) -> None:
        self.sources = {source.name: source for source in source_list(values)}
        """All sources by name."""
        self._leaps = {name: _Leaps() for name in self.sources}
        self._map_frame = frame(values['map_frame'])
        base_frame = frame(values['base_link_frame'])
        self.frames = StaticFrames() if frames is None else frames
        """Where the robot's frames are, as far as /tf_static has told."""
        try:
            self.datum = Datum(values['datum'], wait=values['wait_for_datum'])
            self.fixes = {
                source.name: FixReader(source, self.datum, self.frames, base_frame)
                for source in self.sources.values() if source.kind is Kind.FIX}
        except ValueError as error:
            raise ConfigError(f'parameter {error}') from error

    def renewed(self, values: Mapping[str, Any]) -> 'MessageReader':
        """Return a reader for a graph that begins anew: it knows the same transforms, no more."""
        return MessageReader(values, self.frames)

    def configure(self, values: Mapping[str, Any]) -> None:
        """
        Take other time offsets, lever arms and yaw offsets, for messages from now on.

        What is taken when the node is configured (sources, topics, frames, datum) stays, and so
        do the transforms that are known and all counts.
        """
        for source in source_list(values):
            before = self.sources[source.name]
            self._leaps[source.name].shift(source.time_offset_ns - before.time_offset_ns)
            self.sources[source.name] = source
            if source.kind is Kind.FIX:
                self.fixes[source.name].configure(source)

    def read(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Read a message of the source with this name."""
        source = self.sources[name]
        measurement = self._read(source, message)
        if isinstance(measurement, Answer):
            return measurement
        stamp_ns = measurement.stamp_ns
        if stamp_ns > LARGEST_STAMP_NS:
            return rejected('stamp_out_of_range', f'{stamp_ns} ns')
        # zero and less is the engine's to refuse
        if source.kind is Kind.ODOMETRY and stamp_ns > 0 and self._leaps[name].refuses(stamp_ns):
            return rejected('stamp_leap', f'{stamp_ns} ns is far from those before')
        return measurement

    def _read(self, source: Source, message: Message) -> OdometrySample | Measurement | Answer:
        offset_ns = source.time_offset_ns
        match source.kind:
            case Kind.ODOMETRY:
                return conversions.odometry_sample(message, offset_ns)
            case Kind.GLOBAL_POSE:
                return conversions.global_pose(message, self._map_frame, offset_ns)
            case Kind.FIX:
                return self.fixes[source.name].position(message)
            case Kind.IMU:
                return conversions.heading(
                    message, self.datum.yaw, source.yaw_offset, offset_ns)
            case Kind.LOOP_CLOSURE:
                return conversions.loop_closure(message, offset_ns)


class _Leaps:
    """
    Keeps stamps of another time away from odometry.

    After one of the future all others would be too old; one of the past could be the first.
    """

    def __init__(self) -> None:
        self._newest_ns = 0
        self._count = 0

    def shift(self, by_ns: int) -> None:
        """Let all stamps be later from now on by so much."""
        if self._newest_ns > 0:
            self._newest_ns = max(self._newest_ns + by_ns, 1)

    def refuses(self, stamp_ns: int) -> bool:
        """Tell whether a stamp is far from those before, and not from those to come."""
        if self._newest_ns == 0 or abs(stamp_ns - self._newest_ns) <= LEAP_NS:
            self._newest_ns, self._count = max(self._newest_ns, stamp_ns), 0
            return False
        self._count += 1
        if self._count <= LEAPS:
            return True
        self._newest_ns, self._count = stamp_ns, 0
        return False
