# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From attached measurements to one update of the graph."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import BackendConfig, MeasurementSource, OdometrySource
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure
from pose_graph_ros.core.sources import source_report
from pose_graph_ros.core.sources.gauss_markov import (
    Additions,
    BiasChain,
    CorrelatedErrors,
    GaussMarkovBias,
)
from pose_graph_ros.core.sources.gyro_bias import GyroBias
from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.core.sources.source_constraints import (
    AttachedMeasurement,
    ConstraintOrigin,
    NewConstraint,
    NO_NOISE,
    Queue,
    SavedSource,
    SourceConstraints,
)
from pose_graph_ros.core.sources.source_report import SourceReport


class FactorBuilder:
    """
    Builds updates of the graph from queues of constraints.

    A measurement with a white error becomes an observed node. If the errors of its source are
    correlated in time, it becomes an edge to a state of the source's bias (`GaussMarkovBias`).
    Once the graph has taken the update, the constraints are registered for reweighting, and the
    source of each is recorded.
    """

    def __init__(self, config: BackendConfig, reweighting: Reweighting) -> None:
        self.config = config    # for later updates; error models keep their own settings
        self._reweighting = reweighting
        # of the sources whose errors are correlated in time
        self._error_models: dict[str, GaussMarkovBias] = {}
        self._constraints: dict[str, SourceConstraints] = {}
        self._pose_edges: dict[str, GrowingArray] = {}  # ids of the edges between poses, by source
        self.new: list[NewConstraint] = []  # constraints of the update that was built last
        # biases of gyroscopes, and the edges of their rotations
        self.gyros: dict[str, GyroBias] = {}
        self._abandoned: list[int] = []  # ids of biases that hold no measurement any more

    @property
    def _chains(self) -> list[tuple[str, BiasChain]]:
        return [*self._error_models.items(), *self.gyros.items()]

    @property
    def n_measurements(self) -> int:
        """Number of measurements in the graph, without loop closures."""
        return sum(len(each) + each.n_otherwise for each in self._constraints.values())

    def build(self, queue: Queue, graph: Graph) -> GraphUpdate:
        """
        Return the update that adds a queue to the graph, to be followed by `commit` or `rollback`.
        """
        additions = Additions(graph.next_ids)
        for _, chain in self._chains:
            chain.begin()
        self.new = [
            NewConstraint(additions.add(edge), source, stamp_ns, kind, reference)
            for source, edge, stamp_ns, reference, kind in queue.edges]
        self.new += [self._add(attached, additions) for attached in sorted(
            queue.observed, key=lambda attached: attached.measurement.stamp_ns)]
        for turn in sorted(queue.turns, key=lambda turn: turn.stamp_ns):
            self.gyro_bias(turn.source).add(turn, graph, additions)
        return additions.update()

    def _add(self, attached: AttachedMeasurement, additions: Additions) -> NewConstraint:
        """Add a measurement to an update, as the errors of its source ask for."""
        source, observed, measurement, *_ = attached
        kind, stamp_ns = type(measurement), measurement.stamp_ns
        settings = self.config.measurement_source(source, kind)
        model = self._error_model(source, settings)
        noise = NO_NOISE if settings.correlation_time == 0.0 else attached.noise
        if model is None:
            return NewConstraint(
                additions.add(observed), source, stamp_ns, kind, noise=noise)
        if not settings.finds_correlation:
            return NewConstraint(
                model.add(stamp_ns, observed, noise, additions), source, stamp_ns, kind)
        added = additions.add(observed.weighted(0.0))
        edge = model.add(stamp_ns, observed, noise, additions)
        return NewConstraint(added, source, stamp_ns, kind, noise=noise, held_by=edge)

    def gyro_bias(self, source: str) -> GyroBias:
        """Return the bias of a gyroscope, which may be new."""
        return self.gyros.setdefault(source, GyroBias(self.config.gyro(source)))

    def gyro_rates(self, graph: Graph) -> dict[str, float]:
        """Return the newest estimate of the bias of each gyroscope [rad/s]."""
        rows = {source: int(graph.node_rows(bias.newest)) for source, bias in self.gyros.items()}
        return {source: float(graph.poses[row, 0]) for source, row in rows.items() if row >= 0}

    def error_model(self, source: str) -> GaussMarkovBias | None:
        """Return the model of the errors of a source in use; None for white errors."""
        return self._error_models.get(source)

    def _error_model(
        self, source: str, settings: MeasurementSource,
    ) -> GaussMarkovBias | None:
        """Return the model of the correlated errors of a source; None for white errors."""
        if settings.correlation_time == 0.0:
            return None
        if source not in self._error_models and not settings.finds_correlation:
            self._error_models[source] = GaussMarkovBias(
                CorrelatedErrors(settings.correlation_time, 1.0, SOURCES.white_share))
        return self._error_models.get(source)

    def finding(self) -> list[str]:
        """Return the sources whose errors are estimated and that have measurements."""
        return [source for source, constraints in self._constraints.items()
                if constraints.n_ever >= SOURCES.least_positions
                and self._settings(source).finds_correlation]

    def due_for_estimate(self) -> list[str]:
        """Return those of `finding` with enough new measurements for another estimate."""
        return [source for source in self.finding() if self._constraints[source].n_ever
                >= self._constraints[source].next_estimate]

    def has(self, source: str) -> bool:
        return source in self._constraints

    def constraints(self, source: str) -> SourceConstraints:
        return self._constraints[source]

    def pose_edges(self) -> dict[str, IntArray]:
        """Return the ids of the edges between poses, by source, without primary odometry."""
        return {source: edges.values for source, edges in self._pose_edges.items()}

    def held(self) -> dict[str, tuple[IntArray, IntArray]]:
        """Return the stamps of all measurements in the map [ns], and ids of what holds them."""
        return {source: (each.rows.values[:, 0], each.held())
                for source, each in self._constraints.items()}

    def errors_in_use(self, source: str) -> CorrelatedErrors | None:
        """Return the statistics of the errors of a source in use; None for white errors."""
        model = self._error_models.get(source)
        return None if model is None or model.errors.tau == 0.0 else model.errors

    def set_error_model(self, source: str, model: GaussMarkovBias | None) -> None:
        old = self._error_models.pop(source, None)
        if old is not None:
            self.abandon(old)
        if model is not None:
            model.begin()   # what it has by now is in the graph
            self._error_models[source] = model
        self._constraints[source].n_reported = 0

    def abandon(self, model: GaussMarkovBias) -> None:
        """Let the states of a bias that holds no measurement leave with the next nodes."""
        self._abandoned += model.nodes

    def leaving_biases(
        self, factors: IntArray, others: Mapping[str, GaussMarkovBias],
    ) -> list[int]:
        """Return the ids of the biases that nothing needs once constraints have left the graph."""
        biases = [*self._abandoned]
        for gyro in self.gyros.values():
            biases += gyro.leaving(factors)
        for source, constraints in self._constraints.items():
            models = [each[source] for each in (self._error_models, others) if source in each]
            left = constraints.rows.values[~constraints.leaving(factors), 0]
            oldest_ns = int(np.min(left)) if len(left) > 0 else None
            for model in models:
                biases += model.leaving(oldest_ns)
        return biases

    def forget(self, nodes: IntArray, factors: IntArray) -> dict[str, IntArray]:
        """Return the numbers of the measurements that are left, after forgetting the others."""
        gone, kept = {*nodes.tolist()}, {}
        for _, chain in self._chains:
            chain.forget(gone)
        for gyro in self.gyros.values():
            gyro.forget_factors(factors)
        self._abandoned = [node for node in self._abandoned if node not in gone]
        for source, constraints in self._constraints.items():
            kept[source] = constraints.forget(constraints.leaving(factors))
        for known in self._pose_edges.values():
            known.select(np.flatnonzero(~np.isin(known.values, factors)))
        return kept

    def rollback(self) -> None:
        for _, chain in self._chains:
            chain.rollback()

    def commit(self) -> None:
        for number, source, stamp_ns, kind, _, noise, held_by in self.new:
            odometry = self.config.odometry.get(source) if stamp_ns < 0 else None
            settings = odometry or self.config.measurement_source(source, kind)
            loss = (settings.loss if isinstance(settings, OdometrySource)
                    else settings.applied_loss)
            threshold = settings.rejection_threshold
            self._reweighting.add(number, loss, threshold)
            if held_by >= 0:
                self._reweighting.add(held_by, loss, threshold)
                self._reweighting.set_base_weight(number, 0.0)
            if kind is not LoopClosure:
                constraints = self._constraints.setdefault(source, SourceConstraints())
                constraints.append(stamp_ns, number, noise, held_by)
            else:
                edges = self._pose_edges.setdefault(source, GrowingArray((), np.int64))
                edges.append_one(number)
        # from here on there is nothing that `rollback` could forget
        for _, chain in self._chains:
            chain.begin()

    def origin(self, number: int) -> ConstraintOrigin | None:
        """Return where a constraint comes from; None if this builder has not added it."""
        for source, constraints in self._constraints.items():
            stamp_ns = constraints.stamp_ns(number)
            if stamp_ns is not None:
                return ConstraintOrigin(source, stamp_ns)
        for source, edges in self._pose_edges.items():
            at = int(np.searchsorted(edges.values, number))
            if at < len(edges) and edges.values[at] == number:
                return ConstraintOrigin(source, -1)
        for source, gyro in self.gyros.items():
            if number in gyro.edges:
                return ConstraintOrigin(source, -1)
        return None

    def bias_origin(self, node: int) -> ConstraintOrigin | None:
        """Return the source of a bias, by its id, and when its bin begins."""
        for source, chain in self._chains:
            begin_ns = chain.begin_ns(node)
            if begin_ns is not None:
                return ConstraintOrigin(source, begin_ns)
        return None

    def saved(self) -> dict[str, SavedSource]:
        """Return the state of each source, with empty `seen_ns` and `seen_references`."""
        result, none = {}, np.empty(0, dtype=np.int64)
        for source in dict.fromkeys((*self._constraints, *self._pose_edges)):
            model = self._error_models.get(source)
            constraints = self._constraints.get(source, SourceConstraints())
            edges = self._pose_edges.get(source, GrowingArray((), np.int64))
            saved = SavedSource(
                none, none, constraints.rows.values.copy(), constraints.n_otherwise,
                edges.values.copy(),
                None if model is None else model.saved(),
                n_gone=constraints.n_gone)
            if self._settings(source).finds_correlation:
                saved = replace(
                    saved, errors=self.errors_in_use(source),
                    noise=constraints.noise.values.copy(), edges=constraints.edges.values.copy(),
                    next_estimate=constraints.next_estimate,
                    odometry=np.array(constraints.odometry), past=constraints.past)
            result[source] = saved
        return result

    def restore(self, source: str, saved: SavedSource) -> None:
        """
        Restore the state of a source from what `saved` has returned.

        If its settings now ask for another error model, its constraints stay in the graph as they
        are, and new measurements start a model of their own.
        """
        if len(saved.ties) > 0:
            self._pose_edges[source] = GrowingArray((), np.int64)
            self._pose_edges[source].append(saved.ties)
        if len(saved.rows) + saved.n_otherwise == 0:
            return
        settings = self._settings(source)
        if settings.finds_correlation and saved.errors is not None:
            self._error_models[source] = GaussMarkovBias(saved.errors)
        model = self._error_model(source, settings)
        if model is None:
            same = saved.bins is None
        else:
            same = saved.bins is not None and model.restore(saved.bins)
        if not same and settings.finds_correlation:
            self._error_models.pop(source, None)
        same = same and settings.finds_correlation >= (saved.errors is not None)
        self._constraints[source] = constraints = SourceConstraints()
        if same:
            constraints.restore(saved)
        constraints.n_otherwise = saved.n_otherwise + len(saved.rows) - len(constraints)

    def _settings(self, source: str) -> MeasurementSource:
        return self.config.measurement_source(source, GlobalPose)

    def reports(self, graph: Graph) -> dict[str, SourceReport]:
        """Return how well the newest measurements of each source fit the estimate."""
        for source, constraints in self._constraints.items():
            n, before = constraints.n_ever, constraints.n_reported
            if n - before > SOURCES.more_residuals * min(len(constraints), before):
                constraints.report = self.report(source, graph)
                constraints.n_reported = n if constraints.report.n > 0 else 0
        return {source: each.report for source, each in self._constraints.items()
                if each.report is not None and each.report.energy > 0.0}

    def report(self, source: str, graph: Graph) -> SourceReport:
        constraints = self._constraints[source]
        return source_report.report(
            graph, constraints.rows.values[constraints.are_used(graph)],
            in_use=self.errors_in_use(source), found=self._settings(source).finds_correlation)
