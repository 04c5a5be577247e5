# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A session in a node of the test's own process: states, new graphs, counts and diagnostics."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import threading
from types import SimpleNamespace as Space

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from circle import odometry_at, START, true_pose
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from harness import (
    imu,
    LATCHED,
    odometry,
    PATIENCE,
    PREPARE_PATIENCE,
    stamp_ns,
    TFMessage,
    transform,
)
from local_node import Driver, LocalNode
from nav_msgs.msg import Odometry, Path as PathMessage
import numpy as np
from sensor_msgs.msg import Imu
from visualization_msgs.msg import MarkerArray

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import backend_config
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.judgement.verdicts import SourceVerdicts, State
from pose_graph_ros.ros import diagnostics, input as input_module
from pose_graph_ros.ros.diagnostics import concerns
from pose_graph_ros.ros.session import Session

pytestmark = pytest.mark.timeout(PREPARE_PATIENCE)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PERIODS = {'diagnostics_period': 0.02, 'frequency': 50.0, 'path_period': 0.0}


def health(session: object) -> tuple[bytes, str]:
    """Return the level of the diagnostics and their message."""
    first = next(concerns(session))
    return first.level, f'{first.text[0].upper()}{first.text[1:]}.'


class Robot(Driver):
    """A session of a node, and its client."""

    def __init__(self, local: LocalNode, **values: object) -> None:
        super().__init__(local)
        self.given = PERIODS | {name.replace('__', '.'): value for name, value in values.items()}
        self._session = Session(local.node, checked(self.given))

    @property
    def session(self) -> Session:
        return self._session

    def activate(self) -> None:
        self.session.activate()
        self.connect()

    def configure(self, **values: object) -> None:
        self.given |= {name.replace('__', '.'): value for name, value in values.items()}
        self.session.configure(checked(self.given))

    def values(self) -> dict[str, str]:
        return {key: str(value) for key, value in diagnostics.values(self.session).items()}

    def health(self) -> tuple[bytes, str]:
        return health(self.session)


@pytest.fixture
def robot(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Robot]:
    with LocalNode(tmp_path) as local:
        made = Robot(local, **getattr(request, 'param', {}))
        yield made
        made.session.close()


@pytest.fixture
def active(robot: Robot) -> Robot:
    robot.activate()
    return robot


def test_the_path_follows_an_optimisation_and_diagnostics_are_as_documented(active: Robot) -> None:
    paths = active.local.subscribe(PathMessage, 'path', LATCHED)
    active.drive(10.0)
    active.wait(lambda: len(paths) > 0, 'a path comes')
    # from now on only after an optimisation
    active.configure(path_period=1000.0, odom__sigma_scale=2.0)
    active.session.worker.call(lambda _: None).result(PATIENCE)
    newest_ns = active.session.out.path.stamp_ns
    report = active.session.optimize()
    active.wait(report.done, 'it is optimised')
    assert report.result().status is Status.CONVERGED
    active.wait(lambda: stamp_ns(paths[-1]) > newest_ns, 'the optimised path comes')
    n_hidden = active.session.worker.estimate.n_hidden
    assert len(paths[-1].poses) == n_hidden + 1
    active.session.searches.due = 0.0
    active.wait(lambda: len(active.session.searches.energies) == 3, 'energies are known')
    values = active.values()
    assert (values['received'], values['processed']) == ('120', '120')
    assert (values['odom.accepted'], values['fix.accepted']) == ('100', '20')
    assert (values['active'], values['paused'], values['resets']) == ('1', '0', '0')
    assert (values['odometry'], values['alignment']) == ('odom', 'aligned')
    assert (values['hidden_nodes'], values['observed_nodes']) == (str(n_hidden), '20')
    assert float(values['alignment_yaw_deg']) == pytest.approx(122.0, abs=1.0)
    assert values['datum'].startswith('[48.1')
    assert values['fix.lever_arm'] == '[0.000, 0.000] from none'
    assert (values['odom.errors_turn'], values['odom.errors_rate']) == ('4.000000', '0.000000')
    assert values['global_pose.silence_s'] == 'never received'
    assert float(values['odom.rate_hz']) > 0.0
    assert 0.0 <= float(values['fix.squared_residual']) < 0.1
    assert {f'largest_energy.{rank}' for rank in (1, 2, 3)} < values.keys()
    documented = (Path(__file__).parents[2] / 'docs' / 'topics.md').read_text()
    for key in values.keys() - {f'largest_energy.{rank}' for rank in (2, 3)}:
        source, _, last = key.partition('.')
        names = (key, 'received.<source>' if source == 'received' else f'<source>.{last}',
                 f'.{last}')
        assert any(f'`{name}`' in documented for name in names), f'{key} is not documented'
    assert float(values['memory_mb']) > 10.0
    assert active.health() == (OK, 'Running.')


