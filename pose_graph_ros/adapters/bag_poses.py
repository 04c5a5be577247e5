# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read the planar poses on a topic of a bag: odometry, poses, poses with covariance."""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from pose_graph_ros.adapters.bags import Bag, MessageError, Span, WHOLE
from pose_graph_ros.adapters.conversions import Message, planar_pose, stamp_ns
from pose_graph_ros.core.geometry.se2 import FloatArray

ODOMETRY, POSE, POSE_WITH_COVARIANCE = POSE_TYPES = (
    'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped',
    'geometry_msgs/msg/PoseWithCovarianceStamped')


class BagPose(NamedTuple):
    """A pose that was read from a message."""

    stamp_ns: int
    pose: FloatArray  # shape (3,) [m, m, rad]


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


def _pose(stamped: Message, holder: Message) -> BagPose | None:
    """Return the pose of a message with a header that is in a part with a field `pose`."""
    pose = planar_pose(holder.pose)
    if pose is None:
        return None
    return BagPose(stamp_ns(stamped), pose)
