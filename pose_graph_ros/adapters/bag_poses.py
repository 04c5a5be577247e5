# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read the planar poses on a topic of a bag: odometry, poses, poses with covariance, paths."""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from pose_graph_ros.adapters.bags import Bag, BagError, MessageError, Span, WHOLE
from pose_graph_ros.adapters.conversions import Message, PLANAR, planar_pose, stamp_ns
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.trajectories.sequence import in_order, Key, PoseSequence

ODOMETRY, POSE, POSE_WITH_COVARIANCE = POSE_TYPES = (
    'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped',
    'geometry_msgs/msg/PoseWithCovarianceStamped')
PATH = 'nav_msgs/msg/Path'


class BagPose(NamedTuple):
    """A pose that was read from a message."""

    stamp_ns: int
    pose: FloatArray  # shape (3,) [m, m, rad]
    covariance: FloatArray | None  # in the axes of the parent frame, shape (3, 3)


def poses_on(bag: Bag, topic: str, span: Span = WHOLE) -> Iterator[BagPose]:
    """
    Yield the valid poses on a topic with one of `POSE_TYPES`; invalid messages are ignored.

    Parameters
    ----------
    topic : str
    span : Span, when the messages were recorded

    """
    bare = bag.topics[topic].type == POSE
    for bag_message in bag.messages([topic], span):
        with suppress(MessageError):
            message = bag_message.decode()
            found = _pose(message, message if bare else message.pose)
            if found is not None:
                yield found


def read_poses(bag: Bag, topic: str) -> PoseSequence:
    """
    Return the poses on a topic by stamp; of a `nav_msgs/Path`, those of the last message.

    Raises
    ------
    BagError
        If the topic is missing, of an unsupported type, or without a valid pose.

    """
    info = bag.topics.get(topic)
    if info is None or info.type not in {*POSE_TYPES, PATH}:
        what = 'no topic' if info is None else f'type {info.type} of'
        raise BagError(f'{bag.path}: {what} {topic}; expected one of '
                       f'{", ".join((*POSE_TYPES, PATH))}; the bag has {bag.describe()}')
    stamps, poses = GrowingArray((), np.int64), GrowingArray((3,), np.float64)
    covariances = GrowingArray((3, 3), np.float64)
    for stamp, pose, covariance in (
            _last_path(bag, topic) if info.type == PATH else poses_on(bag, topic)):
        stamps.append_one(stamp)
        poses.append_one(pose)
        if covariance is not None:
            covariances.append_one(covariance)
    if len(stamps) == 0:
        raise BagError(f'{bag.path}: no valid pose on {topic}')
    return in_order(stamps.values, poses.values, Key.STAMP,
                    covariances.values if len(covariances) > 0 else None)


def _last_path(bag: Bag, topic: str) -> Iterator[BagPose]:
    """Yield the poses of the last valid message."""
    last = None
    for message in bag.messages([topic]):
        last = message
    if last is not None:
        with suppress(MessageError):
            for each in last.decode().poses:
                found = _pose(each, each)
                if found is not None:
                    yield found


def _pose(stamped: Message, holder: Message) -> BagPose | None:
    """Return the pose of a message with a header that is in a part with a field `pose`."""
    pose = planar_pose(holder.pose)
    if pose is None:
        return None
    covariance = getattr(holder, 'covariance', None)
    return BagPose(stamp_ns(stamped), pose, None if covariance is None else np.asarray(
        covariance, dtype=np.float64).reshape(6, 6)[PLANAR])
