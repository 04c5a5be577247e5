# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All that this process logs by Python's logging, to the logger of the node; imports no rclpy.

So it reaches /rosout with the node's name, at the level that was asked for. What repeats, such as
an error with each message, is left out and counted.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import logging
import math
import re
import time
import traceback
from typing import Any

from pose_graph_ros.core.judgement.texts import joined, number_of, seconds
from pose_graph_ros.core.judgement.verdicts import Change, Judged, SourceVerdicts, State
from pose_graph_ros.core.quantities import Seconds

# For which a warning or an error, or changes of the verdicts on a source, are logged once [s].
REPEAT_PERIOD = 10.0
NUMBER = re.compile(r'(?<!\w)[-+]?\d[\w.+-]*')  # numbers do not make it another message
ANSWER = {'is_answer': True}
"""Argument `extra` of logging functions for what a person has asked for."""
PACKAGE = __name__.partition('.')[0]


@dataclass(slots=True)
class _Logged:
    at: float  # time of the message [s]
    left_out: int = 0  # how many like it came since


class NodeLog(logging.Handler):
    """Passes records to the logger of a node, from its creation until it is closed."""

    def __init__(self, logger: Any) -> None:
        super().__init__()
        self._logger = logger
        self._logged: dict[tuple[object, ...], _Logged] = {}
        logging.getLogger().addHandler(self)
        # the node's logger has a level of its own
        logging.getLogger(PACKAGE).setLevel(logging.DEBUG)

    def emit(self, record: logging.LogRecord) -> None:
        """
        Log a record; a warning or an error like another one only after a `REPEAT_PERIOD`.

        Those that answer a person are always logged: `extra=ANSWER`.
        """
        try:
            left_out = 0
            if record.levelno >= logging.WARNING and not hasattr(record, 'is_answer'):
                left_out = self._repeated(record)
            if left_out >= 0:
                more = f' ({left_out} more like it before)' if left_out > 0 else ''
                self._log(record.levelno, self.format(record) + more)
        except Exception:
            self.handleError(record)

    def _repeated(self, record: logging.LogRecord) -> int:
        """Return how many records like this one were left out; -1 if this one is to be, too."""
        key = (record.levelno, record.pathname, record.lineno,
               NUMBER.sub('', record.getMessage()), _raised_at(record))
        now, before = time.monotonic(), self._logged.get(key)
        if before is not None and now - before.at < REPEAT_PERIOD:
            before.left_out += 1
            return -1
        if len(self._logged) > 1000:    # texts may come from messages, so without an end
            self._logged.clear()
        self._logged[key] = _Logged(now)
        return 0 if before is None else before.left_out

    def _log(self, level: int, text: str) -> None:
        # a line for each level: rclpy lets no line of code change its level
        if level >= logging.CRITICAL:
            self._logger.fatal(text)
        elif level >= logging.ERROR:
            self._logger.error(text)
        elif level >= logging.WARNING:
            self._logger.warning(text)
        elif level >= logging.INFO:
            self._logger.info(text)
        else:
            self._logger.debug(text)

    def close(self) -> None:
        """Pass on no more records."""
        root = logging.getLogger()
        root.removeHandler(self)
        if not any(isinstance(handler, NodeLog) for handler in root.handlers):
            logging.getLogger(PACKAGE).setLevel(logging.NOTSET)
        super().close()


def _raised_at(record: logging.LogRecord) -> tuple[str, int | None] | None:
    """Return file and line where the exception of a record was raised."""
    if not record.exc_info or record.exc_info[2] is None:
        return None
    raised = traceback.extract_tb(record.exc_info[2])[-1]
    return raised.filename, raised.lineno


# --- what is said when belief changes: once for a change, not for each message

Line = tuple[int, str]  # level of Python's logging, and text


