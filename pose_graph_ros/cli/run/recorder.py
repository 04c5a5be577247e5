# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What run.json is made from: a run at its end, and what was recorded on the way, bounded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import heapq
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.cli.evaluation import Drive, ErrorRow
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate, UpdateReport
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.measurements import Answer, AnswerStatus, LoopClosure, Measurement

MOST_UPDATES = 2000
"""Number of updates that are kept: of more, two neighbours become one with the longer time."""
MOST_SILENCES = 20
"""Number of the longest silences of a source that are kept."""
MOST_REFUSED = 5000
"""Number of refused loop closures whose reasons are kept."""


class Update(NamedTuple):
    """An update, or the worst of several."""

    stamp_ns: int
    nodes: int
    milliseconds: float
    chi2: float
    iterations: int
    """-1 if unknown."""


class UpdateLog:
    """Updates in the order of time, at most `MOST_UPDATES` of them."""

    def __init__(self) -> None:
        self._kept: list[Update] = []
        self._open: Update | None = None
        self._n_open, self._stride = 0, 1
        self.count = 0
        """Number of all updates."""

    def add(self, update: Update) -> None:
        """Add an update, which is later than the others; the first one only loads the solver."""
        self.count += 1
        if self.count == 1:
            return
        self._open = update if self._open is None else _joined(self._open, update)
        self._n_open += 1
        if self._n_open < self._stride:
            return
        self._kept.append(self._open)
        self._open, self._n_open = None, 0
        if len(self._kept) >= MOST_UPDATES:
            self._kept = [_joined(*pair) for pair in zip(
                self._kept[::2], self._kept[1::2], strict=True)]
            self._stride *= 2

    @property
    def updates(self) -> list[Update]:
        """The updates that are kept."""
        return [*self._kept, *([] if self._open is None else [self._open])]


def _joined(first: Update, second: Update) -> Update:
    """Return the later of two updates with the larger time and number of iterations."""
    return second._replace(milliseconds=max(first.milliseconds, second.milliseconds),
                           iterations=max(first.iterations, second.iterations))


@dataclass(slots=True)
class Arrivals:
    """When the measurements of a source were made, and the longest silences between them."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    silences: list[tuple[int, int]] = field(default_factory=list)
    """Length and begin [ns], as a heap with the shortest first."""

    def add(self, stamp_ns: int) -> None:
        """Add a measurement; the silence before a late one is not seen."""
        if self.count == 0:
            self.first_ns = self.last_ns = stamp_ns
        elif stamp_ns > self.last_ns:
            silence = (stamp_ns - self.last_ns, self.last_ns)
            if len(self.silences) < MOST_SILENCES:
                heapq.heappush(self.silences, silence)
            elif silence > self.silences[0]:
                heapq.heapreplace(self.silences, silence)
            self.last_ns = stamp_ns
        self.count += 1

    def gaps(self, least_s: float, periods: float) -> FloatArray:
        """
        Return the longest silences, in the order of time: begin and end [s], shape (K, 2).

        Parameters
        ----------
        least_s : float, shortest one [s]
        periods : float, the same in units of the usual period without these silences

        """
        if self.count < 3:
            return np.empty((0, 2))
        longest = sum(length for length, _ in self.silences)
        n = self.count - 1 - len(self.silences)
        usual = (self.last_ns - self.first_ns - longest) / max(n, 1)
        if n <= 0:
            usual = float(np.median([length for length, _ in self.silences]))
        limit = max(least_s * 1e9, periods * usual)
        found = sorted((begin, begin + length) for length, begin in self.silences
                       if length > limit)
        return np.array(found, dtype=np.float64).reshape(-1, 2) * 1e-9


@dataclass(slots=True)
class Recorder:
    """What is recorded of a run as it goes on."""

    log: UpdateLog = field(default_factory=UpdateLog)
    arrivals: dict[str, Arrivals] = field(default_factory=dict)
    refused: dict[Key, str] = field(default_factory=dict)
    """Why loop closures were refused, of the first `MOST_REFUSED`."""

    def add_measurement(self, source: str, stamp_ns: int) -> None:
        """
        Add a measurement in the order of arrival; one without a stamp does not count.

        Parameters
        ----------
        stamp_ns : int

        """
        if stamp_ns <= 0:
            return
        arrivals = self.arrivals.get(source)
        if arrivals is None:
            arrivals = self.arrivals[source] = Arrivals()
        arrivals.add(stamp_ns)

    def add_answer(self, source: str, measurement: Measurement, answer: Answer) -> None:
        """Add what was answered to a measurement at once."""
        if (answer.status is AnswerStatus.REJECTED and isinstance(measurement, LoopClosure)
                and isinstance(measurement.reference_ns, int)
                and len(self.refused) < MOST_REFUSED):
            self.refused[source, measurement.stamp_ns, measurement.reference_ns] = (
                f'Refused ({answer.reason}): {answer.detail}.')


@dataclass(slots=True)
class Run:
    """A run at its end."""

    title: str
    subtitle: str
    drive: Drive
    backend: PoseGraphBackend
    estimate: Estimate
    """With its path, which is that of `drive`."""
    verdicts: Sequence[Verdict]
    recorder: Recorder
    values: Mapping[str, Any]
    """All parameters of the node."""
    kinds: Mapping[str, Kind]
    """Kinds of the sources that have a topic."""
    counts: Mapping[tuple[str, str], int]
    """Messages by source and answer."""
    rows: Sequence[ErrorRow]
    """Table of errors."""
    report: UpdateReport | None = None
    """Of the final optimisation; None if it was made elsewhere."""
    origin: MapOrigin | None = None
    """Of the map on the Earth; None if it is unknown."""
    seconds: float | None = None
    """Time that the run took [s]."""
    refused: Mapping[Key, str] = field(default_factory=dict)
    """Why loop closures were refused."""
    errors: dict[str, Any] | None = None
    """Errors over time, as in run.json."""

    @property
    def start_ns(self) -> int:
        """Stamp of the first pose of the path [ns]."""
        return int(self.drive.corrected.stamps_ns[0])
