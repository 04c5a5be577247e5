# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The outputs of a node in the test's own process: what is published, when, and its stamps."""

from collections.abc import Iterator
import math
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import LATCHED, odometry, RELIABLE, stamp_ns, TFMessage, transform, yaw
from hypothesis import given as given_numbers, settings, strategies as st
from local_node import LocalNode
from nav_msgs.msg import Odometry, Path as PathMessage
import numpy as np
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from pose_graph_ros.adapters.conversions import states_in
from pose_graph_ros.adapters.fixes import Datum
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph_view import GraphView, Lines
from pose_graph_ros.core.judgement.texts import details, sentence, states_by_stamps
from pose_graph_ros.core.judgement.verdicts import (
    Decision,
    Judged,
    SourceVerdicts,
    State,
    Verdict,
)
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.ros import transforms
from pose_graph_ros.ros.publishers import Publishers, thinned, verdicts_message

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


def trajectory(*seconds: float) -> Trajectory:
    return Trajectory(np.array([round(each * SECOND) for each in seconds]),
                      np.array([[each, 0.0, 0.0] for each in seconds]))


class Given:
    """The outputs of a node, and what they say of other publishers."""

    def __init__(self, local: LocalNode, **values: object) -> None:
        self.local = local
        self.others: list[str] = []
        self.values = values
        self.out = Publishers(local.node, checked(values), self.others.append)
        self.datum = Datum()

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

    def subscribe(self, kind: type, topic: str, *, latched: bool = False) -> list[Any]:
        return self.local.subscribe(kind, topic, LATCHED if latched else RELIABLE)

    def wait_for(self, messages: list[Any], count: int) -> None:
        self.local.spin_until(lambda: len(messages) >= count, f'{count} messages come')
        assert len(messages) == count


def stamps(messages: list[Any]) -> list[float]:
    return [stamp_ns(message) / SECOND for message in messages]


def corrections(messages: list[Any]) -> np.ndarray:
    """Return the poses of the odometry frame in the map, shape (N, 3)."""
    items = [item.transform for message in messages for item in message.transforms]
    return np.array([(item.translation.x, item.translation.y, yaw(item.rotation))
                     for item in items])


@pytest.fixture
def local(tmp_path: Path) -> Iterator[LocalNode]:
    with LocalNode(tmp_path) as made:
        yield made


def test_each_stamp_is_published_once_and_none_goes_back(local: LocalNode) -> None:
    given = Given(local)
    poses = given.subscribe(PoseWithCovarianceStamped, 'pose')
    filtered = given.subscribe(Odometry, 'odometry/filtered')
    for seconds in (1.0, 2.0, 2.0, 1.5, 0.5, 3.0):
        given.publish(seconds, (10.0, 5.0, math.pi / 2.0), x=2.0)
    given.wait_for(poses, 3)
    given.wait_for(filtered, 3)
    assert stamps(poses) == stamps(filtered) == [1.0, 2.0, 3.0]
    for message in (poses[-1], filtered[-1]):
        assert message.header.frame_id == 'map'
        position = message.pose.pose.position
        assert (position.x, position.y) == pytest.approx((10.0, 7.0))
        assert yaw(message.pose.pose.orientation) == pytest.approx(math.pi / 2.0)
    assert filtered[-1].child_frame_id == 'base_link'
    assert filtered[-1].twist.twist.linear.x == 1.0


@needs_tf2_msgs
def test_transforms_have_increasing_stamps_with_the_offset(local: LocalNode) -> None:
    given = Given(local, transform_time_offset=0.5, map_frame='world', odom_frame='/wheels')
    messages = given.subscribe(TFMessage, '/tf')
    for seconds in (1.0, 2.0, 2.0, 1.0, 3.0):
        given.publish(seconds, frame='wheels')
    # with a smaller offset no stamp is published again, and none goes back
    given.configure(transform_time_offset=0.0)
    for seconds in (3.25, 3.5, 4.0):
        given.publish(seconds, frame='wheels')
    given.wait_for(messages, 4)
    items = [item for message in messages for item in message.transforms]
    assert stamps(items) == [1.5, 2.5, 3.5, 4.0]
    assert {(item.header.frame_id, item.child_frame_id) for item in items} == {
        ('world', 'wheels')}


