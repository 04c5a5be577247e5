# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which odometry is doubted, as verdicts.

Where fixes and global poses win against odometry, it is believed less over a gap between them;
`fixes` decides that, and keeps the weights.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.factors import energies
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import (
    Change,
    Decision,
    Judged,
    SourceVerdicts,
    State,
    Verdict,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes


class Doubt(NamedTuple):
    """Odometry is wrong somewhere along some edges; which of them it is cannot be told."""

    edges: tuple[int, ...]  # ids of those that are believed less
    verdict: Verdict  # on all of them, but for what changes with the estimate


class OdometryStates:
    def __init__(self, nodes: HiddenNodes) -> None:
        self._nodes = nodes
        self._gaps: dict[int, Doubt] = {}  # by the id of the first edge, ascending
        self._loosened: Mapping[int, float] = {}
        self._changes: list[Change] = []
        # number of edges of each source that have left the graph doubted
        self.left = Counter[str]()

    def decide_leaving(
        self, graph: Graph, edges: IntArray, fixes: Callable[[int], tuple[str, ...]],
    ) -> list[Verdict]:
        """Return the verdicts on doubted odometry that is about to leave the graph."""
        gone = {*edges.tolist()}
        if gone.isdisjoint(self._gaps):
            return []
        return [each for each in self.verdicts(graph, fixes) if each.number in gone]

    def forget(self, graph: Graph, edges: IntArray, loosened: Mapping[int, float]) -> None:
        gone, self._loosened = {*edges.tolist()}, loosened
        for doubt in self._gaps.values():
            self.left[doubt.verdict.source] += len(gone.intersection(doubt.edges))
        self._gaps = self._found_gaps(graph, self._nodes.newest_ns)

    def keep_gaps(self, loosened: Mapping[int, float], graph: Graph, now_ns: int) -> None:
        """Follow which odometry is believed less because of fixes, and note what has changed."""
        if loosened is self._loosened:
            return
        before, self._loosened = self._gaps, loosened
        self._gaps = self._found_gaps(graph, now_ns)
        for edge in sorted(before.keys() ^ self._gaps.keys()):
            verdict = {**before, **self._gaps}[edge].verdict
            states = State.BELIEVED, State.DOUBTED
            self._changes.append(Change(
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
            gaps[first] = Doubt(tuple(ids[part].tolist()), Verdict(
                id=f'{source}/{number - 1}', kind=Judged.ODOMETRY, source=source,
                stamp_ns=stamp_ns, reference_ns=reference_ns, state=State.DOUBTED,
                since_ns=since_ns.get(first, now_ns), decision=Decision.AUTO,
                residual=np.full(3, np.nan), distance=np.nan, supported_by=(),
                contradicted_by=(), number=first))
        return gaps

    def take_changes(self) -> list[Change]:
        changes, self._changes = self._changes, []
        return changes

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, but for weights."""
        kept = self._gaps, self._loosened
        changes = list(self._changes)

        def bring_back() -> None:
            self._gaps, self._loosened = kept
            self._changes = list(changes)
        return bring_back

    def verdicts(
        self, graph: Graph, fixes: Callable[[int], tuple[str, ...]],
    ) -> list[Verdict]:
        verdicts = []
        for doubt in self._gaps.values():
            edges = graph.factors_at(np.array(doubt.edges))
            begin, end = graph.poses_of((edges.i[0], edges.j[-1]))
            chi2 = np.sum(energies(graph.errors(edges), edges.information))
            verdicts.append(replace(
                doubt.verdict, distance=float(np.sqrt(chi2)), residual=se2.between(
                    reduce(se2.compose, edges.mean), se2.between(begin, end)),
                contradicted_by=fixes(doubt.verdict.stamp_ns)))
        return verdicts

    @property
    def doubted_edges(self) -> list[int]:
        return [edge for doubt in self._gaps.values() for edge in doubt.edges]

    def totals(self) -> dict[str, SourceVerdicts]:
        counts = Counter[str]()
        for doubt in self._gaps.values():
            counts[doubt.verdict.source] += len(doubt.edges)
        n, n_left = len(self._nodes) - 1, self._nodes.n_frozen + len(self._nodes.thinned)
        return {source: SourceVerdicts(
            {State.BELIEVED: n - n_left - counts[source], State.DOUBTED: counts[source]},
            doubting=False, n_left=n_left, n_left_unused=self.left[source])
            for source in (counts | self.left)}
