# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From messages to measurements, with a count for everything; imports no rclpy."""

from collections import Counter
from collections.abc import Callable, Mapping
import time
from typing import Any

from pose_graph_ros.adapters.conversions import Message, stamp_ns
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.sources import Kind, NANOSECONDS, Source
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected
from pose_graph_ros.ros.liveness import Liveness
from pose_graph_ros.ros.refusals import Refusals
from pose_graph_ros.ros.time_jump import Decision, ReceivedMessage, TimeJumpDetector

PAUSED = rejected('paused', 'call ~/pause with false to resume')
BEFORE_JUMP = rejected('before_clock_jump', 'a message from before the clock was set back')
LONGEST_DOUBT = 1.0  # messages that are held back are released if no other comes for so long [s]


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
        self.time_jumps = TimeJumpDetector(_threshold_ns(values))
        self._warn = warn
        self._warned: set[tuple[str, str]] = set()
        self._received_at = 0.0
        self.paused = False  # whether all measurements are rejected
        self._clear()

    def _clear(self) -> None:
        self.received: Counter[str] = Counter()  # number of messages by source
        self.rejected: Counter[tuple[str, str]] = Counter()  # number by source and reason
        self._details: dict[tuple[str, str], str] = {}  # of the newest by source and reason
        self.posted = 0  # number of measurements that were handed to the engine
        self.liveness = Liveness([source.name for source in self.reader.sources.values()
                                  if source.kind is Kind.LOOP_CLOSURE])
        self._refusals = Refusals()
        self.silent: list[str] = []  # sources that are silent while others are not
        self.quiet = 0.0  # for how long nothing at all has come, if that is long [s]
        self.refused: dict[str, str] = {}  # what to say of sources that all is refused from
        self.posted_at = time.monotonic()  # time of the last of them, by a monotonic clock [s]
        self.is_streaming = False  # whether any were posted since the final optimisation

    def configure(self, values: Mapping[str, Any]) -> None:
        """Set the parameters that can change while the node runs."""
        self.reader.configure(values)
        self.time_jumps.threshold_ns = _threshold_ns(values)

    def start_new_graph(self, values: Mapping[str, Any]) -> None:
        """Forget all messages but those of /tf_static; those that are held back stay so."""
        self.reader = MessageReader(values, self.reader.frames)
        self._clear()

    def receive(self, source: Source, message: Message, primary: str) -> Decision:
        """
        Return which messages can be read now, after counting a new one.

        Parameters
        ----------
        primary : str
            Name of the primary odometry, by whose stamps time is judged; empty for any odometry.

        """
        name = source.name
        self.received[name] += 1
        self.liveness.receive(name, time.monotonic())
        # the stamp is without `time_offset`: a change of that must not look like a jump of time
        is_primary = source.kind.is_odometry and primary in ('', name)
        decision = self.time_jumps.receive(
            ReceivedMessage(name, message, stamp_ns(message), is_primary))
        self._received_at = time.monotonic()
        if decision.is_old:
            self.reject(name, BEFORE_JUMP)
        return decision

    def release_overdue(self) -> list[ReceivedMessage]:
        """Remove and return the messages that were held back if no other has come for long."""
        overdue = time.monotonic() - self._received_at > LONGEST_DOUBT
        return self.time_jumps.release() if overdue else []

    def read(self, received: ReceivedMessage) -> OdometrySample | Measurement | None:
        """Return the measurement of a message; None if it cannot be used."""
        try:
            measurement = self.reader.read(received.source, received.message)
        except Exception as error:
            measurement = rejected('malformed', f'{type(error).__name__}: {error}')
        if isinstance(measurement, Answer):
            self.reject(received.source, measurement)
            return None
        return measurement

    def post(
        self, source: str, measurement: OdometrySample | Measurement,
        post: Callable[[str, OdometrySample | Measurement], bool],
    ) -> None:
        """
        Hand a measurement to the engine, unless the input is paused.

        Parameters
        ----------
        measurement : OdometrySample or Measurement
        post : callable, `Worker.post`

        """
        if self.paused:
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

    def refuse(self, source: str, error: Exception) -> None:
        """Count a message that cannot be deserialised."""
        self.received[source] += 1
        self.liveness.receive(source, time.monotonic())
        self.reject(source, rejected('malformed', str(error)))

    def reject(self, source: str, answer: Answer) -> None:
        """Count a message that cannot be used; log the first for each source and reason."""
        self.rejected[source, answer.reason] += 1
        self._details[source, answer.reason] = answer.detail
        self.warn_once(source, answer.reason, f'{source}: {answer.reason}: {answer.detail} '
                                              '(logged once, counted in diagnostics)')

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


def _threshold_ns(values: Mapping[str, Any]) -> int:
    return round(values['clock_jump_threshold'] * NANOSECONDS)