@pytest.mark.parametrize(('first', 'second'), [
    (odometry(START + 5.0, 500.0, 0.0, 0.0, speed=2.0),
     odometry(START + 5.1, 500.2, 0.0, 0.0, speed=2.0)),
    (odometry_at(16.0), odometry_at(16.1))], ids=['jump', 'gap'])
@pytest.mark.parametrize('robot', [{'frequency': 0.01}], indirect=True, ids=['no timer'])
def test_no_pose_is_published_over_a_jump_or_a_gap_before_an_update(
    active: Robot, first: Odometry, second: Odometry,
) -> None:
    active.drive(5.0)
    poses = active.local.subscribe(PoseWithCovarianceStamped, 'pose')
    active.send('odom', first)
    # which does not wait for the timer
    active.wait(lambda: active.session.worker.estimate.stamp_ns == stamp_ns(first), 'an update')
    active.send('odom', second)
    active.wait(lambda: len(poses) > 0, 'a pose comes')
    assert stamp_ns(poses[0]) == stamp_ns(second)
    assert active.session.n_resets == 0


@pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not built: no /tf_static')
def test_static_frames_say_where_an_antenna_is(active: Robot) -> None:
    frames = active.local.client.create_publisher(TFMessage, '/tf_static', LATCHED)
    frames.publish(TFMessage(transforms=[transform('base_link', 'gps', (0.75, -0.25, 1.0))]))
    known = active.session.input.reader.frames
    active.wait(lambda: known.transform('gps', 'base_link') is not None, 'it comes')
    active.drive(1.0)
    assert active.values()['fix.lever_arm'] == '[0.750, -0.250] from tf_static'


@pytest.mark.parametrize('robot', [{'closing_silence': 0.05}], indirect=True)
def test_the_graph_is_optimised_once_when_the_stream_ends(active: Robot) -> None:
    finals = []
    active.drive(3.0)
    active.wait(lambda: not active.session.input.is_streaming, 'a silence is noticed')
    worker = active.session.worker
    optimize = active.session.optimize
    active.session.optimize = lambda: finals.append(optimize())
    assert worker.call(lambda backend: backend.n_waiting).result(PATIENCE) == 0
    for _ in range(2):
        active.session._on_silence_timer()
    assert finals == []
    active.send('odom', odometry_at(3.0))
    active.wait(lambda: len(finals) > 0, 'it is optimised again')
    assert finals[0].result(PATIENCE).status is Status.CONVERGED