@dataclass(slots=True)
class _Source:
    """What is not told yet of a source."""

    gathered: dict[str, Change] = field(default_factory=dict)   # by id
    said_at: Seconds = -math.inf    # when its last line was made
    doubting: bool = False          # whether its newest measurements are doubted
    # new ones that are doubted and follow one another: how many, stamps, number of the newest
    n: int = 0
    begin_ns: int = 0
    end_ns: int = 0
    newest: int = 0

    def add(self, change: Change) -> None:
        """Gather a change, but for what is back to what the last line said of it."""
        earlier = self.gathered.pop(change.id, change)
        if earlier.before is not change.after:
            self.gathered[change.id] = change._replace(before=earlier.before)
        if change.kind is not Judged.FIX or change.before is not None or change.after.in_graph:
            return
        number = int(change.id.rpartition('/')[2])
        if not self.doubting and number != self.newest + 1:
            self.n = 0
        if self.n == 0:
            self.begin_ns = self.end_ns = change.stamp_ns
        self.n, self.newest = self.n + 1, number
        self.begin_ns = min(self.begin_ns, change.stamp_ns)
        self.end_ns = max(self.end_ns, change.stamp_ns)

    def doubt(self, source: str, *, doubting: bool) -> Iterator[Line]:
        """Yield a line where a time begins or ends in which the newest ones are doubted."""
        if doubting and not self.doubting:
            since = '' if self.n == 0 else f' since {seconds(self.begin_ns)}'
            yield logging.WARNING, (f'{source}: its newest measurements are doubted{since}; the '
                                    'path goes on without them')
        if doubting or self.doubting:
            self.gathered = {
                name: change for name, change in self.gathered.items()
                if change.after.in_graph or change.before not in {None, State.WAITING}}
        if self.doubting and not doubting:
            yield logging.INFO, (
                f'{source}: its newest measurements are believed again; {self.n} of them, until '
                f'{seconds(self.end_ns)}, were doubted')
            self.n = 0
        self.doubting = doubting


class Announcer:
    """
    Gathers changes of verdicts, and makes lines of the log of them.

    Of fixes and poses in the map, many of which are wrong at a time, there are lines where a time
    begins and ends in which the newest ones are doubted; single ones are only counted.
    """

    def __init__(self) -> None:
        self._sources: defaultdict[str, _Source] = defaultdict(_Source)

    def lines(
        self, changes: Sequence[Change], totals: Mapping[str, SourceVerdicts], now: Seconds,
        *, flush: bool = False,
    ) -> list[Line]:
        """Return the lines that are due."""
        lines: list[Line] = []
        for change in changes:
            self._sources[change.source].add(change)
        for name, each in totals.items():
            lines += self._sources[name].doubt(name, doubting=each.doubting)
        for name, source in self._sources.items():
            if source.doubting or not (flush or now - source.said_at >= REPEAT_PERIOD):
                continue
            found = list(_lines(name, list(source.gathered.values())))
            source.gathered.clear()
            if len(found) > 0:
                source.said_at = now
                lines += found
        return lines


def _lines(source: str, changes: Sequence[Change]) -> Iterator[Line]:
    """Yield a line for each way in which the state of constraints has changed."""
    ways: dict[tuple[Judged, int, str], list[Change]] = {}
    for change in changes:
        was_in = change.before is not None and change.before.in_graph
        if was_in and not change.after.in_graph:
            key = change.kind, logging.WARNING, 'that had been believed {} thrown out'
        elif change.before is State.DOUBTED and change.after.in_graph:
            key = change.kind, logging.INFO, 'that had been doubted {} now believed'
        elif change.kind is not Judged.FIX and change.after is State.DOUBTED:
            key = change.kind, logging.INFO, '{} now doubted'
        else:
            continue
        ways.setdefault(key, []).append(change)
    for (kind, level, way), found in ways.items():
        how = way.format('is' if len(found) == 1 else 'are')
        yield level, f'{source}: {number_of(len(found), kind)} {how}: {_which(found)}'


def _which(changes: Sequence[Change]) -> str:
    """Return the ids of constraints; of many fixes, their first and last stamp."""
    stamps = [change.stamp_ns for change in changes]
    if changes[0].kind is Judged.FIX and len(changes) > 1:
        return f'from {seconds(min(stamps))} to {seconds(max(stamps))}'
    return joined([change.id for change in changes])
