# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From attached measurements to one update of the graph."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import (
    BackendConfig,
    Correlation,
    OdometrySource,
)
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKinds, Edges, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.measurements import Absolute, GlobalPose, LoopClosure, Measurement
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.saved_columns import Integers, Pairs, Rows3, Rows6
from pose_graph_ros.core.sources import source_report
from pose_graph_ros.core.sources.gauss_markov import (
    Additions,
    GaussMarkovBias,
    GraphSizes,
    InflatedWeights,
    SavedBins,
)
from pose_graph_ros.core.sources.source_report import SourceReport

# A report is renewed when the number of measurements has grown by this factor.
MORE_RESIDUALS = 1.05


@dataclass(frozen=True, slots=True)
class SavedSource:
    """The measurements and constraints of one source."""

    seen_ns: Integers
    """Stamps of all measurements that were received [ns], sorted."""
    seen_references: Integers
    """For each stamp the reference of the loop closure, 0 for others; see `waiting`."""
    rows: Pairs
    """
    Stamp [ns] and row of each constraint, shape (K, 2). The rows are those of edges if the source
    has a bias, else those of observed nodes.
    """
    n_otherwise: int
    """Number of constraints that were added under other settings."""
    ties: Integers
    """Rows of its edges between hidden nodes, except those of the primary odometry."""
    bins: SavedBins | None
    """States of its bias, if it has one."""


@dataclass(frozen=True, slots=True)
class SavedEdges:
    """Edges that are not in the graph yet."""

    sources: tuple[str, ...]
    i: Integers
    j: Integers
    mean: Rows3
    information: Rows6
    kind: EdgeKinds
    stamps_ns: Pairs
    """Of a loop closure and of its other end [ns]; -1 for odometry."""


class QueuedEdge(NamedTuple):
    """An edge between hidden nodes for the next update."""

    source: str
    edge: Edges
    stamp_ns: int = -1
    """Of the loop closure [ns]; -1 for an edge of odometry."""
    reference_ns: int = -1
    """Stamp of its other end [ns]."""


class AttachedMeasurement(NamedTuple):
    """A measurement that is attached to a hidden node."""

    source: str
    observed: ObservedNodes
    """Its constraint if its error is treated as white."""
    measurement: Absolute
    attachment: Attachment


@dataclass(slots=True)
class Queue:
    """Constraints for the next update, with their sources."""

    edges: list[QueuedEdge] = field(default_factory=list)
    observed: list[AttachedMeasurement] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.edges) + len(self.observed)

    def extend(self, other: 'Queue') -> None:
        """Append all constraints of another queue."""
        self.edges += other.edges
        self.observed += other.observed

    def joined(self, other: 'Queue') -> 'Queue':
        """Return a new queue with the constraints of this one, then those of another one."""
        return Queue([*self.edges, *other.edges], [*self.observed, *other.observed])

    def halves(self) -> 'tuple[Queue, Queue]':
        """Return the first half of the constraints and the rest, as new queues."""
        half = len(self) // 2
        n_edges = min(half, len(self.edges))
        n_observed = half - n_edges
        return (Queue(self.edges[:n_edges], self.observed[:n_observed]),
                Queue(self.edges[n_edges:], self.observed[n_observed:]))


class ConstraintOrigin(NamedTuple):
    """The measurement that a constraint was made from."""

    source: str
    stamp_ns: int
    """[ns]; -1 for an edge between poses."""


class _SourceConstraints:
    """The constraints of one source."""

    def __init__(self) -> None:
        self.rows = GrowingArray((2,), np.int64)
        """Stamp [ns] and row in the graph."""
        self.report: SourceReport | None = None
        """The newest report."""
        self.n_otherwise = 0
        """Constraints of a loaded graph that were added under other settings."""


class NewConstraint(NamedTuple):
    """A constraint in the update that was built last."""

    is_edge: bool
    row: int
    """Its row in the graph once the update is applied."""
    source: str
    stamp_ns: int
    """Of the measurement [ns]; -1 for an edge of odometry."""
    kind: type[Measurement]
    """`LoopClosure` for all edges between poses."""
    reference_ns: int = -1
    """Stamp of the other end of a loop closure [ns]; else -1."""


