# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The outputs: what is published, when, and its stamps; with a stand-in for rclpy's node."""

from itertools import count
import math
import time
from types import SimpleNamespace as Space
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from harness import odometry, PATIENCE, stamp_ns, TFMessage, yaw
from hypothesis import given as given_numbers, settings, strategies as st
import numpy as np
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from pose_graph_ros.adapters.conversions import Datum
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph_view import GraphView, Lines
from pose_graph_ros.core.judgement.texts import details, sentence
from pose_graph_ros.core.judgement.verdicts import Decision, Judged, SourceVerdicts, State, Verdict
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.ros import publishers
from pose_graph_ros.ros.publishers import Publishers, thinned, verdicts_message
from pose_graph_ros.ros.worker import WorkerStatus

SECOND = 1_000_000_000
NO_LINES = Lines(np.zeros((0, 2, 2)), np.zeros(0))
VIEW = GraphView(np.array([[1.0, 2.0]]), NO_LINES, NO_LINES, NO_LINES)
needs_tf2_msgs = pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not built: no /tf')


def estimate(
    seconds: float, T_map_odom: tuple[float, float, float] = (0.0, 0.0, 0.0),
    alignment: AlignmentState = AlignmentState.ALIGNED,
) -> Estimate:
    """Return the estimate of a robot that is at the origin of the odometry frame."""
    correction = np.array(T_map_odom)
    return Estimate(
        stamp_ns=round(seconds * SECOND), T_odom_base=np.zeros(3), T_map_base=correction.copy(),
        T_map_odom=correction, covariance=0.01 * np.eye(3), alignment=alignment,
        alignment_sigma=0.01, chi2=0.0, n_hidden=1, n_edges=0, n_observed=1, n_biases=0,
        primary='odom', odometry=OdometrySource())


class Outlet:
    """A publisher that keeps what it is given."""

    def __init__(self, kind: type, topic_name: str) -> None:
        self.kind, self.topic_name, self.listeners = kind, topic_name, 1
        self.sent: list[Any] = []

    def publish(self, message: Any) -> None:
        self.sent.append(deserialize_message(message, self.kind)
                         if isinstance(message, bytes) else message)

    def get_subscription_count(self) -> int:
        return self.listeners


class Outlets(dict[str, Outlet]):
    """What the outputs need of a node; and who else publishes."""

    others: tuple[str, ...] = ()
    warnings: tuple[str, ...] | list[str] = ()

    def create_publisher(self, kind: type, topic: str, *_: object, **__: object) -> Outlet:
        outlet = self.setdefault(topic, Outlet(kind, topic))
        outlet.listeners = 1
        return outlet

    def destroy_publisher(self, outlet: Outlet) -> None:
        outlet.listeners = 0

    def resolve_topic_name(self, name: str) -> str:
        return name

    def count_publishers(self, topic: str) -> int:
        return self.others.count(topic)

    def get_logger(self) -> Any:
        return Space(warning=lambda text, **_: self.warnings.append(text))


class Given:
    """The outputs of a node."""

    def __init__(self, **values: object) -> None:
        self.node, self.values, self.datum = Outlets(), values, Datum()
        self.out = Publishers(self.node, checked(values))

    def configure(self, **values: object) -> None:
        self.values |= values
        self.out.configure(checked(self.values))

    def publish(
        self, seconds: float, T_map_odom: tuple[float, float, float] = (0.0, 0.0, 0.0), *,
        x: float = 0.0, frame: str = 'odom',
        alignment: AlignmentState = AlignmentState.ALIGNED,
    ) -> None:
        """Publish the outputs of one odometry message."""
        message = odometry(seconds, x, 0.0, 0.0)
        message.header.frame_id = frame
        self.out.publish_pose(
            estimate(seconds, T_map_odom, alignment), message,
            OdometrySample(round(seconds * SECOND), np.array([x, 0.0, 0.0])), self.datum)

    def publish_views(self, newest: Estimate, graph: int, *, at_once: bool = False) -> None:
        """Publish path, markers and verdicts after an update of a graph."""
        worker = Space(estimate=newest, status=WorkerStatus(), keep_path=lambda _: None)
        path = Trajectory(np.array([newest.stamp_ns]), np.zeros((1, 3)))
        self.out.publish_views(worker, graph, Space(
            estimate=lambda: Space(path=path, n_frozen=0), view=lambda: VIEW,
            verdicts=lambda _: []), at_once=at_once)

    def stamps(self, topic: str) -> list[float]:
        return [stamp_ns(message) / SECOND for message in self.node[topic].sent]

    def transforms(self) -> list[Any]:
        return [item for message in self.node['/tf'].sent for item in message.transforms]


