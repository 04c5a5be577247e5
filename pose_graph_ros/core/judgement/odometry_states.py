# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which odometry is doubted, as verdicts.

Where fixes and global poses win against odometry, it is believed less over a gap between them;
`fixes` decides that, and keeps the weights.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.error_functions import energies
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
from pose_graph_ros.core.saved_columns import Integers


@dataclass(frozen=True, slots=True)
class SavedOdometry:
    """Saved counts of doubted odometry; which is doubted now follows from the saved fixes."""

    left_sources: tuple[str, ...] = ()
    # number of edges of each of these sources that have left the graph doubted
    left: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))


@dataclass(frozen=True, slots=True)
class Doubt:
    edges: tuple[int, ...]  # ids of those that are believed less
    ends: tuple[int, int]  # nodes between which odometry is wrong; which edge it is cannot be told
    since_ns: int


class OdometryStates:
    def __init__(self, nodes: HiddenNodes) -> None:
        self._nodes = nodes
        self._gaps: dict[int, Doubt] = {}  # by the id of the first edge, ascending
        self._loosened: Mapping[int, float] = {}
        self._changes: list[Change] = []
        # number of edges of each source that have left the graph doubted
        self._left = Counter[str]()

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
            self._left[self._source(doubt.ends[1])] += len(gone.intersection(doubt.edges))
        self._gaps = self._found_gaps(graph, self._nodes.newest_ns)

    def keep_gaps(self, loosened: Mapping[int, float], graph: Graph, now_ns: int) -> None:
        """Follow which odometry is believed less because of fixes, and note what has changed."""
        if loosened is self._loosened:
            return
        before, self._loosened = self._gaps, loosened
        self._gaps = self._found_gaps(graph, now_ns)
        self._note(before, self._gaps, graph)

    def _found_gaps(self, graph: Graph, now_ns: int) -> dict[int, Doubt]:
        """Return the stretches of odometry that is believed much less, by their first edges."""
        since_ns = {edge: doubt.since_ns for doubt in self._gaps.values() for edge in doubt.edges}
        ids = np.array(sorted(edge for edge, factor in self._loosened.items()
                              if factor < BELIEF.much_less), dtype=np.int64)
        edges = graph.edges_at(ids)
        cuts = np.flatnonzero(edges.i[1:] != edges.j[:-1]) + 1
        gaps = {}
        for part in np.split(np.arange(len(ids)), cuts) if len(ids) > 0 else ():
            first = int(ids[part[0]])
            gaps[first] = Doubt(
                tuple(ids[part].tolist()), (int(edges.i[part[0]]), int(edges.j[part[-1]])),
                since_ns.get(first, now_ns))
        return gaps

    def _note(
        self, before: Mapping[int, Doubt], after: Mapping[int, Doubt], graph: Graph,
    ) -> None:
        for edge in sorted(before.keys() ^ after.keys()):
            states = State.BELIEVED, State.DOUBTED
            old, new = states[::-1] if edge in before else states
            end = (before.get(edge) or after[edge]).ends[1]
            self._changes.append(Change(
                self.name(graph, edge), Judged.ODOMETRY, self._source(end), self._stamp_ns(end),
                old, new))

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

    def name(self, graph: Graph, edge: int) -> str:
        """Return the name of an edge: edges are counted along the path."""
        end = int(graph.edges_at(np.array([edge])).j[0])
        return f'{self._source(end)}/{np.searchsorted(self._nodes.ids, end) - 1}'

    def _stamp_ns(self, node: int) -> int:
        return int(self._nodes.stamps_ns[np.searchsorted(self._nodes.ids, node)])

    def _source(self, node: int) -> str:
        return self._nodes.primary_at(self._stamp_ns(node))

    def verdicts(
        self, graph: Graph, fixes: Callable[[int], tuple[str, ...]],
    ) -> list[Verdict]:
        verdicts = []
        for edge, doubt in self._gaps.items():
            edges = graph.edges_at(np.array(doubt.edges))
            begin, end = graph.poses_of((edges.i[0], edges.j[-1]))
            measured = reduce(se2.compose, edges.mean)
            distance = np.sqrt(np.sum(energies(
                graph.edge_errors(edges), edges.information)))
            verdicts.append(Verdict(
                id=self.name(graph, edge), kind=Judged.ODOMETRY,
                source=self._source(doubt.ends[1]), stamp_ns=self._stamp_ns(doubt.ends[1]),
                reference_ns=self._stamp_ns(doubt.ends[0]), state=State.DOUBTED,
                since_ns=doubt.since_ns, decision=Decision.AUTO,
                residual=se2.between(measured, se2.between(begin, end)),
                distance=float(distance), supported_by=(), edge=True, number=edge,
                contradicted_by=fixes(self._stamp_ns(doubt.ends[1]))))
        return verdicts

    @property
    def doubted_edges(self) -> list[int]:
        return [edge for doubt in self._gaps.values() for edge in doubt.edges]

    def totals(self) -> dict[str, SourceVerdicts]:
        counts = Counter[str]()
        for doubt in self._gaps.values():
            counts[self._source(doubt.ends[1])] += len(doubt.edges)
        n, n_left = len(self._nodes) - 1, self._nodes.n_frozen + len(self._nodes.thinned)
        return {source: SourceVerdicts(
            {State.BELIEVED: n - n_left - counts[source], State.DOUBTED: counts[source]}, 1.0,
            doubting=False, n_left=n_left, n_left_unused=self._left[source])
            for source in (counts | self._left)}

    def saved(self) -> SavedOdometry:
        return SavedOdometry(
            tuple(self._left), np.array([*self._left.values()], dtype=np.int64))

    def restore(self, saved: SavedOdometry) -> None:
        self._left.update(dict(zip(saved.left_sources, saved.left.tolist(), strict=True)))
