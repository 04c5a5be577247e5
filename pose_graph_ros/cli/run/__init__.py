# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is known of a run, as the JSON object that `pose-graph report` makes a page of: run.json.

The engine at the end of a replay or a demo comes in, with the measurements that the path is
compared with and what was recorded on the way. The object has paths, measurements with what is
believed of them, residuals by source, the constraints under most tension, the updates, the pattern
of H, and sentences on what a person must know. Read first `document`, then `findings`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.cli.drive import consistency, Drive
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import Estimate, UpdateReport
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import Covariances, FloatArray, IntArray, Points
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.measurements import Answer, AnswerStatus, LoopClosure, Measurement
from pose_graph_ros.core.quantities import Seconds, StampNs

MOST_UPDATES = 2000  # in run.json


class Update(NamedTuple):
    """An update, or the worst of several."""

    stamp_ns: StampNs
    nodes: int
    milliseconds: float
    chi2: float


def thinned(updates: Sequence[Update]) -> list[Update]:
    """Return at most `MOST_UPDATES`: neighbours become the last one with their longest time."""
    stride = 1
    while len(updates) // stride >= MOST_UPDATES:
        stride *= 2
    groups = [updates[k:k + stride] for k in range(0, len(updates), stride)]
    return [group[-1]._replace(milliseconds=max(each.milliseconds for each in group))
            for group in groups]


@dataclass(slots=True)
class Recorder:
    """What is recorded of a run as it goes on."""

    updates: list[Update] = field(default_factory=list)
    n_updates: int = 0  # with those that were not recorded one by one
    refused: dict[Key, str] = field(default_factory=dict)  # why, of loop closures

    def add_update(self, update: Update, count: int = 1) -> None:
        """Add the last of some updates, later than all others; the first loads the solver."""
        if self.n_updates > 0:
            self.updates.append(update)
        self.n_updates += count

    def add_answer(self, source: str, measurement: Measurement, answer: Answer) -> None:
        """Add what was answered to a measurement at once."""
        if (answer.status is AnswerStatus.REJECTED and isinstance(measurement, LoopClosure)
                and isinstance(measurement.reference_ns, int)):
            self.refused[source, measurement.stamp_ns, measurement.reference_ns] = (
                f'Refused ({answer.reason}): {answer.detail}.')


@dataclass(frozen=True)
class Run:
    """A run at its end."""

    title: str
    subtitle: str
    drive: Drive  # whose corrected path is that of the engine
    backend: PoseGraphBackend
    recorder: Recorder
    values: Mapping[str, Any]  # all parameters of the node
    kinds: Mapping[str, Kind]  # of the sources that have a topic
    counts: Mapping[tuple[str, str], int]  # messages by source and answer
    report: UpdateReport  # of the final optimisation
    seconds: Seconds  # that the run took

    @property
    def start_ns(self) -> StampNs:
        """Stamp of the first pose of the path."""
        return int(self.drive.corrected.stamps_ns[0])

    @cached_property
    def estimate(self) -> Estimate:
        """The estimate at the end."""
        estimate = self.backend.estimate()
        assert estimate is not None, 'a run has a hidden node'
        return estimate

    @cached_property
    def verdicts(self) -> list[Verdict]:
        """What is believed at the end."""
        return self.backend.verdicts()

    @cached_property
    def covariances(self) -> Covariances:
        """Those of the path; raises `PoseGraphError` if the solver failed."""
        try:
            return self.backend.path_covariances(self.estimate)
        except ValueError as error:
            raise PoseGraphError(f'there are no covariances: {error}') from error

    @cached_property
    def degrees_of_freedom(self) -> int:
        """Measured coordinates with a weight, less unknowns."""
        graph = self.backend.graph
        information = graph.factors_by_row.information[graph.weights > 0.0]
        return int(np.count_nonzero(np.diagonal(information, axis1=1, axis2=2) > 0.0)) - int(
            np.sum(graph.dimension[~graph.fixed]))

    @cached_property
    def consistency(self) -> dict[str, dict[str, Any] | None]:
        """NEES of positions and poses, for JSON; empty without a truth or a solution."""
        return {} if self.drive.truth is None or self.report.status is Status.FAILED else (
            consistency(self.drive, self.covariances))


def rounded(values: npt.ArrayLike, digits: int = 3) -> list[Any]:
    """Return values as a list for JSON, None for those that are not finite."""
    array = np.round(np.asarray(values, dtype=np.float64), digits) + 0.0
    return [value if math.isfinite(value) else None for value in array.tolist()]


def number(value: float | None, digits: int = 4) -> float | None:
    """Return a number with some significant digits; None if it is not finite."""
    return None if value is None or not math.isfinite(value) else float(f'{value:.{digits}g}')


@dataclass(slots=True)
class Frame:
    """Where times and places of run.json begin, and the texts that its tables refer to."""

    start_ns: StampNs
    offset: FloatArray  # (2,) [m]
    texts: dict[str, int] = field(default_factory=dict)  # with their numbers, which are in order

    def seconds(self, stamps_ns: IntArray) -> list[float]:
        """Return stamps as seconds since the start."""
        return rounded((np.asarray(stamps_ns) - self.start_ns) * 1e-9)

    def places(self, points: Points, digits: int = 2) -> tuple[list[float], list[float]]:
        """Return x and y of points relative to the offset."""
        moved = np.asarray(points).reshape(-1, 2) - self.offset
        return rounded(moved[:, 0], digits), rounded(moved[:, 1], digits)

    def place(self, stamp_ns: StampNs, position: FloatArray) -> dict[str, float]:
        """Return time and place of a point."""
        (x,), (y,) = self.places(position[:2])
        return {'t': self.seconds(np.array([stamp_ns]))[0], 'x': x, 'y': y}

    def text(self, text: str) -> int:
        """Return the number of a text; -1 for an empty one."""
        return -1 if text == '' else self.texts.setdefault(text, len(self.texts))
