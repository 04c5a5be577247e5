# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write what the node publishes often, and what is long, as bytes of the middleware; no rclpy.

Filling in message objects would take ten times as long. In CDR every number is aligned to its
size, counted from the end of the four bytes at the start of the stream.
"""

import functools
import math
import struct
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.core.estimate import Prediction
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph_view import GraphView, Lines
from pose_graph_ros.core.quantities import NANOSECONDS, StampNs

# Variances of height, roll and pitch, which are not estimated, in messages for filters, and in
# poses for viewers, which would draw an ellipsoid of a kilometre [m^2, rad^2].
UNKNOWN_VARIANCE, PLANAR_VARIANCE = 1e6, 1e-6

CDR = b'\x00\x01\x00\x00'  # little endian
Colours = npt.NDArray[np.float32]
_STAMP, _LENGTH = struct.Struct('<iI'), struct.Struct('<I')
_POSE, _POSE_WITH_COVARIANCE = struct.Struct('<7d'), struct.Struct('<43d')
_TWIST = struct.Struct('<6d')
_UNKNOWN_TWIST = bytes(48) + (UNKNOWN_VARIANCE * np.eye(6)).tobytes()


def _text(at: int, text: str) -> bytes:
    """Serialise a string at an offset [bytes]."""
    name = text.encode() + b'\0'
    return bytes(-at % 4) + _LENGTH.pack(len(name)) + name


@functools.cache
def _names(at: int, *frames: str) -> bytes:
    """Serialise frame ids at an offset [bytes], padded for a double to follow."""
    data = b''
    for name in frames:
        data += _text(at + len(data), name)
    return data + bytes(-(at + len(data)) % 8)


def _head(stamp_ns: int, *frames: str, count: bytes = b'') -> bytes:
    """Serialise what comes before the numbers of a message: a header, after a count of items."""
    return b''.join((CDR, count, _STAMP.pack(*divmod(stamp_ns, NANOSECONDS)),
                     _names(8 + len(count), *frames)))


def odometry_cdr(stamp_ns: int, prediction: Prediction, source: Message, map_frame: str,
                 base_frame: str) -> bytes:
    """Return a serialised nav_msgs/Odometry: the pose in the map and the twist of the odometry."""
    twist = source.twist
    linear, angular = twist.twist.linear, twist.twist.angular
    numbers = linear.x, linear.y, linear.z, angular.x, angular.y, angular.z
    covariance = np.asarray(twist.covariance, dtype=np.float64)
    # a finite sum of squares is the quick way to tell
    finite = math.isfinite(sum(numbers) + covariance.dot(covariance)) or (
        all(map(math.isfinite, numbers)) and bool(np.all(np.isfinite(covariance))))
    return b''.join((_head(stamp_ns, map_frame, base_frame),
                     _pose_with_covariance_cdr(prediction, UNKNOWN_VARIANCE),
                     *((_TWIST.pack(*numbers), covariance.tobytes()) if finite
                       else (_UNKNOWN_TWIST,))))


def stamped_pose_cdr(stamp_ns: int, prediction: Prediction, map_frame: str) -> bytes:
    """Return a serialised geometry_msgs/PoseWithCovarianceStamped in the map."""
    return _head(stamp_ns, map_frame) + _pose_with_covariance_cdr(prediction, PLANAR_VARIANCE)


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


def transform_cdr(stamp_ns: int, T_map_odom: FloatArray, map_frame: str, odom_frame: str) -> bytes:
    """Return a serialised tf2_msgs/TFMessage with the transform from map to odom."""
    return _head(stamp_ns, map_frame, odom_frame, count=_LENGTH.pack(1)) + _POSE.pack(
        *_position_and_quaternion(T_map_odom))


def path_cdr(path: Trajectory, stamp_ns: StampNs, frame_id: str) -> bytes:
    """
    Return a serialised nav_msgs/Path whose poses all lie in one frame.

    A PoseStamped ends at a multiple of 8 bytes, so all but the first have the same layout, and
    NumPy fills them at once.
    """
    head = _STAMP.pack(*divmod(stamp_ns, NANOSECONDS)) + _text(8, frame_id)
    head += bytes(-len(head) % 4) + _LENGTH.pack(len(path))
    name = _text(8, frame_id)
    end = 8 + len(name)     # of the header of a pose, from where it begins
    rows = np.zeros(len(path), np.dtype({'names': ('stamp', 'frame', 'pose'), 'formats': (
        '(2,)<u4', f'V{len(name)}', '(7,)<f8'), 'offsets': (0, 8, end + -end % 8)}))
    rows['stamp'] = np.column_stack(np.divmod(path.stamps_ns, NANOSECONDS))
    rows['frame'], half = np.void(name), path.poses[:, 2] / 2.0
    rows['pose'][:, :2] = path.poses[:, :2]
    rows['pose'][:, 5:] = np.column_stack((np.sin(half), np.cos(half)))
    # the first pose begins at the end of the head, the others at a multiple of 8
    first = rows[:1].tobytes()
    return b''.join((CDR, head, first[:end], bytes(-(len(head) + end) % 8 if first else 0),
                     first[-56:], rows[1:].tobytes()))


class Look(NamedTuple):
    """Colours (red, green, blue, alpha) and sizes [m] of the markers of the graph."""

    # of constraints by their errors [sigma], interpolated between
    sigmas: tuple[float, ...] = (1.0, 2.0, 3.0)
    colours: tuple[tuple[float, ...], ...] = (
        (0.15, 0.7, 0.3, 1.0), (0.95, 0.8, 0.1, 1.0), (0.9, 0.1, 0.1, 1.0))
    node: tuple[float, ...] = (0.4, 0.6, 0.85, 1.0)
    waiting: tuple[float, ...] = (0.3, 0.5, 0.95, 0.9)  # loop closures; dashed, as weak ones
    doubted: tuple[float, ...] = (0.55, 0.55, 0.55, 0.8)  # dashed loop closures, and positions
    dashes: int = 12  # of a line; the gaps are as long
    node_size: float = 0.2
    observed_size: float = 0.25
    edge_width: float = 0.06
    closure_width: float = 0.1


LOOK = Look()
# Constants of visualization_msgs/Marker.
LINE_LIST, POINTS, ADD, DELETEALL = 5, 8, 0, 3
NAMESPACES = ('hidden_nodes', 'odometry', 'loop_closures', 'observed_errors', 'observed_nodes',
              'weak_closures', 'waiting_closures', 'doubted', 'unused_errors', 'unused_nodes')
"""Namespaces of the markers by id."""

def markers_cdr(view: GraphView, stamp_ns: int, frame_id: str) -> bytes:
    """
    Return the markers of a graph as a serialised visualization_msgs/MarkerArray.

    The first marker deletes all previous ones. Kinds without points have no marker, because
    viewers report empty markers as errors.
    """
    plain = np.empty((0, 4), dtype='<f4')
    drawn = [
        (POINTS, LOOK.node_size, view.nodes, plain),
        (LINE_LIST, LOOK.edge_width, *_lines(view.odometry)),
        (LINE_LIST, LOOK.closure_width, *_lines(view.loop_closures)),
        (LINE_LIST, LOOK.edge_width, *_lines(view.observed)),
        (POINTS, LOOK.observed_size, view.observed.ends[:, 1], colours(view.observed.sigmas)),
        (LINE_LIST, LOOK.closure_width, *_lines(_dashed(view.weak))),
        (LINE_LIST, LOOK.closure_width, *_plain(_dashed(view.waiting).ends, LOOK.waiting)),
        (LINE_LIST, LOOK.closure_width, *_plain(_dashed(view.doubted).ends, LOOK.doubted)),
        (LINE_LIST, LOOK.edge_width, *_plain(view.unused.ends, LOOK.doubted)),
        (POINTS, LOOK.observed_size, *_plain(view.unused.ends[:, 1], LOOK.doubted))]
    shown = [number for number, (_, _, points, _) in enumerate(drawn) if len(points) > 0]
    header = ('<u4', divmod(stamp_ns, NANOSECONDS)), ('text', frame_id)
    stream = bytearray(_LENGTH.pack(1 + len(shown)))
    for number, namespace, action in ((0, '', DELETEALL), *(
            (number, NAMESPACES[number], ADD) for number in shown)):
        kind, size, points, point_colours = drawn[number] if action == ADD else (
            0, 0.0, np.empty((0, 2)), plain)
        # a visualization_msgs/Marker field by field
        for code, value in (
                *header, ('text', namespace), ('<i4', (number, kind, action)),
                # pose and scale, of which lines use the first
                ('<f8', (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, size, size, 0.0)),
                ('<f4', LOOK.node),     # of points without their own
                ('<i4', (0, 0)), ('u1', 0),     # lifetime: forever; frame_locked
                ('<u4', len(points)),
                *([('<f8', np.pad(points, ((0, 0), (0, 1))))] if len(points) > 0 else []),
                ('<u4', len(point_colours)), ('<f4', point_colours),
                # texture_resource; texture with its data, and uv_coordinates
                ('text', ''), *header, ('text', ''), ('<u4', (0, 0)),
                # text, mesh_resource and the name of mesh_file; mesh_use_embedded_materials
                ('text', ''), ('text', ''), ('text', ''), ('<u4', 0), ('u1', 0)):
            if code == 'text':
                stream += _text(len(stream), str(value))
            else:   # the position of each number is a multiple of its size
                array = np.asarray(value, dtype=code)
                stream += bytes(-len(stream) % array.itemsize) + array.tobytes()
    return CDR + bytes(stream)


def colours(sigmas: FloatArray) -> Colours:
    """Return the colours, shape (M, 4), of constraints with these errors, shape (M,) [sigma]."""
    return np.column_stack([np.interp(sigmas, LOOK.sigmas, channel)
                            for channel in zip(*LOOK.colours, strict=True)]).astype(np.float32)


def _lines(lines: Lines) -> tuple[FloatArray, Colours]:
    """Return the ends of lines as points, shape (2 M, 2), and their colours, shape (2 M, 4)."""
    return lines.ends.reshape(-1, 2), np.repeat(colours(lines.sigmas), 2, axis=0)


def _dashed(lines: Lines) -> Lines:
    """Return the dashes of lines as lines."""
    at = np.linspace(0.0, 1.0, 2 * LOOK.dashes)[:, None]
    begin, end = lines.ends[:, 0, None], lines.ends[:, 1, None]
    points = begin + at * (end - begin)
    return Lines(points.reshape(-1, 2, 2), np.repeat(lines.sigmas, LOOK.dashes))


def _plain(points: FloatArray, colour: tuple[float, ...]) -> tuple[FloatArray, Colours]:
    """Return points, shape (..., 2), as one array, and the same colour for each of them."""
    points = points.reshape(-1, 2)
    return points, np.tile(np.array(colour, dtype=np.float32), (len(points), 1))
