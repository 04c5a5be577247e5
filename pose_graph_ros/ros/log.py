# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All that this process logs by Python's logging, to the logger of the node; imports no rclpy.

So it reaches /rosout with the node's name, at the level that was asked for. What repeats, such as
an error with each message, is left out and counted.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import logging
import math
import re
import time
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


def _raised_at(record: logging.LogRecord) -> tuple[str, int] | None:
    """Return file and line where the exception of a record was raised."""
    traceback = record.exc_info[2] if record.exc_info else None
    if traceback is None:
        return None
    while traceback.tb_next is not None:
        traceback = traceback.tb_next
    return traceback.tb_frame.f_code.co_filename, traceback.tb_lineno


# --- what is said when belief changes: once for a change, not for each message

Line = tuple[int, str]  # level of Python's logging, and text


@dataclass(slots=True)
class _Doubt:
    """A time in which the newest measurements of a source are doubted."""

    end_ns: int  # stamp of the newest of these [ns]
    n: int  # how many there are


class Announcer:
    """
    Gathers changes of verdicts, and makes lines of the log of them.

    Of fixes and poses in the map, many of which are wrong at a time, there are lines where a time
    begins and ends in which the newest ones are doubted; single ones are only counted.
    """

    def __init__(self) -> None:
        self._gathered: dict[str, dict[str, Change]] = {}  # not told yet, by source and id
        self._at: dict[str, float] = {}  # when the last line of each source was made [s]
        self._doubts: dict[str, _Doubt] = {}
        # new measurements that are doubted and follow one another, by source
        self._newest: dict[str, list[Change]] = {}

    def lines(
        self, changes: Sequence[Change], totals: Mapping[str, SourceVerdicts], now: Seconds,
        *, flush: bool = False,
    ) -> list[Line]:
        """Return the lines that are due."""
        lines: list[Line] = []
        for change in changes:
            gathered = self._gathered.setdefault(change.source, {})
            earlier = gathered.get(change.id)
            gathered[change.id] = (
                change if earlier is None else change._replace(before=earlier.before))
            if gathered[change.id].before is change.after:
                # back to what the last line said of it; while a source is doubted for long, there
                # may be many of these
                del gathered[change.id]
            if _is_new_doubt(change):
                self._follow(change)
        for source, each in totals.items():
            lines += self._doubt(source, doubting=each.doubting)
        for source, gathered in self._gathered.items():
            if source in self._doubts or not (
                    flush or now - self._at.get(source, -math.inf) >= REPEAT_PERIOD):
                continue
            found = list(_lines(source, list(gathered.values())))
            gathered.clear()
            if len(found) > 0:
                self._at[source] = now
                lines += found
        return lines

    def _follow(self, change: Change) -> None:
        """Note a new measurement that is doubted; begin again if one before it is not."""
        newest = self._newest.setdefault(change.source, [])
        if len(newest) > 0 and _number(newest[-1]) + 1 != _number(change):
            newest.clear()
        newest.append(change)
        del newest[:-100]

    def _doubt(self, source: str, *, doubting: bool) -> Iterator[Line]:
        """Yield a line where a time begins or ends in which a source is doubted."""
        doubt, gathered = self._doubts.get(source), self._gathered.get(source, {})
        new = [change for change in gathered.values() if _is_new_doubt(change)]
        if doubting and doubt is None:
            # some of these may not be gathered any more
            begin = self._newest.get(source, [])
            stamps = [change.stamp_ns for change in begin]
            doubt = self._doubts[source] = _Doubt(
                max(stamps, default=0), sum(change.id not in gathered for change in begin))
            since = '' if len(stamps) == 0 else f' since {seconds(min(stamps))}'
            yield logging.WARNING, (f'{source}: its newest measurements are doubted{since}; the '
                                    'path goes on without them')
        if doubt is None:
            return
        doubt.n += len(new)
        doubt.end_ns = max([doubt.end_ns, *(change.stamp_ns for change in new)])
        for change in list(gathered.values()):
            if change.before in (None, State.WAITING) and not change.after.in_graph:
                del gathered[change.id]
        if not doubting:
            del self._doubts[source]
            yield logging.INFO, (
                f'{source}: its newest measurements are believed again; {doubt.n} of them, until '
                f'{seconds(doubt.end_ns)}, were doubted')


def _lines(source: str, changes: Sequence[Change]) -> Iterator[Line]:
    """Yield a line for each way in which the state of constraints has changed."""
    for kind in Judged:
        own = [change for change in changes if change.kind is kind]
        out = [change for change in own if _was_in(change) and not change.after.in_graph]
        back = [change for change in own
                if change.before is State.DOUBTED and change.after.in_graph]
        new = [] if kind is Judged.FIX else [
            change for change in own if not _was_in(change)
            and change.before is not State.DOUBTED and change.after is State.DOUBTED]
        if len(out) > 0:
            yield logging.WARNING, (
                f'{source}: {number_of(len(out), kind)} that had been believed '
                f'{_are(out)} thrown out: {_which(out)}')
        if len(new) > 0:
            yield logging.INFO, (
                f'{source}: {number_of(len(new), kind)} {_are(new)} now doubted: {_which(new)}')
        if len(back) > 0:
            yield logging.INFO, (
                f'{source}: {number_of(len(back), kind)} that had been doubted {_are(back)} now '
                f'believed: {_which(back)}')


def _is_new_doubt(change: Change) -> bool:
    return change.kind is Judged.FIX and change.before is None and not change.after.in_graph


def _number(change: Change) -> int:
    """Return which constraint of its source it is."""
    return int(change.id.rpartition('/')[2])


def _was_in(change: Change) -> bool:
    return change.before is not None and change.before.in_graph


def _are(changes: Sequence[Change]) -> str:
    return 'is' if len(changes) == 1 else 'are'


def _which(changes: Sequence[Change]) -> str:
    """Return the ids of constraints; of many fixes, their first and last stamp."""
    stamps = [change.stamp_ns for change in changes]
    if changes[0].kind is Judged.FIX and len(changes) > 1:
        return f'from {seconds(min(stamps))} to {seconds(max(stamps))}'
    return joined([change.id for change in changes])
