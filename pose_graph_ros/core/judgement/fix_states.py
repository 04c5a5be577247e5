# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is decided on each position and pose in the map, why, and the weights that follow.

Where they win against odometry, it is believed less over a gap between them; `fixes` decides that,
and keeps the weights. Here it is told which odometry is doubted.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import reduce
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.factors import energies
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement import verdicts as vd
from pose_graph_ros.core.judgement.judgements import Column, Judgements
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes

# Run of a measurement that is wrong by itself, and of all that are good.
LONE, GOOD = -1, 0
# Members of a run follow one another: so many records before and after one are looked at.
ALIKE_WITHIN = 50


class FixStates(Judgements):
    KIND = vd.Judged.FIX
    run = Column(np.int64, new=LONE)  # id of the first one of its fault, `LONE` or `GOOD`

    @property
    def believed(self) -> BoolArray:
        return np.asarray(self.state == vd.BELIEVED)

    def leaving(self, factors: IntArray) -> BoolArray:
        """Return which records leave with factors, shape (M,)."""
        return np.isin(self.held, factors) | np.isin(self.added, factors)

    def believe(self, which: IntArray, believed: BoolArray) -> None:
        """Believe or doubt some records, but not those that a person has decided on."""
        free = self.decision[which] == vd.AUTO
        self.state[which[free]] = np.where(believed[free], vd.BELIEVED, vd.DOUBTED)

    def weights(self, size: int, numbers: IntArray, before: IntArray, *,
                base: bool = False) -> dict[int, float]:
        """
        Return weights that change, or `base` weights, by the ids of factors.

        There were so many records, and some had another state.
        """
        changed = numbers[self.state[numbers] != before]
        later = np.empty(0, dtype=np.int64)
        doubted = np.flatnonzero(self.state[size:] != vd.BELIEVED) + size
        again = self.stamps_ns[changed[self.state[changed] == vd.BELIEVED], 0]
        if not base and len(again) > 0:
            # losses have lowered the weights of the believed ones since one that returns
            later = np.flatnonzero((self.stamps_ns[:, 0] >= np.min(again)) & self.believed)
        which = np.concatenate((doubted, later, changed))
        believed = self.state[which] == vd.BELIEVED
        return dict(zip(self.held[which].tolist(), believed.astype(float).tolist(), strict=True))

    def numbers_of(self, factors: IntArray) -> IntArray:
        """Return the numbers of records by the ids they were added as, -1 where there is none."""
        # mostly they are among the newest
        first, oldest = len(self), np.min(factors, initial=np.iinfo(np.int64).max)
        while first > 0 and self.added[first - 1] >= oldest:
            first = max(2 * first - len(self) - 16, 0)
        added = self.added[first:]
        at = np.searchsorted(added, factors)
        found = np.flatnonzero(np.append(added, -1)[at] == factors)
        numbers = np.full(len(factors), -1)
        numbers[found] = first + at[found]
        return numbers

    def moved(self, before: IntArray, after: IntArray) -> None:
        """Have records follow measurements that other factors hold now; by ids."""
        numbers, order = np.flatnonzero(np.isin(self.held, before)), np.argsort(before)
        at = order[np.searchsorted(before, self.held[numbers], sorter=order)]
        self.held[numbers] = after[at]

    def believed_after(self, stamp_ns: int) -> tuple[str, ...]:
        """Return the ids of the first believed measurements from a stamp on."""
        after = np.flatnonzero(self.believed & (self.stamps_ns[:, 0] >= stamp_ns))
        first = after[np.argsort(self.stamps_ns[after, 0], kind='stable')][:vd.MOST_NAMED]
        return tuple(map(self.name, first.tolist()))

    def verdicts(self, graph: Graph, numbers: IntArray) -> list[vd.Verdict]:
        factors, verdicts = graph.factors_at(self.held[numbers]), []
        measured = np.diagonal(factors.information, axis1=1, axis2=2) > 0.0
        residuals = np.where(measured, graph.errors(factors), np.nan)
        for number, residual in zip(numbers.tolist(), residuals, strict=True):
            # a person may force out what fits, and force in what does not
            contradicted = (self.state[number] == vd.DOUBTED if self.decision[number] == vd.AUTO
                            else self.distance[number]**2 > BELIEF.event)
            verdicts.append(self.verdict(
                number, residual, supported_by=self._alike(number),
                contradicted_by=(vd.ODOMETRY,) if contradicted else ()))
        return verdicts

    def _alike(self, number: int) -> Sequence[int]:
        """Return other members of the same run, the nearest first."""
        if self.run[number] == LONE:
            return ()
        first = max(number - ALIKE_WITHIN, 0)
        alike = first + np.flatnonzero(self.run[first:number + ALIKE_WITHIN] == self.run[number])
        alike = alike[alike != number]
        return alike[np.argsort(np.abs(alike - number), kind='stable')].tolist()