def test_each_stamp_is_published_once_and_none_goes_back() -> None:
    given = Given(transform_time_offset=0.5, map_frame='world', odom_frame='/wheels')
    for seconds in (1.0, 2.0, 2.0, 1.5, 0.5, 3.0):
        given.publish(seconds, (10.0, 5.0, math.pi / 2.0), x=2.0, frame='wheels')
    # with a smaller offset no stamp is published again, and none goes back
    given.configure(transform_time_offset=0.0)
    for seconds, frame in ((3.25, ''), (3.5, 'wheels'), (3.75, 'visual'), (4.0, '/wheels')):
        given.publish(seconds, (10.0, 5.0, math.pi / 2.0), x=2.0, frame=frame)
    for topic in ('pose', 'odometry/filtered'):
        assert given.stamps(topic) == [1.0, 2.0, 3.0, 3.25, 3.5, 3.75, 4.0]
        message = given.node[topic].sent[-1]
        assert message.header.frame_id == 'world'
        position = message.pose.pose.position
        assert (position.x, position.y) == pytest.approx((10.0, 7.0))
        assert yaw(message.pose.pose.orientation) == pytest.approx(math.pi / 2.0)
    assert message.child_frame_id == 'base_link'
    assert message.twist.twist.linear.x == 1.0
    if TFMessage is not None:   # none for odometry in another frame
        items = given.transforms()
        assert [stamp_ns(item) / SECOND for item in items] == [1.5, 2.5, 3.5, 4.0]
        assert {(item.header.frame_id, item.child_frame_id) for item in items} == {
            ('world', 'wheels')}


@needs_tf2_msgs
@pytest.mark.parametrize(
    'event', ['correction', 'jump', 'alignment', 'new graph', 'new transform'])
def test_a_correction_is_slow_unless_the_map_or_the_robot_was_put_elsewhere(event: str) -> None:
    given = Given(transform_slew=[0.5, 0.1])
    given.publish(1.0, x=10.0, alignment=(
        AlignmentState.UNALIGNED if event == 'alignment' else AlignmentState.ALIGNED))
    if event == 'jump':
        given.out.jump()
    elif event == 'new graph':
        given.out.start_new_graph()
    elif event == 'new transform':
        given.configure(publish_tf=False)
        given.publish(1.5)
        assert given.out.transforms is None
        given.configure(publish_tf=True)
    target = np.array([3.0, 4.0, 0.5])
    given.publish(2.0, tuple(target), x=10.0)
    first, second = (np.array([item.transform.translation.x, item.transform.translation.y,
                               yaw(item.transform.rotation)]) for item in given.transforms())
    if event != 'correction':
        np.testing.assert_allclose(second, target, atol=1e-12)
        return
    step = np.subtract(*(se2.compose(each, np.array([10.0, 0.0, 0.0]))
                         for each in (second, first)))
    assert math.hypot(*step[:2]) == pytest.approx(0.5)
    assert step[2] == pytest.approx(0.1)


