# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is written as bytes is read by rclpy as the message that it would have made."""

import math

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from geometry_msgs.msg import PoseWithCovarianceStamped
from hypothesis import given, settings, strategies as st
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.core.estimate import Prediction
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph_view import GraphView, Lines

STAMP = 2**31 * 10**9 - 1
FRAMES = ['m', 'ma', 'map', 'map1', 'robot/map', 'kürzel']


def numbers(pose: object) -> list[float]:
    """Return the numbers of a pose or a transform."""
    place = pose.position if hasattr(pose, 'position') else pose.translation
    turn = pose.orientation if hasattr(pose, 'orientation') else pose.rotation
    return [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]


def planar(pose: np.ndarray) -> list[float]:
    x, y, theta = pose.tolist()
    return pytest.approx([x, y, 0, 0, 0, math.sin(theta / 2), math.cos(theta / 2)], abs=1e-15)


def check_header(message: object, stamp_ns: int, frame: str) -> None:
    stamp = message.header.stamp
    assert (stamp.sec, stamp.nanosec, message.header.frame_id) == (*divmod(stamp_ns, 10**9), frame)


def read(data: bytes, kind: type) -> object:
    message = deserialize_message(data, kind)
    assert len(serialize_message(message)) - len(data) in range(4), 'at most the end is padded'
    return message


def some_prediction(seed: int) -> Prediction:
    rng = np.random.default_rng(seed)
    return Prediction(rng.normal(0.0, 1.0, 3), rng.normal(0.0, 1.0, (3, 3)))


def check_covariance(values: object, prediction: Prediction, other: float) -> None:
    wanted = np.diag((0.0, 0.0, other, other, other, 0.0))
    wanted[np.ix_((0, 1, 5), (0, 1, 5))] = prediction.covariance
    np.testing.assert_array_equal(np.asarray(values).reshape(6, 6), wanted)


@pytest.mark.parametrize('frame', ['', *FRAMES])
@pytest.mark.parametrize('count', [0, 1, 2, 50])
def test_a_path(frame: str, count: int) -> None:
    generator = np.random.default_rng(count)
    path = Trajectory(1_700_000_000_123_456_789 + np.cumsum(generator.integers(1, 2**31, count)),
                      generator.normal(0.0, 100.0, (count, 3)))
    message = read(output_cdr.path_cdr(path, STAMP, frame), Path)
    check_header(message, STAMP, frame)
    assert len(message.poses) == count
    for item, stamp_ns, pose in zip(
            message.poses, path.stamps_ns.tolist(), path.poses, strict=True):
        check_header(item, stamp_ns, frame)
        assert numbers(item.pose) == planar(pose)


@pytest.mark.parametrize('frame', FRAMES)
@pytest.mark.parametrize('base', ['b', 'ba', 'base_link'])
@pytest.mark.parametrize('broken', ['', 'twist', 'covariance'])
def test_odometry_whose_twist_is_unknown_if_it_is_not_finite(
    frame: str, base: str, broken: str,
) -> None:
    prediction, source = some_prediction(len(frame)), Odometry()
    source.twist.twist.linear.x, source.twist.twist.angular.z = 1.25, -0.5
    source.twist.covariance = np.arange(36.0)
    if broken == 'twist':
        source.twist.twist.angular.y = math.inf
    elif broken == 'covariance':
        source.twist.covariance[35] = math.nan
    message = read(output_cdr.odometry_cdr(STAMP, prediction, source, frame, base), Odometry)
    check_header(message, STAMP, frame)
    assert message.child_frame_id == base
    assert numbers(message.pose.pose) == planar(prediction.T_map_base)
    check_covariance(message.pose.covariance, prediction, output_cdr.UNKNOWN_VARIANCE)
    unknown = Odometry().twist
    unknown.covariance = (output_cdr.UNKNOWN_VARIANCE * np.eye(6)).ravel()
    assert message.twist == (source.twist if broken == '' else unknown)