@needs_tf2_msgs
def test_transforms_can_be_switched_off_and_on(local: LocalNode) -> None:
    given = Given(local, publish_tf=False)
    assert given.out.transforms is None
    poses = given.subscribe(PoseWithCovarianceStamped, 'pose')
    given.publish(1.0)
    given.wait_for(poses, 1)
    assert not any(publisher.topic_name == '/tf' for publisher in local.node.publishers)
    given.configure(publish_tf=True)
    messages = given.subscribe(TFMessage, '/tf')
    given.publish(2.0)
    given.wait_for(messages, 1)
    given.configure(publish_tf=False)
    given.publish(3.0)
    given.wait_for(poses, 3)
    local.spin_until(lambda: local.node.count_publishers('/tf') == 0, 'nobody publishes it')
    assert stamps([message.transforms[0] for message in messages]) == [2.0]


@needs_tf2_msgs
@pytest.mark.parametrize(
    'event', ['correction', 'jump', 'alignment', 'new graph', 'new transform'])
def test_a_correction_is_slow_unless_the_map_or_the_robot_was_put_elsewhere(
    local: LocalNode, event: str,
) -> None:
    given = Given(local, transform_slew=[0.5, 0.1])
    messages = given.subscribe(TFMessage, '/tf')
    before, after = AlignmentState.ALIGNED, AlignmentState.ALIGNED
    if event in ('alignment', 'new graph'):
        before = AlignmentState.UNALIGNED
    if event == 'new graph':
        after = AlignmentState.UNALIGNED
    given.publish(1.0, x=10.0, alignment=before)
    if event == 'jump':
        given.out.jump()
    elif event == 'new graph':
        given.out.start_new_graph()
    elif event == 'new transform':
        given.wait_for(messages, 1)
        given.configure(publish_tf=False)
        given.configure(publish_tf=True)
        local.spin_until(lambda: all(publisher.get_subscription_count() > 0 for publisher in
                                     local.node.publishers if publisher.topic_name == '/tf'),
                         'the new publisher is matched')
    target = (3.0, 4.0, 0.5)
    given.publish(2.0, target, x=10.0, alignment=after)
    given.wait_for(messages, 2)
    if event == 'correction':
        first, second = (se2.compose(row, np.array([10.0, 0.0, 0.0]))
                         for row in corrections(messages))
        assert math.hypot(*(second - first)[:2]) == pytest.approx(0.5)
        assert second[2] - first[2] == pytest.approx(0.1)
        # without limits it arrives at once
        given.configure(transform_slew=[0.0, 0.0])
        given.publish(3.0, target, x=10.0)
        given.wait_for(messages, 3)
    np.testing.assert_allclose(corrections(messages)[-1], target, atol=1e-12)


def test_the_fix_needs_a_datum_and_a_measurement_in_the_map(local: LocalNode) -> None:
    given = Given(local)
    fixes = given.subscribe(NavSatFix, 'gps/filtered')
    poses = given.subscribe(PoseWithCovarianceStamped, 'pose')
    given.publish(1.0)
    given.datum = Datum([48.1, 11.6])
    given.datum.plane_for(48.1, 11.6, 500.0)
    given.publish(2.0, alignment=AlignmentState.LOCAL)
    given.publish(3.0)
    given.wait_for(poses, 3)
    given.wait_for(fixes, 1)
    assert stamps(fixes) == [3.0]
    assert (fixes[0].latitude, fixes[0].longitude) == pytest.approx((48.1, 11.6), abs=1e-9)
    assert fixes[0].altitude == pytest.approx(500.0)
    assert fixes[0].header.frame_id == 'base_link'


def test_the_path_is_due_once_for_each_estimate_and_only_for_a_subscriber(
    local: LocalNode,
) -> None:
    given = Given(local, path_period=0.0)
    first = estimate(2.0)
    assert not given.out.path_is_due(first)
    paths = given.subscribe(PathMessage, 'path', latched=True)
    assert given.out.path_is_due(first)
    given.out.publish_path(first, trajectory(1.0, 2.0), graph=0)
    given.wait_for(paths, 1)
    assert not given.out.path_is_due(first)
    assert given.out.path_is_due(estimate(3.0))
    given.configure(path_period=1000.0)
    assert not given.out.path_is_due(estimate(3.0))
    assert [item.pose.position.x for item in paths[0].poses] == [1.0, 2.0]
    assert stamps(paths[0].poses) == [1.0, 2.0]


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


