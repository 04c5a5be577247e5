# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Jumps: of time, by which messages are held back or old, and of odometry, over which no pose goes.

While it is in doubt whether time begins again, as `TimeKeeper` judges, all messages are held back,
so that no measurement of the new time reaches the old graph, and afterwards those of the old time
that are still in the queues are recognised. Imports no rclpy.
"""

import math
from typing import NamedTuple

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.scalar_se2 import between_one
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample
from pose_graph_ros.core.odometry.jumps import is_jump, SpeedWindow, UNKNOWN
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper

MOST_HELD = 10_000  # greatest number of messages that are held back at a time
MOST_OLD = 20  # after this many odometry messages of the new time the old ones have drained


class ReceivedMessage(NamedTuple):
    """A usable message as it came."""

    source: str
    message: Message
    measurement: OdometrySample | Measurement
    refusal: Answer | None = None  # why it is not used, by its stamp

    @property
    def stamp_ns(self) -> int:
        """Its stamp, with the offset of its source [ns]."""
        return self.measurement.stamp_ns


class Decision(NamedTuple):
    """What is to be done after a message has come."""

    released: list[ReceivedMessage]
    """Messages that can be used now, in the order in which they came."""
    jump_ns: int = 0  # length of the jump back in time before these messages [ns]; 0 for none
    is_old: bool = False  # whether the message is from before time began again


class TimeJumps:
    """Holds messages back while the keeper of time is in doubt."""

    def __init__(self, keeper: TimeKeeper) -> None:
        self._keeper = keeper
        self._held: list[ReceivedMessage] = []
        self._drained: set[str] | None = None
        """Sources that have sent messages of the new time; None if no old ones are expected."""
        self._old_above_ns = self._n_new = 0

    def receive(self, received: ReceivedMessage) -> Decision:
        """Return which messages can be used, now that this one has come."""
        if self._is_old(received):
            return Decision([], is_old=True)
        newest_ns = self._keeper.now_ns
        judged = self._keeper.judge(received.source, received.measurement)
        received = received._replace(refusal=judged.refusal)
        if judged.jump_ns > 0:
            self._expect_old(newest_ns, judged.jump_ns, {received.source})
            return Decision(self.release([received]), judged.jump_ns)
        if self._keeper.in_doubt and len(self._held) < MOST_HELD:
            self._held.append(received)
            return Decision([])
        return Decision(self.release([received]))

    def release(self, more: list[ReceivedMessage] | None = None) -> list[ReceivedMessage]:
        """Remove and return the messages that are held back, with more appended."""
        held, self._held = self._held, []
        return held + (more or [])

    def forget(self) -> None:
        """Forget all stamps; messages that are held back stay so."""
        self._keeper.forget()
        self._drained = None

    def clock_jumped(self, back_ns: int, clock_ns: int) -> None:
        """Start again because the clock was set back by an amount, to a time [ns]."""
        newest_ns = self._keeper.now_ns
        self.forget()
        if newest_ns > clock_ns:
            # the clock may have run on for long without a message
            back_ns = min(back_ns, newest_ns - clock_ns)
        if newest_ns > 0:
            self._expect_old(newest_ns, back_ns, set())

    def _expect_old(self, newest_ns: int, back_ns: int, drained: set[str]) -> None:
        """
        Expect messages of the old time that may still be in the queues.

        They are those less than half of the jump behind the newest one, of sources that have sent
        none of the new time before; such messages that are held back are dropped.
        """
        self._drained, self._n_new = drained, 0
        self._old_above_ns = newest_ns - back_ns // 2
        self._held = [received for received in self._held if not self._is_old(received)]

    def _is_old(self, received: ReceivedMessage) -> bool:
        if self._drained is None:
            return False
        if received.source not in self._drained and received.stamp_ns > self._old_above_ns:
            return True
        self._drained.add(received.source)
        self._n_new += isinstance(received.measurement, OdometrySample)
        if self._n_new > MOST_OLD:
            self._drained = None
        return False


# A step in the stamps by more than this may be a mistake: it is treated as a jump [ns].
FAR_NS = 10_000_000_000


class PoseContinuity:
    """
    Watches the raw poses of the primary odometry for jumps, as the engine does.

    Its next estimate accounts for a jump; until then the old one must not be propagated over it.

    Parameters
    ----------
    maximum_speed : float, greatest possible speed of the robot [m/s]
    resumes : bool
        Whether there is an estimate from before the first sample: the engine then decides whether
        the odometry continues from there.

    """

    def __init__(self, maximum_speed: float, *, resumes: bool = False) -> None:
        self.maximum_speed = maximum_speed  # may be changed at any time
        self._resumes = resumes
        self._stamp_ns = 0
        self._pose = (0.0, 0.0, 0.0)
        self._window = SpeedWindow(UNKNOWN, 0, self._pose)
        self._jump_ns = 0

    def covers(self, estimate: Estimate | None, sample: OdometrySample) -> bool:
        """
        Tell whether an estimate can be propagated to the newest sample.

        Parameters
        ----------
        estimate : Estimate or None, the newest estimate, a little older than the sample
        sample : OdometrySample, newest sample of the primary odometry, in order of arrival

        """
        if sample.stamp_ns > self._stamp_ns:
            self._add(sample)
        elif sample.stamp_ns < self._stamp_ns - FAR_NS:
            # the stamp before was wrong: it lay in the future
            self._begin(sample)
            self._jump_ns = 0
        return estimate is not None and estimate.stamp_ns >= self._jump_ns

    def _begin(self, sample: OdometrySample) -> None:
        x, y, theta = sample.pose.tolist()
        self._stamp_ns, self._pose = sample.stamp_ns, (x, y, theta)
        self._window = SpeedWindow(self._window.speeds, sample.stamp_ns, self._pose)

    def _add(self, sample: OdometrySample) -> None:
        x, y, theta = sample.pose.tolist()
        elapsed_ns, pose = sample.stamp_ns - self._stamp_ns, (x, y, theta)
        motion = between_one(self._pose, pose)
        step = math.hypot(motion[0], motion[1]), abs(motion[2])
        if self._stamp_ns == 0:
            jumped = self._resumes
        else:
            jumped = elapsed_ns > FAR_NS or is_jump(
                self._window.speeds, step, elapsed_ns * 1e-9, sample.speed, self.maximum_speed)
        if jumped or self._stamp_ns == 0:
            self._begin(sample)
            self._jump_ns = sample.stamp_ns if jumped else 0
        else:
            self._stamp_ns, self._pose = sample.stamp_ns, pose
            self._window = self._window.moved(sample.stamp_ns, pose, step)
