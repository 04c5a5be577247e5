# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements that wait for odometry to reach their stamps, and the stamps seen so far."""

from array import array
import bisect
import itertools
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.measurements import LoopClosure, PoseMeasurement

# Maximum number of waiting measurements; bounds the memory if the clock of a sender is ahead.
MAX_WAITING = 10_000


class WaitingMeasurement(NamedTuple):
    """A measurement that waits."""

    due_ns: int
    """Stamp that odometry must reach [ns]."""
    arrival: int
    """Number of measurements that arrived before it."""
    source: str
    measurement: PoseMeasurement


class WaitingMeasurements:
    """Waiting measurements, ordered by the stamp at which they are due."""

    def __init__(self) -> None:
        self._waiting: list[WaitingMeasurement] = []
        """In descending order of `due_ns`, then of `arrival`."""
        self._arrival = itertools.count()

    def __len__(self) -> int:
        return len(self._waiting)

    def push(self, source: str, measurement: PoseMeasurement) -> WaitingMeasurement | None:
        """
        Return the measurement that is dropped if too many wait with the one added, else None.

        Of more than `MAX_WAITING` it is the one due last. A sender whose clock is ahead thus does
        not displace the measurements of others.
        """
        waiting = WaitingMeasurement(due_ns(measurement), next(self._arrival), source, measurement)
        bisect.insort(self._waiting, waiting, key=_last_first)
        return self._waiting.pop(0) if len(self) > MAX_WAITING else None

    @property
    def measurements(self) -> list[tuple[str, PoseMeasurement]]:
        """All waiting measurements, with their sources."""
        return [(waiting.source, waiting.measurement) for waiting in self._waiting]

    def until(self, stamp_ns: int) -> list[tuple[str, PoseMeasurement]]:
        """Return the measurements due up to a stamp [ns], with their sources, earliest first."""
        return [(waiting.source, waiting.measurement) for waiting in itertools.takewhile(
            lambda waiting: waiting.due_ns <= stamp_ns, reversed(self._waiting))]

    def pop_due(self, covered_ns: int) -> list[WaitingMeasurement]:
        """Remove and return the measurements due up to a stamp [ns], the earliest first."""
        at = bisect.bisect_left(self._waiting, (-covered_ns, -next(self._arrival)),
                                key=_last_first)
        due = self._waiting[at:]
        del self._waiting[at:]
        return due[::-1]


def _last_first(waiting: WaitingMeasurement) -> tuple[int, int]:
    return -waiting.due_ns, -waiting.arrival


_NO_STAMPS: 'array[int]' = array('q')


class SeenStamps:
    """Stamps and references of the measurements seen so far, by source; 16 bytes each."""

    def __init__(self) -> None:
        self._stamps: dict[str, array[int]] = {}
        self._references: dict[str, array[int]] = {}

    def has(self, source: str, measurement: PoseMeasurement) -> bool:
        """Tell whether a measurement with the same stamp and reference was added."""
        return self._find(source, measurement) >= 0

    def near(self, source: str, stamp_ns: int, period_ns: int) -> bool:
        """Tell whether the source has a stamp closer than a period to a given one."""
        stamps = self._stamps.get(source, _NO_STAMPS)
        at = bisect.bisect_left(stamps, stamp_ns)
        return ((at > 0 and stamp_ns - stamps[at - 1] < period_ns)
                or (at < len(stamps) and stamps[at] - stamp_ns < period_ns))

    def add(self, source: str, measurement: PoseMeasurement) -> None:
        """Add a measurement, which is cheap if stamps come in order."""
        stamps = self._stamps.setdefault(source, array('q'))
        at = bisect.bisect_right(stamps, measurement.stamp_ns)
        stamps.insert(at, measurement.stamp_ns)
        self._references.setdefault(source, array('q')).insert(at, _reference(measurement))

    def remove(self, source: str, measurement: PoseMeasurement) -> None:
        """Remove a measurement, if it was added."""
        at = self._find(source, measurement)
        if at >= 0:
            del self._stamps[source][at], self._references[source][at]

    def forget(self, before_ns: int) -> None:
        """Forget all stamps before one [ns]: such measurements are refused for another reason."""
        for source, stamps in self._stamps.items():
            n = bisect.bisect_left(stamps, before_ns)
            del stamps[:n], self._references[source][:n]

    def saved(
        self, without: list[tuple[str, PoseMeasurement]],
    ) -> dict[str, tuple[IntArray, IntArray]]:
        """Return stamps and references, shape (M,) each, by source, without some measurements."""
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
        """
        Set what `saved` has returned for a source.

        Parameters
        ----------
        stamps_ns, references : ndarray of int64, shape (M,)

        """
        self._stamps[source] = array('q', stamps_ns.tolist())
        self._references[source] = array('q', references.tolist())

    def _find(self, source: str, measurement: PoseMeasurement) -> int:
        stamps = self._stamps.get(source)
        if stamps is None:
            return -1
        begin = bisect.bisect_left(stamps, measurement.stamp_ns)
        end = bisect.bisect_right(stamps, measurement.stamp_ns)
        reference, references = _reference(measurement), self._references[source]
        return next((at for at in range(begin, end) if references[at] == reference), -1)


def due_ns(measurement: PoseMeasurement) -> int:
    """Return the stamp that odometry must have reached to attach a measurement [ns]."""
    if isinstance(measurement, LoopClosure) and measurement.reference_ns is not None:
        return max(measurement.stamp_ns, measurement.reference_ns)
    return measurement.stamp_ns


def _reference(measurement: PoseMeasurement) -> int:
    """
    Return a number that distinguishes measurements of a source with the same stamp.

    It is the stamp of the reference of a loop closure, -2 - k for hidden node k as its reference,
    and 0 for all other measurements.
    """
    if not isinstance(measurement, LoopClosure):
        return 0
    if measurement.reference_ns is not None:
        return measurement.reference_ns
    return -1 if measurement.reference_node is None else -2 - measurement.reference_node
