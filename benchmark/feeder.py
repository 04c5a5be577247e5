# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Sends odometry and fixes at an exact pace, and notes when what follows from them comes back.

One thread, no executor: between two messages it sleeps in the wait set of its subscriptions. What
it adds itself is its pacing error.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
import gc
import math
import os
import struct
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import NavSatFix

from pose_graph_ros.adapters.output_cdr import odometry_cdr
from pose_graph_ros.core.estimate import Prediction
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray

# As a driver has it; the node listens with best effort, so nothing is sent again.
QOS = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE)
SECOND = 1_000_000_000
PATIENCE = 60.0
"""How long the node is waited for [s]."""
DATUM = 48.0, 11.0
SIGMA_FIX = 0.3
"""Of the fixes [m]."""
RADIUS = 60.0
"""Of the circle that the robot drives, lap after lap [m]."""
HEADING_ERROR = 1e-3
"""By so much of the turn odometry is wrong."""
FILL_SPEED, FILL_STEP, FILL_FIXES = 5.1, 0.2, 50
"""While the graph is filled: speed [m/s], time between samples [s], samples to a fix."""
MOST_UNDER_WAY = 400
"""Then so many samples may be without an answer ..."""
MOST_BEHIND = 20_000
"""... and so many be received, but not processed."""
SPEED, FIX_RATE = 2.0, 10.0
"""While it is measured [m/s, Hz]."""
STRAGGLERS = 0.5
"""How long outputs are waited for after the last message [s]."""
STANDSTILL = 10.0
"""A node that has processed nothing for so long will not go on [s]."""


def truth(way: FloatArray | float) -> tuple[Any, Any]:
    """Return where the robot is after a way [m], in the map."""
    return RADIUS * np.sin(way / RADIUS), RADIUS * (1.0 - np.cos(way / RADIUS))


def drifting(way: float) -> tuple[float, float, float]:
    """Return what odometry says after a way [m]: another circle."""
    theta = (1.0 + HEADING_ERROR) * way / RADIUS
    radius = RADIUS / (1.0 + HEADING_ERROR)
    return radius * math.sin(theta), radius * (1.0 - math.cos(theta)), theta


@cache
def _moving(speed: float) -> Odometry:
    """Return odometry with a speed [m/s]."""
    message = Odometry()
    message.twist.twist.linear.x = speed
    return message


def stamp_of(data: bytes) -> int:
    """Return the stamp [ns] of a serialised message whose first field is a header."""
    seconds, nanoseconds = struct.unpack_from('<iI', data, 4)
    return int(seconds * SECOND + nanoseconds)


@dataclass(slots=True)
class Phase:
    """What was sent at one rate, and what came back; times by the steady clock [ns]."""

    rate: float
    """Of odometry [Hz]."""
    sent_ns: dict[int, int] = field(default_factory=dict)
    """When publishing began, by the stamp of the odometry."""
    late_ns: list[int] = field(default_factory=list)
    """How long after its time that was."""
    came_ns: dict[int, int] = field(default_factory=dict)
    """By the stamp of the output."""
    lost: int = 0
    """Messages of odometry that the node did not take."""
    cpu: float = 0.0
    """Time of the processor that the node took, in parts of one core."""
    error: float = math.nan
    """Distance of the last output from where the robot is [m]."""

    @property
    def latency(self) -> FloatArray:
        """From before publishing to the output [ms], for what has come back."""
        return 1e-6 * np.array([came - self.sent_ns[stamp]
                                for stamp, came in self.came_ns.items() if stamp in self.sent_ns])

    @property
    def missing(self) -> int:
        """Outputs that have not come."""
        return len(self.sent_ns.keys() - self.came_ns.keys())


