# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a peer sends is kept up to a bound, told once and shortly, and counted."""

from collections.abc import Iterator
import logging
import threading
from types import SimpleNamespace as Space

from diagnostic_msgs.msg import KeyValue
import harness
import numpy as np
import pytest
from tf2_msgs.msg import TFMessage

from pose_graph_ros.adapters import conversions
from pose_graph_ros.adapters.conversions import StaticFrames
from pose_graph_ros.adapters.parameters import changed, checked, unknown
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, RANGES
from pose_graph_ros.core.exceptions import ConfigError, PoseGraphError
from pose_graph_ros.core.judgement.verdicts import Decision
from pose_graph_ros.core.measurements import OdometrySample, Position, Range
from pose_graph_ros.core.sources.queued import MOST_BEACONS
from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.ros import log
from pose_graph_ros.ros.input import Input
from pose_graph_ros.ros.worker import MOST_JOBS, SetPoseInput, Worker

MEGABYTE = 1_000_000 * 'x'
SECOND = 1_000_000_000


def assert_short(text: str) -> None:
    assert len(text) < 400
    assert '\n' not in text
    assert '1000000 characters' in text


# --- texts

@pytest.mark.parametrize('field', ['frame_id', 'child_frame_id'])
def test_a_message_with_an_endless_name_is_refused_and_not_kept(field: str) -> None:
    received, message = Input(checked({}), lambda _: ()), harness.odometry(5.0, 0.0, 0.0, 0.0)
    setattr(message.header if field == 'frame_id' else message, field, MEGABYTE)
    assert received.receive('odom', message).released == []
    assert received.rejected == {('odom', 'long_name'): 1}
    assert_short(received._details['odom', 'long_name'])
    assert received.arrivals['odom'].frames is None


def test_an_endless_text_is_told_shortly_wherever_it_is_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    pose = harness.pose(5.0, 0.0, 0.0, 0.0, MEGABYTE)
    assert_short(SetPoseInput(('map', 'odom', 'base_link')).receive(pose).detail)
    assert_short(PoseGraphBackend().decide(MEGABYTE, Decision.OUT).detail)
    assert_short(PoseGraphBackend().decide(f'fix/{1_000_000 * "9"}', Decision.OUT).detail.replace(
        '1000004', '1000000'))
    values = checked({})
    for name, value in (('graph_file', MEGABYTE), ('window.prior', MEGABYTE), ('frequency',
                                                                            MEGABYTE)):
        with pytest.raises(ConfigError) as raised:
            changed(values, {name: value}, configured=True)
        assert_short(str(raised.value))
    assert_short(str(unknown(MEGABYTE, values)))
    worker = Worker(PoseGraphBackend(), lambda _: None)
    worker.decide(KeyValue(key=MEGABYTE, value=MEGABYTE))
    worker.thread.start()
    worker.call(lambda _: None).result(harness.PATIENCE)
    assert worker.stop(harness.PATIENCE)
    assert_short(caplog.messages[-1])


def test_an_id_of_thousands_of_digits_is_unknown() -> None:
    backend = PoseGraphBackend()
    for k in range(50):
        backend.add_odometry(OdometrySample((k + 10) * SECOND, np.array([1.0 * k, 0.0, 0.0])))
        backend.add_measurement(Position((k + 10) * SECOND, np.array([1.0 * k, 0.0]), np.eye(2),
                                         np.zeros(2)), 'fix')
    backend.optimize()
    assert backend.decide(f'fix/{5000 * "9"}', Decision.OUT).reason == 'unknown_id'
    assert backend.decide('fix/3', Decision.OUT).reason == ''


# --- the log

@pytest.fixture
def lines() -> Iterator[list[str]]:
    found: list[str] = []
    levels = ('debug', 'info', 'warning', 'error', 'fatal')
    handler = log.NodeLog(Space(**dict.fromkeys(levels, found.append)))
    yield found
    handler.close()


