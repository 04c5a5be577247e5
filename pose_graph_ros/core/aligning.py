# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
When the graph is turned into the map, and when that is done over.

The first measurements that tell the angle turn the graph. Each time that twice as many have come
they are all judged again: the first few may have been wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import alignment, se2
from pose_graph_ros.core.alignment import ALIGNING_SIGMA, Turn
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.consensus import Lifetime
from pose_graph_ros.core.constraints import full, ObservedKind, ObservedNodes, upper
from pose_graph_ros.core.estimate import AlignmentState
from pose_graph_ros.core.hidden_nodes import HiddenNodes
from pose_graph_ros.core.joining import Bound
from pose_graph_ros.core.saved_columns import Integers, Rows3, Rows6
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sources import MeasurementSource, OdometryNoise

# With so many measurements the angle has been judged often enough.
LAST_VERDICT = 4096
# The first verdict over one that has turned the graph comes with so many.
FIRST_VERDICT = 8


@dataclass(frozen=True, slots=True)
class SavedAlignment:
    """What is known of the angle between odometry and map, and the measurements that tell it."""

    state: str
    sigma: float | None
    """[rad]; None for infinite."""
    next_verdict: int
    sources: tuple[str, ...]
    source: Integers
    """Index of each measurement's source."""
    stamps_ns: Integers
    node: Integers
    offset: Rows3
    mean: Rows3
    information: Rows6
    kind: Integers


class Heard(NamedTuple):
    """A measurement that has told of the angle."""

    source: str
    stamp_ns: int
    observed: ObservedNodes