class Feeder:
    """
    Sends what sensors would and hears what the node answers.

    Parameters
    ----------
    environment : mapping
        Of the node; the domain is taken from it.
    output : type and topic of the output that is noted

    """

    def __init__(self, environment: Mapping[str, str],
                 output: tuple[type, str] = (Odometry, 'odometry/filtered')) -> None:
        self._output = output
        for name in ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOG_DIR', 'AMENT_PREFIX_PATH'):
            os.environ[name] = environment[name]
        self._context, self.domain = Context(), int(environment['ROS_DOMAIN_ID'])
        rclpy.init(context=self._context, domain_id=self.domain)
        self._node = rclpy.create_node('feeder', context=self._context)
        self._odometry = self._node.create_publisher(Odometry, 'odom', QOS)
        self._fix = self._node.create_publisher(NavSatFix, 'gps/fix', QOS)
        self._takers: dict[int, tuple[Any, Callable[[bytes, int], None]]] = {}
        for kind, topic, take in ((DiagnosticArray, '/diagnostics', self._on_diagnostics),
                                  (*output, self._on_output)):
            subscription = self._node.create_subscription(
                kind, topic, lambda _: None, QOS, raw=True)
            self._takers[subscription.handle.pointer] = subscription, take
        # used for as long as the context and the subscriptions are
        self._used = ExitStack()
        for handle in (self._context.handle, *(each.handle for each, _ in self._takers.values())):
            self._used.enter_context(handle)
        self._wait_set = rclpy_implementation.WaitSet(
            len(self._takers), 0, 0, 0, 0, 0, self._context.handle)
        self._plane = TangentPlane(*DATUM)
        self._rng = np.random.default_rng(0)
        self.values: dict[str, str] = {}
        """Of the node's newest diagnostics."""
        self._n_diagnostics = 0
        self._n_sent = 0
        self.stamp_ns, self._way = 1_700_000_000 * SECOND, 0.0
        self._newest_output = b''
        self._phase = Phase(0.0)

    def __enter__(self) -> 'Feeder':
        return self

    def __exit__(self, *_: object) -> None:
        self._used.close()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _on_diagnostics(self, data: bytes, _: int) -> None:
        message = deserialize_message(data, DiagnosticArray)
        self.values = {item.key: item.value for item in message.status[0].values}
        self._n_diagnostics += 1

    def _on_output(self, data: bytes, now_ns: int) -> None:
        self._phase.came_ns.setdefault(stamp_of(data), now_ns)
        self._newest_output = data

    def listen(self, until: float) -> None:
        """Take what comes up to an instant of the steady clock [s]."""
        waits = True
        while waits:
            self._wait_set.clear_entities()
            for subscription, _ in self._takers.values():
                self._wait_set.add_subscription(subscription.handle)
            left = until - time.monotonic()
            waits = left > 0.0
            self._wait_set.wait(int(left * 1e9) if waits else 0)
            for pointer in self._wait_set.get_ready_entities('subscription'):
                subscription, take = self._takers[pointer]
                taken = subscription.handle.take_message(subscription.msg_type, True)
                if taken is not None:
                    take(taken[0], time.monotonic_ns())

    def wait_until(self, done: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        """Listen until something is so; raises TimeoutError if it does not become so."""
        end = time.monotonic() + patience
        while not done():
            if time.monotonic() > end:
                raise TimeoutError(f'waited {patience} s until {what}: {self.values}')
            self.listen(time.monotonic() + 0.002)

    def wait_for_listener(self) -> None:
        """Wait until somebody listens to odometry and sends outputs."""
        self.wait_until(lambda: self._odometry.get_subscription_count() > 0
                        and self._node.count_publishers(self._output[1]) > 0, 'somebody is up')

    def wait_until_ready(self) -> None:
        """Wait until the node listens and has its kernels."""
        self.wait_until(lambda: self._odometry.get_subscription_count() > 0
                        and self._fix.get_subscription_count() > 0
                        and self.values.get('prepared') == '1', 'the node is ready', 300.0)

    def settle(self) -> None:
        """Wait until the node has processed all that was sent and not lost, and has said so."""
        seen, processed, since = self._n_diagnostics, -1, time.monotonic()

        def done() -> bool:
            nonlocal processed, since
            if self.count('processed') > processed:
                processed, since = self.count('processed'), time.monotonic()
            # what is lost is never processed
            return self._n_diagnostics >= seen + 2 and (
                processed >= self._n_sent or time.monotonic() > since + STANDSTILL)

        self.wait_until(done, 'the node has processed everything', 300.0)

    def count(self, name: str) -> int:
        """Return a count of the node's newest diagnostics."""
        return int(self.values.get(name, 0))

    def _advance(self, seconds: float, speed: float) -> None:
        self.stamp_ns += round(seconds * SECOND)
        self._way += seconds * speed

    def _send_odometry(self, speed: float) -> int:
        """Send odometry as of now; return when that began [ns]."""
        pose = Prediction(np.array(drifting(self._way)), np.zeros((3, 3)))
        data = odometry_cdr(self.stamp_ns, pose, _moving(speed), 'odom', 'base_link')
        self._n_sent += 1
        begin_ns = time.monotonic_ns()
        self._odometry.publish(data)
        return begin_ns

    def _send_fix(self) -> None:
        position = np.array(truth(self._way)) + self._rng.normal(0.0, SIGMA_FIX, 2)
        message = NavSatFix(position_covariance_type=2, position_covariance=(
            SIGMA_FIX**2 * np.diag((1.0, 1.0, 4.0))).ravel())
        message.header.frame_id = 'gps'
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp_ns, SECOND)
        message.status.status = 0
        message.latitude, message.longitude, _ = self._plane.to_geodetic(position).tolist()
        self._n_sent += 1
        self._fix.publish(message)

    def fill(self, nodes: int) -> float:
        """Make the node drive until it has so many hidden nodes; return how long that took [s]."""
        begin = time.monotonic()
        for k in range(nodes + 1):
            self._advance(FILL_STEP, FILL_SPEED)
            self._send_odometry(FILL_SPEED)
            if k % FILL_FIXES == 0:
                self._send_fix()
            if not self._newest_output:
                # before its first estimate the node answers nothing
                self.listen(time.monotonic() + 0.02)
            patience = time.monotonic() + PATIENCE
            while self._newest_output and self._busy():
                self.listen(time.monotonic() + 0.001)
                if time.monotonic() > patience:
                    raise TimeoutError(f'the node does not go on: {self.values}')
            if k % 50 == 0:
                self.listen(0.0)
        self.settle()
        return time.monotonic() - begin

    def _busy(self) -> bool:
        """Tell whether the node has enough to do for now."""
        under_way = (self.stamp_ns - stamp_of(self._newest_output)) / (FILL_STEP * SECOND)
        return (under_way > MOST_UNDER_WAY
                or self.count('received') - self.count('processed') > MOST_BEHIND)

    def run(self, rate: float, seconds: float, cpu_seconds: Callable[[], float]) -> Phase:
        """
        Drive at a rate of odometry, with fixes, and note what comes back.

        Parameters
        ----------
        rate : float
            Of odometry [Hz].
        seconds : float
        cpu_seconds : callable
            Tells the time of the processor that the node has taken so far [s].

        """
        phase = self._phase = Phase(rate)
        every, count = max(round(rate / FIX_RATE), 1), round(rate * seconds)
        gc.collect()
        gc.disable()
        cpu, begin = cpu_seconds(), time.monotonic()
        for k in range(count):
            due = begin + k / rate
            self.listen(due)
            self._advance(1.0 / rate, SPEED)
            sent_ns = self._send_odometry(SPEED)
            phase.sent_ns[self.stamp_ns] = sent_ns
            phase.late_ns.append(sent_ns - int(due * 1e9))
            if k % every == 0:
                self._send_fix()
        self.listen(begin + count / rate)
        phase.cpu = (cpu_seconds() - cpu) / (time.monotonic() - begin)
        self.listen(time.monotonic() + STRAGGLERS)
        gc.enable()
        if self._newest_output and stamp_of(self._newest_output) == self.stamp_ns:
            position = deserialize_message(self._newest_output, self._output[0]).pose.pose.position
            x, y = truth(self._way)
            phase.error = math.hypot(position.x - x, position.y - y)
        return phase
