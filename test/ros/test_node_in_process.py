# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The managed node in the test's own process: its lifecycle, parameters and services."""

from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
import json
import math
from pathlib import Path
import threading
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from circle import fix_at, odometry_at, PLANE
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import PATIENCE, PREPARE_PATIENCE, RELIABLE, TFMessage, transform
from local_node import Driver, LocalNode
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import get_parameter_value, Parameter
from rclpy.task import Future
from sensor_msgs.msg import Range
from std_srvs.srv import SetBool, Trigger

from pose_graph_ros.adapters.parameter_table import Change
from pose_graph_ros.adapters.parameters import all_parameters, checked, constraints
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.io import graph_files
from pose_graph_ros.ros import diagnostics, services
from pose_graph_ros.ros.diagnostics import concerns
from pose_graph_ros.ros.node import PoseGraphNode
from pose_graph_ros.ros.services import CLOSED, REPLACED
from pose_graph_ros.ros.session import Session

pytestmark = pytest.mark.timeout(PREPARE_PATIENCE)
SUCCESS = TransitionCallbackReturn.SUCCESS


class Managed(Driver):
    """The node with parameters, and a client that calls its services."""

    def call(self, name: str, request: Any = None, kind: type = Trigger) -> Any:
        future = self.request(name, request, kind)
        self.wait(future.done, f'{name} answers')
        return future.result()

    def request(self, name: str, request: Any = None, kind: type = Trigger) -> Future:
        """Call a service; return its future answer."""
        client = self.local.client.create_client(kind, f'/pose_graph/{name}')
        self.wait(client.service_is_ready, f'{name} is there')
        return client.call_async(kind.Request() if request is None else request)

    def pause(self, *, data: bool) -> SetBool.Response:
        return self.call('pause', SetBool.Request(data=data), SetBool)

    def set(self, name: str, value: object) -> tuple[bool, str]:
        (result,) = self.local.node.set_parameters([Parameter(name, value=value)])
        return result.successful, result.reason

    def start(self) -> None:
        self.local.node.start()
        self.connect()


@pytest.fixture
def managed(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Managed]:
    values = {'frequency': 50, 'diagnostics_period': 0.02, 'file_folder': str(tmp_path),
              **getattr(request, 'param', {})}
    values = {name: value.replace('PATH', str(tmp_path)) if isinstance(value, str) else value
              for name, value in values.items()}
    overrides = [Parameter(name, value=value) for name, value in values.items()]

    def make(context: Context) -> PoseGraphNode:
        return PoseGraphNode(context=context, parameter_overrides=overrides)
    with LocalNode(tmp_path, make) as local:
        yield Managed(local)
        local.node.close()


