# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the log says when belief changes: once for a change, not for each message. Imports no ROS.

Changes of a source are gathered for a while and become one line. Of fixes and poses in the map,
many of which are wrong at a time, the log has the begin and the end of a time in which the newest
ones are doubted; single ones are only counted.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import logging
import math

from pose_graph_ros.core.judgement.texts import joined, number_of, seconds
from pose_graph_ros.core.judgement.verdicts import Change, Judged, SourceVerdicts, State

# Time between two lines on changes of the same source [s]; the log repeats nothing within 10 s.
PERIOD = 10.0
MOST_FOLLOWED = 100  # measurements that are doubted before their source is

Line = tuple[int, str]
"""Level of Python's logging, and text."""


@dataclass(slots=True)
class _Doubt:
    """A time in which the newest measurements of a source are doubted."""

    end_ns: int
    """Stamp of the newest of these [ns]."""
    n: int
    """How many there are."""


class Announcer:
    """Gathers changes of verdicts, and makes lines of the log of them."""

    def __init__(self) -> None:
        self._gathered: dict[str, dict[str, Change]] = {}
        """Changes that no line was made of, by source and id."""
        self._at: dict[str, float] = {}
        """When the last line of each source was made [s]."""
        self._doubts: dict[str, _Doubt] = {}
        self._newest: dict[str, list[Change]] = {}
        """New measurements that are doubted and follow one another, by source."""

    def lines(
        self, changes: Sequence[Change], totals: Mapping[str, SourceVerdicts], now: float,
        *, flush: bool = False,
    ) -> list[Line]:
        """
        Return the lines that are due.

        Parameters
        ----------
        changes : sequence of Change, since the last call
        totals : mapping, what is believed of each source
        now : float, time [s]
        flush : bool, whether all changes so far are due

        """
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
                    flush or now - self._at.get(source, -math.inf) >= PERIOD):
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
        del newest[:-MOST_FOLLOWED]

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