def test_a_better_path_at_the_same_odometry_is_a_nanosecond_newer(local: LocalNode) -> None:
    given = Given(local)
    paths = given.subscribe(PathMessage, 'path')
    for seconds in (2.0, 2.0, 2.0, 3.0):
        given.out.publish_path(estimate(seconds), trajectory(1.0), graph=0)
        given.out.publish_graph(VIEW, round(seconds * SECOND), graph=0)
    given.wait_for(paths, 4)
    assert [stamp_ns(path) - 2 * SECOND for path in paths] == [0, 1, 2, SECOND]


def test_a_new_graph_removes_path_and_markers_and_forgets_all_stamps(local: LocalNode) -> None:
    given = Given(local)
    poses = given.subscribe(PoseWithCovarianceStamped, 'pose')
    paths = given.subscribe(PathMessage, 'path')
    graphs = given.subscribe(MarkerArray, 'graph')
    # nothing has been published that could be taken back
    given.out.start_new_graph()
    given.publish(100.0)
    given.out.publish_path(estimate(100.0), trajectory(99.0), graph=1)
    given.out.publish_graph(VIEW, 99 * SECOND, graph=1)
    given.out.start_new_graph()
    assert given.out.graph == 2
    given.publish(1.0)
    given.wait_for(poses, 2)
    assert stamps(poses) == [100.0, 1.0]
    # what a worker of the old graph still publishes is dropped
    given.out.publish_path(estimate(101.0), trajectory(101.0), graph=1)
    given.out.publish_graph(VIEW, 101 * SECOND, graph=1)
    given.out.publish_path(estimate(1.0), trajectory(1.0), graph=2)
    given.out.publish_graph(VIEW, SECOND, graph=2)
    given.wait_for(paths, 3)
    given.wait_for(graphs, 3)
    assert [len(path.poses) for path in paths] == [1, 0, 1]
    assert stamps(paths) == [100.0, 100.0 + 1e-9, 1.0]
    assert [item.action for item in graphs[1].markers] == [Marker.DELETEALL]
    assert stamps(graphs[2].markers)[-1] == 1.0


def test_the_message_of_verdicts_has_one_status_for_each_and_one_for_all() -> None:
    verdicts = [Verdict(
        f'loop/{k}', Judged.LOOP_CLOSURE, 'loop', k * SECOND, None, state, SECOND, Decision.AUTO,
        np.array([1.0, 2.0, np.nan]), 3.0, ('loop/1', 'loop/2'), (), edge=True, number=7)
        for k, state in enumerate(State)]
    totals = {'loop': SourceVerdicts({State.DOUBTED: 1, State.BELIEVED: 9}, 2.0, doubting=True)}
    message = verdicts_message(verdicts, totals, Header(frame_id='map'))
    summary, *statuses = message.status
    assert (summary.name, summary.level) == ('summary', DiagnosticStatus.WARN)
    assert summary.message == '4 of 10 are listed; loop: 1 doubted, 9 believed, sigmas times 2'
    assert {item.key: item.value for item in summary.values}['loop.doubted'] == '1'
    for status, each in zip(statuses, verdicts, strict=True):
        assert (status.name, status.hardware_id, status.message) == (
            each.id, 'loop', sentence(each))
        assert {item.key: item.value for item in status.values} == details(each)
    assert states_in(message) == states_by_stamps(verdicts)
    assert 'nothing is judged yet' in verdicts_message([], {}, Header()).status[0].message


def test_no_publisher_is_left_after_the_end(local: LocalNode) -> None:
    before = len(list(local.node.publishers))
    given = Given(local)
    assert len(list(local.node.publishers)) >= before + 6
    given.out.close()
    assert len(list(local.node.publishers)) == before


def broadcast(seconds: float, parent: str, child: str) -> Any:
    return TFMessage(transforms=[transform(parent, child, seconds=seconds)])


