# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All that this process logs by Python's logging, to the logger of the node; imports no rclpy.

So it reaches /rosout with the node's name, at the level that was asked for. What repeats, such as
an error with each message, is left out and counted.
"""

from dataclasses import dataclass
import logging
import re
import time
from typing import Any

PERIOD = 10.0  # for which a warning or an error is logged once [s]
FLUSH_PERIOD = 2.0  # of the calls of `NodeLog.flush` [s]
NUMBER = re.compile(r'(?<!\w)[-+]?\d[\w.+-]*')  # numbers do not make it another message
ANSWER = {'is_answer': True}
"""Argument `extra` of logging functions for what a person has asked for."""
PACKAGE = __name__.partition('.')[0]


@dataclass(slots=True)
class _Logged:
    at: float  # time of the message [s]
    level: int
    left_out: int = 0  # how many like it came since
    newest: str = ''  # the first line of the last of them


class NodeLog(logging.Handler):
    """
    Passes records to the logger of a node, from its creation until it is closed.

    Parameters
    ----------
    logger : rclpy.impl.rcutils_logger.RcutilsLogger

    """

    def __init__(self, logger: Any) -> None:
        super().__init__()
        self._logger = logger
        self._logged: dict[tuple[object, ...], _Logged] = {}
        logging.getLogger().addHandler(self)
        # the node's logger has a level of its own
        logging.getLogger(PACKAGE).setLevel(logging.DEBUG)

    def emit(self, record: logging.LogRecord) -> None:
        """
        Log a record; a warning or an error like another one only after a `PERIOD`.

        Those that answer a person are always logged: `extra=ANSWER`.
        """
        try:
            if (record.levelno < logging.WARNING or hasattr(record, 'is_answer')
                    or self._is_new(record)):
                self._log(record.levelno, self.format(record))
        except Exception:
            self.handleError(record)

    def _is_new(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        key = (record.levelno, record.pathname, record.lineno, NUMBER.sub('', text),
               _raised_at(record))
        now, before = time.monotonic(), self._logged.get(key)
        if before is not None and now - before.at < PERIOD:
            before.left_out += 1
            before.newest = text.partition('\n')[0]
            return False
        self._forget(key, now)
        self._logged[key] = _Logged(now, record.levelno)
        return True

    def flush(self) -> None:
        """Log how many records were left out, of those that can be logged again."""
        self._flush(PERIOD)

    def close(self) -> None:
        """Pass on no more records."""
        root = logging.getLogger()
        root.removeHandler(self)
        if not any(isinstance(handler, NodeLog) for handler in root.handlers):
            logging.getLogger(PACKAGE).setLevel(logging.NOTSET)
        self._flush(0.0)
        super().close()

    def _flush(self, age: float) -> None:
        now = time.monotonic()
        self.acquire()
        try:
            for key in [key for key, logged in self._logged.items() if now - logged.at >= age]:
                self._forget(key, now)
        finally:
            self.release()

    def _forget(self, key: tuple[object, ...], now: float) -> None:
        """Forget a message, and log how many like it were left out."""
        logged = self._logged.pop(key, None)
        if logged is not None and logged.left_out > 0:
            self._log(logged.level, f'{logged.newest} ({logged.left_out} more like it in '
                                    f'{now - logged.at:.0f} s)')

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


def _raised_at(record: logging.LogRecord) -> tuple[str, int] | None:
    """Return file and line where the exception of a record was raised."""
    traceback = record.exc_info[2] if record.exc_info else None
    if traceback is None:
        return None
    while traceback.tb_next is not None:
        traceback = traceback.tb_next
    return traceback.tb_frame.f_code.co_filename, traceback.tb_lineno