def test_no_text_of_others_makes_more_than_some_lines(lines: list[str]) -> None:
    logger = logging.getLogger('pose_graph_ros.ros.somewhere')
    for k in range(1000):
        logger.warning('the frame is %r', f'peer_{k}_{chr(97 + k % 26)}')
    assert lines == ["the frame is 'peer_0_a'"]
    for k in range(1000):
        logger.warning('the frame is %s', 'x' * k)  # not quoted: each is another message
    for k in range(1000):
        logger.warning('the pose is not set: %s', k, extra=log.ANSWER)
    assert len(lines) == 1 + 2 * log.MOST_LINES
    assert len(handler_of(lines)._logged) <= 1000


def handler_of(_: list[str]) -> log.NodeLog:
    return next(each for each in logging.getLogger().handlers if isinstance(each, log.NodeLog))


# --- what is kept

def test_of_static_frames_those_that_came_last_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conversions, 'MOST_FRAMES', 10)
    frames = StaticFrames()
    for k in range(30):
        frames.receive(TFMessage(transforms=[harness.transform('base_link', f'child_{k}')]))
        frames.receive(TFMessage(transforms=[harness.transform('base_link', 'gps')]))
    frames.receive(TFMessage(transforms=[harness.transform('base_link', MEGABYTE)]))
    assert len(frames._frames) == 10
    assert frames.transform('gps', 'base_link') is not None
    assert frames.counts == {('tf_static', 'dropped'): 21, ('tf_static', 'ignored'): 1}


def test_ranges_of_few_unknown_beacons_wait() -> None:
    backend = PoseGraphBackend(BackendConfig(measurements={'tags': RANGES}))
    for k in range(3):
        backend.add_odometry(OdometrySample((k + 10) * SECOND, np.array([1.0 * k, 0.0, 0.0])))
    for k in range(300):
        backend.add_measurement(Range(11 * SECOND, f'beacon_{k}', 5.0, 0.01, np.zeros(2)), 'tags')
    waiting = backend._pipeline.beacons
    assert [each.beacon for _, each in waiting.measurements] == [
        f'beacon_{k}' for k in range(300 - MOST_BEACONS, 300)]
    assert backend.counts['tags', 'dropped_unlocated'] == 300 - MOST_BEACONS
    assert len(waiting._next_try) <= MOST_BEACONS


def test_in_a_second_of_stamps_a_source_has_a_number_of_measurements() -> None:
    backend = PoseGraphBackend()
    for k in range(100):
        backend.add_odometry(OdometrySample(10 * SECOND + k * SECOND // 10,
                                            np.array([0.1 * k, 0.0, 0.0])))
    for k in range(1000):
        backend.add_measurement(Position(11 * SECOND + 1000 * k, np.zeros(2), np.eye(2),
                                         np.zeros(2)), 'fix')
    assert backend.counts['fix', 'accepted'] == SOURCES.most_in_second
    assert backend.counts['fix', 'too_dense'] == 1000 - SOURCES.most_in_second


def test_jobs_of_a_kind_wait_up_to_a_number_and_those_with_a_key_are_one() -> None:
    worker, done, hold = Worker(PoseGraphBackend(), lambda _: None), [], threading.Event()
    worker.call(lambda _: hold.wait(harness.PATIENCE))
    worker.thread.start()
    futures = [worker.call(lambda _, k=k: done.append(k), 'a decision', f'fix/{k}')
               for k in range(MOST_JOBS + 7)]
    same = [worker.call(lambda _, k=k: k, 'the full optimisation', 'the one') for k in range(50)]
    hold.set()
    assert {future.result(harness.PATIENCE) for future in same} == {49}
    for future in futures[:7]:
        with pytest.raises(PoseGraphError, match='more than 100 of a decision wait'):
            future.result(harness.PATIENCE)
    assert done == list(range(7, MOST_JOBS + 7))
    worker.request_update()
    worker.call(worker.optimize_fully).result(harness.PATIENCE)
    assert worker.status.counts['worker', 'dropped_job'] == 7
    assert worker.stop(harness.PATIENCE)
