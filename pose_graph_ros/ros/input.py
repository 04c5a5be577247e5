# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From messages to measurements, with a count for everything; imports no rclpy.

While it is in doubt whether time begins again, as `TimeKeeper` judges, all messages are held back,
so that no measurement of the new time reaches the old graph, and afterwards those of the old time
that are still in the queues are recognised.
"""

from collections import Counter
from collections.abc import Callable, Mapping
import logging
import math
import time
from typing import Any, NamedTuple

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.se2 import between_one
from pose_graph_ros.core.measurements import (
    Answer,
    Measurement,
    OdometrySample,
    rejected,
)
from pose_graph_ros.core.odometry.jumps import is_jump, SpeedWindow, UNKNOWN
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper
from pose_graph_ros.ros.arrivals import Arrivals, INTENDED, quiet, silent

logger = logging.getLogger(__name__)

PAUSED = rejected('paused', 'call ~/pause with false to resume')
BEFORE_JUMP = rejected('before_clock_jump', 'a message from before the clock was set back')
LONGEST_DOUBT = 1.0  # messages that are held back are released without odometry for so long [s]


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
        if self._keeper.in_doubt and len(self._held) < 10_000:
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
        if self._n_new > 20:     # so many of odometry that the queues are empty
            self._drained = None
        return False


class Input:
    """Counts all messages, holds them back while time may have jumped back, and reads them."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.reader = MessageReader(values)
        self.time_jumps = TimeJumps(self.reader.keeper)
        self._told: set[tuple[str, str]] = set()
        self._odometry_at = 0.0
        self.paused = False  # whether all measurements are rejected
        self._clear()

    def _clear(self) -> None:
        self.arrivals = {
            name: Arrivals(name, is_rare=source.kind.is_rare)
            for name, source in self.reader.sources.items()}
        self.rejected: Counter[tuple[str, str]] = Counter()  # number by source and reason
        self._details: dict[tuple[str, str], str] = {}  # of the newest by source and reason
        self.posted = 0  # number of measurements that were handed to the engine
        self.silent: list[str] = []  # sources that are silent while others are not
        self.quiet = 0.0  # for how long nothing at all has come, if that is long [s]
        self.refused: dict[str, str] = {}  # what to say of sources that all is refused from
        self.posted_at = time.monotonic()  # time of the last of them, by a monotonic clock [s]
        self.is_streaming = False  # whether any were posted since the final optimisation

    def start_new_graph(self, values: Mapping[str, Any]) -> None:
        """Forget all messages but those of /tf_static; those that are held back stay so."""
        self.reader = MessageReader(values, self.reader.frames, self.reader.keeper)
        self._clear()

    def receive(self, source: str, message: Message) -> Decision:
        """Return which messages can be used now, after counting a new one."""
        now, arrivals = time.monotonic(), self.arrivals[source]
        arrivals.receive(now)
        measurement = self.read(source, message)
        if measurement is None:
            return Decision([])
        if isinstance(measurement, OdometrySample):
            self._odometry_at = now
        decision = self.time_jumps.receive(ReceivedMessage(source, message, measurement))
        if decision.is_old:
            self.reject(source, BEFORE_JUMP)
        elif decision.jump_ns == 0 and not arrivals.is_rare:
            arrivals.compare(measurement.stamp_ns, self.reader.keeper.clock,
                             may_be_late=not self.reader.sources[source].kind.is_motion)
        return decision

    def release_overdue(self) -> list[ReceivedMessage]:
        """Remove and return the messages that were held back if no odometry has come for long."""
        overdue = time.monotonic() - self._odometry_at > LONGEST_DOUBT
        return self.time_jumps.release() if overdue else []

    def read(self, source: str, message: Message) -> OdometrySample | Measurement | None:
        """Return the measurement of a message; None if it cannot be used, whatever its stamp."""
        try:
            measurement = self.reader.convert(source, message)
        except Exception as error:
            measurement = rejected('malformed', f'{type(error).__name__}: {error}')
        if isinstance(measurement, Answer):
            self.reject(source, measurement)
            return None
        self.arrivals[source].frames = (
            message.header.frame_id, getattr(message, 'child_frame_id', ''))
        return measurement

    def post(
        self, received: ReceivedMessage,
        post: Callable[[str, OdometrySample | Measurement], bool],
    ) -> None:
        """Hand a measurement to the engine, unless its stamp is refused or the input is paused."""
        source, _, measurement, refusal = received
        if refusal is not None:
            self.reject(source, refusal)
        elif self.paused:
            self.reject(source, PAUSED)
        elif not post(source, measurement):
            self.reject(source, rejected('inbox_full', 'the solver does not keep up'))
        else:
            self.posted += 1
            self.posted_at, self.is_streaming = time.monotonic(), True

    def watch(
        self, counts: Counter[tuple[str, str]], details: Mapping[tuple[str, str], str], *,
        active: bool,
    ) -> None:
        """
        Find the sources that are silent or refused, and log each reason once.

        The engine has counted measurements by source and 'accepted' or a reason, and kept the
        details of the newest refusals.
        """
        now, details = time.monotonic(), {**details, **self._details}
        arrivals, counts = self.arrivals.values(), counts + self.rejected
        self.silent = silent(arrivals, now) if active else []
        self.quiet = quiet(arrivals, now) if active else 0.0
        self.refused = {each.source: sentence for each in arrivals
                        if (sentence := each.refusal(counts, details, now)) != ''}
        for (source, reason), detail in details.items():
            if source in self.reader.sources and (source, reason) not in self._told:
                self._told.add((source, reason))
                logger.log(logging.INFO if reason in INTENDED else logging.WARNING,
                           '%s: %s: %s (logged once, counted in diagnostics)',
                           source, reason, detail)

    def reject(self, source: str, answer: Answer) -> None:
        """Count a message that cannot be used."""
        self.rejected[source, answer.reason] += 1
        self._details[source, answer.reason] = answer.detail


