# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Beliefs that an update cannot change in its time, as its iterations diverge with them.

The graph is solved with them as a copy, part by part, between the updates (`smoother/trial.py`).
The result is adopted if they fit there. Trials that follow one another, with no update between
that could do without, have longer and longer pauses: also where nothing else succeeds any more,
they take a time in proportion to the drive.
"""

from collections.abc import Collection, Mapping
import math

import numpy as np

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.judgement import relative
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.smoother.trial import Trial

# Number of updates that diverge without a pause. After each further one the graph has to grow by
# this share of its size until the next trial, doubled so many times; so many updates that do not
# diverge make up for one.
WITHOUT_PAUSE, PAUSE, MOST_DOUBLINGS, MAKE_UP = 3, 0.01, 4, 3
# Number of nodes up to which there are no pauses, as solving for all takes a few milliseconds.
SMALL = 100


class ClosureTrial:
    """One trial at a time, and the closures that have to wait for its end."""

    def __init__(self, smoother: IncrementalSmoother) -> None:
        self._smoother = smoother
        self._trial: Trial | None = None
        self.changes: dict[int, State] = {}
        """The states that are tried, by the numbers of closures."""
        self.weights: dict[int, float] = {}
        """The weights that are tried, by the ids of edges."""
        self._is_set = False
        """Whether it is a whole set, whose residuals were compared already."""
        self.later: set[int] = set()
        """Numbers of closures that another update has diverged with meanwhile."""
        self._n_diverged = 0
        """Updates that have diverged, times `MAKE_UP`, less those that have not."""
        self._next_at = 0
        """Next id of a node from which on there may be another trial."""

    def begin(
        self, changes: Mapping[int, State], weights: Mapping[int, float],
        poses: FloatArray | None = None, observed: Mapping[int, float] | None = None,
    ) -> None:
        """
        Begin a trial, but during a pause; that of a whole set does not wait for its end.

        While another trial goes on, the closures are only noted for later.

        Parameters
        ----------
        changes : mapping, the states of closures that are tried, by number
        weights : mapping, the weights of their edges, by id
        poses : ndarray, shape (N, 3), optional, where it starts
        observed : mapping, optional, the weights of observed nodes that are tried, by id

        """
        if self._trial is not None:
            self.later.update(changes)
            return
        if poses is None and not self.may_solve():
            return
        self.changes, self.weights = dict(changes), dict(weights)
        self._is_set = poses is not None
        self._trial = self._smoother.trial(
            GraphUpdate(weigh_edges=self.weights, weigh_observed=observed or {}), poses)

    def may_solve(self) -> bool:
        """Tell whether all may be solved for now that an update has diverged, or in a pause."""
        self._n_diverged = min(
            self._n_diverged + MAKE_UP, MAKE_UP * (WITHOUT_PAUSE + MOST_DOUBLINGS))
        if self.is_pausing:
            return False
        graph = self._smoother.graph
        doublings = max(self._n_diverged // MAKE_UP - WITHOUT_PAUSE, 0)
        self._next_at = graph.next_ids.node + math.ceil(PAUSE * graph.n_nodes * 2**doublings)
        return True

    @property
    def is_due_or_pausing(self) -> bool:
        """Whether a copy is solved, or has to wait until the graph has grown."""
        return self._trial is not None or self.is_pausing

    @property
    def is_pausing(self) -> bool:
        """Whether the graph has to grow until the next trial, as too many updates diverge."""
        graph = self._smoother.graph
        return (self._n_diverged >= MAKE_UP * WITHOUT_PAUSE and graph.n_nodes > SMALL
                and graph.next_ids.node < self._next_at)

    def was_not_needed(self) -> None:
        """Shorten the next pause, as an update has changed beliefs without a trial."""
        self._n_diverged = max(self._n_diverged - 1, 0)

    @property
    def keeps_others_out(self) -> bool:
        """Whether updates diverge as long as a trial goes on."""
        return len(self.later) > 0

    def work(self) -> bool:
        """Do a part; tell whether there was any."""
        if self._trial is None:
            return False
        self._trial.work()
        return True

    @property
    def is_finished(self) -> bool:
        """Whether a trial has come to its end, and waits to be adopted or dropped."""
        return self._trial is not None and self._trial.result is not None

    @property
    def is_outdated(self) -> bool:
        """Whether the poses of the graph were set since, as an alignment with the map does."""
        return self._trial is not None and self._trial.is_outdated

    def misfits(self, table: ClosureTable) -> list[int]:
        """Return which of the closures that would be believed do not fit into the copy."""
        assert self._trial is not None
        assert self._trial.result is not None
        if self._is_set or self._trial.result.status is Status.FAILED:
            return []
        wanted = np.array(
            [k for k, state in self.changes.items() if state.in_graph], dtype=np.int64)
        fit = relative.residuals(self._trial.graph, table.rows(wanted))
        return list(map(int, wanted[~(fit <= GATE)]))

    def adopt(self) -> bool:
        """Replace the graph by the copy; tell whether that was possible."""
        assert self._trial is not None
        return self._smoother.adopt(self._trial).status is not Status.FAILED

    def forget(self, edges: Collection[int], numbers: Collection[int]) -> None:
        """
        Try no longer what has left the graph.

        Parameters
        ----------
        edges : collection of int, ids
        numbers : collection of int, closures

        """
        self.weights = {edge: weight for edge, weight in self.weights.items()
                        if edge not in edges}
        self.changes = {k: state for k, state in self.changes.items() if k not in numbers}
        self.later -= {*numbers}

    def renumber(self, new: IntArray) -> None:
        """Follow closures that have other numbers now: `new`, shape (M,), by the old ones."""
        self.changes = {int(new[k]): state for k, state in self.changes.items()}
        self.later = {int(new[k]) for k in self.later}

    def end(self) -> None:
        """Forget the trial, and who has waited."""
        self._trial, self.later = None, set()
