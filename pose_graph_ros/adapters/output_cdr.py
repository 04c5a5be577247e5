# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write what the node publishes with each odometry message, and its path, as bytes; no rclpy.

They are the bytes of the middleware (CDR, little endian): filling in message objects would take
ten times as long. In CDR every number is aligned to its size, counted from the end of the four
bytes at the start of the stream.
"""

import functools
import math
import struct

import numpy as np
import numpy.typing as npt

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.adapters.sources import NANOSECONDS
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.prediction import Prediction

# Variance of height, roll and pitch in messages for filters: they are not estimated [m^2, rad^2].
UNKNOWN_VARIANCE = 1e6
# The same in poses for viewers, which would draw an ellipsoid of a kilometre [m^2, rad^2].
PLANAR_VARIANCE = 1e-6

PATH_CHUNK = 2048  # number of poses of a path that are written at a time

CDR = b'\x00\x01\x00\x00'
_STAMP, _LENGTH = struct.Struct('<iI'), struct.Struct('<I')
_POSE, _POSE_WITH_COVARIANCE = struct.Struct('<7d'), struct.Struct('<43d')
_TWIST_WITH_COVARIANCE = struct.Struct('<42d')
_UNKNOWN_TWIST = bytes(48) + (UNKNOWN_VARIANCE * np.eye(6)).tobytes()


@functools.cache
def _names(at: int, frame_id: str, child_frame_id: str = '') -> bytes:
    """Serialise one or two frame ids at an offset [bytes], padded for a double to follow."""
    data = b''
    for text in (frame_id, child_frame_id) if child_frame_id else (frame_id,):
        data += bytes(-(at + len(data)) % 4)
        name = text.encode() + b'\0'
        data += _LENGTH.pack(len(name)) + name
    return data + bytes(-(at + len(data)) % 8)


def odometry_cdr(
    stamp_ns: int, prediction: Prediction, source: Message, map_frame: str, base_frame: str,
) -> bytes:
    """
    Return a serialised nav_msgs/Odometry: the pose in the map and the twist of the odometry.

    Parameters
    ----------
    source : nav_msgs.msg.Odometry, its twist is replaced by an unknown one if it is not finite

    """
    twist = source.twist
    linear, angular = twist.twist.linear, twist.twist.angular
    numbers = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z, *twist.covariance)
    # a finite sum is the quick way to tell
    finite = math.isfinite(sum(numbers)) or all(map(math.isfinite, numbers))
    return b''.join((
        CDR, _STAMP.pack(*divmod(stamp_ns, NANOSECONDS)), _names(8, map_frame, base_frame),
        _pose_with_covariance_cdr(prediction, UNKNOWN_VARIANCE),
        _TWIST_WITH_COVARIANCE.pack(*numbers) if finite else _UNKNOWN_TWIST))


def stamped_pose_cdr(stamp_ns: int, prediction: Prediction, map_frame: str) -> bytes:
    """Return a serialised geometry_msgs/PoseWithCovarianceStamped in the map."""
    return b''.join((CDR, _STAMP.pack(*divmod(stamp_ns, NANOSECONDS)), _names(8, map_frame),
                     _pose_with_covariance_cdr(prediction, PLANAR_VARIANCE)))


def _pose_with_covariance_cdr(prediction: Prediction, unknown: float) -> bytes:
    """Serialise a planar pose; height, roll and pitch have the unknown variance."""
    (xx, xy, xt), (yx, yy, yt), (tx, ty, tt) = prediction.covariance.tolist()
    return _POSE_WITH_COVARIANCE.pack(
        *_position_and_quaternion(prediction.T_map_base),
        xx, xy, 0.0, 0.0, 0.0, xt,
        yx, yy, 0.0, 0.0, 0.0, yt,
        0.0, 0.0, unknown, 0.0, 0.0, 0.0,
        0.0, 0.0, 0.0, unknown, 0.0, 0.0,
        0.0, 0.0, 0.0, 0.0, unknown, 0.0,
        tx, ty, 0.0, 0.0, 0.0, tt)


def _position_and_quaternion(pose: FloatArray) -> tuple[float, ...]:
    """Return the seven numbers of a planar pose in messages."""
    x, y, theta = pose.tolist()
    return x, y, 0.0, 0.0, 0.0, math.sin(theta / 2.0), math.cos(theta / 2.0)


def transform_cdr(
    stamp_ns: int, T_map_odom: FloatArray, map_frame: str, odom_frame: str,
) -> bytes:
    """
    Return a serialised tf2_msgs/TFMessage with the transform from map to odom.

    Parameters
    ----------
    T_map_odom : ndarray, shape (3,)

    """
    return b''.join((CDR, _LENGTH.pack(1), _STAMP.pack(*divmod(stamp_ns, NANOSECONDS)),
                     _names(12, map_frame, odom_frame),
                     _POSE.pack(*_position_and_quaternion(T_map_odom))))


def path_cdr(path: Trajectory, stamp_ns: int, frame_id: str) -> bytes:
    """
    Return a serialised nav_msgs/Path whose poses all lie in one frame.

    A PoseStamped ends at a multiple of 8 bytes, so all but the first have the same layout, and
    NumPy fills many at once.

    Parameters
    ----------
    stamp_ns : int, stamp of the path; each pose has its own [ns]

    """
    name = frame_id.encode() + b'\0'
    head = _STAMP.pack(*divmod(stamp_ns, NANOSECONDS)) + _LENGTH.pack(len(name)) + name
    head += bytes(-len(head) % 4) + _LENGTH.pack(len(path))
    if len(path) == 0:
        return CDR + head
    # as many at a time as stay in the processor's cache while they are filled in
    size = 12 + len(name) + -(12 + len(name)) % 8 + 7 * 8
    numbers = np.zeros((PATH_CHUNK, size // 8), dtype='<f8')
    pose, integers = numbers[:, -7:], numbers.view('<u4')
    integers[:, 2] = len(name)
    numbers.view(np.uint8)[:, 12:12 + len(name)] = np.frombuffer(name, np.uint8)
    parts = [CDR, head]
    for begin in range(0, len(path), PATH_CHUNK):
        chunk = slice(begin, begin + PATH_CHUNK)
        stamps, poses = path.stamps_ns[chunk], path.poses[chunk]
        n, half = len(stamps), poses[:, 2] / 2.0
        integers[:n, 0], integers[:n, 1] = np.divmod(stamps, NANOSECONDS)
        pose[:n, :2] = poses[:, :2]
        pose[:n, 5], pose[:n, 6] = np.sin(half), np.cos(half)
        if begin == 0:
            # the first pose begins at the end of the head, the others at a multiple of 8
            first, names_end = numbers[0].tobytes(), 12 + len(name)
            parts += (first[:names_end], bytes(-(len(head) + names_end) % 8), first[-56:])
        parts.append(numbers[begin == 0:n].tobytes())
    return b''.join(parts)


_LENGTH = struct.Struct('<I')


class CdrStream:
    """A stream of CDR: the position of each number is a multiple of its size."""

    def __init__(self) -> None:
        self._data = bytearray()

    def add(self, code: str, *numbers: npt.ArrayLike) -> None:
        """Add numbers, or an array, as a type of NumPy."""
        array = np.asarray(numbers, dtype=code)
        self._data += bytes(-len(self._data) % array.itemsize) + array.tobytes()

    def add_text(self, text: str) -> None:
        """Add a string."""
        name = text.encode() + b'\0'
        self._data += bytes(-len(self._data) % 4) + _LENGTH.pack(len(name)) + name

    def message(self) -> bytes:
        """Return the message, with the bytes that tell the encoding in front."""
        return b'\x00\x01\x00\x00' + bytes(self._data)
