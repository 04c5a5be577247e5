# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What run.json is made from: a run at its end, and what was recorded on the way."""

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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

MOST_UPDATES = 2000  # in run.json
MOST_SILENCES = 20  # of a source that are told
MOST_REFUSED = 5000  # loop closures whose reasons are kept


class Update(NamedTuple):
    """An update, or the worst of several."""

    stamp_ns: StampNs
    nodes: int
    milliseconds: float
    chi2: float
    iterations: int  # -1 if unknown


def thinned(updates: Sequence[Update]) -> list[Update]:
    """Return at most `MOST_UPDATES`: neighbours become the last one with their longest time."""
    stride = 1
    while len(updates) // stride >= MOST_UPDATES:
        stride *= 2
    groups = [updates[k:k + stride] for k in range(0, len(updates), stride)]
    return [group[-1]._replace(milliseconds=max(each.milliseconds for each in group),
                               iterations=max(each.iterations for each in group))
            for group in groups]


def silent(stamps_ns: Sequence[StampNs], least_s: Seconds) -> FloatArray:
    """
    Return the longest silences of a source: begin and end [s], shape (K, 2).

    Stamps are in the order of arrival; the silence before a late one is not seen.
    """
    if len(stamps_ns) < 3:
        return np.empty((0, 2))
    newest = np.maximum.accumulate(np.array(stamps_ns, dtype=np.int64))
    lengths = np.diff(newest)
    longest = np.argsort(lengths, kind='stable')[-MOST_SILENCES:]
    others = np.delete(lengths, longest)
    usual = float(np.mean(others) if len(others) > 0 else np.median(lengths))
    found = np.sort(longest[lengths[longest] > max(least_s * 1e9, 8.0 * usual)])
    return np.column_stack((newest[found], newest[found + 1])) * 1e-9


@dataclass(slots=True)
class Recorder:
    """What is recorded of a run as it goes on."""

    updates: list[Update] = field(default_factory=list)
    n_updates: int = 0  # with those that were not recorded one by one
    stamps_ns: 'dict[str, array[int]]' = field(default_factory=dict)  # by source, as they came
    refused: dict[Key, str] = field(default_factory=dict)  # why, of the first loop closures

    def add_update(self, update: Update, count: int = 1) -> None:
        """Add the last of some updates, later than all others; the first loads the solver."""
        if self.n_updates > 0:
            self.updates.append(update)
        self.n_updates += count

    def add_measurement(self, source: str, stamp_ns: StampNs) -> None:
        """Add a measurement in the order of arrival; one without a stamp does not count."""
        if stamp_ns > 0:
            self.stamps_ns.setdefault(source, array('q')).append(stamp_ns)

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
