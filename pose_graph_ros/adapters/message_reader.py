# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert the messages of all sources to measurements, in the node and offline; no rclpy."""

from collections.abc import Mapping
from typing import Any

from pose_graph_ros.adapters.conversions import frame, Message
from pose_graph_ros.adapters.sources import CLOCK_JUMP_NS, source_list
from pose_graph_ros.adapters.surroundings import datum_of, StaticFrames, Surroundings
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper
from pose_graph_ros.core.quantities import NANOSECONDS


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
        self.frames = StaticFrames() if frames is None else frames
        self.datum = datum_of(values)
        self.surroundings = Surroundings(
            frame(values['map_frame']), frame(values['base_link_frame']), self.datum, self.frames)

    def configure(self, values: Mapping[str, Any]) -> None:
        """
        Use other time offsets, lever arms, yaw offsets and mountings for messages from now on.

        Sources, topics, frames, datum, static transforms and counts stay.
        """
        for source in source_list(values):
            before = self.sources[source.name]
            self.keeper.shift(source.name, source.time_offset_ns - before.time_offset_ns)
            self.sources[source.name] = source

    def read(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Return the measurement in a message of a source, or the reason for rejecting it."""
        measurement = self.convert(name, message)
        if isinstance(measurement, Answer):
            return measurement
        return self.keeper.judge(name, measurement).refusal or measurement

    def convert(self, name: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Return the same without a judgement of its stamp."""
        source = self.sources[name]
        measurement = source.kind.convert(message, source, self.surroundings)
        if not isinstance(measurement, Answer) and (
                # the seconds have 31 bits, of which one hour is left for offsets
                measurement.stamp_ns > (2**31 - 3600) * NANOSECONDS):
            return rejected('stamp_out_of_range', f'{measurement.stamp_ns} ns')
        return measurement
