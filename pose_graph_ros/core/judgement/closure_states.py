# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each loop closure, in the order of addition, and why."""

from collections.abc import Sequence
import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE
from pose_graph_ros.core.judgement.judgements import Column, Judgements
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import (
    AUTO,
    DOUBTED,
    Judged,
    ODOMETRY,
    SourceVerdicts,
    USED,
    Verdict,
    WAITING,
    WEAK,
)

NEVER = -1  # round of the last test of one that was not tested


class ClosureStates(Judgements):
    forgotten, round, resting = Column(), Column(), Column()

    def __init__(self) -> None:
        super().__init__(
            Judged.LOOP_CLOSURE,
            forgotten=False,  # hopeless, and not judged again
            # the round of its last test, and the id of the node until which it is not tested
            round=NEVER, resting=0)

    @property
    def judged(self) -> BoolArray:
        """Whether they are judged: no person has decided on them, and they are not forgotten."""
        return (self.decision == AUTO) & ~self.forgotten

    def record(self, source: int) -> tuple[int, int]:
        """Return how many closures of a source, by its index, are or were used, and doubted."""
        counts = self.counts(source)
        return int(np.sum(counts[USED])), int(counts[DOUBTED])

    def numbers(self, edges: IntArray) -> IntArray:
        """Return the numbers of those of some edges, given by their ids, that are closures."""
        return np.flatnonzero(np.isin(self.held, edges))

    def forget(self, source: int) -> None:
        """Forget closures of a source if too many are not believed, the oldest doubted first."""
        kept = np.flatnonzero((self.source == source) & ~self.in_graph & self.judged)
        if len(kept) <= BELIEF.most_waiting:
            return
        order = np.lexsort((self.stamps_ns[kept, 0], self.state[kept] != DOUBTED))
        # some more than need be, as this is not to be done for each new one
        self.forgotten[kept[order[:len(kept) - 9 * BELIEF.most_waiting // 10]]] = True

    def totals(self) -> dict[str, SourceVerdicts]:
        return {source: each._replace(n_forgotten=int(np.count_nonzero(
            self.forgotten[self.source == self.sources.index(source)])))
            for source, each in super().totals().items()}

    def drawn_ids(self) -> list[IntArray]:
        """Return the ids of edges that are believed weakly, wait, and are doubted."""
        return [self.held[self.state == each] for each in (WEAK, WAITING, DOUBTED)]

    def reports(
        self, graph: Graph, table: ClosureTable, numbers: Sequence[int],
    ) -> list[Verdict]:
        """Return what is decided on some closures, and why."""
        verdicts = []
        usable = ~self.forgotten
        near = [table.near(number, usable) for number in numbers]
        sizes = np.array([len(each) for each in near], dtype=np.int64)
        others = np.concatenate([np.empty(0, np.int64), *near])
        agree = np.split(table.agree(np.repeat(np.array(numbers, np.int64), sizes), others),
                         np.cumsum(sizes)[:-1]) if len(sizes) > 0 else []
        residuals = graph.errors(graph.factors_at(self.held[list(numbers)]))
        for number, residual, around, agrees in zip(
                numbers, residuals, near, agree, strict=True):
            contradicted = [self.name(other) for other in around[~agrees]
                            if USED[self.state[other]]]
            if self.distance[number] > math.sqrt(GATE):
                contradicted.insert(0, ODOMETRY)
            verdicts.append(self.verdict(
                number, residual, supported_by=around[agrees].tolist(),
                contradicted_by=contradicted))
        return verdicts