def test_what_fails_is_answered_and_a_transition_leaves_the_node_unconfigured(
    managed: Managed, monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise MemoryError('no memory')
    node = managed.local.node
    assert node.trigger_configure() is SUCCESS
    with monkeypatch.context() as patch:
        patch.setattr(Session, 'activate', fail)
        assert node.trigger_activate() is TransitionCallbackReturn.ERROR
    assert node.failure == 'MemoryError: no memory'
    assert node._session is None
    managed.start()
    managed.drive(2.0)
    monkeypatch.setattr(managed.session.worker._backend, 'optimize', fail)
    answer = managed.call('optimize')
    assert (answer.success, answer.message) == (False, 'failed: no memory')
    monkeypatch.setattr(managed.session.out, 'configure', fail)
    result = node.set_parameters_atomically([Parameter('odom.maximum_speed', value=4.0)])
    assert (result.successful, result.reason) == (False, 'failed: MemoryError: no memory')
    assert managed.session.worker.thread.is_alive()


@pytest.mark.parametrize('managed', [
    {'sources': ['odom', 'rear'], 'rear.type': 'fix', 'rear.topic': 'rear/fix', 'datum': [48, 11],
     'wheels.type': 'odometry', 'other_node.gain': 1.0, 'frequncy': 3.0}], indirect=True)
def test_parameters_may_be_whole_numbers_and_unknown_ones_are_warned_of(
    managed: Managed, caplog: pytest.LogCaptureFixture,
) -> None:
    node = managed.local.node
    log = '\n'.join(record.getMessage() for record in caplog.get_records('setup'))
    assert 'parameter wheels.type is not known: wheels is not in sources' in log
    assert 'frequncy is not known: did you mean frequency?' in log
    assert 'other_node' not in log
    node.start()
    assert managed.session.input.reader.sources['rear'].topic == 'rear/fix'
    plane = managed.session.input.reader.datum.plane
    assert (plane.latitude, plane.longitude) == (48.0, 11.0)
    assert not node.has_parameter('fix.topic')
    assert managed.call('set_datum').message.startswith('refused: it is given')


@pytest.mark.parametrize('managed', [{'diagnostics_period': 30.0}], indirect=True)
def test_parameters_are_described_changed_and_refused(managed: Managed) -> None:
    node, own = managed.local.node, {each.name: each for each in all_parameters({})}
    managed.start()
    for descriptor in node.describe_parameters(list(own)):
        parameter = own[descriptor.name]
        assert parameter.description in descriptor.description
        assert descriptor.read_only == (parameter.change is Change.START)
        assert descriptor.additional_constraints == constraints(parameter)
    for name, value, expected in (
            ('map_frame', 'world', 'configured'), ('sources', ['odom'], 'read at the start'),
            ('fix.robust_loss', 'l1', 'none, huber, cauchy'),
            ('frequency', -1.0, 'expected a number in [0.01, 100], got -1.0'),
            ('frequency', 'often', 'expected a number'), ('fix.lever_arm', [1.0], '2 numbers'),
            ('fix.covariance_scal', 1.0, 'did you mean fix.covariance_scale?')):
        successful, reason = managed.set(name, value)
        assert not successful, name
        assert expected in reason, (name, reason)
    result = node.set_parameters_atomically([
        Parameter('path_period', value=0.2), Parameter('map_frame', value='world')])
    assert not result.successful
    assert node.get_parameter('path_period').value == 1.0
    diagnostics = managed.local.subscribe(DiagnosticArray, '/diagnostics')
    assert managed.set('diagnostics_period', 0.02) == (True, '')
    managed.wait(lambda: len(diagnostics) > 5, 'they hurry')


def test_what_was_dumped_can_be_loaded_and_given_as_a_file(
    managed: Managed, tmp_path: Path, capfd: pytest.CaptureFixture[str],
) -> None:
    node = managed.local.node
    managed.start()
    assert managed.set('minimum_travel_distance', 4) == (True, '')
    names = node.list_parameters([], 0).names

    def values() -> dict[str, object]:
        return {name: list(value) if isinstance(value, array) else value
                for name in names for value in [node.get_parameter(name).value]}

    def load(texts: Mapping[str, str]) -> set[str]:
        """Set parameters as `ros2 param load` does; return those that were refused."""
        results = node.set_parameters([Parameter.from_parameter_msg(
            ParameterMessage(name=name, value=get_parameter_value(text)))
            for name, text in texts.items()])
        return {name for name, result in zip(texts, results, strict=True) if not result.successful}

    dumped = values()
    assert dumped['datum'] is dumped['fix.covariance_override'] is None
    assert dumped['qos_overrides./odom.subscription.depth'] == 1000
    texts = {name: str(value) for name, value in dumped.items()}
    assert load(texts) == set()
    assert values() == dumped
    for _ in range(2):  # what is unset there is unset again, and can be set again
        assert managed.set('fix.covariance_override', [2.0]) == (True, '')
        assert load(texts) == set()
        assert values()['fix.covariance_override'] == []
    assert load({**texts, 'autostart': 'False', 'sources': '[odom]'}) == {'autostart', 'sources'}

    file = tmp_path / 'dumped.yaml'
    file.write_text(json.dumps({'/pose_graph': {'ros__parameters': {
        name: dumped[name] for name in checked({})}}}))
    capfd.readouterr()
    other = PoseGraphNode(context=managed.local.context,
                          cli_args=['--ros-args', '--params-file', str(file)])
    other.start()
    assert other.get_parameter('minimum_travel_distance').value == 4.0
    assert other._configured.input.reader.datum.plane is None
    other.close()
    other.destroy_node()
    assert 'is not known' not in capfd.readouterr().err


@pytest.mark.parametrize('managed', [
    {'sources': ['odom', 'global_pose', 'fix', 'rear'], 'rear.type': 'fix',
     'rear.topic': '/gnss'}], indirect=True)
def test_mistakes_around_the_node_are_logged_when_they_begin_and_end(
    managed: Managed, capfd: pytest.CaptureFixture[str],
) -> None:
    client, logged = managed.local.client, []
    poses = client.create_publisher(PoseWithCovarianceStamped, 'pose', RELIABLE)
    other = None if TFMessage is None else client.create_publisher(TFMessage, '/tf', RELIABLE)
    managed.start()
    managed.session.activated_at = -math.inf    # all drivers have had the time to start
    said = [
        '/pose is published by /client as well: give one of them another topic',
        'rear listens to /gnss for sensor_msgs/msg/NavSatFix, but nobody publishes it; there is '
        '/gps/fix',
        "odom has the child_frame_id 'base_footprint', but the parameter base_link_frame is",
        'fix has no frame_id: its antenna is taken to be in base_link: set fix.lever_arm',
        *(['another node publishes map -> odom on /tf'] if other else [])]
    lone = fix_at(0.1)
    lone.header.frame_id = ''
    managed.send('fix', lone)
    step = 0

    def all_is_said() -> bool:
        nonlocal step
        step += 1
        message = odometry_at(step / 20.0)
        message.child_frame_id = 'base_footprint'
        managed.publishers['odom'].publish(message)
        if other is not None:   # others are no conflict
            other.publish(TFMessage(transforms=[
                transform('odom', 'base_link', seconds=float(step)),
                transform('map', 'odom', seconds=float(step))]))
        logged.extend(capfd.readouterr().err.splitlines())
        return all(any(words in line for line in logged) for words in said)

    managed.wait(all_is_said, 'all is said')
    assert next(concerns(managed.session)).level == DiagnosticStatus.WARN
    client.destroy_publisher(poses)

    def is_over() -> bool:
        logged.extend(capfd.readouterr().err.splitlines())
        return f'over: {said[0]}' in logged[-1]
    managed.wait(is_over, 'its end is said')
    for words in said:
        (line,) = [line for line in logged if words in line and 'over: ' not in line]
        assert '[WARN]' in line


@pytest.mark.parametrize('managed', [{
    'sources': ['odom', 'fix', 'tags'], 'tags.type': 'range', 'tags.beacons': ['door 3 4']}],
    indirect=True)
def test_a_range_to_a_beacon_of_the_map_waits_until_the_graph_lies_there(managed: Managed) -> None:
    managed.start()
    managed.publishers['tags'] = managed.local.advertise(Range, 'tags')
    managed.drive(4.0, fixes=False)
    message = Range(header=odometry_at(2.05).header, range=5.0, variance=0.01)
    message.header.frame_id = 'door'
    managed.send('tags', message)
    managed.drive(6.0, 4.0, fixes=False)
    status = managed.session.worker.status
    assert (status.counts['tags', 'accepted'], status.pending) == (1, 1)
    assert diagnostics.values(managed.session)['tags.lever_arm'] == '[0.000, 0.000] from none'


def test_the_datum_can_be_set_until_the_graph_refers_to_it(managed: Managed) -> None:
    managed.start()
    assert managed.call('set_datum').success
    managed.drive(2.0, fixes=False)
    datum = managed.session.input.reader.datum
    # placed, but not in the graph: nothing refers to it
    datum.place(48.0, 11.0, 0.0)
    assert managed.call('set_datum').success
    assert datum.plane is None
    managed.drive(4.0, 2.0)
    answer = managed.call('set_datum')
    assert not answer.success
    assert '4 fixes in the graph refer to the datum [48.' in answer.message
    datum.keep(PLANE.origin)
    assert 'graph that was loaded' in managed.call('set_datum').message


@pytest.mark.parametrize('managed', [{'state_file': 'PATH/state.db'}], indirect=True)
def test_the_map_of_a_journal_comes_back_after_a_reset_while_it_is_read(
    managed: Managed, monkeypatch: pytest.MonkeyPatch,
) -> None:
    managed.start()
    managed.drive(3.0)
    managed.wait(lambda: managed.session.worker.estimate is not None, 'there is a map')
    managed.call('optimize')
    n_nodes, node = managed.session.worker.estimate.n_hidden, managed.local.node
    for trigger in (node.trigger_deactivate, node.trigger_cleanup):
        assert trigger() is SUCCESS
    reset, warm_up = threading.Event(), Session._warm_up

    def slowly(session: Session, stopped: Callable[[], bool]) -> None:
        reset.wait(PATIENCE)
        warm_up(session, stopped)
    monkeypatch.setattr(Session, '_warm_up', slowly)
    managed.start()
    managed.session.reset()
    reset.set()
    answer = managed.call('undo_reset')
    assert answer.success, answer.message
    managed.wait(lambda: managed.session.worker.estimate is not None, 'the map is back')
    assert managed.session.worker.estimate.n_hidden == n_nodes


def test_a_node_starts_with_a_graph(
    managed: Managed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    node = managed.local.node
    managed.set('graph_file', str(tmp_path / 'map.g2o'))
    assert managed.set('load_graph_on_start', True) == (True, '')
    managed.start()
    assert 'map.g2o yet: starting with an empty one' in capfd.readouterr().err
    managed.drive(8.0)
    before = managed.session.worker.estimate
    assert managed.call('save_graph').success
    assert {path.suffix for path in tmp_path.glob('map.*')} == {'.g2o', '.json', '.tum'}
    assert not managed.set('load_graph_on_start', False)[0], 'while it is configured'

    assert node.trigger_deactivate() is node.trigger_cleanup() is SUCCESS
    (tmp_path / 'no.g2o').touch()   # without the .json beside it
    # as Path.home does not know everyone
    for wrong in ('', str(tmp_path), str(tmp_path / 'no.g2o'), '~nobody_of_this_name/map.g2o'):
        managed.set('graph_file', wrong)
        with pytest.raises(ConfigError, match=r'parameter (graph_file|load_graph_on_start): '):
            node.start()
        assert node._session is None
    managed.set('graph_file', str(tmp_path / 'map'))
    managed.set('datum', [50.0, 8.0])
    with pytest.raises(ConfigError, match='another site'):
        node.start()
    managed.set('datum', [])

    with held(monkeypatch, 'read_graph', graph_files) as reading:
        # it is read in the thread of the graph, while messages come
        managed.start()
        assert managed.session.input.reader.datum.is_of_graph
        managed.wait(reading.is_set, 'the file is read')
        managed.send('odom', *(odometry_at(8.0 + 0.1 * step) for step in range(20)))
        assert managed.session.worker.estimate is None
    managed.wait(lambda: managed.session.worker.status.processed == 20, 'all are processed')
    managed.drive(12.0, 10.0)
    after = managed.session.worker.estimate
    assert after.n_hidden > before.n_hidden
    assert 'odom.jump' not in diagnostics.values(managed.session)
    assert managed.session.n_resets == 0

    # a new graph is an empty one
    managed.session.reset()
    managed.drive(14.0, 12.0)
    assert managed.session.worker.estimate.n_hidden < before.n_hidden


@contextmanager
def held(
    monkeypatch: pytest.MonkeyPatch, name: str, module: ModuleType = services,
) -> Iterator[threading.Event]:
    """Let a function of a module wait; yield an event that is set while it does."""
    function = getattr(module, name)
    running, release = threading.Event(), threading.Event()

    def wait(*given: object) -> object:
        running.set()
        assert release.wait(PATIENCE)
        return function(*given)
    with monkeypatch.context() as patch:
        patch.setattr(module, name, wait)
        yield running
        release.set()


def test_a_cleanup_waits_for_no_file_and_each_request_is_answered(
    managed: Managed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    managed.start()
    managed.set('graph_file', str(tmp_path / 'map.g2o'))
    node = managed.local.node

    def clean_up() -> None:
        assert node.trigger_deactivate() is SUCCESS
        assert node.trigger_cleanup() is SUCCESS

    managed.drive(4.0)
    with held(monkeypatch, 'write_graph') as writing:
        answer = managed.request('save_graph')
        managed.wait(writing.is_set, 'the file is written')
        clean_up()
        assert not (tmp_path / 'map.g2o').exists()
    managed.wait(answer.done, 'it answers')
    assert answer.result().success
    assert (tmp_path / 'map.g2o').exists()
    managed.wait(lambda: managed.local.client.count_services('/pose_graph/save_graph') == 0,
                 'the service ends')

    node.start()
    session = managed.session
    with held(monkeypatch, 'read_graph', graph_files) as reading:
        answer = managed.request('load_graph')
        managed.wait(reading.is_set, 'the file is read')
        clean_up()
    managed.wait(answer.done, 'it answers')
    assert (answer.result().success, answer.result().message) == (False, CLOSED)
    assert not session.worker.thread.is_alive()


def test_a_graph_of_another_version_is_refused_and_the_present_one_stays(
    managed: Managed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    managed.start()
    managed.set('graph_file', str(tmp_path / 'map.g2o'))
    managed.drive(4.0)
    with monkeypatch.context() as patch:
        patch.setattr(graph_files, 'VERSION', 7)
        assert managed.call('save_graph').success
    before = managed.session.worker.estimate
    answer = managed.call('load_graph')
    assert not answer.success
    assert 'expected a pose_graph_ros graph of version 8' in answer.message
    assert managed.session.n_resets == 0
    assert managed.session.worker.estimate.n_hidden == before.n_hidden > 0


def test_a_graph_is_not_replaced_by_one_that_was_asked_for_before(
    managed: Managed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    managed.start()
    managed.set('graph_file', str(tmp_path / 'map.g2o'))
    managed.drive(4.0)
    assert managed.call('save_graph').success
    with held(monkeypatch, 'read_graph', graph_files) as reading:
        answer = managed.request('load_graph')
        managed.wait(reading.is_set, 'the file is read')
        managed.session.reset()
    managed.wait(answer.done, 'it answers')
    assert (answer.result().success, answer.result().message) == (False, REPLACED)
    assert managed.session.worker.estimate is None


def test_files_are_written_and_read_in_the_folder_alone_and_those_of_others_stay(
    managed: Managed, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory,
) -> None:
    outside = tmp_path_factory.mktemp('outside')
    managed.start()
    assert not managed.set('file_folder', str(outside))[0]
    managed.drive(4.0)
    (tmp_path / 'mine.g2o').write_text('mine')
    (tmp_path / 'away').symlink_to(outside)
    for name, words in (
            (str(outside / 'map'), 'expected the name of a file below'),
            ('../map', 'expected the name of a file below'), ('away/map', 'below'),
            ('mine', 'there already, and not of a saved graph'), (300 * 'x', 'at most 255 bytes')):
        managed.set('graph_file', name)
        for service in ('save_graph', 'load_graph'):
            answer = managed.call(service)
            assert not answer.success
            assert len(answer.message) < 500
            assert words in answer.message or (service, name) == ('load_graph', 'mine')
    assert list(outside.iterdir()) == []
    assert (tmp_path / 'mine.g2o').read_text() == 'mine'
    managed.set('graph_file', 'yard/map')
    assert managed.call('save_graph').success
    assert managed.call('load_graph').success
    assert (tmp_path / 'yard' / 'map.tum').exists()


def test_more_changes_and_resets_than_a_person_makes_cost_little(managed: Managed) -> None:
    managed.start()
    answers = [managed.set('path_period', 1.0 + 0.001 * k) for k in range(150)]
    assert (True, '') in answers
    assert 'more than 100 changes of parameters at once' in answers[-1][1]
    managed.wait(lambda: managed.set('path_period', 2.0)[0], 'it can be changed again')
    managed.drive(2.0)
    before, worker = managed.session.n_resets, managed.session.worker
    for _ in range(50):
        managed.session.reset()
    assert managed.session.n_resets == before + 50
    assert managed.session.worker is not worker
    worker = managed.session.worker
    managed.session.reset()
    assert managed.session.worker is worker, 'it has nothing yet'
