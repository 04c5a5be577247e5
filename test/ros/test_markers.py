# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The markers of the graph are those that rclpy makes field by field."""

import time

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from geometry_msgs.msg import Point
from hypothesis import given, settings, strategies as st
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.adapters import markers
from pose_graph_ros.core.graph.graph_view import GraphView, Lines
from pose_graph_ros.ros.publishers import time_message

STAMP = 1_800_000_000_000_000_007
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
    r, g, b, a = markers.colours(np.array([sigmas]))[0].tolist()
    return ColorRGBA(r=r, g=g, b=b, a=a)


def marker(frame: str) -> Marker:
    made = Marker()
    for header in (made.header, made.texture.header):
        header.stamp, header.frame_id = time_message(STAMP), frame
    made.pose.orientation.w = 1.0
    made.color = ColorRGBA(**dict(zip(
        'rgba', np.float32(markers.NODE_COLOUR).tolist(), strict=True)))
    return made


def message(view: GraphView, frame: str) -> MarkerArray:
    """Build the message field by field."""
    first = marker(frame)
    first.action = Marker.DELETEALL
    array = [first]
    made = [marker(frame) for _ in markers.NAMESPACES]
    for number, each in enumerate(made):
        each.ns, each.id, each.action = markers.NAMESPACES[number], number, Marker.ADD
    (nodes, odometry, closures, errors, observed, weak, waiting, doubted, unused_errors,
     unused) = made
    nodes.type = observed.type = unused.type = Marker.POINTS
    nodes.scale.x = nodes.scale.y = markers.NODE_SIZE
    for points in (observed, unused):
        points.scale.x = points.scale.y = markers.OBSERVED_SIZE
    nodes.points = [point(position) for position in view.nodes]
    for line, lines, width in (
            (odometry, view.odometry, markers.EDGE_WIDTH),
            (closures, view.loop_closures, markers.CLOSURE_WIDTH),
            (errors, view.observed, markers.EDGE_WIDTH)):
        line.type = Marker.LINE_LIST
        line.scale.x = line.scale.y = width
        for ends, sigmas in zip(lines.ends, lines.sigmas, strict=True):
            line.points += [point(ends[0]), point(ends[1])]
            line.colors += [colour(sigmas), colour(sigmas)]
    for ends, sigmas in zip(view.observed.ends, view.observed.sigmas, strict=True):
        observed.points.append(point(ends[1]))
        observed.colors.append(colour(sigmas))
    grey, blue = (ColorRGBA(**dict(zip('rgba', np.float32(each).tolist(), strict=True)))
                  for each in (markers.DOUBTED_COLOUR, markers.WAITING_COLOUR))
    for line, lines, plain in (
            (weak, view.weak, None), (waiting, view.waiting, blue), (doubted, view.doubted, grey)):
        line.type = Marker.LINE_LIST
        line.scale.x = line.scale.y = markers.CLOSURE_WIDTH
        for (begin, end), sigmas in zip(lines.ends, lines.sigmas, strict=True):
            for part in np.linspace(0.0, 1.0, 2 * markers.DASHES):
                line.points.append(point(begin + part * (end - begin)))
                line.colors.append(plain or colour(sigmas))
    unused_errors.type = Marker.LINE_LIST
    unused_errors.scale.x = unused_errors.scale.y = markers.EDGE_WIDTH
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
    ours, theirs = markers.markers_cdr(view, STAMP, frame), message(view, frame)
    assert deserialize_message(ours, MarkerArray) == theirs
    assert len(serialize_message(theirs)) - len(ours) in range(4), 'at most the end is padded'


def test_springs_go_from_green_over_yellow_to_red() -> None:
    sigmas = np.linspace(0.0, 6.0, 601)
    red, green, _, alpha = markers.colours(sigmas).T
    assert np.all(alpha == 1.0)
    assert np.ptp(markers.colours(sigmas[sigmas <= 1.0]), axis=0).max() == 0.0
    assert np.ptp(markers.colours(sigmas[sigmas >= 3.0]), axis=0).max() == 0.0
    assert green[0] - red[0] > 0.4
    assert red[-1] - green[-1] > 0.4
    assert min(red[200], green[200]) > 0.7, 'yellow at 2 sigmas'
    assert np.abs(np.diff(markers.colours(sigmas), axis=0)).max() < 0.02, 'smooth'
    assert np.all(np.diff(red[:201]) >= 0.0)
    assert np.all(np.diff(green[200:]) <= 0.0)


def test_the_namespaces_and_ids_stay_whatever_there_is_to_draw() -> None:
    for counts in ((1, 0, 0, 1), (3, 2, 1, 0), (9, 8, 3, 5), (5, 4, 3, 2, 1, 2, 3, 4)):
        array = deserialize_message(
            markers.markers_cdr(random_view(counts), STAMP, 'map'), MarkerArray).markers
        assert array[0].action == Marker.DELETEALL
        for each in array[1:]:
            assert each.action == Marker.ADD
            assert markers.NAMESPACES[each.id] == each.ns
            assert len(each.points) > 0
            assert len(each.colors) in {0, len(each.points)}


def test_many_markers_are_quick() -> None:
    view = random_view((100_000, 100_000, 1000, 20_000, 1000, 1000, 1000, 1000))
    markers.markers_cdr(view, STAMP, 'map')
    start = time.process_time()
    markers.markers_cdr(view, STAMP, 'map')
    # fifty times what it takes
    assert time.process_time() - start < 1.0
