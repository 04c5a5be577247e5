# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From bound measurements to one update of the graph, each as its source's settings want it.

White errors make observed nodes; errors that live on make edges to the states of the error, or
observed nodes with shares of a weight. What has a robust loss is enlisted for reweighing, and of
every source it is remembered which constraints are its own.
"""

from dataclasses import dataclass, field
from typing import cast, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import autocorrelation, linearize, se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.binding import Anchor
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedNodes
from pose_graph_ros.core.correlated import Additions, BiasChain, GraphSizes, SavedBins, Shares
from pose_graph_ros.core.graph import Graph, GraphUpdate
from pose_graph_ros.core.measurements import Absolute, GlobalPose, LoopClosure, Measurement
from pose_graph_ros.core.reweighing import Reweighing
from pose_graph_ros.core.saved_columns import Integers, Pairs, Rows3, Rows6
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.sources import Correlation, MeasurementSource, OdometrySource

# So many of the newest residuals of a source are looked at, anew when there are so many more.
MOST_RESIDUALS = 5000
MORE_RESIDUALS = 1.05
# Residuals that are so much smaller than was claimed do no harm, whatever they look like.
LEAST_ENERGY = 0.1


@dataclass(frozen=True, slots=True)
class SavedSource:
    """A source of measurements."""

    seen_ns: Integers
    """Stamps of all that have come, increasing ..."""
    seen_references: Integers
    """... and what tells closures of one stamp apart; see `pending`."""
    rows: Pairs
    """Stamps and rows of its constraints, shape (K, 2): edges to biases or observed nodes."""
    n_otherwise: int
    """Constraints that came before its settings were others."""
    ties: Integers
    """Its edges between hidden nodes; not those of an odometry that made the nodes."""
    bins: SavedBins | None
    """Where its errors are estimated as a bias."""


@dataclass(frozen=True, slots=True)
class SavedEdges:
    """Edges that have not joined the graph yet."""

    sources: tuple[str, ...]
    i: Integers
    j: Integers
    mean: Rows3
    information: Rows6
    kind: Integers


class Bound(NamedTuple):
    """A measurement that is bound to a hidden node."""

    source: str
    observed: ObservedNodes
    """Its constraint, if its error is white."""
    measurement: Absolute
    anchor: Anchor


@dataclass(slots=True)
class Queue:
    """Constraints that are bound and join the graph at the next update, with their sources."""

    edges: list[tuple[str, Edges]] = field(default_factory=list)
    observed: list[Bound] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.edges) + len(self.observed)

    def all_observed(self) -> ObservedNodes:
        """Return the observed nodes as one table."""
        return ObservedNodes.joined([bound.observed for bound in self.observed])


class SourceReport(NamedTuple):
    """How well the measurements of a source fit."""

    n: int
    """Measurements in the graph."""
    energy: float
    """Mean squared residual of a coordinate in units of the sigmas that it came with."""
    errors: autocorrelation.Autocorrelation
    """Of the newest residuals [m]."""
    white: bool
    """Whether its errors are taken for white."""

    @property
    def wrongly_white(self) -> bool:
        """Whether its errors look correlated but are taken for white: the claims are too good."""
        return self.white and self.errors.significant and self.energy > LEAST_ENERGY


class Origin(NamedTuple):
    """Where a constraint comes from."""

    source: str
    stamp_ns: int
    """Of the measurement [ns]; -1 for an edge between poses."""


class _Enlisted(NamedTuple):
    """A constraint of the update that was begun."""

    is_edge: bool
    row: int
    source: str
    stamp_ns: int
    """Of the measurement [ns]; -1 for an edge between poses."""
    kind: type[Measurement]


class _Own:
    """The constraints of one source."""

    def __init__(self) -> None:
        self.rows = GrowingArray((2,), np.int64)
        """Stamp and row in the graph."""
        self.report: SourceReport | None = None
        """The newest."""
        self.n_otherwise = 0
        """Constraints that joined a graph that was loaded, by other settings than now."""


class Joining:
    """
    Turns queues into updates of the graph.

    Parameters
    ----------
    config : BackendConfig
    reweighing : Reweighing

    """

    def __init__(self, config: BackendConfig, reweighing: Reweighing) -> None:
        self._config = config
        self._reweighing = reweighing
        self._correlated: dict[str, BiasChain | Shares] = {}
        self._own: dict[str, _Own] = {}
        self._ties: dict[str, GrowingArray] = {}
        """Of each source its edges between poses, by their numbers in the graph."""
        self._enlisted: list[_Enlisted] = []
        self._n_new = 0
        self._shares: dict[int, float] = {}
        self.n_bias_edges = 0
        """Edges of the graph that lead to states of an error."""

    def configure(self, config: BackendConfig) -> None:
        """Take other settings, for what joins from now on; of errors that live on the same."""
        self._config = config

    def settings(self, source: str, kind: type[Measurement]) -> MeasurementSource:
        """Return the settings of a source of measurements of a kind."""
        return self._config.measurement_source(source, kind)

    @property
    def n_measurements(self) -> int:
        """Number of measurements in the map that have joined the graph."""
        return sum(len(own.rows) + own.n_otherwise for own in self._own.values())

    def begin(self, queue: Queue, graph: Graph) -> GraphUpdate:
        """Return the update that adds all of a queue; `finish` or `undo` comes next."""
        additions = Additions(GraphSizes(graph.n_nodes, graph.n_edges, graph.n_observed))
        self._enlisted.clear()
        for old in self._correlated.values():
            old.begin()
        for source, edge in queue.edges:
            self._enlisted.append(
                _Enlisted(True, additions.add_edge(edge), source, -1, LoopClosure))
        for bound in sorted(queue.observed, key=lambda bound: bound.measurement.stamp_ns):
            kind, stamp_ns = type(bound.measurement), bound.measurement.stamp_ns
            chain = self._chain(bound.source, kind)
            if isinstance(chain, BiasChain):
                row = chain.add(bound.measurement, bound.anchor, additions)
            elif isinstance(chain, Shares):
                row = chain.add(stamp_ns, bound.observed, additions)
            else:
                row = additions.add_observed(bound.observed)
            self._enlisted.append(
                _Enlisted(isinstance(chain, BiasChain), row, bound.source, stamp_ns, kind))
        self._n_new = len(additions.edges) - len(queue.edges)
        self._shares = additions.weigh_observed
        return GraphUpdate(
            biases=np.array(additions.biases).reshape(-1, 3),
            edges=Edges.joined(additions.edges), observed=ObservedNodes.joined(additions.observed),
            remove_edges=additions.remove_edges, remove_observed=additions.remove_observed,
            weigh_observed=additions.weigh_observed)

    def _chain(self, source: str, kind: type[Measurement]) -> BiasChain | Shares | None:
        settings = self.settings(source, kind)
        if settings.correlation_time == 0.0:
            return None
        if source not in self._correlated:
            inflate = settings.correlation is Correlation.INFLATE
            self._correlated[source] = Shares(settings) if inflate else BiasChain(settings)
        return self._correlated[source]

    def undo(self) -> None:
        """Forget the update that was begun: it has failed."""
        for chain in self._correlated.values():
            chain.undo()

    def finish(self) -> None:
        """Remember what the update that was begun has added."""
        self.n_bias_edges += self._n_new
        for is_edge, row, source, stamp_ns, kind in self._enlisted:
            settings: MeasurementSource | OdometrySource | None = (
                self._config.odometry.get(source) if stamp_ns < 0 else None)
            settings = settings or self.settings(source, kind)
            enlist = self._reweighing.add_edge if is_edge else self._reweighing.add_observed
            enlist(row, settings.loss, settings.rejection_threshold)
            if stamp_ns >= 0:
                self._own.setdefault(source, _Own()).rows.append_one((stamp_ns, row))
            else:
                ties = self._ties.setdefault(source, GrowingArray((), np.int64))
                ties.append_one(row)
        for row, share in self._shares.items():
            self._reweighing.share(row, share)

    def origin(self, row: int, *, edge: bool) -> Origin | None:
        """Return where an edge or an observed node comes from, if it came through here."""
        for source, own in self._own.items():
            if isinstance(self._correlated.get(source), BiasChain) is edge:
                # rows grow in the order in which they came
                at = _find(own.rows.values[:, 1], row)
                if at >= 0:
                    return Origin(source, int(own.rows.values[at, 0]))
        for source, ties in self._ties.items() if edge else ():
            if _find(ties.values, row) >= 0:
                return Origin(source, -1)
        return None

    def bias_origin(self, row: int) -> Origin | None:
        """Return the source of a state of an error, by its row, and when the state begins."""
        for source, chain in self._correlated.items():
            begin_ns = chain.begin_ns(row) if isinstance(chain, BiasChain) else None
            if begin_ns is not None:
                return Origin(source, begin_ns)
        return None

    def saved(self) -> dict[str, SavedSource]:
        """Return what there is of each source; which measurements were seen is not known here."""
        result, none = {}, np.empty(0, dtype=np.int64)
        for source in dict.fromkeys((*self._own, *self._ties)):
            chain, own = self._correlated.get(source), self._own.get(source, _Own())
            ties = self._ties.get(source, GrowingArray((), np.int64))
            result[source] = SavedSource(
                none, none, cast('IntArray', own.rows.values).copy(), own.n_otherwise,
                cast('IntArray', ties.values).copy(),
                chain.saved() if isinstance(chain, BiasChain) else None)
        return result

    def restore(self, source: str, saved: SavedSource) -> None:
        """
        Take what `saved` has returned for a source.

        If its errors are now treated in another way, what is in the graph stays as it is, and
        what comes begins anew.
        """
        if len(saved.ties) > 0:
            self._ties[source] = GrowingArray((), np.int64)
            self._ties[source].append(saved.ties)
        if len(saved.rows) + saved.n_otherwise == 0:
            return
        self._own[source] = own = _Own()
        # by default errors live on with no kind of measurements
        chain = self._chain(source, GlobalPose)
        if isinstance(chain, BiasChain):
            same = saved.bins is not None and chain.restore(saved.bins)
        else:
            same = saved.bins is None
            if isinstance(chain, Shares) and same:
                chain.restore(saved.rows)
        own.rows.append(saved.rows if same else saved.rows[:0])
        own.n_otherwise = saved.n_otherwise + len(saved.rows) - len(own.rows)

    def count_bias_edges(self, graph: Graph) -> None:
        """Count the edges to states of an error in a graph that was loaded."""
        self.n_bias_edges = int(np.sum(graph.edges.kind == EdgeKind.BIAS))

    def reports(self, graph: Graph) -> dict[str, SourceReport]:
        """Return how well each source fits, by its newest measurements."""
        for source, own in self._own.items():
            n = len(own.rows)
            if n > 0 and (own.report is None or n > MORE_RESIDUALS * own.report.n):
                own.report = self._report(graph, source, own)
        # a source of headings alone has no residuals of positions
        return {source: own.report for source, own in self._own.items()
                if own.report is not None and own.report.energy > 0.0}

    def _report(self, graph: Graph, source: str, own: _Own) -> SourceReport:
        newest = own.rows.values[-MOST_RESIDUALS:].astype(np.int64)
        newest = newest[np.argsort(newest[:, 0], kind='stable')]
        newest = newest[np.append(True, np.diff(newest[:, 0]) > 0)]
        stamps, rows = newest[:, 0], newest[:, 1]
        if isinstance(self._correlated.get(source), BiasChain):
            residuals, information = _biased_residuals(graph, graph.edges_at(rows))
        else:
            residuals, information = _residuals(graph, graph.observed_at(rows))
        energy = np.einsum('ki,kij,kj->k', residuals, information, residuals)
        return SourceReport(
            len(own.rows), float(np.mean(energy)) / 2.0,
            autocorrelation.estimate(stamps, residuals), source not in self._correlated)


def _find(rows: npt.NDArray[np.generic], row: int) -> int:
    """Return where a number stands among numbers that grow, or -1."""
    at = int(np.searchsorted(rows, row))
    return at if at < len(rows) and rows[at] == row else -1


def _residuals(graph: Graph, observed: ObservedNodes) -> tuple[FloatArray, FloatArray]:
    """Return residuals of the positions in map axes, shape (K, 2), and their information."""
    errors = linearize.observed_errors(graph.poses, observed)
    turn = se2.rotation(observed.mean[:, 2])
    back = np.einsum('kij,kj->ki', turn, errors[:, :2])
    information = turn @ observed.information[:, :2, :2] @ np.swapaxes(turn, 1, 2)
    return back, information


def _biased_residuals(graph: Graph, edges: Edges) -> tuple[FloatArray, FloatArray]:
    """Return the same where the state of the error is a part of the residual."""
    poses = graph.poses
    errors = linearize.edge_errors(poses, edges)[:, :2]
    factor = edges.bias[:, 2]
    total = errors - factor[:, None] * poses[edges.j, :2]
    variance = factor**2 + 1.0 / (0.5 * np.trace(
        edges.information[:, :2, :2], axis1=1, axis2=2) + 1e-12)
    return total, np.eye(2) / variance[:, None, None]
