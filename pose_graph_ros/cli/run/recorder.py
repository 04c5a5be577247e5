# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What run.json is made from: a run at its end, and what was recorded on the way, bounded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import heapq
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.cli.drive import Drive
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate, UpdateReport
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.measurements import Answer, AnswerStatus, LoopClosure, Measurement
from pose_graph_ros.core.quantities import Seconds, StampNs

MOST_UPDATES = 2000  # that are kept: of more, two neighbours become one with the longer time
MOST_SILENCES = 20  # of a source that are kept, the longest
MOST_REFUSED = 5000  # loop closures whose reasons are kept


class Update(NamedTuple):
    """An update, or the worst of several."""

    stamp_ns: StampNs
    nodes: int
    milliseconds: float
    chi2: float
    iterations: int  # -1 if unknown


class UpdateLog:
    """Updates in the order of time, at most `MOST_UPDATES` of them, of `count`."""

    def __init__(self) -> None:
        self._kept: list[Update] = []
        self._open: list[Update] = []  # those that become the next one that is kept
        self._stride = 1
        self.count = 0

    def add(self, update: Update) -> None:
        """Add an update, which is later than the others; the first one only loads the solver."""
        self.count += 1
        if self.count == 1:
            return
        self._open.append(update)
        if len(self._open) < self._stride:
            return
        self._kept.append(_worst(*self._open))
        self._open = []
        if len(self._kept) >= MOST_UPDATES:
            self._kept = [_worst(*pair) for pair in zip(
                self._kept[::2], self._kept[1::2], strict=True)]
            self._stride *= 2

    @property
    def updates(self) -> list[Update]:
        """The updates that are kept."""
        return [*self._kept, *([_worst(*self._open)] if self._open else [])]


def _worst(*updates: Update) -> Update:
    """Return the last of some updates with the largest time and number of iterations."""
    return updates[-1]._replace(milliseconds=max(each.milliseconds for each in updates),
                                iterations=max(each.iterations for each in updates))


@dataclass(slots=True)
class Arrivals:
    """When the measurements of a source were made, and the longest silences between them."""

    count: int = 0
    first_ns: StampNs = 0
    last_ns: StampNs = 0
    silences: list[tuple[int, StampNs]] = field(default_factory=list)  # length, begin: a heap

    def add(self, stamp_ns: StampNs) -> None:
        """Add a measurement; the silence before a late one is not seen."""
        if self.count == 0:
            self.first_ns = self.last_ns = stamp_ns
        elif stamp_ns > self.last_ns:
            heapq.heappush(self.silences, (stamp_ns - self.last_ns, self.last_ns))
            if len(self.silences) > MOST_SILENCES:
                heapq.heappop(self.silences)
            self.last_ns = stamp_ns
        self.count += 1

    def gaps(self, least_s: Seconds, periods: float) -> FloatArray:
        """Return the longest silences, in the order of time: begin and end [s], shape (K, 2)."""
        if self.count < 3:
            return np.empty((0, 2))
        lengths = [length for length, _ in self.silences]
        others = self.count - 1 - len(lengths)
        usual = (self.last_ns - self.first_ns - sum(lengths)) / others if others > 0 else (
            float(np.median(lengths)))
        found = sorted((begin, begin + length) for length, begin in self.silences
                       if length > max(least_s * 1e9, periods * usual))
        return np.array(found, dtype=np.float64).reshape(-1, 2) * 1e-9


@dataclass(slots=True)
class Recorder:
    """What is recorded of a run as it goes on."""

    log: UpdateLog = field(default_factory=UpdateLog)
    arrivals: dict[str, Arrivals] = field(default_factory=dict)
    refused: dict[Key, str] = field(default_factory=dict)  # why, of the first loop closures

    def add_measurement(self, source: str, stamp_ns: StampNs) -> None:
        """Add a measurement in the order of arrival; one without a stamp does not count."""
        if stamp_ns > 0:
            self.arrivals.setdefault(source, Arrivals()).add(stamp_ns)

    def add_answer(self, source: str, measurement: Measurement, answer: Answer) -> None:
        """Add what was answered to a measurement at once."""
        if (answer.status is AnswerStatus.REJECTED and isinstance(measurement, LoopClosure)
                and isinstance(measurement.reference_ns, int)
                and len(self.refused) < MOST_REFUSED):
            self.refused[source, measurement.stamp_ns, measurement.reference_ns] = (
                f'Refused ({answer.reason}): {answer.detail}.')


@dataclass(frozen=True, slots=True)
class Run:
    """A run at its end."""

    title: str
    subtitle: str
    drive: Drive
    backend: PoseGraphBackend
    estimate: Estimate  # with its path, which is that of `drive`
    verdicts: Sequence[Verdict]
    recorder: Recorder
    values: Mapping[str, Any]  # all parameters of the node
    kinds: Mapping[str, Kind]  # of the sources that have a topic
    counts: Mapping[tuple[str, str], int]  # messages by source and answer
    report: UpdateReport | None = None  # of the final optimisation; None if made elsewhere
    origin: MapOrigin | None = None  # of the map on the Earth; None if it is unknown
    seconds: Seconds = 0.0  # that the run took; 0 if it is unknown
    refused: Mapping[Key, str] = field(default_factory=dict)  # why loop closures were refused

    @property
    def start_ns(self) -> StampNs:
        """Stamp of the first pose of the path."""
        return int(self.drive.corrected.stamps_ns[0])
