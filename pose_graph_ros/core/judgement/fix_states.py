# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each position and pose in the map, why, and the weights that follow."""

from collections.abc import Sequence

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.judgements import Column, Judgements
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import (
    AUTO,
    BELIEVED,
    DOUBTED,
    Judged,
    MOST_NAMED,
    ODOMETRY,
    Verdict,
)

# Run of a measurement that is wrong by itself, and of all that are good.
LONE, GOOD = -1, 0
# Members of a run follow one another: so many records before and after one are looked at.
ALIKE_WITHIN = 50


class FixStates(Judgements):
    run = Column()

    def __init__(self) -> None:
        # id of the first one of its fault, `LONE` or `GOOD`
        super().__init__(Judged.FIX, run=LONE)

    @property
    def believed(self) -> BoolArray:
        return np.asarray(self.state == BELIEVED)

    @property
    def unused(self) -> IntArray:
        """Ids of what holds those that are not believed."""
        return np.asarray(self.held[~self.believed])

    def leaving(self, factors: IntArray) -> BoolArray:
        """Return which records leave with factors, shape (M,)."""
        return np.isin(self.held, factors) | np.isin(self.added, factors)

    def by_stamp(self) -> IntArray:
        """Return the numbers of all records, by stamp, then by the name of the source."""
        names = np.argsort(np.argsort(np.array(self.sources)))
        return np.lexsort((names[self.source], self.stamps_ns[:, 0]))

    def believe(self, which: IntArray, *, believed: bool) -> None:
        """Believe or doubt some records, but not those that a person has decided on."""
        self.state[which[self.decision[which] == AUTO]] = BELIEVED if believed else DOUBTED

    def weights(self, before: IntArray, reweighting: Reweighting) -> dict[int, float]:
        """Return weights that change, by the ids of factors."""
        changed = self.changed(before)
        doubted = np.flatnonzero(~self.believed[len(before):]) + len(before)
        # losses have lowered the weights of the believed ones since one that returns
        again = self.stamps_ns[changed[self.believed[changed]], 0]
        since = np.min(again) if len(again) > 0 else np.inf
        later = np.flatnonzero((self.stamps_ns[:, 0] >= since) & self.believed)
        return {
            int(self.held[number]): self._base_weight(number, changed, reweighting)
            if self.state[number] == BELIEVED else 0.0
            for number in (*doubted.tolist(), *later.tolist(), *changed.tolist())}

    def changed(self, before: IntArray) -> IntArray:
        """Return the numbers of records that had another state, given all that there were."""
        return np.flatnonzero(self.state[:len(before)] != before)

    def set_base_weights(self, before: IntArray, reweighting: Reweighting) -> None:
        """Tell what is not believed any more, or again."""
        changed = self.changed(before)
        for number in (*range(len(before), len(self)), *changed.tolist()):
            held = int(self.held[number])
            if self.state[number] == DOUBTED:
                reweighting.set_base_weight(held, 0.0)
            elif number < len(before):
                reweighting.set_base_weight(
                    held, self._base_weight(number, changed, reweighting))

    def _base_weight(self, number: int, changed: IntArray, reweighting: Reweighting) -> float:
        """Return the base weight of a believed record, or else that of one next to it."""
        held, source = self.records[number][['held', 'source']].tolist()
        own = reweighting.base_weight(held)
        if own:
            return own
        first = max(number - BELIEF.records_near, 0)
        near = slice(first, number + BELIEF.records_near)
        alike = first + np.flatnonzero(
            self.believed[near] & (self.source[near] == source))
        alike = np.setdiff1d(alike, changed)
        if len(alike) == 0:
            return 1.0
        nearest = int(alike[np.argmin(np.abs(alike - number))])
        return reweighting.base_weight(int(self.held[nearest])) or 1.0

    def moved(self, before: IntArray, after: IntArray) -> None:
        """Have records follow measurements that other factors hold now; by ids."""
        numbers, order = np.flatnonzero(np.isin(self.held, before)), np.argsort(before)
        at = order[np.searchsorted(before, self.held[numbers], sorter=order)]
        self.held[numbers] = after[at]

    def believed_after(self, stamp_ns: int) -> tuple[str, ...]:
        """Return the ids of the first believed measurements from a stamp on."""
        after = np.flatnonzero(self.believed & (self.stamps_ns[:, 0] >= stamp_ns))
        first = after[np.argsort(self.stamps_ns[after, 0], kind='stable')][:MOST_NAMED]
        return tuple(map(self.name, first.tolist()))

    def verdicts(self, graph: Graph, numbers: IntArray) -> list[Verdict]:
        verdicts, residuals = [], _residuals(graph, self.held[numbers])
        for number, residual in zip(numbers.tolist(), residuals, strict=True):
            # a person may force out what fits, and force in what does not
            contradicted = (self.state[number] == DOUBTED if self.decision[number] == AUTO
                            else self.distance[number]**2 > BELIEF.event)
            verdicts.append(self.verdict(
                number, residual, supported_by=self._alike(number),
                contradicted_by=(ODOMETRY,) if contradicted else ()))
        return verdicts

    def _alike(self, number: int) -> Sequence[int]:
        """Return other members of the same run, the nearest first."""
        if self.run[number] == LONE:
            return ()
        first = max(number - ALIKE_WITHIN, 0)
        alike = first + np.flatnonzero(
            self.run[first:number + ALIKE_WITHIN] == self.run[number])
        alike = alike[alike != number]
        return alike[np.argsort(np.abs(alike - number), kind='stable')].tolist()


def _residuals(graph: Graph, held: IntArray) -> FloatArray:
    """Return the errors at the estimate, shape (K, 3), nan where nothing is measured."""
    factors = graph.factors_at(held)
    measured = np.diagonal(factors.information, axis1=1, axis2=2) > 0.0
    return np.where(measured, graph.errors(factors), np.nan)
