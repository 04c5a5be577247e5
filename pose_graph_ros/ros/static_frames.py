# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of the robot that do not move against each other, as /tf_static tells; no rclpy."""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.ros.conversions import frame, Message

# No robot has more frames in a row; more would be a circle.
LONGEST_CHAIN = 100
# A sensor further from the robot is none [m].
LARGEST_DISTANCE = 1e3


class _Frame(NamedTuple):
    """A frame in its parent."""

    parent: str
    rotation: FloatArray
    translation: FloatArray


class StaticFrames:
    """Static transforms, of which the newest counts for each child."""

    def __init__(self) -> None:
        self._frames: dict[str, _Frame] = {}

    def take(self, message: Message) -> None:
        """Take a tf2_msgs/TFMessage; what is no transform in it is left out."""
        for item in message.transforms:
            parent, child = frame(item.header.frame_id), frame(item.child_frame_id)
            t, q = item.transform.translation, item.transform.rotation
            norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
            translation = np.array([t.x, t.y, t.z])
            if (parent in ('', child) or child == '' or not 1e-6 < norm < math.inf
                    or not np.all(np.abs(translation) < LARGEST_DISTANCE)):
                continue
            self._frames[child] = _Frame(
                parent, _rotation(q.x / norm, q.y / norm, q.z / norm, q.w / norm), translation)

    def position(self, name: str, base: str) -> FloatArray | None:
        """Return the origin of a frame in another one, shape (3,) [m]; None if it is not known."""
        of_name, of_base = self._chain(name), self._chain(base)
        for ancestor, (_, point) in of_name.items():
            if ancestor in of_base:
                rotation, translation = of_base[ancestor]
                return np.asarray(rotation.T @ (point - translation))
        return None

    def _chain(self, name: str) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Return a frame in itself and in each of its ancestors: rotation and translation."""
        rotation, translation = np.eye(3), np.zeros(3)
        chain = {name: (rotation, translation)}
        while name in self._frames and len(chain) < LONGEST_CHAIN:
            name, turn, shift = self._frames[name]
            rotation, translation = turn @ rotation, turn @ translation + shift
            if name in chain:
                break
            chain[name] = rotation, translation
        return chain


def _rotation(x: float, y: float, z: float, w: float) -> FloatArray:
    """Return the matrix of a unit quaternion."""
    return np.array([
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]])
