# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
An hour with the real node over DDS, as fast as it answers, while people and machines disturb it.

At random the graph is reset, the node is deactivated or cleaned up and started again, parameters
change, messages are malformed, a drive begins again as a bag does that is played again, and the
node is killed and goes on from its journal. In between all that is sent must be received.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import itertools
import math
from pathlib import Path
import random
import time

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from benchmark.soak.life import Life
from benchmark.soak.robot import DATUM, malformed, Robot
from pose_graph_ros.adapters.conversions import Datum, stamp_ns
from pose_graph_ros.cli.demo import isolated_environment

EPOCH = 4.0, 20.0   # time between two disturbances [s]
FAR = 3.0   # error of a pose that is explained [m]
LOSS_WINDOW = 1.5   # what was known so long before a kill must be there after it [s]
CHANGES: dict[str, Callable[[random.Random], object]] = {
    'frequency': lambda draw: draw.uniform(5.0, 20.0),
    'path_period': lambda draw: draw.uniform(0.2, 2.0),
    'closing_silence': lambda draw: draw.choice((0.0, 1.0, 3.0)),
    'minimum_travel_distance': lambda draw: draw.uniform(0.5, 2.0),
    'window.nodes': lambda draw: float(draw.randrange(500, 3000)),
    'odom.maximum_speed': lambda draw: draw.uniform(20.0, 100.0),
    'fix.covariance_scale': lambda draw: draw.uniform(0.5, 2.0),
    'loop_closure.covariance_scale': lambda draw: draw.uniform(0.5, 2.0),
    'transform_slew': lambda draw: draw.choice(([0.0, 0.0], [0.5, 0.2]))}
"""What may change while the node runs, and what to; what is wrong stays judged."""


@dataclass(slots=True)
class Minute:
    """What happened so far, and in the last minute."""

    minutes: float
    resident: float     # memory of the node [MB]
    age: float  # time since the node's process began [min]
    sent: int   # messages so far, of all kinds
    received: int   # of them by the node, so far
    lost: int   # in the difference, where they are compared
    poses: int  # so far
    unanswered: int     # odometry that no pose came of although it flowed, so far
    latency_p50: float  # of a pose in this minute, behind some messages [ms]
    latency_p99: float
    latency_max: float
    lines: int  # of log, so far
    errors: int     # of them errors or tracebacks
    crashes: int    # the process ended by itself, so far
    stuck: list[str]    # what was waited for in vain, so far
    actions: dict[str, int]     # disturbances so far
    changes_refused: int    # parameters that should have changed, so far
    missing: int    # hidden nodes that a kill has cost although they were old enough, so far
    error: float    # of poses before disturbances in this minute, median [m]
    error_max: float
    far: list[str]  # when it was more than `FAR`
    nodes: int  # hidden ones
    journal: float  # [MB]
    journal_lag: float  # longest time that the disk took [s]