class Doubt(NamedTuple):
    """Odometry is wrong somewhere along some edges; which of them it is cannot be told."""

    edges: tuple[int, ...]  # ids of those that are believed less
    verdict: vd.Verdict  # on all of them, but for what changes with the estimate


class OdometryStates:
    def __init__(self, nodes: HiddenNodes) -> None:
        self._nodes = nodes
        self._gaps: dict[int, Doubt] = {}  # by the id of the first edge, ascending
        self._loosened: Mapping[int, float] = {}
        self._changes: list[vd.Change] = []
        # number of edges of each source that have left the graph doubted
        self.left = Counter[str]()

    @property
    def edges(self) -> list[int]:
        """The ids of doubted edges."""
        return [edge for doubt in self._gaps.values() for edge in doubt.edges]

    def forget(self, edges: IntArray) -> None:
        for doubt in self._gaps.values():
            self.left[doubt.verdict.source] += int(np.sum(np.isin(doubt.edges, edges)))

    def follow(self, loosened: Mapping[int, float], graph: Graph, now_ns: int, *,
               announce: bool = True) -> None:
        """Follow which odometry is believed less because of fixes, and note what has changed."""
        if announce and loosened is self._loosened:
            return
        before, self._loosened = self._gaps, loosened
        self._gaps = self._found_gaps(graph, now_ns)
        for edge in sorted(before.keys() ^ self._gaps.keys()) if announce else ():
            verdict = {**before, **self._gaps}[edge].verdict
            states = vd.State.BELIEVED, vd.State.DOUBTED
            self._changes.append(vd.Change(
                verdict.id, verdict.kind, verdict.source, verdict.stamp_ns,
                *(states[::-1] if edge in before else states)))

    def _found_gaps(self, graph: Graph, now_ns: int) -> dict[int, Doubt]:
        """Return the stretches of odometry that is believed much less, by their first edges."""
        since_ns = {edge: doubt.verdict.since_ns
                    for doubt in self._gaps.values() for edge in doubt.edges}
        ids = np.array(sorted(edge for edge, factor in self._loosened.items()
                              if factor < BELIEF.much_less), dtype=np.int64)
        edges = graph.factors_at(ids)
        cuts = np.flatnonzero(edges.i[1:] != edges.j[:-1]) + 1
        gaps = {}
        for part in np.split(np.arange(len(ids)), cuts) if len(ids) > 0 else ():
            first = int(ids[part[0]])
            # edges are counted along the path
            begin, number, end = np.searchsorted(
                self._nodes.ids, (edges.i[part[0]], edges.j[part[0]], edges.j[part[-1]])).tolist()
            reference_ns, stamp_ns = self._nodes.stamps_ns[[begin, end]].tolist()
            source = self._nodes.primary_at(stamp_ns)
            gaps[first] = Doubt(tuple(ids[part].tolist()), vd.Verdict(
                id=f'{source}/{number - 1}', kind=vd.Judged.ODOMETRY, source=source,
                stamp_ns=stamp_ns, reference_ns=reference_ns, state=vd.State.DOUBTED,
                since_ns=since_ns.get(first, now_ns), decision=vd.Decision.AUTO,
                residual=np.full(3, np.nan), distance=np.nan, supported_by=(),
                contradicted_by=(), number=first))
        return gaps

    def take_changes(self) -> list[vd.Change]:
        changes, self._changes = self._changes, []
        return changes

    def keep(self, undo: ExitStack[bool]) -> None:
        """Have the present state brought back, but for weights."""
        for name, value in (('_gaps', self._gaps), ('_loosened', self._loosened),
                            ('_changes', [*self._changes])):
            undo.callback(setattr, self, name, value)

    def verdicts(self, graph: Graph, fixes: FixStates) -> list[vd.Verdict]:
        verdicts = []
        for doubt in self._gaps.values():
            edges = graph.factors_at(np.array(doubt.edges))
            begin, end = graph.poses_of((edges.i[0], edges.j[-1]))
            chi2 = np.sum(energies(graph.errors(edges), edges.information))
            verdicts.append(doubt.verdict._replace(
                distance=float(np.sqrt(chi2)), residual=se2.between(
                    reduce(se2.compose, edges.mean), se2.between(begin, end)),
                contradicted_by=fixes.believed_after(doubt.verdict.stamp_ns)))
        return verdicts

    def totals(self) -> dict[str, vd.SourceVerdicts]:
        counts = Counter[str]()
        for doubt in self._gaps.values():
            counts[doubt.verdict.source] += len(doubt.edges)
        n, n_left = len(self._nodes) - 1, self._nodes.n_frozen + self._nodes.n_thinned
        return {source: vd.SourceVerdicts(
            {vd.State.BELIEVED: n - n_left - counts[source], vd.State.DOUBTED: counts[source]},
            doubting=False, n_left=n_left, n_left_unused=self.left[source])
            for source in (counts | self.left)}
