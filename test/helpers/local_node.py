# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node in the test's own process and a client that talks to it over DDS, in one executor."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
import time
from typing import Any

from circle import fix_at, odometry_at
from harness import PATIENCE, RELIABLE
from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import NavSatFix

from pose_graph_ros.cli.demo import isolated_environment
from pose_graph_ros.ros.session import Session


class LocalNode:
    """
    Two nodes in a context and domain of their own: the one under test, and its client.

    Parameters
    ----------
    log : Path
        Folder for the logs.
    make_node : callable
        Makes the node under test, given a context.

    """

    def __init__(self, log: Path, make_node: Callable[[Context], Node] | None = None) -> None:
        self.context = Context()
        self._stack = ExitStack()
        env = self._stack.enter_context(isolated_environment(log))
        rclpy.init(context=self.context, domain_id=int(env['ROS_DOMAIN_ID']))
        self.node = (Node('pose_graph', context=self.context) if make_node is None
                     else make_node(self.context))
        self.client = Node('client', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._executor.add_node(self.client)

    def __enter__(self) -> 'LocalNode':
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self.client.destroy_node()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        self._stack.close()

    def spin_until(self, done: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        """Serve callbacks of both nodes until a condition holds."""
        end = time.monotonic() + patience
        while not done():
            assert time.monotonic() < end, f'waited {patience} s until {what}'
            self._executor.spin_once(timeout_sec=0.003)

    def subscribe(self, kind: type, topic: str, qos: QoSProfile = RELIABLE) -> list[Any]:
        """Return a list of the messages that the client receives, once both sides match."""
        messages: list[Any] = []
        subscription = self.client.create_subscription(kind, topic, messages.append, qos)
        self._match(subscription.get_publisher_count, [
            publisher.get_subscription_count for publisher in self.node.publishers
            if publisher.topic_name == subscription.topic_name])
        return messages

    def _match(self, mine: Callable[[], int], theirs: list[Callable[[], int]]) -> None:
        """Serve callbacks until both sides of a topic count each other."""
        self.spin_until(lambda: all(count() > 0 for count in (mine, *theirs)), 'it is matched')

    def advertise(self, kind: type, topic: str) -> Publisher:
        """Return a publisher of the client, once the node's subscription matches it."""
        publisher = self.client.create_publisher(kind, topic, RELIABLE)
        self._match(publisher.get_subscription_count, [
            subscription.get_publisher_count for subscription in self.node.subscriptions
            if subscription.topic_name == publisher.topic_name])
        return publisher


class Driver:
    """
    Publishes the sources of a session of the node under test, and waits for what it does.

    Parameters
    ----------
    local : LocalNode

    """

    def __init__(self, local: LocalNode) -> None:
        self.local = local
        self.publishers: dict[str, Publisher] = {}

    @property
    def session(self) -> Session:
        """Session of a configured PoseGraphNode."""
        return self.local.node._configured

    def connect(self) -> None:
        """Wait until the session subscribes to odometry and fixes."""
        for source, kind, topic in (('odom', Odometry, 'odom'), ('fix', NavSatFix, 'gps/fix')):
            self.publishers[source] = self.local.advertise(kind, topic)

    def wait(self, done: Callable[[], bool], what: str) -> None:
        self.local.spin_until(done, what)

    def send(self, source: str, *messages: object) -> None:
        """Publish messages, and wait until the session has counted them."""
        arrivals = self.session.input.arrivals[source]
        wanted = arrivals.count + len(messages)
        for message in messages:
            self.publishers[source].publish(message)
        self.wait(lambda: arrivals.count >= wanted, f'{wanted} messages of {source} come')

    def drive(self, end: float, begin: float = 0.0, *, fixes: bool = True) -> None:
        """Publish a drive, odometry at 10 Hz and fixes at 2 Hz, and wait until it is processed."""
        for at in np.arange(begin, end, 0.5):
            self.send('odom', *(odometry_at(at + 0.1 * step) for step in range(5)))
            if fixes:
                self.send('fix', fix_at(at))
            if at == begin:
                # poses are published from the first estimate on
                self.update()
        self.update()

    def update(self) -> None:
        """Wait until an estimate has all that was posted."""
        worker, posted = self.session.worker, self.session.input.posted
        self.wait(lambda: worker.status.processed >= posted and worker.estimate is not None,
                  f'{posted} measurements are processed')
        before = worker.status.report
        worker.request_update()
        # it makes no new estimate if one by the timer has had all; the status is whole afterwards
        self.wait(lambda: worker.status.report is not before and worker.is_refined,
                  'an update and a refinement follow')