class Aligning:
    """
    Knows whether the graph lies in the map, and by what.

    Parameters
    ----------
    config : BackendConfig

    """

    def __init__(self, config: BackendConfig) -> None:
        self._config = config
        self.state = AlignmentState.LOCAL
        self.sigma = np.inf
        """Of the angle when it was found [rad]."""
        self._heard: list[Heard] = []
        self._next_verdict = FIRST_VERDICT

    def configure(self, config: BackendConfig) -> None:
        """Take other settings, for verdicts from now on, over all that has come."""
        self._config = config

    def find(self, poses: FloatArray, waiting: list[Bound], lead: str) -> FloatArray | None:
        """
        Return the motion of the graph into the map, once what waits for it tells.

        Parameters
        ----------
        poses : ndarray, shape (N, 3)
            Hidden nodes.
        waiting : list of Bound
            Measurements on them.
        lead : str
            Source of the odometry.

        """
        if self.state is AlignmentState.ALIGNED or len(waiting) == 0:
            return None
        where = placed(waiting)
        if len(where) == 0:
            return None  # where the robot is, nobody has said
        turn = alignment.find_turn(
            poses, _table(where), self._config.alignment, self._noise(lead),
            self._lifetime([_heard(bound) for bound in where]))
        pointed = [bound for bound in waiting if _kind(bound) == ObservedKind.HEADING]
        if len(pointed) > 0:
            by_heading = _turned_by_heading(poses, _table(pointed), _table(where))
            if by_heading.sigma < min(turn.sigma, ALIGNING_SIGMA):
                turn = by_heading
        self.state = (AlignmentState.UNALIGNED if turn.T_map_graph is None
                      else AlignmentState.ALIGNED)
        self.sigma = turn.sigma
        return turn.T_map_graph

    def hear(self, joined: list[Bound]) -> None:
        """Remember measurements that have joined the graph, for the next verdict."""
        if self._next_verdict <= LAST_VERDICT:
            self._heard += map(_heard, placed(joined))

    def settle(self) -> None:
        """Judge no more: the path is not what odometry alone tells."""
        self._heard.clear()
        self._next_verdict = LAST_VERDICT + 1

    def judge_again(self, solved: FloatArray, nodes: HiddenNodes) -> FloatArray | None:
        """
        Return the motion from the odometry frame into the map if the angle in use is wrong.

        That is looked at only when twice as many measurements have come as the last time.

        Parameters
        ----------
        solved : ndarray, shape (N, 3)
            All rows of the graph in the map, as they are in use.
        nodes : HiddenNodes

        """
        if self.state is not AlignmentState.ALIGNED or len(self._heard) < self._next_verdict:
            return None
        self._next_verdict = 2 * len(self._heard)
        table = _table(self._heard)
        table = ObservedNodes(
            np.searchsorted(nodes.rows, table.node), *table.columns[1:])
        turn = alignment.judge_again(
            solved[nodes.rows], nodes.odometry, table, self._config.alignment,
            self._noise(nodes.lead), correlation=self._lifetime(self._heard), sigma=self.sigma)
        if self._next_verdict > LAST_VERDICT:
            self._heard.clear()
        if turn is None:
            return None
        self.sigma = turn.sigma
        return turn.T_map_graph

    def _noise(self, lead: str) -> OdometryNoise:
        return self._config.odometry_source(lead).noise

    def _lifetime(self, heard: list[Heard]) -> Lifetime:
        times = {name: source.correlation_time
                 for name, source in self._config.measurements.items()}
        default = MeasurementSource().correlation_time
        return Lifetime(
            np.array([each.stamp_ns for each in heard]) * 1e-9,
            np.array([times.get(each.source, default) for each in heard]))

    def copy(self) -> tuple[AlignmentState, float]:
        """Return what `restore` takes."""
        return self.state, self.sigma

    def restore(self, state: tuple[AlignmentState, float]) -> None:
        """Undo what has been found: the graph could not be turned."""
        self.state, self.sigma = state

    def saved(self) -> SavedAlignment:
        """Return what is known."""
        table = _table(self._heard)
        names = tuple(dict.fromkeys(each.source for each in self._heard))
        source, stamps = (np.array(numbers, dtype=np.int64) for numbers in (
            [names.index(each.source) for each in self._heard],
            [each.stamp_ns for each in self._heard]))
        return SavedAlignment(
            self.state.value, float(self.sigma) if np.isfinite(self.sigma) else None,
            self._next_verdict, names, source, stamps, table.node, table.offset, table.mean,
            upper(table.information), table.kind.astype(np.int64))

    def load(self, saved: SavedAlignment) -> None:
        """Take what `saved` has returned."""
        self.state = AlignmentState(saved.state)
        self.sigma = np.inf if saved.sigma is None else saved.sigma
        self._next_verdict = saved.next_verdict
        table = ObservedNodes(saved.node, saved.offset, saved.mean, full(saved.information),
                              saved.kind)
        self._heard = [
            Heard(saved.sources[source], stamp_ns, table.rows(slice(k, k + 1)))
            for k, (source, stamp_ns) in enumerate(
                zip(saved.source.tolist(), saved.stamps_ns.tolist(), strict=True))]


def placed(bounds: list[Bound]) -> list[Bound]:
    """Return those that say where the robot is, not only which way it points."""
    return [bound for bound in bounds if _kind(bound) != ObservedKind.HEADING]


def _kind(bound: Bound) -> ObservedKind:
    return ObservedKind(int(bound.observed.kind[0]))


def _heard(bound: Bound) -> Heard:
    return Heard(bound.source, bound.measurement.stamp_ns, bound.observed)


def _table(bounds: Sequence[Bound | Heard]) -> ObservedNodes:
    return ObservedNodes.joined([bound.observed for bound in bounds])


def _turned_by_heading(
    poses: FloatArray, pointed: ObservedNodes, placed: ObservedNodes,
) -> Turn:
    """Return the motion that the surest of some headings gives, onto the mean of positions."""
    best = int(np.argmax(pointed.information[:, 2, 2]))
    node = int(pointed.node[best])
    theta = float(se2.wrap(
        pointed.mean[best, 2] - poses[node, 2] - pointed.offset[best, 2]))
    weight = np.trace(placed.information[:, :2, :2], axis1=1, axis2=2)
    predicted = se2.compose(poses[placed.node], placed.offset)[:, :2]
    shift = np.average(
        placed.mean[:, :2] - predicted @ se2.rotation(theta).T, axis=0, weights=weight)
    return Turn(np.array((*shift, theta)),
                float(1.0 / np.sqrt(pointed.information[best, 2, 2])), node)
