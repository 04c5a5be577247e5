# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Decides which constraints the graph believes.

All judged constraints are rows of the graph, with weight 0 while they are not believed. Around an
update the judge is called three times: `before` weighs the new rows by what is believed so far,
`commit` or `rollback` says whether the update succeeded, and `after` judges again what may have
changed. It does a bounded part of that; `work` does the rest, part by part, between two updates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.config import BackendConfig, Robust
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.graph_view import DrawnRows
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closure_judge import ClosureJudge
from pose_graph_ros.core.judgement.closure_states import SavedClosures
from pose_graph_ros.core.judgement.verdicts import Change, Decision, SourceVerdicts, Verdict
from pose_graph_ros.core.measurements import Answer, LoopClosure
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import NewConstraint


@dataclass(frozen=True, slots=True)
class SavedJudgement:
    """Saved state of the judgement."""

    closures: SavedClosures


class Judge:
    """
    Judges the constraints of a graph; it knows no clock, and nothing of how they arrived.

    Parameters
    ----------
    smoother : IncrementalSmoother
    reweighting : Reweighting, of its constraints with a robust loss
    config : BackendConfig

    """

    def __init__(
        self, smoother: IncrementalSmoother, reweighting: Reweighting, config: BackendConfig,
    ) -> None:
        self._config = config
        self._closures = ClosureJudge(smoother, reweighting, config)

    def configure(self, config: BackendConfig) -> None:
        """Set the settings for later constraints."""
        self._config = config
        self._closures.configure(config)

    def before(
        self, new: Sequence[NewConstraint], change: GraphUpdate, now_ns: int,
    ) -> GraphUpdate:
        """
        Return an update in which the new rows have the weights that they begin with.

        Parameters
        ----------
        new : sequence of NewConstraint, what the new rows were made from
        change : GraphUpdate, that adds them
        now_ns : int, stamp of the newest odometry

        """
        first = self._closures.n_edges_of_graph
        closures = [
            one for one in new if one.is_edge and self._is_judged_closure(one, change, first)]
        if len(closures) == 0:
            return change
        numbers = np.array([one.row - first for one in closures])
        weights = change.edges.weight.copy()
        weights[numbers] = self._closures.before(
            closures, change.edges.rows(numbers), now_ns)
        edges = change.edges
        return change._replace(edges=type(edges)(
            edges.i, edges.j, edges.mean, edges.information, edges.kind, weights, edges.bias))

    def _is_judged_closure(self, one: NewConstraint, change: GraphUpdate, first: int) -> bool:
        number = one.row - first
        # one without a position, such as of the walls of a building, recognises no place
        return (change.edges.kind[number] == EdgeKind.LOOP_CLOSURE
                and bool(change.edges.information[number, 0, 0] > 0.0)
                and self._config.measurement_source(
                    one.source, LoopClosure).robust is Robust.JUDGED)

    def commit(self) -> None:
        """Keep what the last `before` has decided, after its update has succeeded."""
        self._closures.commit()

    def rollback(self) -> None:
        """Forget the constraints of the last `before`, as their update has failed."""
        self._closures.rollback()

    def after(self) -> None:
        """Judge again what an update may have changed, in bounded time."""
        self._closures.after()

    def work(self) -> bool:
        """Do a bounded part of what is left to be judged; tell whether there is more."""
        return self._closures.work()

    def verdicts(self, most_believed: int | None = None) -> list[Verdict]:
        """Return all verdicts, but of those that are believed only the newest of each source."""
        return self._closures.verdicts(most_believed)

    def drawn_rows(self) -> DrawnRows:
        """Return the rows of constraints that are drawn in another way than believed ones."""
        return self._closures.reports.drawn_rows()

    def changes(self) -> list[Change]:
        """Return the changes of verdicts since the last call."""
        return self._closures.states.take_changes()

    def totals(self) -> Mapping[str, SourceVerdicts]:
        """Return what is believed of each source, as a whole."""
        return self._closures.totals()

    def decide(self, name: str, decision: Decision) -> Answer:
        """
        Return the answer to a person's decision on a constraint, which is applied at once.

        Parameters
        ----------
        name : str, `Verdict.id`
        decision : Decision

        """
        return self._closures.decide(name, decision)

    def saved(self) -> SavedJudgement:
        """Return the state; what is left to be done is not part of it."""
        return SavedJudgement(self._closures.saved())

    def restore(self, saved: SavedJudgement) -> None:
        """Restore what `saved` has returned, for a graph with the same rows."""
        self._closures.restore(saved.closures)

    def finish(self) -> None:
        """Do all the work that is left, then decide on all by the graph alone."""
        while self.work():
            pass
        self._closures.decide_finally()