@needs_tf2_msgs
@pytest.mark.parametrize(('parent', 'two_parents'), [('map', False), ('world', True)])
def test_another_publisher_of_the_transform_is_warned_of_once(
    local: LocalNode, parent: str, two_parents: bool,
) -> None:
    given = Given(local)
    out = given.out.transforms
    out.check_for_others()
    assert out._subscription is None, 'nobody else publishes on /tf'
    other = local.client.create_publisher(TFMessage, '/tf', transforms.TF_QOS)
    local.spin_until(lambda: local.node.count_publishers('/tf') == 2, 'the other one is known')
    out.check_for_others()
    assert out._subscription is not None
    local.spin_until(lambda: other.get_subscription_count() > 0
                     and out._subscription.get_publisher_count() == 2, 'it is matched')
    # neither its own transforms nor those of other frames are those of another publisher
    for step in range(1, 4):
        given.publish(float(step), (1.0, 2.0, 0.3))
        other.publish(broadcast(float(step), 'odom', 'base_link'))
    received = []
    on_transforms = out._on_transforms
    out._subscription.callback = lambda data: (received.append(data), on_transforms(data))
    local.spin_until(lambda: len(received) >= 6, 'all of them come')
    assert given.others == []
    for _ in range(2):
        other.publish(broadcast(4.0, parent, 'odom'))
    local.spin_until(lambda: len(received) >= 8, 'those of the other come')
    assert given.others == [out.other]
    assert f'another node publishes {parent} -> odom on /tf' in out.other
    assert '-r /tf:=tf -r /tf_static:=tf_static' in out.other
    assert ('two parents' in out.other) is two_parents


def test_until_the_map_is_known_the_covariance_says_so_if_a_source_is_to_tell(
    local: LocalNode,
) -> None:
    given = Given(local)
    poses = given.subscribe(PoseWithCovarianceStamped, 'pose')
    filtered = given.subscribe(Odometry, 'odometry/filtered')
    # with loop closures alone the map is the frame of odometry
    given.publish(1.0, alignment=AlignmentState.LOCAL)
    given.wait_for(poses, 1)
    receiver = local.client.create_publisher(NavSatFix, 'gps/fix', RELIABLE)
    local.spin_until(lambda: local.node.count_publishers('gps/fix') > 0, 'the receiver is seen')
    given.publish(2.0, alignment=AlignmentState.LOCAL)
    given.wait_for(poses, 2)
    # also when it has gone
    local.client.destroy_publisher(receiver)
    local.spin_until(lambda: local.node.count_publishers('gps/fix') == 0, 'it is gone')
    given.publish(3.0, alignment=AlignmentState.LOCAL)
    given.publish(4.0)
    given.wait_for(filtered, 4)
    given.wait_for(poses, 4)
    for messages in (poses, filtered):
        found = [message.pose.covariance for message in messages]
        x, y, yaw = (np.array([each[k] for each in found]) for k in (0, 7, 35))
        np.testing.assert_array_equal(x > 1e5, [False, True, True, False])
        np.testing.assert_array_equal(y > 1e5, [False, True, True, False])
        np.testing.assert_array_equal(yaw > 3.0, [False, True, True, False])


@pytest.mark.parametrize('sources', [['odom', 'fix'], ['odom']])
def test_outputs_are_held_back_until_the_map_is_known_if_asked_for(
    local: LocalNode, sources: list[str],
) -> None:
    given = Given(local, wait_for_map=True, sources=sources)
    poses = given.subscribe(PoseWithCovarianceStamped, 'pose')
    before = [AlignmentState.LOCAL, AlignmentState.UNALIGNED]
    for seconds, state in enumerate((*before, AlignmentState.ALIGNED), 1):
        given.publish(float(seconds), alignment=state)
    held = 'fix' in sources
    given.wait_for(poses, 1 if held else 3)
    assert stamps(poses) == ([3.0] if held else [1.0, 2.0, 3.0])
    # can be changed at run time
    given.configure(wait_for_map=False)
    given.publish(4.0, alignment=AlignmentState.UNALIGNED)
    given.wait_for(poses, 2 if held else 4)


@needs_tf2_msgs
def test_odometry_in_another_frame_has_no_transform_but_a_pose(local: LocalNode) -> None:
    given = Given(local)
    messages = given.subscribe(TFMessage, '/tf')
    poses = given.subscribe(PoseWithCovarianceStamped, 'pose')
    for seconds, frame in ((1.0, 'visual'), (2.0, ''), (3.0, '/odom')):
        given.publish(seconds, frame=frame)
    given.wait_for(poses, 3)
    given.wait_for(messages, 2)
    assert stamps([message.transforms[0] for message in messages]) == [2.0, 3.0]