# A step in the stamps by more than this may be a mistake: it is treated as a jump [ns].
FAR_NS = 10_000_000_000


class PoseContinuity:
    """
    Watches the raw poses of the primary odometry for jumps, as the engine does.

    Its next estimate accounts for a jump; until then the old one must not be propagated over it.
    Where there is an estimate from before the first sample, the engine decides whether the
    odometry continues from there.
    """

    def __init__(self, maximum_speed: float, *, resumes: bool = False) -> None:
        self.maximum_speed = maximum_speed  # may be changed at any time
        self._resumes = resumes
        self._stamp_ns = 0
        self._pose = (0.0, 0.0, 0.0)
        self._window = SpeedWindow(UNKNOWN, 0, self._pose)
        self._jump_ns = 0

    def covers(self, estimate: Estimate | None, sample: OdometrySample) -> bool:
        """Tell whether an estimate can be propagated to the newest sample."""
        elapsed_ns = sample.stamp_ns - self._stamp_ns
        # far behind, the stamp before was wrong: it lay in the future
        if elapsed_ns > 0 or elapsed_ns < -FAR_NS:
            self._add(sample, elapsed_ns)
        return estimate is not None and estimate.stamp_ns >= self._jump_ns

    def _add(self, sample: OdometrySample, elapsed_ns: int) -> None:
        x, y, theta = sample.pose.tolist()
        motion = between_one(self._pose, (x, y, theta))
        step = math.hypot(motion[0], motion[1]), abs(motion[2])
        begins = self._stamp_ns == 0 or elapsed_ns < 0
        if begins:
            jumped = self._stamp_ns == 0 and self._resumes
        else:
            jumped = elapsed_ns > FAR_NS or is_jump(
                self._window.speeds, step, elapsed_ns * 1e-9, sample.speed, self.maximum_speed)
        self._stamp_ns, self._pose = sample.stamp_ns, (x, y, theta)
        if begins or jumped:
            self._window = SpeedWindow(self._window.speeds, sample.stamp_ns, self._pose)
            self._jump_ns = sample.stamp_ns if jumped else 0
        else:
            self._window = self._window.moved(sample.stamp_ns, self._pose, step)
