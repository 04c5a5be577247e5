# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each source's messages to what the engine takes; node and offline tools share it, no rclpy."""

from collections.abc import Mapping
from typing import Any

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample
from pose_graph_ros.ros import conversions
from pose_graph_ros.ros.conversions import frame, Message
from pose_graph_ros.ros.fixes import Datum, FixReader
from pose_graph_ros.ros.sources import Kind, source_list
from pose_graph_ros.ros.static_frames import StaticFrames


class MessageReader:
    """
    Turns the messages of all sources into measurements.

    Parameters
    ----------
    values : mapping
        All checked parameters.

    Raises
    ------
    ConfigError
        If the datum is no point on the Earth.

    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.sources = {source.name: source for source in source_list(values)}
        """All sources by name."""
        self._map_frame = frame(values['map_frame'])
        base_frame = frame(values['base_link_frame'])
        self.frames = StaticFrames()
        """Where the robot's frames are, as far as /tf_static has told."""
        try:
            self.datum = Datum(values['datum'], wait=values['wait_for_datum'])
            self.fixes = {
                source.name: FixReader(source, self.datum, self.frames, base_frame)
                for source in self.sources.values() if source.kind is Kind.FIX}
        except ValueError as error:
            raise ConfigError(f'parameter {error}') from error

    def read(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Read a message of the source with this name."""
        source = self.sources[name]
        offset_ns = source.time_offset_ns
        match source.kind:
            case Kind.ODOMETRY:
                return conversions.odometry_sample(message, offset_ns)
            case Kind.GLOBAL_POSE:
                return conversions.global_pose(message, self._map_frame, offset_ns)
            case Kind.FIX:
                return self.fixes[name].position(message)
            case Kind.IMU:
                return conversions.heading(
                    message, self.datum.yaw, source.yaw_offset, offset_ns)
            case Kind.LOOP_CLOSURE:
                return conversions.loop_closure(message, offset_ns)
