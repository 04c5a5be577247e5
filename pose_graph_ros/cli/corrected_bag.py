# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Copy a bag, with the corrected path, odometry in the map, and the transform to odom."""

import bisect
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.bag_inputs import Inputs, reader_of, STATIC_FRAMES
from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import Bag, BagMessage, MessageError, Span
from pose_graph_ros.adapters.conversions import frame
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.output_cdr import (
    odometry_cdr,
    path_cdr,
    transform_cdr,
    UNKNOWN_VARIANCE,
)
from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.correction import OdometryAtPath, PathCorrection
from pose_graph_ros.core.geometry.scalar_se2 import between_one, compose_one, Pose
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.prediction import Prediction

PATH, ODOMETRY, TF = '/path', '/odometry/filtered', '/tf'
"""Topics that are written, as those of the node."""
TYPES = {PATH: 'nav_msgs/msg/Path', ODOMETRY: 'nav_msgs/msg/Odometry',
         TF: 'tf2_msgs/msg/TFMessage'}
MESSAGES = message_types()
LATCHED = (PATH,)
MOST_POSES = 100_000  # of a path in a message; of more only every second is written, or fewer
UNKNOWN = UNKNOWN_VARIANCE * np.eye(3)
ORIGIN = 0.0, 0.0, 0.0


class Copied(NamedTuple):
    """Numbers of messages."""

    original: int
    """Copied as they are."""
    corrected: int
    """Poses of odometry in the map."""
    left_out: int
    """Others on the topics that are written, or that cannot be converted from ROS 1."""


class _Corrector:
    """Makes what is published with each message of the primary odometry."""

    def __init__(
        self, bag: Bag, inputs: Inputs, values: Mapping[str, Any], estimate: Estimate,
        covariances: FloatArray,
    ) -> None:
        self._source = estimate.primary
        self.topic = inputs.topics[self._source]
        self._has_poses = inputs.kinds[self._source] is Kind.ODOMETRY
        self.map_frame, self.odom_frame, self._base_frame = (
            frame(values[key]) for key in ('map_frame', 'odom_frame', 'base_link_frame'))
        at_path = OdometryAtPath(estimate.path)
        if self._has_poses:
            reader = MessageReader(values)
            for message in bag.messages([self.topic], inputs.span):
                with suppress(MessageError):
                    sample = reader.read(self._source, message.decode())
                    if isinstance(sample, OdometrySample):
                        at_path.add(sample.stamp_ns, _pose(sample))
        self._correction = PathCorrection(estimate.path, at_path.poses)
        self._stamps, self._covariances = estimate.path.stamps_ns.tolist(), covariances
        self._newest_ns = 0
        # from the first message on again, as it remembers the stamps before
        self._reader = reader_of(bag, values)

    def outputs(self, message: BagMessage) -> Iterator[tuple[str, bytes]]:
        """Yield topics and serialised messages; none outside the path."""
        try:
            source = message.decode()
        except MessageError:
            return
        sample = self._reader.read(self._source, source)
        if not isinstance(sample, OdometrySample):
            return
        stamp_ns, odometry = sample.stamp_ns, _pose(sample)
        pose = self._correction.at(stamp_ns, odometry)
        if pose is None:
            return
        covariance = self._covariances[bisect.bisect_right(self._stamps, stamp_ns) - 1]
        yield ODOMETRY, odometry_cdr(
            stamp_ns, Prediction(np.array(pose), UNKNOWN if np.isnan(covariance[0, 0])
                                 else covariance), source, self.map_frame, self._base_frame)
        if (self._has_poses and stamp_ns > self._newest_ns
                and frame(source.header.frame_id) == self.odom_frame):
            self._newest_ns = stamp_ns
            yield TF, transform_cdr(
                stamp_ns, np.array(compose_one(pose, between_one(odometry, ORIGIN))),
                self.map_frame, self.odom_frame)


def write_corrected(
    writer: BagWriter, bag: Bag, inputs: Inputs, values: Mapping[str, Any], *,
    estimate: Estimate, covariances: FloatArray,
) -> Copied:
    """
    Return the numbers of messages after copying those of the span of the inputs, with the result.

    With each message of the primary odometry comes its pose in the map by the whole recording,
    and the transform from map to odom if its frame is `odom_frame`. The path comes first.

    Parameters
    ----------
    writer : BagWriter, open, with `LATCHED` topics
    values : mapping, all parameters of the node
    estimate : Estimate, with the path
    covariances : ndarray, shape (N, 3, 3), of the path, in map axes; NaN where unknown

    """
    corrector = _Corrector(bag, inputs, values, estimate, covariances)
    begin_ns = inputs.span.begin_ns
    writer.write(
        PATH, TYPES[PATH], bag.start_ns if begin_ns is None else begin_ns,
        path_cdr(_thinned(estimate.path), int(estimate.path.stamps_ns[-1]), corrector.map_frame))
    if begin_ns is not None and STATIC_FRAMES[0] in bag.topics:
        for message in bag.messages([STATIC_FRAMES[0]], Span(None, begin_ns)):
            writer.copy(replace(message, recorded_ns=begin_ns))
    original = corrected = left_out = 0
    for message in bag.messages(list(bag.topics), inputs.span):
        if _copy(writer, message, corrector):
            original += 1
        else:
            left_out += 1
        if message.topic == corrector.topic:
            for topic, data in corrector.outputs(message):
                writer.write(topic, TYPES[topic], message.recorded_ns, data)
                corrected += topic == ODOMETRY
    return Copied(original, corrected, left_out)


def _copy(writer: BagWriter, message: BagMessage, ours: _Corrector) -> bool:
    """Copy a message without what is written anew; return whether anything was left."""
    if message.topic in (PATH, ODOMETRY):
        return False
    try:
        if message.topic == TF and all(
                name.encode() in message.raw for name in (ours.map_frame, ours.odom_frame)):
            transforms = message.decode().transforms
            kept = [each for each in transforms if (
                frame(each.header.frame_id), frame(each.child_frame_id)) != (
                    ours.map_frame, ours.odom_frame)]
            if len(kept) < len(transforms):
                if len(kept) > 0:
                    writer.write(TF, TYPES[TF], message.recorded_ns, MESSAGES[TYPES[TF]](kept))
                return len(kept) > 0
        writer.copy(message)
    except MessageError:
        return False
    return True


def _pose(sample: OdometrySample) -> Pose:
    x, y, theta = sample.pose.tolist()
    return x, y, theta


def _thinned(path: Trajectory) -> Trajectory:
    step = -(-len(path) // MOST_POSES)
    return Trajectory(path.stamps_ns[::step], path.poses[::step])
