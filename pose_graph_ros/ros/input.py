# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From messages to measurements, with a count for everything; imports no rclpy."""

from collections import Counter
from collections.abc import Callable, Mapping
import time
from typing import Any

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.core.measurements import (
    Answer,
    LoopClosure,
    Measurement,
    OdometrySample,
    rejected,
    YawRate,
)
from pose_graph_ros.ros.arrivals import Delays, Liveness, Refusals
from pose_graph_ros.ros.jumps import Decision, ReceivedMessage, TimeJumps

PAUSED = rejected('paused', 'call ~/pause with false to resume')
BEFORE_JUMP = rejected('before_clock_jump', 'a message from before the clock was set back')
LONGEST_DOUBT = 1.0  # messages that are held back are released without odometry for so long [s]


class Input:
    """
    Counts all messages, holds them back while time may have jumped back, and reads them.

    Parameters
    ----------
    values : mapping, all checked parameters; raises `ConfigError` if they contradict each other
    warn : callable, logs a sentence

    """

    def __init__(self, values: Mapping[str, Any], warn: Callable[[str], None]) -> None:
        self.reader = MessageReader(values)
        self.time_jumps = TimeJumps(self.reader.keeper)
        self._warn = warn
        self._warned: set[tuple[str, str]] = set()
        self._odometry_at = 0.0
        self.paused = False  # whether all measurements are rejected
        self.frames: dict[str, tuple[str, str]] = {}
        """The frame_id and child_frame_id of the newest message by source."""
        self._clear()

    def _clear(self) -> None:
        self.received: Counter[str] = Counter()  # number of messages by source
        self.rejected: Counter[tuple[str, str]] = Counter()  # number by source and reason
        self._details: dict[tuple[str, str], str] = {}  # of the newest by source and reason
        self.posted = 0  # number of measurements that were handed to the engine
        self.liveness = Liveness([source.name for source in self.reader.sources.values()
                                  if source.kind is Kind.LOOP_CLOSURE])
        self._refusals = Refusals()
        self.delays = Delays()
        self.silent: list[str] = []  # sources that are silent while others are not
        self.quiet = 0.0  # for how long nothing at all has come, if that is long [s]
        self.refused: dict[str, str] = {}  # what to say of sources that all is refused from
        self.posted_at = time.monotonic()  # time of the last of them, by a monotonic clock [s]
        self.is_streaming = False  # whether any were posted since the final optimisation

    def configure(self, values: Mapping[str, Any]) -> None:
        """Set the parameters that can change while the node runs."""
        self.reader.configure(values)

    def start_new_graph(self, values: Mapping[str, Any]) -> None:
        """Forget all messages but those of /tf_static; those that are held back stay so."""
        self.reader = MessageReader(values, self.reader.frames, self.reader.keeper)
        self._clear()

    def receive(self, source: str, message: Message) -> Decision:
        """Return which messages can be used now, after counting a new one."""
        now = time.monotonic()
        self.received[source] += 1
        self.liveness.receive(source, now)
        measurement = self.read(source, message)
        if measurement is None:
            return Decision([])
        if isinstance(measurement, OdometrySample):
            self._odometry_at = now
        decision = self.time_jumps.receive(ReceivedMessage(source, message, measurement))
        if decision.is_old:
            self.reject(source, BEFORE_JUMP)
        elif decision.jump_ns == 0 and not isinstance(measurement, LoopClosure):
            self.delays.receive(
                source, measurement.stamp_ns, self.reader.keeper.clock,
                may_be_late=not isinstance(measurement, OdometrySample | YawRate))
            if source in self.delays.wrong:
                self.warn_once(source, 'delay', self.delays.wrong[source])
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
        self.frames[source] = (
            message.header.frame_id, getattr(message, 'child_frame_id', ''))
        return measurement

    def post(
        self, received: ReceivedMessage,
        post: Callable[[str, OdometrySample | Measurement], bool],
    ) -> None:
        """
        Hand a measurement to the engine, unless its stamp is refused or the input is paused.

        Parameters
        ----------
        received : ReceivedMessage
        post : callable, `Worker.post`

        """
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
        Find the sources that are silent or refused, and log each silence once.

        Parameters
        ----------
        counts : Counter
            Number of measurements by source and 'accepted' or a reason, of the engine.
        details : mapping, of its newest refusal by source and reason
        active : bool, whether messages can be received

        """
        now, silent, quiet = time.monotonic(), self.silent, self.quiet
        self.silent = self.liveness.silent(now) if active else []
        self.quiet = self.liveness.quiet(now) if active else 0.0
        if self.quiet > 0.0 and quiet == 0.0:
            self._warn(f'nothing has been received for {self.quiet:.0f} s')
        for name in sorted(set(self.silent) - set(silent)):
            self._warn(f'{name} is silent while other sources are not')
        self.refused = self._refusals.update(
            self.received, counts + self.rejected, {**details, **self._details}, now)

    def reject(self, source: str, answer: Answer) -> None:
        """Count a message that cannot be used; log the first for each source and reason."""
        self.count(source, answer)
        self.warn_once(source, answer.reason, f'{source}: {answer.reason}: {answer.detail} '
                                              '(logged once, counted in diagnostics)')

    def count(self, source: str, answer: Answer) -> None:
        """Count a message that cannot be used."""
        self.rejected[source, answer.reason] += 1
        self._details[source, answer.reason] = answer.detail

    def warn_once(self, about: str, what: str, sentence: str) -> None:
        """
        Log a sentence, once for each pair of the first two arguments.

        Parameters
        ----------
        about, what, sentence : str
            The first two: a source and a reason, or a parameter and a value.

        """
        if (about, what) not in self._warned:
            self._warned.add((about, what))
            self._warn(sentence)
