# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements that wait for odometry to reach their stamps, and which ones have come before."""

from array import array
import bisect
import itertools
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.measurements import LoopClosure, Measurement
from pose_graph_ros.core.se2 import IntArray

# A sender whose clock is ahead must not fill the memory.
MAX_PENDING = 10_000


class Waiting(NamedTuple):
    """A measurement that waits."""

    due_ns: int
    arrival: int
    """So many came before it."""
    source: str
    measurement: Measurement


class Pending:
    """Measurements by the stamp at which they are due."""

    def __init__(self) -> None:
        self._waiting: list[Waiting] = []
        """The one that is due last first."""
        self._arrival = itertools.count()

    def __len__(self) -> int:
        return len(self._waiting)

    def push(self, source: str, measurement: Measurement) -> Waiting | None:
        """
        Let a measurement wait.

        Returns
        -------
        Waiting or None
            Where there are too many, that which would have to wait longest: a sender whose clock
            is ahead does not keep out the others.

        """
        waiting = Waiting(due_ns(measurement), next(self._arrival), source, measurement)
        bisect.insort(self._waiting, waiting, key=_last_first)
        return self._waiting.pop(0) if len(self) > MAX_PENDING else None

    @property
    def measurements(self) -> list[tuple[str, Measurement]]:
        """All that wait, with their sources."""
        return [(waiting.source, waiting.measurement) for waiting in self._waiting]

    def pop_due(self, covered_ns: int) -> list[Waiting]:
        """Hand out what is due, the oldest first."""
        at = bisect.bisect_left(self._waiting, (-covered_ns, -next(self._arrival)),
                                key=_last_first)
        due = self._waiting[at:]
        del self._waiting[at:]
        return due[::-1]


def _last_first(waiting: Waiting) -> tuple[int, int]:
    return -waiting.due_ns, -waiting.arrival


_NONE: 'array[int]' = array('q')


class Seen:
    """Which measurements have come before, by source and stamps: 16 bytes each."""

    def __init__(self) -> None:
        self._stamps: dict[str, array[int]] = {}
        self._references: dict[str, array[int]] = {}

    def has(self, source: str, measurement: Measurement) -> bool:
        """Tell whether there was one with the same stamp, and the same reference."""
        return self._find(source, measurement) >= 0

    def near(self, source: str, stamp_ns: int, period_ns: int) -> bool:
        """Tell whether a stamp of the source lies closer than a period to this one."""
        stamps = self._stamps.get(source, _NONE)
        at = bisect.bisect_left(stamps, stamp_ns)
        return ((at > 0 and stamp_ns - stamps[at - 1] < period_ns)
                or (at < len(stamps) and stamps[at] - stamp_ns < period_ns))

    def add(self, source: str, measurement: Measurement) -> None:
        """Add a measurement; in order it costs nothing."""
        stamps = self._stamps.setdefault(source, array('q'))
        at = bisect.bisect_right(stamps, measurement.stamp_ns)
        stamps.insert(at, measurement.stamp_ns)
        self._references.setdefault(source, array('q')).insert(at, _reference(measurement))

    def remove(self, source: str, measurement: Measurement) -> None:
        """Forget a measurement that has been added."""
        at = self._find(source, measurement)
        if at >= 0:
            del self._stamps[source][at], self._references[source][at]

    def saved(
        self, without: list[tuple[str, Measurement]],
    ) -> dict[str, tuple[IntArray, IntArray]]:
        """Return stamps and references, shape (M,) each, of each source but for some of them."""
        left_out: dict[str, list[int]] = {}
        for source, measurement in without:
            left_out.setdefault(source, []).append(self._find(source, measurement))
        result = {}
        for source, stamps in self._stamps.items():
            rows = [at for at in left_out.get(source, ()) if at >= 0]
            result[source] = (np.delete(np.array(stamps), rows),
                              np.delete(np.array(self._references[source]), rows))
        return result

    def restore(self, source: str, stamps_ns: IntArray, references: IntArray) -> None:
        """Take what `saved` has returned for a source."""
        self._stamps[source] = array('q', stamps_ns.tolist())
        self._references[source] = array('q', references.tolist())

    def _find(self, source: str, measurement: Measurement) -> int:
        stamps = self._stamps.get(source)
        if stamps is None:
            return -1
        begin = bisect.bisect_left(stamps, measurement.stamp_ns)
        end = bisect.bisect_right(stamps, measurement.stamp_ns)
        reference, references = _reference(measurement), self._references[source]
        return next((at for at in range(begin, end) if references[at] == reference), -1)


def due_ns(measurement: Measurement) -> int:
    """Return the stamp [ns] that odometry must have reached."""
    if isinstance(measurement, LoopClosure) and measurement.reference_ns is not None:
        return max(measurement.stamp_ns, measurement.reference_ns)
    return measurement.stamp_ns


def _reference(measurement: Measurement) -> int:
    """Return what tells a measurement from others at its stamp."""
    if not isinstance(measurement, LoopClosure):
        return 0
    if measurement.reference_ns is not None:
        return measurement.reference_ns
    return -1 if measurement.reference_node is None else -2 - measurement.reference_node
