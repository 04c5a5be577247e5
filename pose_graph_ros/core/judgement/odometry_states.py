# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which odometry is doubted, as states, as weights of the graph, and as verdicts.

Loop closures doubt single edges (`jumps`). Where fixes and global poses win against odometry, it
is believed less over a gap between them (`fixes`), whose weights are kept there.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.error_functions import energies
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.jumps import Jump
from pose_graph_ros.core.judgement.odometry_chain import integrated
from pose_graph_ros.core.judgement.verdicts import (
    Change,
    Decision,
    Judged,
    MOST_NAMED,
    SourceVerdicts,
    State,
    Verdict,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.saved_columns import Integers, Numbers, Pairs

# Factor on the weights of odometry below which a gap between fixes is told as doubted.
MUCH_LESS = 0.25


@dataclass(frozen=True, slots=True)
class SavedOdometry:
    """Saved state of the doubted odometry edges; who has contradicted them is not part of it."""

    rows: Integers
    """Ids of the edges."""
    ends: Pairs
    """Nodes between which odometry is wrong."""
    weights: Numbers
    """Factors on the weights of the edges."""
    since_ns: Integers
    final: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """1 for doubts that stay, whatever closures show; empty if there is none."""
    left_sources: tuple[str, ...] = ()
    left: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Number of edges of each of these sources that have left the graph doubted."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Doubted odometry."""

    edges: tuple[int, ...]
    """Ids of those that are believed less; one where closures contradict it."""
    ends: tuple[int, int]
    """Nodes between which odometry is wrong; which edge it is cannot be told."""
    weight: float
    """Factor on the weights of the edges."""
    since_ns: int
    seen_by: tuple[str, ...] = ()
    """Ids of closures that contradict it."""
    is_final: bool = False
    """Whether a believed closure over it has left the graph, so that the prior knows the jump."""

    def is_under(self, ends: IntArray) -> bool:
        """Return whether one of some closures, given by their nodes, shape (K, 2), is over it."""
        first, last = np.sort(ends, axis=1).T
        return bool(np.any((first <= self.ends[0]) & (last >= self.ends[1])))


class OdometryStates:
    """
    The doubted edges of odometry.

    Parameters
    ----------
    nodes : HiddenNodes, with the stamps and the name of the odometry
    weight_of : callable, returns the weight that an edge would have, by its id

    """

    def __init__(self, nodes: HiddenNodes, weight_of: Callable[[int], float]) -> None:
        self._nodes, self._weight_of = nodes, weight_of
        self.doubts: dict[int, Doubt] = {}
        """By closures, by the ids of the edges; replaced, never changed."""
        self._gaps: dict[int, Doubt] = {}
        """By fixes, by the id of the first edge."""
        self._loosened: Mapping[int, float] = {}
        self._changes: list[Change] = []
        self._left = Counter[str]()
        """Number of edges of each source that have left the graph doubted."""

    def weights_with(self, doubts: Mapping[int, Doubt]) -> dict[int, float]:
        """Return the weights of edges that are doubted, or were and no longer are, by id."""
        return {edge: self._weight_of(edge) * (doubts[edge].weight if edge in doubts else 1.0)
                for edge in sorted({*self.doubts, *doubts})}

    def kept(self, weights: Mapping[int, float]) -> dict[int, float]:
        """Return new weights of edges, in which doubted ones have no more than they have."""
        return {edge: weight * (self.doubts[edge].weight if edge in self.doubts else 1.0)
                for edge, weight in weights.items()}

    def doubted(
        self, graph: Graph, jumps: Iterable[Jump], now_ns: int, name: Callable[[int], str],
    ) -> dict[int, Doubt]:
        """
        Return the doubts that jumps give; those that are there already keep their stamps.

        Parameters
        ----------
        now_ns : int, stamp of the newest odometry
        name : callable, returns the id of a closure by its number among those of the jumps

        """
        doubts = {}
        for jump in jumps:
            own = graph.edges_at(np.array([jump.edge]))
            error = se2.between(own.mean, jump.motion[None])
            size = float(energies(error, own.information)[0])
            before = self.doubts.get(jump.edge)
            doubts[jump.edge] = Doubt(
                (jump.edge,), jump.ends, 1.0 / max(size, 1.0),
                now_ns if before is None else before.since_ns,
                tuple(map(name, jump.seen_by[:MOST_NAMED].tolist())))
        return doubts

    def still_doubted(self, closures: Edges) -> dict[int, Doubt]:
        """Return the doubts over which one of the closures that are believed leads."""
        ends = np.column_stack((closures.i, closures.j))
        return {edge: doubt for edge, doubt in self.doubts.items()
                if doubt.is_final or doubt.is_under(ends)}

    @property
    def final(self) -> dict[int, Doubt]:
        """Those that stay, whatever closures show."""
        return {edge: doubt for edge, doubt in self.doubts.items() if doubt.is_final}

    def decide_leaving(
        self, graph: Graph, edges: IntArray, fixes: Callable[[int], tuple[str, ...]],
    ) -> list[Verdict]:
        """
        Return the verdicts on doubted odometry that is about to leave the graph.

        Parameters
        ----------
        edges : ndarray of int, ids of what leaves
        fixes : callable, as in `verdicts`

        """
        gone = {*edges.tolist()}
        if gone.isdisjoint(self._gaps) and gone.isdisjoint(self.doubts):
            return []
        return [each for each in self.verdicts(graph, fixes) if each.number in gone]

    def forget(
        self, graph: Graph, edges: IntArray, closures: IntArray, loosened: Mapping[int, float],
    ) -> None:
        """
        Forget edges that have left the graph.

        Parameters
        ----------
        graph : Graph, without them
        edges : ndarray of int, ids
        closures : ndarray of int, shape (K, 2), nodes of believed closures that have left
        loosened : mapping, as in `keep_gaps`

        """
        gone, self._loosened = {*edges.tolist()}, loosened
        for doubt in self._every():
            self._left[self._source(doubt.ends[1])] += len(gone.intersection(doubt.edges))
        self.doubts = {
            edge: replace(doubt, is_final=doubt.is_final or doubt.is_under(closures))
            for edge, doubt in self.doubts.items() if edge not in gone}
        self._gaps = self._found_gaps(graph, self._nodes.newest_ns)

    def keep(self, doubts: Mapping[int, Doubt], graph: Graph) -> None:
        """
        Replace all doubts, and note what has changed.

        Parameters
        ----------
        doubts : mapping, by the ids of edges

        """
        before, self.doubts = self.doubts, dict(doubts)
        self._note(before, doubts, graph)

    def keep_gaps(self, loosened: Mapping[int, float], graph: Graph, now_ns: int) -> None:
        """
        Follow which odometry is believed less because of fixes, and note what has changed.

        Parameters
        ----------
        loosened : mapping, factors on weights by id; another one after each change
        now_ns : int, stamp of the newest odometry

        """
        if loosened is self._loosened:
            return
        before, self._loosened = self._gaps, loosened
        self._gaps = self._found_gaps(graph, now_ns)
        self._note(before, self._gaps, graph)

    def _found_gaps(self, graph: Graph, now_ns: int) -> dict[int, Doubt]:
        """Return the stretches of odometry that is believed much less, by their first edges."""
        since_ns = {edge: doubt.since_ns for doubt in self._gaps.values() for edge in doubt.edges}
        ids = np.array(sorted(edge for edge, factor in self._loosened.items()
                              if factor < MUCH_LESS), dtype=np.int64)
        edges = graph.edges_at(ids)
        cuts = np.flatnonzero(edges.i[1:] != edges.j[:-1]) + 1
        gaps = {}
        for part in np.split(np.arange(len(ids)), cuts) if len(ids) > 0 else ():
            first = int(ids[part[0]])
            gaps[first] = Doubt(
                tuple(ids[part].tolist()), (int(edges.i[part[0]]), int(edges.j[part[-1]])),
                self._loosened[first], since_ns.get(first, now_ns))
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
        """Return the changes since the last call."""
        changes, self._changes = self._changes, []
        return changes

    def state(self) -> Callable[[], None]:
        """Return what brings the present state back, but for weights."""
        kept = self.doubts, self._gaps, self._loosened
        changes = list(self._changes)

        def bring_back() -> None:
            self.doubts, self._gaps, self._loosened = kept
            self._changes = list(changes)
        return bring_back

    def name(self, graph: Graph, edge: int) -> str:
        """
        Return the name of an edge: edges are counted along the path.

        Parameters
        ----------
        edge : int, id

        """
        end = int(graph.edges_at(np.array([edge])).j[0])
        return f'{self._source(end)}/{np.searchsorted(self._nodes.ids, end) - 1}'

    def _stamp_ns(self, node: int) -> int:
        return int(self._nodes.stamps_ns[np.searchsorted(self._nodes.ids, node)])

    def _source(self, node: int) -> str:
        """Return the source of the odometry that has led to a node."""
        return self._nodes.primary_at(self._stamp_ns(node))

    def verdicts(
        self, graph: Graph, fixes: Callable[[int], tuple[str, ...]],
    ) -> list[Verdict]:
        """
        Return the verdicts on doubted odometry.

        Parameters
        ----------
        fixes : callable, returns the ids of the first fixes that are believed after a stamp

        """
        verdicts = []
        for edge, doubt in sorted({**self._gaps, **self.doubts}.items()):
            edges = graph.edges_at(np.array(doubt.edges))
            begin, end = graph.poses_of((edges.i[0], edges.j[-1]))
            measured = integrated(edges.mean)[-1]
            against = (doubt.seen_by if edge in self.doubts
                       else fixes(self._stamp_ns(doubt.ends[1])))
            distance = np.sqrt(np.sum(energies(
                graph.edge_errors(edges), edges.information)))
            verdicts.append(Verdict(
                id=self.name(graph, edge), kind=Judged.ODOMETRY,
                source=self._source(doubt.ends[1]), stamp_ns=self._stamp_ns(doubt.ends[1]),
                reference_ns=self._stamp_ns(doubt.ends[0]), state=State.DOUBTED,
                since_ns=doubt.since_ns, decision=Decision.AUTO,
                residual=se2.between(measured, se2.between(begin, end)),
                distance=float(distance), supported_by=(), contradicted_by=against, edge=True,
                number=edge))
        return verdicts

    def _every(self) -> list[Doubt]:
        return [doubt for _, doubt in sorted({**self._gaps, **self.doubts}.items())]

    @property
    def doubted_edges(self) -> list[int]:
        """Ids of all edges that are doubted."""
        return [edge for doubt in self._every() for edge in doubt.edges]

    def totals(self) -> dict[str, SourceVerdicts]:
        """Return how many edges of each source are doubted."""
        counts = Counter[str]()
        for doubt in self._every():
            counts[self._source(doubt.ends[1])] += len(doubt.edges)
        n, n_left = len(self._nodes) - 1, self._nodes.n_frozen + len(self._nodes.table.thinned)
        return {source: SourceVerdicts(
            {State.BELIEVED: n - n_left - counts[source], State.DOUBTED: counts[source]}, 1.0,
            doubting=False, n_left=n_left, n_left_unused=self._left[source])
            for source in (counts | self._left)}

    def saved(self) -> SavedOdometry:
        """Return all doubts."""
        every = list(self.doubts.values())
        return SavedOdometry(
            np.array(list(self.doubts), dtype=np.int64),
            np.array([each.ends for each in every], dtype=np.int64).reshape(-1, 2),
            np.array([each.weight for each in every], dtype=np.float64),
            np.array([each.since_ns for each in every], dtype=np.int64),
            np.array([int(each.is_final) for each in every], dtype=np.int64),
            tuple(self._left), np.array([*self._left.values()], dtype=np.int64))

    def restore(self, saved: SavedOdometry) -> None:
        """Restore what `saved` has returned, for the same graph."""
        self._left.update(dict(zip(saved.left_sources, saved.left.tolist(), strict=True)))
        final = saved.final if len(saved.final) > 0 else np.zeros(len(saved.rows), np.int64)
        self.doubts = {edge: Doubt((edge,), (ends[0], ends[1]), weight, since_ns,
                                   is_final=bool(is_final))
                       for edge, ends, weight, since_ns, is_final in zip(*(
                           column.tolist() for column in (
                               saved.rows, saved.ends, saved.weights, saved.since_ns, final)),
                           strict=True)}