def test_without_tf2_msgs_all_but_the_transform_is_published(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(publishers, 'TFMessage', None)
    monkeypatch.setattr(Outlets, 'warnings', [])
    given = Given()
    given.publish(1.0)
    assert given.stamps('pose') == [1.0]
    assert '/tf' not in given.node
    assert 'tf2_msgs is not installed' in given.node.warnings[0]
    given.configure(publish_tf=False)


def test_the_fix_needs_a_datum_and_a_measurement_in_the_map() -> None:
    given = Given()
    given.publish(1.0)
    given.datum = Datum([48.1, 11.6])
    given.datum.place(48.1, 11.6, 500.0)
    given.publish(2.0, alignment=AlignmentState.LOCAL)
    given.publish(3.0)
    (fix,) = given.node['gps/filtered'].sent
    assert stamp_ns(fix) == 3 * SECOND
    assert (fix.latitude, fix.longitude) == pytest.approx((48.1, 11.6), abs=1e-9)
    assert fix.altitude == pytest.approx(500.0)
    assert fix.header.frame_id == 'base_link'


def test_who_listens_from_later_on_is_heard_of_without_a_new_estimate() -> None:
    given = Given()
    outlets = given.node['pose'], given.node['odometry/filtered']
    fixed, stamps = estimate(1.0), count(2)

    def publish() -> None:
        stamp_ns = next(stamps) * SECOND
        given.out.publish_pose(fixed, odometry(stamp_ns / SECOND, 0.0, 0.0, 0.0),
                               OdometrySample(stamp_ns, np.zeros(3)), given.datum)

    for outlet in outlets:
        outlet.listeners = 0
    publish()
    assert [outlet.sent for outlet in outlets] == [[], []]
    for outlet in outlets:
        outlet.listeners = 1
    end = time.monotonic() + PATIENCE
    while len(outlets[0].sent) == 0:
        assert time.monotonic() < end, 'a subscriber of a robot that stands is never served'
        publish()
        time.sleep(0.002)
    assert len(outlets[1].sent) == 1


def test_the_path_is_published_once_for_each_estimate_and_only_for_a_subscriber() -> None:
    given = Given(path_period=0.0)
    given.node['path'].listeners = 0
    first = estimate(2.0)
    given.publish_views(first, 0)
    given.node['path'].listeners = 1
    for newest in (first, first, estimate(2.0), estimate(3.0)):
        given.publish_views(newest, 0)
    given.configure(path_period=1000.0)
    given.publish_views(estimate(4.0), 0)
    # a better path at the same odometry is a nanosecond newer
    assert [stamp_ns(path) - 2 * SECOND for path in given.node['path'].sent] == [0, 1, SECOND]
    given.publish_views(estimate(4.0), 0, at_once=True)
    assert len(given.node['path'].sent) == 4
    # markers and verdicts at most once in twice the period, however busy the machine is
    given = Given(path_period=1000.0)
    for newest in (first, first, estimate(3.0)):
        given.publish_views(newest, 0)
    assert len(given.node['graph'].sent) == len(given.node['~/verdicts'].sent) == 1


def test_a_new_graph_removes_path_and_markers_and_forgets_all_stamps() -> None:
    given = Given(path_period=0.0)
    # nothing has been published that could be taken back
    given.out.start_new_graph()
    given.publish(100.0)
    given.publish_views(estimate(100.0), 1)
    given.out.start_new_graph()
    given.publish(1.0)
    # what a worker of the old graph still publishes is dropped
    given.publish_views(estimate(101.0), 1)
    given.publish_views(estimate(1.0), 2)
    assert given.stamps('pose') == [100.0, 1.0]
    assert [len(path.poses) for path in given.node['path'].sent] == [1, 0, 1]
    assert given.stamps('path') == [100.0, 100.0 + 1e-9, 1.0]
    graphs = given.node['graph'].sent
    assert [item.action for item in graphs[1].markers] == [Marker.DELETEALL]
    assert stamp_ns(graphs[2].markers[-1]) == SECOND
    given.out.close()
    assert all(outlet.listeners == 0 for outlet in given.node.values())


@settings(max_examples=30, deadline=None)
@given_numbers(st.integers(0, 100_000), st.integers(0, 5))
def test_frozen_poses_that_are_shown_begin_with_the_first(frozen: int, others: int) -> None:
    stamps_ns = np.arange(frozen + others)
    kept = thinned(Trajectory(stamps_ns, np.zeros((len(stamps_ns), 3))), frozen).stamps_ns
    shown = kept[kept < frozen]
    assert len(shown) <= 20_000
    assert len(shown) >= min(frozen, 20_000 // 2)
    assert len(np.unique(np.diff(shown))) <= 1
    np.testing.assert_array_equal(kept[kept >= frozen], stamps_ns[frozen:])
    assert frozen == 0 or shown[0] == 0


def test_the_message_of_verdicts_has_one_status_for_each_and_one_for_all() -> None:
    verdicts = [Verdict(
        f'loop/{k}', Judged.LOOP_CLOSURE, 'loop', k * SECOND, None, state, SECOND, Decision.AUTO,
        np.array([1.0, 2.0, np.nan]), 3.0, ('loop/1', 'loop/2'), (), number=7)
        for k, state in enumerate(State)]
    totals = {'loop': SourceVerdicts({State.DOUBTED: 1, State.BELIEVED: 9}, doubting=True)}
    message = verdicts_message(verdicts, totals, Header(frame_id='map'))
    summary, *statuses = message.status
    assert (summary.name, summary.level) == ('summary', DiagnosticStatus.WARN)
    assert summary.message == '4 of 10 are listed; loop: 1 doubted, 9 believed'
    assert {item.key: item.value for item in summary.values}['loop.doubted'] == '1'
    for status, each in zip(statuses, verdicts, strict=True):
        assert (status.name, status.hardware_id, status.message) == (
            each.id, 'loop', sentence(each))
        assert {item.key: item.value for item in status.values} == details(each)
    assert 'nothing is judged yet' in verdicts_message([], {}, Header()).status[0].message


def test_until_the_map_is_known_the_covariance_says_so_if_a_source_is_to_tell() -> None:
    given = Given()
    # with loop closures alone the map is the frame of odometry
    given.publish(1.0, alignment=AlignmentState.LOCAL)
    given.node.others = ('gps/fix',)
    given.publish(2.0, alignment=AlignmentState.LOCAL)
    given.node.others = ()  # also when it has gone
    given.publish(3.0, alignment=AlignmentState.LOCAL)
    given.publish(4.0)
    for topic in ('pose', 'odometry/filtered'):
        found = [message.pose.covariance for message in given.node[topic].sent]
        for k, large in ((0, 1e5), (7, 1e5), (35, 3.0)):
            assert [each[k] > large for each in found] == [False, True, True, False]


@pytest.mark.parametrize('sources', [['odom', 'fix'], ['odom']])
def test_outputs_are_held_back_until_the_map_is_known_if_asked_for(sources: list[str]) -> None:
    given = Given(wait_for_map=True, sources=sources)
    before = [AlignmentState.LOCAL, AlignmentState.UNALIGNED]
    for seconds, state in enumerate((*before, AlignmentState.ALIGNED), 1):
        given.publish(float(seconds), alignment=state)
    held = 'fix' in sources
    assert given.stamps('pose') == ([3.0] if held else [1.0, 2.0, 3.0])
    # can be changed at run time
    given.configure(wait_for_map=False)
    given.publish(4.0, alignment=AlignmentState.UNALIGNED)
    assert len(given.node['pose'].sent) == (2 if held else 4)
