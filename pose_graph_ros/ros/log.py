# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All that this process logs by Python's logging, to the logger of the node; imports no rclpy.

So it reaches /rosout with the node's name, at the level that was asked for. What repeats, such as
an error with each message, is left out and counted.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Iterator
import logging
import math
import re
import time
import traceback
from typing import Any

from pose_graph_ros.core.judgement.texts import joined, number_of, seconds
from pose_graph_ros.core.judgement.verdicts import Change, Judged, State

# For which a warning, an error or a way of changes of verdicts is logged once [s].
REPEAT_PERIOD = 10.0
# For so long at most so many of one line of code, whatever they say.
MOST_LINES = 20
# Numbers, and what is quoted, which may come from messages, do not make it another message.
VARYING = re.compile(r"""(?<!\w)(?:[-+]?\d[\w.+-]*|'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")""")
ANSWER = {'is_answer': True}
"""Argument `extra` of logging functions for what a person has asked for."""
PACKAGE = __name__.partition('.')[0]


class NodeLog(logging.Handler):
    """Passes records to the logger of a node, from its creation until it is closed."""

    def __init__(self, logger: Any) -> None:
        super().__init__()
        self._logger = logger
        # of messages that are like one another, when one was logged [s], and how many came since
        self._logged: dict[tuple[object, ...], float] = {}
        self._left_out: Counter[tuple[object, ...]] = Counter()
        # of lines of code when the newest were logged [s]
        self._lines = defaultdict[tuple[str, int], deque[float]](
            lambda: deque([-math.inf] * MOST_LINES, MOST_LINES))
        logging.getLogger().addHandler(self)
        # the node's logger has a level of its own
        logging.getLogger(PACKAGE).setLevel(logging.DEBUG)

    def emit(self, record: logging.LogRecord) -> None:
        """
        Log a record; a warning or an error like another one only after a `REPEAT_PERIOD`.

        So is what has a way in which verdicts have changed: `extra={'way': ...}`.
        Those that answer a person are always logged: `extra=ANSWER`. Of no line of code are there
        more than `MOST_LINES` in that time.
        """
        try:
            repeats = hasattr(record, 'way') or (
                record.levelno >= logging.WARNING and not hasattr(record, 'is_answer'))
            if (left_out := self._left_out_before(record, repeats=repeats)) < 0:
                return
            text = self.format(record) + (
                f' ({left_out} more like it before)' if left_out > 0 else '')
            # a line for each level: rclpy lets no line of code change its level
            if record.levelno >= logging.CRITICAL:
                self._logger.fatal(text)
            elif record.levelno >= logging.ERROR:
                self._logger.error(text)
            elif record.levelno >= logging.WARNING:
                self._logger.warning(text)
            elif record.levelno >= logging.INFO:
                self._logger.info(text)
            else:
                self._logger.debug(text)
        except Exception:
            self.handleError(record)

    def _left_out_before(self, record: logging.LogRecord, *, repeats: bool) -> int:
        """Return how many records like this one were left out; -1 if this one is to be, too."""
        line, now = (record.pathname, record.lineno), time.monotonic()
        if now - self._lines[line][0] < REPEAT_PERIOD:
            self._left_out[line] += 1
            return -1
        if (count := self._repeated(record, now) if repeats else 0) >= 0:
            self._lines[line].append(now)
            count += self._left_out.pop(line, 0)
        return count

    def _repeated(self, record: logging.LogRecord, now: float) -> int:
        """Return the same by what records say."""
        if (key := getattr(record, 'way', None)) is None:
            key = record.levelno, record.pathname, record.lineno, VARYING.sub(
                '', record.getMessage())
            if record.exc_info and record.exc_info[2] is not None:
                raised = traceback.extract_tb(record.exc_info[2])[-1]
                key += raised.filename, raised.lineno
        if now - self._logged.get(key, -math.inf) < REPEAT_PERIOD:
            self._left_out[key] += 1
            return -1
        if len(self._logged) > 1000:    # texts may come from messages, so without an end
            self._logged.clear()
            self._left_out.clear()
        self._logged[key] = now
        return self._left_out.pop(key, 0)

    def close(self) -> None:
        """Pass on no more records."""
        root = logging.getLogger()
        root.removeHandler(self)
        if not any(isinstance(handler, NodeLog) for handler in root.handlers):
            logging.getLogger(PACKAGE).setLevel(logging.NOTSET)
        super().close()


def verdict_lines(changes: list[Change], doubted: set[str]) -> Iterator[tuple[int, str, object]]:
    """
    Yield level, text and way of each way in which the states of constraints have changed.

    Not of fixes and poses of sources whose newest ones are all doubted: many are wrong at a time.
    """
    ways: dict[tuple[str, Judged, int, str], list[Change]] = {}
    for change in changes:
        if (change.before is not None and change.before.in_graph) and not change.after.in_graph:
            way = logging.WARNING, 'that had been believed {} thrown out'
        elif change.before is State.DOUBTED and change.after.in_graph:
            way = logging.INFO, 'that had been doubted {} now believed'
        elif change.kind is not Judged.FIX and change.after is State.DOUBTED:
            way = logging.INFO, '{} now doubted'
        else:
            continue
        if change.source not in doubted:
            ways.setdefault((change.source, change.kind, *way), []).append(change)
    for (source, kind, level, words), found in ways.items():
        how = words.format('is' if len(found) == 1 else 'are')
        which = joined([change.id for change in found])
        if kind is Judged.FIX and len(found) > 1:
            stamps = [change.stamp_ns for change in found]
            which = f'from {seconds(min(stamps))} to {seconds(max(stamps))}'
        yield (level, f'{source}: {number_of(len(found), kind)} {how}: {which}',
               (source, kind, words))