@pytest.mark.parametrize('frame', FRAMES)
def test_a_pose_and_a_transform(frame: str) -> None:
    prediction = some_prediction(1)
    message = read(output_cdr.stamped_pose_cdr(STAMP, prediction, frame),
                   PoseWithCovarianceStamped)
    check_header(message, STAMP, frame)
    assert numbers(message.pose.pose) == planar(prediction.T_map_base)
    check_covariance(message.pose.covariance, prediction, output_cdr.PLANAR_VARIANCE)
    tf2_msgs = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not there')
    for child in ('o', 'odom', 'robot/odom'):
        data = output_cdr.transform_cdr(7, prediction.T_map_base, frame, child)
        (item,) = read(data, tf2_msgs.TFMessage).transforms
        check_header(item, 7, frame)
        assert item.child_frame_id == child
        assert numbers(item.transform) == planar(prediction.T_map_base)


# --- the markers of the graph

frames = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=12)
counts = st.integers(0, 4)


def random_view(counts: tuple[int, ...], seed: int = 0) -> GraphView:
    """Return a view with so many nodes and lines of each kind, in the order of its fields."""
    rng = np.random.default_rng(seed)
    lines = [Lines(rng.normal(0.0, 100.0, (n, 2, 2)), rng.uniform(0.0, 5.0, n))
             for n in counts[1:]]
    return GraphView(rng.normal(0.0, 100.0, (counts[0], 2)), *lines)


def dashed(ends: np.ndarray) -> np.ndarray:
    shares = np.linspace(0.0, 1.0, 2 * output_cdr.LOOK.dashes)[:, None]
    return np.concatenate([begin + shares * (end - begin) for begin, end in ends] or [
        np.empty((0, 2))])


@settings(deadline=None, derandomize=True, max_examples=60)
@given(frames, st.tuples(*[counts] * 8), st.integers(0, 100))
def test_markers_are_read_by_rclpy_with_all_points_for_any_frame_and_graph(
    frame: str, counts: tuple[int, ...], seed: int,
) -> None:
    view, look = random_view(counts, seed), output_cdr.LOOK
    first, *made = read(output_cdr.markers_cdr(view, STAMP, frame), MarkerArray).markers
    assert (first.action, first.ns, len(first.points)) == (Marker.DELETEALL, '', 0)
    n = 2 * look.dashes
    wanted = {name: (points, colours) for name, points, colours in zip(
        output_cdr.NAMESPACES,
        (view.nodes, *(each.ends.reshape(-1, 2) for each in (
            view.odometry, view.loop_closures, view.observed)), view.observed.ends[:, 1],
         *(dashed(each.ends) for each in (view.weak, view.waiting, view.doubted)),
         view.unused.ends.reshape(-1, 2), view.unused.ends[:, 1]),
        (None, *(np.repeat(output_cdr.colours(each.sigmas), 2, axis=0) for each in (
            view.odometry, view.loop_closures, view.observed)),
         output_cdr.colours(view.observed.sigmas),
         np.repeat(output_cdr.colours(view.weak.sigmas), n, axis=0), look.waiting,
         look.doubted, look.doubted, look.doubted), strict=True) if len(points) > 0}
    assert [each.ns for each in made] == list(wanted)
    for each in made:
        check_header(each, STAMP, frame)
        points, colours = wanted[each.ns]
        are_points = each.ns.endswith('_nodes')
        assert (each.type, each.action, each.id) == (
            Marker.POINTS if are_points else Marker.LINE_LIST, Marker.ADD,
            output_cdr.NAMESPACES.index(each.ns))
        assert each.pose.orientation.w == 1.0
        assert each.scale.x == each.scale.y > 0.0
        np.testing.assert_array_equal([(one.x, one.y, one.z) for one in each.points],
                                      np.pad(points, ((0, 0), (0, 1))))
        if colours is None:
            assert len(each.colors) == 0
        else:
            np.testing.assert_array_equal(
                [(one.r, one.g, one.b, one.a) for one in each.colors],
                np.broadcast_to(np.float32(colours), (len(points), 4)))