def test_the_most_urgent_state_is_said_with_what_to_do(active: Robot) -> None:
    active.drive(3.0, fixes=False)
    level, text = active.health()
    assert (level, text.startswith('Running without measurements in the map')) == (OK, True)
    session = active.session
    final = session.optimize()
    active.wait(final.done, 'it is optimised')
    worker = Space(thread=session.worker.thread, prepared=True, is_optimal=False,
                   status=session.worker.status, estimate=session.worker.estimate,
                   watchdog=Space(interrupted=''))
    received = Space(paused=False, posted=7, silent=[], quiet=0.0, refused={},
                     arrivals={'fix': Space(wrong='')}, reader=Space(sources={}))
    seen = Space(worker=worker, active=True, journal=None, input=received,
                 is_loaded=False, compiling=False, values=session.values,
                 node=Space(count_publishers=lambda _: 0),
                 searches=Space(contradiction=None),
                 out=Space(transforms=Space(other='')))

    def status(**changes: object) -> dict[str, object]:
        return {'status': replace(worker.status, **changes)}
    correlated = Space(wrongly_white=True, errors=Space(tau=12.0))
    # each is more urgent than the one before
    for owner, changes, expected, words in (
            (worker, lambda: status(sources={'fix': correlated}), WARN,
             'set fix.correlation_time to about 12 s'),
            (worker, lambda: status(verdicts={
                'fix': SourceVerdicts({State.DOUBTED: 3}, doubting=True)}), WARN,
             'The newest measurements of fix are doubted and not used'),
            (worker, lambda: {'estimate': replace(
                worker.estimate, alignment=AlignmentState.UNALIGNED)}, WARN, 'Unaligned'),
            (received.arrivals['fix'], {'wrong': 'the stamps of fix are 18.0 s ahead'}, WARN,
             'The stamps of fix are 18.0 s ahead.'),
            (received, {'silent': ['fix']}, WARN, 'Nothing comes from fix, while'),
            (received, {'silent': ['fix', 'imu']}, WARN, 'from fix and imu, while'),
            (seen.out.transforms, {'other': 'another node publishes map -> odom'}, WARN,
             'Another node publishes map -> odom.'),
            (received, {'refused': {'fix': 'the newest 7 messages of fix were refused'}}, WARN,
             'The newest 7 messages of fix were refused.'),
            (received, {'quiet': 12.3}, WARN, 'or a bag has ended.'),
            (worker, {'is_optimal': True}, WARN,
             'or a bag has ended; the graph has been optimised.'),
            (worker, {'prepared': False}, WARN, 'Loading compiled kernels'),
            (seen, {'compiling': True}, WARN, 'measurements wait'),
            (seen, {'active': False}, OK, 'Inactive'),
            (worker.watchdog, {'interrupted': 'an update'}, WARN, 'An update took longer'),
            (worker, lambda: status(report=UpdateReport(Status.FAILED, 'singular', 0, 0, 0.0)),
             ERROR, 'solver failed'),
            (worker, {'thread': Space(is_alive=lambda: False)}, ERROR, 'restart')):
        vars(owner).update(changes() if callable(changes) else changes)
        level, text = health(seen)
        assert level == expected
        assert words in text


def test_a_graph_that_was_loaded_waits_for_odometry(active: Robot) -> None:
    paths = active.local.subscribe(PathMessage, 'path', LATCHED)
    graphs = active.local.subscribe(MarkerArray, 'graph', LATCHED)
    active.drive(4.0)
    session = active.session
    saved = session.worker.call(lambda backend: backend.saved()).result(PATIENCE)
    active.wait(lambda: len(paths) > 0 and len(graphs) > 0, 'path and markers come')
    session.reset()
    active.wait(lambda: len(paths[-1].poses) == 0, 'the path is taken back')
    session.reset()
    session.load(saved, PoseGraphBackend.restored(backend_config(session.values), saved), 'map')
    n_hidden = len(saved.nodes.ids)
    active.wait(lambda: len(paths[-1].poses) >= n_hidden, 'its path comes')
    assert all(stamp_ns(message) > 0 for message in (*paths, *(
        marker for array in graphs for marker in array.markers)))
    waits = f'A graph of {n_hidden} hidden nodes is loaded and waits for odometry: '
    assert active.health() == (WARN, f'{waits}check /odom.')
    active.send('odom', *(odometry(0.0, 0.1 * step, 0.0, 0.0) for step in range(3)))
    active.wait(lambda: active.health()[1].startswith(f'{waits}3 of 3 messages'), 'it is said')
    # the reset has taken the datum back, so that fixes would be elsewhere
    active.drive(6.0, 4.0, fixes=False)
    active.session.publish_diagnostics()
    assert active.health() == (OK, 'Running.')


