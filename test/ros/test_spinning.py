# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Both executors under the node: the one of events, and the one that every rclpy has."""

from collections.abc import Callable, Iterator
from pathlib import Path
import threading
import time
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not there: no rclpy')

from harness import PATIENCE, RELIABLE
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from pose_graph_ros.cli.demo import isolated_environment
from pose_graph_ros.ros import spinning
from pose_graph_ros.ros.spinning import guarded, Spinner


class Spun:
    """A node whose callbacks run in a thread."""

    def __init__(self, node: Node) -> None:
        self.node, self.spinner = node, Spinner(node)
        self._thread = threading.Thread(target=self.spinner.spin)
        self._thread.start()

    def wait(self, done: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < end, f'waited {PATIENCE} s until {what}'
            time.sleep(0.01)

    def stop(self) -> None:
        self.spinner.stop()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


@pytest.fixture(params=['events', 'single'])
def spun(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Spun]:
    if request.param == 'single':
        monkeypatch.setattr(spinning, 'EventsExecutor', None)
    elif spinning.EventsExecutor is None:
        pytest.skip('this rclpy has no EventsExecutor')
    context = Context()
    with isolated_environment(tmp_path) as env:
        rclpy.init(context=context, domain_id=int(env['ROS_DOMAIN_ID']),
                   signal_handler_options=SignalHandlerOptions.NO)
        each = Spun(Node('pose_graph', context=context))
        yield each
        each.stop()
        each.spinner.close()
        each.node.destroy_node()
        rclpy.shutdown(context=context)


def test_it_stops_at_once_though_no_callback_is_due(spun: Spun) -> None:
    spun.stop()
    spun.stop()


def test_no_exception_of_a_callback_ends_it(spun: Spun, caplog: pytest.LogCaptureFixture) -> None:
    heard: list[str] = []

    def hear(message: Any) -> None:
        heard.append(message.data)
        raise ValueError(f'{message.data} is wrong')

    subscription = spun.node.create_subscription(String, 'word', hear, RELIABLE)
    publisher = spun.node.create_publisher(String, 'word', RELIABLE)
    spun.wait(lambda: publisher.get_subscription_count() > 0
              and subscription.get_publisher_count() > 0, 'it listens')
    for k in range(3):
        publisher.publish(String(data=f'w{k}'))
        spun.wait(lambda k=k: len(heard) > k, 'the next one comes')
    spun.wait(lambda: 'w2 is wrong' in caplog.text, 'the last one is logged')
    assert heard == ['w0', 'w1', 'w2']


def test_a_guarded_callback_never_raises_and_does_nothing_when_it_is_not_due(
    caplog: pytest.LogCaptureFixture,
) -> None:
    heard, due = [], True

    def hear(word: str) -> None:
        heard.append(word)
        raise ValueError(f'{word} is wrong')
    callback = guarded(hear, lambda: due)
    callback('one')
    due = False
    callback('two')
    assert heard == ['one']
    assert 'one is wrong' in caplog.text
