# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The journal: what an engine has accepted is on the disk after a second, whatever happens then.

Workers note measurements as they come, what is done between them, and the path that is published.
A thread of the journal writes all that to a `JournalFile` twice in each period. A checkpoint, the
whole state of the engine, replaces the log, so that the size of the file is bounded.
`core.recovery` makes an engine of what a file holds.
"""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
import contextlib
import logging
from pathlib import Path
import sqlite3
import threading
import time
from typing import Any

from pose_graph_ros.core.io import journal_file as jf
from pose_graph_ros.core.io.graph_files import SavedGraph
from pose_graph_ros.core.io.journal_file import Batch, Checkpoint, Entry, Found, KnownPath

logger = logging.getLogger(__name__)

RETRY = 5.0     # time after which a file that could not be written is tried again [s]
# Between two checkpoints, while measurements come, there is at least the first time, and so many
# times as long as the last one took [s].
LEAST, SHARE = 10.0, 50.0
IDLE = 1.0      # time without a measurement after which a checkpoint costs nobody anything [s]
LONGEST_WAIT = 1.0  # of a path for the disk [s]


class Chapter:
    """What one worker writes to the journal; that of a later one replaces it."""

    def __init__(self, journal: 'Journal', number: int, *, awaits_state: bool = False) -> None:
        self._journal, self.number = journal, number
        self.awaits_state = awaits_state  # whether nothing is written before a checkpoint
        self.base = 0, 0  # of measurements and acts that were found; set by the journal's thread
        self.taken = self._posted = self._acts = 0
        self._is_changed, self._cost, self._checked_at = True, 0.0, time.monotonic()

    def measured(self, source: str, measurement: jf.Measured) -> None:
        """Note a measurement that is handed to the engine."""
        self._posted, self._is_changed = self._posted + 1, True
        self._journal.put(self, Entry(self._posted, 0, source, measurement))

    def act(self, name: str, *values: object) -> None:
        """Note what the engine does now, after the measurements that are `taken`."""
        self._acts, self._is_changed = self._acts + 1, True
        self._journal.put(self, Entry(self.taken, self._acts, name, values))

    def keep_path(self, path: KnownPath) -> None:
        """Note the path that is about to be published; wait, not for long, until it is safe."""
        self._journal.put_at_once(self, path).wait(LONGEST_WAIT)

    def is_due(self, idle: float) -> bool:
        """Tell whether a checkpoint is due, given how long ago the newest measurement came [s]."""
        waited = time.monotonic() - self._checked_at
        if self._journal.has_gap:
            return waited > RETRY
        return self._is_changed and (
            idle > IDLE or waited > LEAST) and waited > SHARE * self._cost

    def begin_checkpoint(self) -> None:
        """Begin to copy the state: the next one is not due soon, also if this one fails."""
        self._checked_at = time.monotonic()

    def checkpoint(self, saved: SavedGraph, pending: Sequence[tuple[str, jf.Measured]]) -> None:
        """Note the state of the engine, in whose thread it was copied."""
        self._is_changed, self._cost = False, time.monotonic() - self._checked_at
        waiting = [(source, jf.plain(each)) for source, each in pending]
        self._journal.put(self, Checkpoint(saved, waiting, (self.taken, self._acts)))


Item = tuple[float, Chapter, Any, threading.Event | None]
"""When something was handed over [s], by whom, what, and what to set once it is written."""


class Journal:
    """
    Writes a journal; `take` returns what the file held.

    What is handed over is on the disk after `period` [s], if the disk is not slower; `lag` is the
    longest time that it took. If the file cannot be written, `failure` says why; from then on
    there is a gap, until a checkpoint can be written. `refusal` returns why a state that was found
    is not of here.
    """

    def __init__(self, path: Path, period: float,
                 refusal: Callable[[SavedGraph], str | None] = lambda _: None) -> None:
        self._found = Future[Found]()
        self.failure, self.lag, self.has_gap = '', 0.0, False
        self._file, self._period, self._refusal = jf.JournalFile(path), period, refusal
        self._items = deque[Item]()
        self._condition = threading.Condition()
        self._is_wanted = self._closing = False
        self._unusable = ''  # why what was found cannot be used
        # since there is a gap, measurements that the next checkpoint may not have
        self._left: list[Entry] = []
        self._n_chapters, self._chapter = 0, Chapter(self, 0)
        self._thread = threading.Thread(target=self._run, name='journal', daemon=True)
        self._thread.start()

    def take(self) -> Found:
        """Return what the file held, once it is read; only the first call does."""
        found, self._found = self._found.result(), Future()
        return found

    def begin(self, *, has_state: bool = False) -> Chapter:
        """
        Return the next chapter: the first one continues what was found, others replace it.

        One whose engine has a state from elsewhere begins with its first checkpoint.
        """
        self._n_chapters += 1
        chapter = Chapter(self, self._n_chapters, awaits_state=has_state)
        self.put(chapter, None)
        return chapter

    def put(self, chapter: Chapter, item: object) -> None:
        """Hand something over to be written within the period."""
        self._items.append((time.monotonic(), chapter, item, None))

    def put_at_once(self, chapter: Chapter, item: object) -> threading.Event:
        """Hand something over to be written now; return the event that it is."""
        event = threading.Event()
        self._items.append((time.monotonic(), chapter, item, event))
        with self._condition:
            self._is_wanted = True
            self._condition.notify()
        return event

    def set_aside(self, why: str) -> None:
        """Keep the file as it is, as no engine can be made of it, and write a new one."""
        self._unusable = why

    @property
    def size(self) -> int:
        """Size of the files [bytes]; 0 if they cannot be looked at."""
        with contextlib.suppress(OSError):
            return self._file.size
        return 0

    def close(self, timeout: float) -> bool:
        """Write what is left and end; return whether that is done within a time [s]."""
        with self._condition:
            self._closing = True
            self._condition.notify()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        found = Found()
        try:
            found = self._file.read(self._refusal)
            self._file.take(found)
        except Exception as error:
            self._fail(error)
        self._found.set_result(found)
        last = found.last
        del found
        while True:
            with self._condition:
                self._condition.wait_for(
                    lambda: self._is_wanted or self._closing, 0.5 * self._period)
                closing, self._is_wanted = self._closing, False
            items = [self._items.popleft() for _ in range(len(self._items))]
            batch = Batch()
            try:
                batch = self._batch(items, last)
                self._write(batch)
            except Exception as error:
                self._fail(error)
            if self.has_gap:
                taken = self._chapter.base[0] + self._chapter.taken
                self._left = [each for each in batch.entries
                              if each.act == 0 and each.number > taken]
            elif len(items) > 0:
                self.lag = max(self.lag, time.monotonic() - items[0][0])
            for *_, event in items:
                if event is not None:
                    event.set()
            if closing:
                self._file.close()
                return

    def _batch(self, items: Sequence[Item], found: tuple[int, int]) -> Batch:
        batch, self._left = Batch(entries=self._left), []
        for k, (_, chapter, item, _) in enumerate(items):
            if (chapter is not self._chapter if item is not None else any(
                    each is None and of.number > chapter.number for _, of, each, _ in items[k:])):
                continue    # of a chapter that was replaced
            if item is None and chapter.awaits_state and (chapter.number > 1 or found == (0, 0)):
                if not any(isinstance(each, Checkpoint) and of is chapter
                           for _, of, each, _ in items[k:]):
                    self._items.extendleft(reversed(items[k:]))
                    break
                chapter.awaits_state = False
            if item is None:
                self._chapter = chapter
                if chapter.number > 1:
                    batch = Batch(cleared=True)
                elif found > (0, 0):
                    chapter.base = found[0], found[1] + 1
                    batch.entries.append(Entry(*chapter.base, 'resume', []))
                continue
            number, act = chapter.base
            if isinstance(item, Checkpoint):
                last = number + item.last[0], act + item.last[1]
                batch.checkpoint, batch.path = item._replace(last=last), None
                batch.entries = [each for each in batch.entries if each[:2] > last]
            elif isinstance(item, KnownPath):
                batch.path = item
            elif item.act > 0:
                batch.entries.append(item._replace(
                    number=number + item.number, act=act + item.act))
            else:
                batch.entries.append(item._replace(
                    number=number + item.number, values=jf.plain(item.values)))
        return batch

    def _write(self, batch: Batch) -> None:
        if self._unusable != '':
            self._file.close()
            self._file.set_aside(self._unusable)
            self._unusable, self.has_gap = '', True
        if self._file.is_lost:
            self._fail(FileNotFoundError('it was removed or replaced'))
            self._file.close()
        if self.has_gap:
            if batch.checkpoint is None and not batch.cleared:
                return
            batch.cleared = True
        if batch.is_empty:
            return
        self._file.write(batch)
        if self.has_gap:
            logger.warning('the journal is written again')
        self.failure, self.has_gap = '', False

    def _fail(self, error: Exception) -> None:
        text = f'{self._file.path}: {error}'
        if text != self.failure:
            logger.error('the journal cannot be written: %s', text, exc_info=None if isinstance(
                error, sqlite3.Error | OSError) else error)
        self.failure, self.has_gap = text, True