def test_a_graph_that_was_replaced_comes_back_with_all_that_was_posted_to_it(
    active: Robot, caplog: pytest.LogCaptureFixture,
) -> None:
    active.drive(4.0)
    session, plane = active.session, active.session.input.reader.datum.plane
    saved = session.worker.call(lambda backend: backend.saved()).result(PATIENCE)
    release = threading.Event()
    session.worker.call(lambda _: release.wait(PATIENCE))
    active.send('odom', *(odometry_at(4.0 + 0.1 * step) for step in range(20)))
    first = session.worker
    session.load(saved, PoseGraphBackend.restored(backend_config(session.values), saved), 'map')
    release.set()

    def undo() -> None:
        assert session.replaced.worker.stop(PATIENCE)
        session.undo_reset(session.replaced)
    loaded = session.worker
    undo()
    assert session.worker.status.counts['fix', 'accepted'] == 8     # before it has done anything
    active.wait(lambda: session.worker.status.counts['odom', 'accepted'] == 60, 'all are in it')
    assert session.worker._backend is first._backend
    assert session.input.reader.datum.plane is plane
    # the robot has driven on meanwhile
    active.drive(24.0, begin=20.0)
    assert 'odom.jump' not in active.values()
    final = session.optimize()
    active.wait(final.done, 'it is optimised')
    newest = session.worker.estimate
    np.testing.assert_allclose(newest.T_map_base[:2], true_pose(23.9)[:2], atol=1e-3)
    # the other graph is the one that can be brought back now, and no empty one takes its place
    assert session.replaced.worker is loaded
    undo()
    newest = session.worker
    active.wait(lambda: newest.estimate is not None, 'it is back')
    session.reset()
    session.reset()
    assert session.replaced.worker is newest
    left = f'{len(saved.nodes.ids)} hidden nodes, by ~/undo_reset'
    assert active.values()['undo'] == left
    assert f'a call of ~/reset; what can be brought back: {left}' in caplog.text


@pytest.mark.parametrize('robot', [{
    'sources': ['odom', 'fix', 'visual'], 'visual__type': 'odometry'}], indirect=True)
def test_a_graph_that_was_loaded_is_not_taken_back_by_the_odometry_that_is_preferred(
    active: Robot,
) -> None:
    active.publishers['visual'] = active.local.advertise(Odometry, 'visual')
    active.drive(4.0)
    session = active.session
    saved = session.worker.call(lambda backend: backend.saved()).result(PATIENCE)
    session.load(saved, PoseGraphBackend.restored(backend_config(session.values), saved), 'map')
    active.send('visual', odometry_at(3600.0))
    active.send('odom', *(odometry_at(4.0 + 0.1 * step) for step in range(20)))
    assert session.n_resets == 1
    assert active.values()['odom.stamp_leap'] == '20'


@pytest.mark.parametrize('robot', [{
    'sources': ['odom', 'fix', 'gyro'], 'gyro__mounting': 'up'}], indirect=True)
def test_gyroscopes_that_are_of_no_use_or_wrong_are_warned_of(
    active: Robot, monkeypatch: pytest.MonkeyPatch,
) -> None:
    active.publishers['gyro'] = active.local.advertise(Imu, 'imu/data')
    # on a busy machine the gyroscope, which is sent first, is told to be silent instead
    monkeypatch.setattr(input_module, 'silent', lambda sources, now: [])

    def rates(begin: float, end: float, late: float = 0.0) -> list[Imu]:
        """Of a gyroscope that is upside down, in the circle of the drive."""
        messages = [imu(START + late + at, 0.0) for at in np.arange(begin, end, 0.1)]
        for message in messages:
            message.angular_velocity.z = -0.1
        return messages

    active.send('gyro', *rates(0.0, 5.0, 50.0))
    active.drive(15.0, fixes=False)
    assert active.values()['gyro.accepted'] == '50'
    level, text = active.health()
    assert level == WARN
    assert 'No message of gyro could be used' in text
    active.send('gyro', *rates(65.0, 85.0))
    active.drive(85.0, begin=65.0, fixes=False)
    assert int(active.values()['gyro.rotations']) > 20
    level, text = active.health()
    assert level == WARN
    assert 'The bias of gyro is -0.19 rad/s' in text
    assert 'mounting' in text
