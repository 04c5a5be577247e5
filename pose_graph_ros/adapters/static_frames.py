# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Static transforms between the frames of the robot, as published on /tf_static; no rclpy."""

import math

import numpy as np

from pose_graph_ros.adapters.conversions import frame, Message
from pose_graph_ros.core.geometry.scalar_se2 import Pose
from pose_graph_ros.core.geometry.se2 import FloatArray

LONGEST_CHAIN = 100  # largest number of frames from one to its root; protects against cycles
LARGEST_DISTANCE = 1e3  # largest valid coordinate of a translation [m]


class StaticFrames:
    """Static transforms; for each child frame the newest one is used."""

    def __init__(self) -> None:
        # parent, rotation and translation by child frame
        self._frames: dict[str, tuple[str, FloatArray, FloatArray]] = {}

    def receive(self, message: Message) -> None:
        """Add the transforms of a tf2_msgs/TFMessage; invalid ones are ignored."""
        for item in message.transforms:
            parent, child = frame(item.header.frame_id), frame(item.child_frame_id)
            t, q = item.transform.translation, item.transform.rotation
            norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
            translation = np.array([t.x, t.y, t.z])
            if (parent in ('', child) or child == '' or not 1e-6 < norm < math.inf
                    or not np.all(np.abs(translation) < LARGEST_DISTANCE)):
                continue
            rotation = _rotation(q.x / norm, q.y / norm, q.z / norm, q.w / norm)
            self._frames[child] = parent, rotation, translation

    def position(self, name: str, base: str) -> FloatArray | None:
        """Return the origin of a frame in a base frame, shape (3,) [m]; None if it is unknown."""
        found = self._transform(name, base)
        return None if found is None else found[1]

    def rotation(self, name: str, base: str) -> FloatArray | None:
        """Return the rotation from a frame to a base frame, shape (3, 3); None if unknown."""
        found = self._transform(name, base)
        return None if found is None else found[0]

    def planar(self, name: str, base: str) -> Pose | None:
        """Return the pose of a frame in the plane of another one [m, m, rad]; None if unknown."""
        found = self._transform(name, base)
        if found is None:
            return None
        rotation, (x, y, _) = found
        return float(x), float(y), math.atan2(rotation[1, 0], rotation[0, 0])

    def _transform(self, name: str, base: str) -> tuple[FloatArray, FloatArray] | None:
        """Return rotation and translation of a frame in another one; None if unknown."""
        of_name, of_base = self._chain(name), self._chain(base)
        for ancestor, (turn, point) in of_name.items():
            if ancestor in of_base:
                rotation, translation = of_base[ancestor]
                return rotation.T @ turn, rotation.T @ (point - translation)
        return None

    def _chain(self, name: str) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Return rotation and translation of a frame in itself and in each of its ancestors."""
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
    """Return the matrix of a unit quaternion; SciPy's would make each start 0.3 s longer."""
    return np.array([
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]])
