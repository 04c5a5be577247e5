# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The weights of robust losses, and the refinement of the estimate between two updates."""


from collections.abc import Mapping

import numpy as np

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.error_tuner import ErrorTuner
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.reweighting import TUNING
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.smoother import incremental as inc
from pose_graph_ros.core.transaction import checked, Transaction

# Constraints with a loss that are looked at in turn without a change after an update.
LOOKED_AT = 2 * TUNING.part


class Refiner:
    """Takes the estimate from that of an update to the minimum, one bounded part at each call."""

    def __init__(self, parts: Parts, tuner: ErrorTuner) -> None:
        self._smoother, self._reweighting = parts.smoother, parts.reweighting
        self._judge, self._tuner = parts.judge, tuner
        self.finished = True  # whether there is nothing to refine until the next update
        self._tests = False  # whether closures may wait for a test since the last update
        self._cursor = self._unchanged = self._reweightings = 0

    def restart(self) -> None:
        """Begin again, after an update."""
        self.finished, self._tests = False, True
        self._unchanged = self._reweightings = 0

    def reweight(self, result: inc.UpdateResult) -> tuple[inc.UpdateResult, bool]:
        """
        Return the last result after judging again and some reweightings, and if none was needed.
        """
        self._judge.after()
        if self._judge.solves_later:
            self._judge.work()  # a part of it also where nobody refines, as in a replay
        settled = result.status is Status.CONVERGED
        # the rest is done by `refine`
        for _ in range(3 if self._may_reweight else 0):
            weights = self._reweighting.changes(self._smoother.graph)
            if len(weights) == 0:
                break
            settled = False
            with Transaction() as transaction:
                result = checked(self._weigh(weights))
            if transaction.failure != '':
                break
        return result, settled

    @property
    def _may_reweight(self) -> bool:
        return len(self._reweighting) > 0 and not self._judge.solves_later

    def _weigh(self, weights: Mapping[int, float]) -> inc.UpdateResult:
        """
        Return the result of an update with new weights.

        If its iterations diverge, a small graph is solved at once, but not again and again; else
        the graph keeps the old ones, and is solved as a copy later.
        """
        update = GraphUpdate(weigh=weights)
        result = self._smoother.update(update, fall_back=False)
        if result.reason == inc.DIVERGED and self._judge.may_solve():
            return self._smoother.update(update)
        if result.reason == inc.DIVERGED:
            self._judge.solve_later(weights)
        return result

    def refine(self) -> inc.Refinement:
        """
        Do one step of the tuner, test closures that wait, or do one iteration.

        The estimate of an update is good enough for tests, and what is found changes it more than
        iterations do. Where there is nothing to iterate any more, weigh and judge again.
        """
        if self._smoother.graph.has_touched:
            self.finished = True    # an update that failed; the next one eliminates all nodes
        if self.finished:
            return inc.Refinement(finished=True, moved=0.0)
        if not self._tuner.is_idle:
            moved = self._tuner.step()
            if moved > 0.0:
                self.restart()
            return inc.Refinement(finished=False, moved=moved)
        self._tests = self._tests and self._judge.test()
        if self._tests:
            self.restart()
            return inc.Refinement(finished=False, moved=0.0)
        result = self._smoother.refine()
        if result.finished:
            result = self._reweight(result.moved)
        if result.finished and self._judge.work():
            self.restart()
            return result._replace(finished=False)
        return result

    def _reweight(self, moved: float) -> inc.Refinement:
        graph, size = self._smoother.graph, len(self._reweighting)
        while (self._may_reweight and self._unchanged < min(size, LOOKED_AT)
               and self._reweightings < 100):
            weights = self._reweighting.changes_of_part(graph, self._cursor)
            if len(weights) > 0:
                self._unchanged, self._reweightings = 0, self._reweightings + 1
                before = graph.poses.copy()
                result = self._weigh(weights)
                self.finished = result.status is Status.FAILED and result.reason != inc.DIVERGED
                by_weights = np.max(np.abs(graph.poses - before)[graph.is_pose, :2], initial=0.0)
                return inc.Refinement(finished=self.finished, moved=max(moved, float(by_weights)))
            self._unchanged += TUNING.part
            self._cursor = (self._cursor + TUNING.part) % size
        self.finished = True
        return inc.Refinement(finished=True, moved=moved)