class FactorBuilder:
    """
    Builds updates of the graph from queues of constraints.

    A measurement with a white error becomes an observed node. If the errors of its source are
    correlated in time, it becomes an edge to a state of the source's bias (`GaussMarkovBias`), or
    an observed node with a lower weight (`InflatedWeights`). Once the graph has taken the update,
    the constraints are registered for reweighting, and the source of each is recorded.

    Parameters
    ----------
    config : BackendConfig
    reweighting : Reweighting, where constraints with a robust loss are registered

    """

    def __init__(self, config: BackendConfig, reweighting: Reweighting) -> None:
        self._config = config
        self._reweighting = reweighting
        self._error_models: dict[str, GaussMarkovBias | InflatedWeights] = {}
        """Of the sources whose errors are correlated in time."""
        self._constraints: dict[str, _SourceConstraints] = {}
        self._pose_edges: dict[str, GrowingArray] = {}
        """Rows of the edges between poses, by source."""
        self.new: list[NewConstraint] = []
        """Constraints of the update that was built last."""
        self._n_new_bias_edges = 0
        self._new_weights: dict[int, float] = {}
        """Weights of observed nodes, by row, that the update sets."""
        self.n_bias_edges = 0
        """Number of edges of the graph that end at a bias."""

    def configure(self, config: BackendConfig) -> None:
        """Set the settings for later updates; error models that exist keep their own."""
        self._config = config

    @property
    def n_measurements(self) -> int:
        """Number of measurements in the graph, without loop closures."""
        return sum(len(each.rows) + each.n_otherwise for each in self._constraints.values())

    def build(self, queue: Queue, graph: Graph, *, settle: bool = False) -> GraphUpdate:
        """
        Return the update that adds the constraints of a queue to the graph.

        Call `commit` when the update has been applied, `rollback` when it has failed.

        Parameters
        ----------
        queue : Queue
        graph : Graph, it is not changed
        settle : bool, whether to set all weights that older measurements wait for

        """
        additions = Additions(GraphSizes(graph.n_nodes, graph.n_edges, graph.n_observed))
        for model in self._error_models.values():
            model.begin()
        self.new = [
            NewConstraint(True, additions.add_edge(edge), source, stamp_ns, LoopClosure, reference)
            for source, edge, stamp_ns, reference in queue.edges]
        for source, observed, measurement, attachment in sorted(
                queue.observed, key=lambda attached: attached.measurement.stamp_ns):
            kind, stamp_ns = type(measurement), measurement.stamp_ns
            error_model = self._error_model(source, kind)
            if isinstance(error_model, GaussMarkovBias):
                row = error_model.add(measurement, attachment, additions)
            elif isinstance(error_model, InflatedWeights):
                row = error_model.add(stamp_ns, observed, additions)
            else:
                row = additions.add_observed(observed)
            self.new.append(NewConstraint(
                isinstance(error_model, GaussMarkovBias), row, source, stamp_ns, kind))
        self._n_new_bias_edges = len(additions.edges) - len(queue.edges)
        for model in self._error_models.values() if settle else ():
            if isinstance(model, InflatedWeights):
                model.settle(additions)
        self._new_weights = additions.weigh_observed
        return GraphUpdate(
            biases=np.array(additions.biases).reshape(-1, 3),
            edges=Edges.joined(additions.edges), observed=ObservedNodes.joined(additions.observed),
            remove_edges=additions.remove_edges, remove_observed=additions.remove_observed,
            weigh_observed=self._changed_weights(additions.weigh_observed, graph))

    def _changed_weights(
        self, base_weights: Mapping[int, float], graph: Graph,
    ) -> dict[int, float]:
        """Return the weights that differ from those in the graph, given the new base weights."""
        present, changed = graph.memory['observed_f'][:graph.n_observed, tb.WEIGHT], {}
        for row, wanted in base_weights.items():
            if row >= graph.n_observed:
                changed[row] = wanted
                continue
            base, weight = self._reweighting.base_weight(row), float(present[row])
            # what a robust loss has taken off stays off
            target = wanted if base is None else wanted * (weight / base)
            if target != weight:
                changed[row] = target
        return changed

    def _error_model(
        self, source: str, kind: type[Measurement],
    ) -> GaussMarkovBias | InflatedWeights | None:
        """Return the model of the correlated errors of a source; None for white errors."""
        settings = self._config.measurement_source(source, kind)
        if settings.correlation_time == 0.0:
            return None
        if source not in self._error_models:
            inflate = settings.correlation is Correlation.INFLATE
            self._error_models[source] = (
                InflatedWeights(settings) if inflate else GaussMarkovBias(settings))
        return self._error_models[source]

    def rollback(self) -> None:
        """Discard the update that was built last."""
        for model in self._error_models.values():
            model.rollback()

    def commit(self) -> None:
        """Record the constraints of the update that was built last."""
        self.n_bias_edges += self._n_new_bias_edges
        for is_edge, row, source, stamp_ns, kind, _ in self.new:
            odometry = self._config.odometry.get(source) if stamp_ns < 0 else None
            settings = odometry or self._config.measurement_source(source, kind)
            loss = (settings.loss if isinstance(settings, OdometrySource)
                    else settings.applied_loss)
            self._reweighting.add(row, loss, settings.rejection_threshold, edge=is_edge)
            if kind is not LoopClosure:
                constraints = self._constraints.setdefault(source, _SourceConstraints())
                constraints.rows.append_one((stamp_ns, row))
            else:
                edges = self._pose_edges.setdefault(source, GrowingArray((), np.int64))
                edges.append_one(row)
        for row, weight in self._new_weights.items():
            self._reweighting.set_base_weight(row, weight)
        # from here on there is nothing that `rollback` could forget
        for model in self._error_models.values():
            model.begin()

    def origin(self, row: int, *, edge: bool) -> ConstraintOrigin | None:
        """
        Return where a constraint comes from; None if this builder has not added it.

        Parameters
        ----------
        row : int, in the table of edges or of observed nodes
        edge : bool, whether it is an edge

        """
        for source, constraints in self._constraints.items():
            if isinstance(self._error_models.get(source), GaussMarkovBias) is edge:
                # rows are appended in increasing order
                at = _find(constraints.rows.values[:, 1], row)
                if at >= 0:
                    return ConstraintOrigin(source, int(constraints.rows.values[at, 0]))
        for source, edges in self._pose_edges.items() if edge else ():
            if _find(edges.values, row) >= 0:
                return ConstraintOrigin(source, -1)
        return None

    def bias_origin(self, row: int) -> ConstraintOrigin | None:
        """Return the source of a bias, by its row in the graph, and when its bin begins."""
        for source, model in self._error_models.items():
            begin_ns = model.begin_ns(row) if isinstance(model, GaussMarkovBias) else None
            if begin_ns is not None:
                return ConstraintOrigin(source, begin_ns)
        return None

    def saved(self) -> dict[str, SavedSource]:
        """Return the state of each source, with empty `seen_ns` and `seen_references`."""
        result, none = {}, np.empty(0, dtype=np.int64)
        for source in dict.fromkeys((*self._constraints, *self._pose_edges)):
            model = self._error_models.get(source)
            constraints = self._constraints.get(source, _SourceConstraints())
            edges = self._pose_edges.get(source, GrowingArray((), np.int64))
            result[source] = SavedSource(
                none, none, constraints.rows.values.copy(), constraints.n_otherwise,
                edges.values.copy(), model.saved() if isinstance(model, GaussMarkovBias) else None)
        return result

    def restore(self, source: str, saved: SavedSource) -> None:
        """
        Restore the state of a source from what `saved` has returned.

        If its settings now ask for another error model, its constraints stay in the graph as they
        are, and new measurements start a model of their own.

        Parameters
        ----------
        source : str
        saved : SavedSource

        """
        if len(saved.ties) > 0:
            self._pose_edges[source] = GrowingArray((), np.int64)
            self._pose_edges[source].append(saved.ties)
        if len(saved.rows) + saved.n_otherwise == 0:
            return
        self._constraints[source] = constraints = _SourceConstraints()
        # the default settings of all kinds have the same error model
        model = self._error_model(source, GlobalPose)
        if isinstance(model, GaussMarkovBias):
            same = saved.bins is not None and model.restore(saved.bins)
        else:
            same = saved.bins is None
            if isinstance(model, InflatedWeights) and same:
                model.restore(saved.rows)
        constraints.rows.append(saved.rows if same else saved.rows[:0])
        constraints.n_otherwise = saved.n_otherwise + len(saved.rows) - len(constraints.rows)

    def reports(self, graph: Graph) -> dict[str, SourceReport]:
        """Return how well the newest measurements of each source fit the estimate."""
        reports = {}
        for source, constraints in self._constraints.items():
            n, model = len(constraints.rows), self._error_models.get(source)
            if n > 0 and (constraints.report is None
                          or n > MORE_RESIDUALS * constraints.report.n):
                constraints.report = source_report.report(
                    graph, constraints.rows.values, biased=isinstance(model, GaussMarkovBias),
                    white=model is None)
            # a source of headings alone has no residuals of positions
            if constraints.report is not None and constraints.report.energy > 0.0:
                reports[source] = constraints.report
        return reports


def _find(rows: npt.NDArray[np.generic], row: int) -> int:
    """Return the index of a row among increasing rows; -1 if it is missing."""
    at = int(np.searchsorted(rows, row))
    return at if at < len(rows) and rows[at] == row else -1
