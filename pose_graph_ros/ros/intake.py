# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From messages to measurements, with a count for everything; no rclpy.

Each message is heard, perhaps held back while it is in doubt whether time has begun again, and
read. What cannot be used is counted by source and reason, and said once.
"""

from collections import Counter
from collections.abc import Callable, Mapping
import time
from typing import Any

from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected
from pose_graph_ros.ros.conversions import Message, stamp_ns
from pose_graph_ros.ros.hearing import Hearing
from pose_graph_ros.ros.reader import MessageReader
from pose_graph_ros.ros.rewind import Heard, Rewind, Taken
from pose_graph_ros.ros.sources import Kind, NANOSECONDS, Source

PAUSED = rejected('paused', 'call ~/pause with false to go on')
# So long a message is held back while nothing else comes that would tell what it is [s].
LONGEST_DOUBT = 1.0


class Intake:
    """
    Takes the messages of all sources.

    Parameters
    ----------
    values : mapping
        All checked parameters.
    say : callable
        Takes a sentence for the log.

    Raises
    ------
    ConfigError
        If they do not go together.

    """

    def __init__(self, values: Mapping[str, Any], say: Callable[[str], None]) -> None:
        self.reader = MessageReader(values)
        self.rewind = Rewind(_threshold_ns(values))
        self._say = say
        self._said: set[tuple[str, str]] = set()
        self._in_doubt_at = 0.0
        self.paused = False
        """Whether everything is refused."""
        self._clear()

    def _clear(self) -> None:
        self.received: Counter[str] = Counter()
        """Messages by source."""
        self.refused: Counter[tuple[str, str]] = Counter()
        """Messages that were of no use before the engine saw them, by source and reason."""
        self.posted = 0
        """Measurements that were handed to the engine."""
        self.hearing = Hearing([source.name for source in self.reader.sources.values()
                                if source.kind is Kind.LOOP_CLOSURE])
        self.heard_at = time.monotonic()
        """When the last usable message came [s], by a clock that is never set ..."""
        self.goes_on = False
        """... and whether one came since the stream was ended."""

    def configure(self, values: Mapping[str, Any]) -> None:
        """Take the parameters that can change while the node runs."""
        self.reader.configure(values)
        self.rewind.threshold_ns = _threshold_ns(values)

    def begin_anew(self, values: Mapping[str, Any]) -> None:
        """Forget all that was heard but /tf_static; what is held back stays so."""
        self.reader = self.reader.renewed(values)
        self._clear()

    def hear(self, source: Source, message: Message, lead: str) -> Taken:
        """
        Take a message; say which ones can be read now.

        Parameters
        ----------
        source : Source
        message : Message
        lead : str
            Name of the odometry that tells the time; empty for any.

        """
        name = source.name
        self.received[name] += 1
        self.hearing.hear(name, time.monotonic())
        # an offset that is changed while the node runs must not look like a jump of time
        taken = self.rewind.take(Heard(
            name, message, stamp_ns(message),
            source.kind is Kind.ODOMETRY and lead in ('', name)))
        self._in_doubt_at = time.monotonic()
        if taken.is_old:
            self.refuse(name, rejected(
                'before_clock_jump', 'a message of the time before the clock was set back'))
        return taken

    def overdue(self) -> list[Heard]:
        """Return what was held back long enough, as nothing has come to end the doubt."""
        late = time.monotonic() - self._in_doubt_at > LONGEST_DOUBT
        return self.rewind.release() if late else []

    def read(self, heard: Heard) -> OdometrySample | Measurement | None:
        """Read a message; None if it cannot be used."""
        try:
            measurement = self.reader.read(heard.source, heard.message)
        except Exception as error:
            measurement = rejected('malformed', f'{type(error).__name__}: {error}')
        if isinstance(measurement, Answer):
            self.refuse(heard.source, measurement)
            return None
        return measurement

    def post(
        self, source: str, measurement: OdometrySample | Measurement,
        post: Callable[[str, OdometrySample | Measurement], bool],
    ) -> None:
        """Hand a measurement to the engine, unless that is paused."""
        if self.paused:
            self.refuse(source, PAUSED)
        elif not post(source, measurement):
            self.refuse(source, rejected('inbox_full', 'the solver does not keep up'))
        else:
            self.posted += 1
            self.heard_at, self.goes_on = time.monotonic(), True

    def refuse(self, source: str, answer: Answer) -> None:
        """Count what cannot be used, and say so once for each source and reason."""
        self.refused[source, answer.reason] += 1
        self.say_once(source, answer.reason, f'{source}: {answer.reason}: {answer.detail} (said '
                                             'once, counted in diagnostics)')

    def say_once(self, about: str, what: str, sentence: str) -> None:
        """Say a sentence if nothing was said of this before."""
        if (about, what) not in self._said:
            self._said.add((about, what))
            self._say(sentence)


def _threshold_ns(values: Mapping[str, Any]) -> int:
    return round(values['clock_jump_threshold'] * NANOSECONDS)
