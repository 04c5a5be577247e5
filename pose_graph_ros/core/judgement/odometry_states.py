# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which odometry is doubted, as states, as weights of the graph, and as verdicts.

Loop closures doubt single edges (`jumps`). Where fixes and global poses win against odometry, it
is believed less over a gap between them (`fixes`), whose weights are kept there.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.error_functions import edge_errors, energies
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.graph_view import DrawnRows
from pose_graph_ros.core.judgement.jumps import Jump
from pose_graph_ros.core.judgement.odometry_motions import integrated
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
    """Rows of the edges in the graph."""
    ends: Pairs
    """Nodes between which odometry is wrong."""
    weights: Numbers
    """Factors on the weights of the edges."""
    since_ns: Integers


@dataclass(frozen=True, slots=True)
class Doubt:
    """Doubted odometry."""

    rows: tuple[int, ...]
    """Of the edges that are believed less; one where closures contradict it."""
    ends: tuple[int, int]
    """Nodes between which odometry is wrong; which edge it is cannot be told."""
    weight: float
    """Factor on the weights of the edges."""
    since_ns: int
    seen_by: tuple[int, ...] = ()
    """Numbers of the closures that contradict it."""


class OdometryStates:
    """
    The doubted edges of odometry.

    Parameters
    ----------
    nodes : HiddenNodes, with the stamps and the name of the odometry
    weight_of : callable, returns the weight that an edge would have, by its row

    """

    def __init__(self, nodes: HiddenNodes, weight_of: Callable[[int], float]) -> None:
        self._nodes, self._weight_of = nodes, weight_of
        self.doubts: dict[int, Doubt] = {}
        """By closures, by the rows of the edges; replaced, never changed."""
        self._gaps: dict[int, Doubt] = {}
        """By fixes, by the row of the first edge."""
        self._loosened: Mapping[int, float] = {}
        self._changes: list[Change] = []

    def weights_with(self, doubts: Mapping[int, Doubt]) -> dict[int, float]:
        """Return the weights of edges that are doubted, or were and no longer are, by row."""
        return {row: self._weight_of(row) * (doubts[row].weight if row in doubts else 1.0)
                for row in sorted({*self.doubts, *doubts})}

    def kept(self, weights: Mapping[int, float]) -> dict[int, float]:
        """Return new weights of edges, in which doubted ones have no more than they have."""
        return {row: weight * (self.doubts[row].weight if row in self.doubts else 1.0)
                for row, weight in weights.items()}

    def doubted(
        self, graph: Graph, jumps: Iterable[Jump], now_ns: int, numbers: IntArray,
    ) -> dict[int, Doubt]:
        """
        Return the doubts that jumps give; those that are there already keep their stamps.

        Parameters
        ----------
        graph : Graph
        jumps : iterable of Jump
        now_ns : int, stamp of the newest odometry
        numbers : ndarray of int, shape (M,), numbers of the closures that jumps were found by

        """
        doubts = {}
        for jump in jumps:
            edge = graph.edges_at(np.array([jump.row]))
            error = se2.between(edge.mean, jump.motion[None])
            size = float(energies(error, edge.information)[0])
            before = self.doubts.get(jump.row)
            doubts[jump.row] = Doubt(
                (jump.row,), jump.ends, 1.0 / max(size, 1.0),
                now_ns if before is None else before.since_ns,
                tuple(numbers[jump.seen_by].tolist()))
        return doubts

    def still_doubted(self, closures: Edges) -> dict[int, Doubt]:
        """Return the doubts over which one of the closures that are believed leads."""
        first, last = np.minimum(closures.i, closures.j), np.maximum(closures.i, closures.j)
        return {row: doubt for row, doubt in self.doubts.items()
                if np.any((first <= doubt.ends[0]) & (last >= doubt.ends[1]))}

    def keep(self, doubts: Mapping[int, Doubt], graph: Graph) -> None:
        """
        Replace all doubts, and note what has changed.

        Parameters
        ----------
        doubts : mapping, by row
        graph : Graph

        """
        before, self.doubts = self.doubts, dict(doubts)
        self._note(before, doubts, graph)

    def keep_gaps(self, loosened: Mapping[int, float], graph: Graph, now_ns: int) -> None:
        """
        Follow which odometry is believed less because of fixes, and note what has changed.

        Parameters
        ----------
        loosened : mapping, factors on weights by row; another one after each change
        graph : Graph
        now_ns : int, stamp of the newest odometry

        """
        if loosened is self._loosened:
            return
        before, self._gaps, self._loosened = self._gaps, {}, loosened
        rows = np.array(sorted(row for row, factor in loosened.items() if factor < MUCH_LESS),
                        dtype=np.int64)
        edges = graph.edges_at(rows)
        cuts = np.flatnonzero(edges.i[1:] != edges.j[:-1]) + 1
        for part in np.split(np.arange(len(rows)), cuts) if len(rows) > 0 else ():
            row = int(rows[part[0]])
            self._gaps[row] = Doubt(
                tuple(rows[part].tolist()), (int(edges.i[part[0]]), int(edges.j[part[-1]])),
                loosened[row], before[row].since_ns if row in before else now_ns)
        self._note(before, self._gaps, graph)

    def _note(
        self, before: Mapping[int, Doubt], after: Mapping[int, Doubt], graph: Graph,
    ) -> None:
        for row in sorted(before.keys() ^ after.keys()):
            states = State.BELIEVED, State.DOUBTED
            old, new = states[::-1] if row in before else states
            end = (before.get(row) or after[row]).ends[1]
            self._changes.append(Change(
                self.name(graph, row), Judged.ODOMETRY, self._source(end), self._stamp_ns(end),
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

    def name(self, graph: Graph, row: int) -> str:
        """
        Return the id of an edge: edges are counted along the path.

        Parameters
        ----------
        graph : Graph
        row : int

        """
        end = int(graph.memory['edge_i'][row, tb.END_J])
        return f'{self._source(end)}/{np.searchsorted(self._nodes.ids, end) - 1}'

    def _stamp_ns(self, node: int) -> int:
        return int(self._nodes.stamps_ns[np.searchsorted(self._nodes.ids, node)])

    def _source(self, node: int) -> str:
        """Return the source of the odometry that has led to a node."""
        return self._nodes.primary_at(self._stamp_ns(node))

    def verdicts(
        self, graph: Graph, closure: Callable[[int], str],
        fixes: Callable[[int], tuple[str, ...]],
    ) -> list[Verdict]:
        """
        Return the verdicts on doubted odometry.

        Parameters
        ----------
        graph : Graph
        closure : callable, returns the id of a closure by its number
        fixes : callable, returns the ids of the first fixes that are believed after a stamp

        """
        verdicts = []
        for row, doubt in sorted({**self._gaps, **self.doubts}.items()):
            edges = graph.edges_at(np.array(doubt.rows))
            begin, end = graph.poses[list(doubt.ends)] if len(doubt.rows) > 1 else (
                graph.poses[edges.i[0]], graph.poses[edges.j[0]])
            measured = integrated(edges.mean)[-1]
            against = fixes(self._stamp_ns(doubt.ends[1])) if row not in self.doubts else tuple(
                map(closure, doubt.seen_by[:MOST_NAMED]))
            distance = np.sqrt(np.sum(energies(
                edge_errors(graph.poses, edges), edges.information)))
            verdicts.append(Verdict(
                id=self.name(graph, row), kind=Judged.ODOMETRY,
                source=self._source(doubt.ends[1]), stamp_ns=self._stamp_ns(doubt.ends[1]),
                reference_ns=self._stamp_ns(doubt.ends[0]), state=State.DOUBTED,
                since_ns=doubt.since_ns, decision=Decision.AUTO,
                residual=se2.between(measured, se2.between(begin, end)),
                distance=float(distance), supported_by=(), contradicted_by=against, edge=True,
                row=row))
        return verdicts

    def _every(self) -> list[Doubt]:
        return [doubt for _, doubt in sorted({**self._gaps, **self.doubts}.items())]

    def drawn_rows(self, others: DrawnRows) -> DrawnRows:
        """Return rows that are drawn apart, with the doubted edges of odometry."""
        return others._replace(doubted=[*others.doubted, *(
            row for doubt in self._every() for row in doubt.rows)])

    def totals(self) -> dict[str, SourceVerdicts]:
        """Return how many edges of each source are doubted."""
        counts = Counter[str]()
        for doubt in self._every():
            counts[self._source(doubt.ends[1])] += len(doubt.rows)
        return {source: SourceVerdicts(
            {State.BELIEVED: len(self._nodes) - 1 - count, State.DOUBTED: count}, 1.0,
            doubting=False) for source, count in counts.items()}

    def saved(self) -> SavedOdometry:
        """Return all doubts."""
        every = list(self.doubts.values())
        return SavedOdometry(
            np.array(list(self.doubts), dtype=np.int64),
            np.array([each.ends for each in every], dtype=np.int64).reshape(-1, 2),
            np.array([each.weight for each in every], dtype=np.float64),
            np.array([each.since_ns for each in every], dtype=np.int64))

    def restore(self, saved: SavedOdometry) -> None:
        """Restore what `saved` has returned, for a graph with the same rows and weights."""
        self.doubts = {row: Doubt((row,), (ends[0], ends[1]), weight, since_ns)
                       for row, ends, weight, since_ns in zip(*(
                           column.tolist() for column in (
                               saved.rows, saved.ends, saved.weights, saved.since_ns)),
                           strict=True)}
