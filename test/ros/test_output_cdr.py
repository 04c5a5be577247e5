# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is written as bytes is read by rclpy as the message that it would have made."""

import math

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from hypothesis import given, settings, strategies as st
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.core.estimate import Prediction
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph_view import GraphView, Lines
from pose_graph_ros.ros.publishers import time_message

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
    assert (stamp.sec, stamp.nanosec, message.header.frame_id) == (
        *divmod(stamp_ns, 10**9), frame)


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
def test_a_path(frame: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_cdr, 'PATH_CHUNK', 7)
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


def point(position: np.ndarray) -> Point:
    return Point(x=float(position[0]), y=float(position[1]))


def colour(sigmas: float) -> ColorRGBA:
    r, g, b, a = output_cdr.colours(np.array([sigmas]))[0].tolist()
    return ColorRGBA(r=r, g=g, b=b, a=a)


def marker(frame: str) -> Marker:
    made = Marker()
    for header in (made.header, made.texture.header):
        header.stamp, header.frame_id = time_message(STAMP), frame
    made.pose.orientation.w = 1.0
    made.color = ColorRGBA(**dict(zip(
        'rgba', np.float32(output_cdr.LOOK.node).tolist(), strict=True)))
    return made


def marker_message(view: GraphView, frame: str) -> MarkerArray:
    """Build the message field by field."""
    first = marker(frame)
    first.action = Marker.DELETEALL
    array = [first]
    made = [marker(frame) for _ in output_cdr.NAMESPACES]
    for number, each in enumerate(made):
        each.ns, each.id, each.action = output_cdr.NAMESPACES[number], number, Marker.ADD
    (nodes, odometry, closures, errors, observed, weak, waiting, doubted, unused_errors,
     unused) = made
    nodes.type = observed.type = unused.type = Marker.POINTS
    nodes.scale.x = nodes.scale.y = output_cdr.LOOK.node_size
    for points in (observed, unused):
        points.scale.x = points.scale.y = output_cdr.LOOK.observed_size
    nodes.points = [point(position) for position in view.nodes]
    for line, lines, width in (
            (odometry, view.odometry, output_cdr.LOOK.edge_width),
            (closures, view.loop_closures, output_cdr.LOOK.closure_width),
            (errors, view.observed, output_cdr.LOOK.edge_width)):
        line.type = Marker.LINE_LIST
        line.scale.x = line.scale.y = width
        for ends, sigmas in zip(lines.ends, lines.sigmas, strict=True):
            line.points += [point(ends[0]), point(ends[1])]
            line.colors += [colour(sigmas), colour(sigmas)]
    for ends, sigmas in zip(view.observed.ends, view.observed.sigmas, strict=True):
        observed.points.append(point(ends[1]))
        observed.colors.append(colour(sigmas))
    grey, blue = (ColorRGBA(**dict(zip('rgba', np.float32(each).tolist(), strict=True)))
                  for each in (output_cdr.LOOK.doubted, output_cdr.LOOK.waiting))
    for line, lines, plain in (
            (weak, view.weak, None), (waiting, view.waiting, blue), (doubted, view.doubted, grey)):
        line.type = Marker.LINE_LIST
        line.scale.x = line.scale.y = output_cdr.LOOK.closure_width
        for (begin, end), sigmas in zip(lines.ends, lines.sigmas, strict=True):
            for part in np.linspace(0.0, 1.0, 2 * output_cdr.LOOK.dashes):
                line.points.append(point(begin + part * (end - begin)))
                line.colors.append(plain or colour(sigmas))
    unused_errors.type = Marker.LINE_LIST
    unused_errors.scale.x = unused_errors.scale.y = output_cdr.LOOK.edge_width
    for ends in view.unused.ends:
        unused_errors.points += [point(ends[0]), point(ends[1])]
        unused_errors.colors += [grey, grey]
        unused.points.append(point(ends[1]))
        unused.colors.append(grey)
    array += [each for each in made if len(each.points) > 0]
    return MarkerArray(markers=array)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(frames, st.tuples(*[counts] * 8), st.integers(0, 100))
def test_markers_are_what_rclpy_makes_for_any_frame_and_graph(
    frame: str, counts: tuple[int, ...], seed: int,
) -> None:
    view = random_view(counts, seed)
    ours, theirs = output_cdr.markers_cdr(view, STAMP, frame), marker_message(view, frame)
    assert deserialize_message(ours, MarkerArray) == theirs
    assert len(serialize_message(theirs)) - len(ours) in range(4), 'at most the end is padded'


def test_springs_go_from_green_over_yellow_to_red() -> None:
    sigmas = np.linspace(0.0, 6.0, 601)
    red, green, _, alpha = output_cdr.colours(sigmas).T
    assert np.all(alpha == 1.0)
    assert np.ptp(output_cdr.colours(sigmas[sigmas <= 1.0]), axis=0).max() == 0.0
    assert np.ptp(output_cdr.colours(sigmas[sigmas >= 3.0]), axis=0).max() == 0.0
    assert green[0] - red[0] > 0.4
    assert red[-1] - green[-1] > 0.4
    assert min(red[200], green[200]) > 0.7, 'yellow at 2 sigmas'
    assert np.abs(np.diff(output_cdr.colours(sigmas), axis=0)).max() < 0.02, 'smooth'
    assert np.all(np.diff(red[:201]) >= 0.0)
    assert np.all(np.diff(green[200:]) <= 0.0)