class Soak:
    """Disturbs a node at random, and counts what comes of it."""

    def __init__(self, robot: Robot, seed: int) -> None:
        self.robot, self._draw = robot, random.Random(seed)
        self.begin = self._told = time.monotonic()
        self.actions, self.stuck = Counter[str](), list[str]()
        self.lost = self.received = self.crashes = self.refused = self.missing = 0
        self.errors, self.far = list[float](), list[str]()
        self._last = ''     # disturbance
        self._weights: dict[Callable[[], None], int] = {
            self.reset: 3, self.deactivate: 3, self.clean_up: 2, self.change: 6, self.again: 2,
            self.kill: 1, self.damage: 6}

    def run(self, seconds: float) -> Iterator[Minute]:
        """Run for a time [s], and yield what happened at the end of each minute."""
        self._restart()
        while (now := time.monotonic()) < self.begin + seconds:
            end = min(now + self._draw.uniform(*EPOCH), self.begin + seconds)
            try:
                self._begin_epoch()
                while time.monotonic() < end:
                    self.robot.say(next(self._events))
                    if time.monotonic() > self._told + 60.0:
                        yield self.minute()
                action, = self._draw.choices([*self._weights], [*self._weights.values()])
                if action != self.kill:     # which may come in the middle of it all
                    self._end_epoch()
                self._last = action.__name__
                self.actions[self._last] += 1
                action()
            except TimeoutError as error:
                self.stuck.append(f'{error} after {self.actions.total()} actions')
                self._start_anew()
            except ChildProcessError:
                self.crashes += 1
                self._start_anew()
        yield self.minute()

    def _restart(self) -> None:
        """Let the drive begin again."""
        self.life = Life(30, 5.0, Datum(DATUM), seed=self._draw.randrange(1000))
        self._events = itertools.chain.from_iterable(
            piece.events for piece in itertools.chain.from_iterable(
                self.life.pieces() for _ in iter(int, 1)))

    def _start_anew(self) -> None:
        self.robot.process.process.kill()
        self.robot.process.process.wait()
        self.robot.stop_flowing()
        self.robot.start()

    def _begin_epoch(self) -> None:
        self.robot.wait_quiet()
        self._from, self._sent = int(self.robot.values['received']), self.robot.sent

    def _end_epoch(self) -> None:
        """Compare what was sent and received, and the pose with the truth."""
        robot = self.robot
        robot.wait_quiet()
        for event in itertools.islice(self._events, 5):
            robot.say(event)    # a pose by an estimate that has all
        robot.wait_quiet()
        received, sent = int(robot.values['received']) - self._from, robot.sent - self._sent
        self.received, self.lost = self.received + received, self.lost + sent - received
        self._from, self._sent = self._from + received, robot.sent
        if robot.newest is not None and robot.values.get('alignment') == 'aligned':
            x, y = self.life.truth_at(np.array([stamp_ns(robot.newest)]))[0, :2]
            where = robot.newest.pose.pose.position
            self.errors.append(math.hypot(where.x - x, where.y - y))
            if self.errors[-1] > FAR:
                told = {name: robot.values.get(name, '') for name in (
                    'hidden_nodes', 'alignment_sigma_deg', 'fix.accepted', 'fix.doubted')}
                without = (stamp_ns(robot.newest) - robot.fixed_ns) / 1_000_000_000
                sigma = math.sqrt(robot.newest.pose.covariance[0])
                self.far.append(f'{self.errors[-1]:.1f} m (sigma {sigma:.1f} m), {sent} messages '
                                f'after {self._last}, {without:.0f} s after a fix, {told}')
        robot.stop_flowing()

    # ---- disturbances

    def reset(self) -> None:
        """Start a new graph."""
        before = int(self.robot.values['resets'])
        self.robot.call(Trigger, 'reset', Trigger.Request())
        self.robot.wait(lambda: int(self.robot.values['resets']) > before, 'a new graph')

    def _change_state(self, *transitions: int) -> None:
        for transition in transitions:
            request = ChangeState.Request(transition=Transition(id=transition))
            if not self.robot.call(ChangeState, 'change_state', request).success:
                raise TimeoutError(f'transition {transition} succeeds')
        self.robot.values = {}
        self.robot.wait_ready()

    def deactivate(self) -> None:
        """Deactivate and activate the node."""
        self._change_state(Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)

    def clean_up(self) -> None:
        """Deactivate, clean up, configure and activate the node."""
        self._change_state(Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
                           Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)

    def change(self) -> None:
        """Change a parameter."""
        name = self._draw.choice([*CHANGES])
        wanted = Parameter(name, value=CHANGES[name](self._draw)).to_parameter_msg()
        result, = self.robot.call(
            SetParameters, 'set_parameters', SetParameters.Request(parameters=[wanted])).results
        if not result.successful:
            self.refused += 1
            self.stuck.append(f'{name}: {result.reason}')

    def again(self) -> None:
        """Begin the drive again, with publishers of its own, as a bag that is played again."""
        before = int(self.robot.values['resets'])
        self.robot.connect()
        self.robot.wait_ready()
        self._restart()
        for _ in range(200):
            self.robot.say(next(self._events))
            if int(self.robot.values['resets']) > before:
                break
        self.robot.wait(lambda: int(self.robot.values['resets']) > before, 'time begins again')

    def kill(self) -> None:
        """Kill the node, and start it again with its journal."""
        robot, now = self.robot, time.monotonic()
        before = [nodes for at, nodes in robot.known if at < now - LOSS_WINDOW]
        self._start_anew()
        robot.wait(lambda: 'hidden_nodes' in robot.values or not before[-1:] or before[-1] == 0,
                   'the map is there')
        after = int(robot.values.get('hidden_nodes', 0))
        self.missing += max((before or [0])[-1] - after, 0)

    def damage(self) -> None:
        """Send malformed messages."""
        stamp = 0 if self.robot.newest is None else stamp_ns(self.robot.newest)
        for _ in range(500):
            self.robot.send(*malformed(self._draw, stamp))
            time.sleep(0.0005)
        self.robot.wait_quiet()
        self._end_epoch()

    def minute(self) -> Minute:
        """Return what happened so far."""
        robot, latencies, errors = self.robot, self.robot.latencies, self.errors
        robot.latencies, self.errors, self._told = [], [], time.monotonic()
        ms = 1e3 * np.percentile(latencies or [math.nan], (50, 99, 100))
        lines = [line for log in robot.logs for line in log.read_text('utf-8').splitlines()]
        return Minute(
            (self._told - self.begin) / 60.0, robot.process.memory()['VmRSS'],
            (self._told - robot.began) / 60.0, robot.sent, self.received, self.lost, robot.poses,
            robot.unanswered, *ms.tolist(), len(lines),
            sum('[ERROR]' in line or 'Traceback' in line for line in lines), self.crashes,
            self.stuck[-20:], dict(self.actions), self.refused, self.missing,
            float(np.median(errors or [math.nan])), max(errors, default=math.nan),
            self.far[-20:],
            int(robot.values.get('hidden_nodes', 0)), float(robot.values.get(
                'journal.size_mb', 'nan')), float(robot.values.get('journal.lag_max_s', 'nan')))


def run(minutes: float, folder: Path, seed: int = 0) -> Iterator[Minute]:
    """Run the node for a time; logs and journal are in a folder."""
    with isolated_environment(folder) as environment:
        robot = Robot(environment, folder)
        try:
            yield from Soak(robot, seed).run(60.0 * minutes)
        finally:
            robot.close()
