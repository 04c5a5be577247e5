# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From queued constraints to one update of the graph, and what is kept of each source."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from pose_graph_ros.core import measurements, saved_columns
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import BackendConfig, MeasurementSource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import Covariance, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.odometry.hidden_nodes import NewNode
from pose_graph_ros.core.odometry.motion import as_calibrated, AS_CLAIMED, OdometryErrors
from pose_graph_ros.core.sources import bias as bs, source_report
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.core.sources.source_report import SourceReport

# A measurement in the map, or of a landmark: its stamp [ns], the id of what it was first added as,
# that of the edge that holds it instead, or -1, and `Queued.noise`.
MEASURED = np.dtype([('stamp_ns', 'i8'), ('id', 'i8'), ('held_by', 'i8'), ('noise', 'f8', 2)])
# An edge between poses: `Queued.stamp_ns`, and its id.
EDGE = np.dtype([('stamp_ns', 'i8'), ('id', 'i8')])


@dataclass(slots=True)
class SourceState:
    """
    What the graph has of one source; it is saved as it is.

    A measurement whose error was found to be correlated keeps its observed node, with weight 0;
    an edge to the bias holds it instead. So it can become white again, or get another bias. With a
    given correlation time that edge is what it is added as.
    """

    measured: Annotated[GrowingArray, saved_columns.Column(MEASURED)] = field(
        default_factory=lambda: GrowingArray((), MEASURED))
    edges: Annotated[GrowingArray, saved_columns.Column(EDGE)] = field(
        default_factory=lambda: GrowingArray((), EDGE))  # but those of primary odometry
    # of errors that are correlated, of a gyroscope, or of what an odometry is calibrated by
    bias: bs.BiasChain | None = None
    errors: bs.CorrelatedErrors | None = None  # found ones in use; None for white or given ones
    n_otherwise: int = 0  # constraints of a loaded graph that were added under other settings
    n_gone: int = 0  # number of measurements that have left the graph

    def __len__(self) -> int:
        return len(self.measured)

    @property
    def n_ever(self) -> int:
        """Number of measurements, with those that have left the graph."""
        return len(self) + self.n_gone

    def forget(self, nodes: IntArray, factors: IntArray) -> IntArray:
        """Return the numbers of the measurements that are left, after forgetting the others."""
        kept = np.flatnonzero(~np.isin(self.measured['id'], factors))
        self.n_gone += len(self) - len(kept)
        for table in (self.measured, self.edges):
            gone = np.isin(table['id'], factors)
            if np.any(gone):
                table.select(np.flatnonzero(~gone))
        if self.bias is not None:
            self.bias = self.bias.without(nodes)
        return kept

    def held(self, which: IntArray | slice = slice(None)) -> IntArray:
        """Return the ids of the factors that hold some measurements."""
        some = self.measured.values[which]
        return np.where(some['held_by'] >= 0, some['held_by'], some['id'])


class FactorBuilder:
    """
    Builds updates of the graph from queues of constraints.

    A measurement with a white error becomes an observed node. If the errors of its source are
    correlated in time, it becomes an edge to a state of the source's bias. Nothing is changed
    before `commit` says that the graph has taken the update: then the constraints are registered
    for reweighting and with their sources.
    """

    def __init__(self, config: BackendConfig, reweighting: Reweighting) -> None:
        self.config = config    # for later updates; error models keep their own settings
        self._reweighting = reweighting
        self.sources: dict[str, SourceState] = {}
        # constraints of the update that was built last, as far as a source keeps them, and the
        # chains that it makes
        self.new: list[Queued] = []
        self._chains: dict[str, bs.BiasChain] = {}
        self._abandoned: list[int] = []  # ids of biases that hold no measurement any more
        # of each source the newest report, and the number of measurements when it was made, 0 if
        # none of them was used
        self._reports: dict[str, tuple[SourceReport, int]] = {}

    def build(self, queue: Sequence[Queued], graph: Graph) -> GraphUpdate:
        """Return the update that adds a queue to the graph, to be followed by `commit`."""
        additions = bs.Additions(graph.next_ids)
        queue = sorted(queue, key=_order)
        self._extend_chains(queue, graph, additions)
        self.new = []
        for queued in queue:
            source, factor, edge = queued.source, queued.factor, None
            errors = self._errors(queued) if queued.is_in_map else None
            if errors is not None:
                edge = bs.held_by_bias(queued, self._chains[source], errors)
                if not self._settings(source, queued.measured).finds_correlation:
                    factor, edge = edge, None
            elif queued.needs_bias:
                factor = factor.replaced(**{'i' if len(queued.nodes) == 0 else 'k': [
                    self._chains[source].state(queued.stamp_ns)]})
            number = int(additions.add(factor if edge is None else factor.replaced(weight=0.0))[0])
            if len(queued.nodes) == 0:
                continue    # it has a say on the bias alone
            self.new.append(queued._replace(
                number=number, held_by=-1 if edge is None else int(additions.add(edge)[0])))
        return additions.update()

    def _extend_chains(self, queue: list[Queued], graph: Graph, additions: bs.Additions) -> None:
        """Make the chains of sources with the states that a queue needs, which are added."""
        needed: dict[tuple[str, bs.Process], list[Queued]] = {}
        for queued in queue:
            errors = self._errors(queued) if queued.is_in_map else None
            if errors is not None:
                process = bs.Process.correlated(errors)
            elif queued.needs_bias:
                process = bs.Process.of_gyro(self.config.gyro(queued.source))
            else:
                continue
            needed.setdefault((queued.source, process), []).append(queued)
        chains = self._chains = {}
        for (source, process), some in needed.items():
            chain = chains.get(source) or self._state(source).bias or bs.BiasChain()
            value = np.zeros(3)
            if len(process.growth) > 0 and len(chain) > 0:
                value = graph.poses_of(chain.nodes[-1])
            elif len(process.growth) > 0:
                value = next((each.factor.mean[0] for each in some if len(each.nodes) == 0), value)
            stamps_ns = np.array([each.stamp_ns for each in some])
            chains[source] = chain.with_bins(stamps_ns, process, additions, value)

    def next_node(self, made: NewNode, graph: Graph) -> tuple[GraphUpdate, bs.BiasChain]:
        """
        Return an update with a node behind the newest one by calibrated odometry.

        The edge to the node is its last factor. With it comes the chain, for `keep`.
        """
        assert made.information is not None, 'it is not the first one'
        first, last = graph.next_ids, graph.newest_pose
        additions = bs.Additions(first._replace(node=first.node + 1))  # the pose is before them
        chain, value = self._state(made.source).bias or bs.BiasChain(), np.zeros(3)
        if len(chain) > 0:
            value = graph.poses_of(chain.nodes[-1])
        process = bs.Process.of_odometry(self.config.odometry_source(made.source))
        chain = chain.with_bins(np.array([made.stamp_ns]), process, additions, value)
        edge = Factors([last], [first.node], made.mean[None], made.information[None],
                       [FactorKind.ODOMETRY], constants=[(0.0, 0.0, 0.0, -made.moving)], k=[0])
        motion = as_calibrated(edge, value[None]).mean
        additions.add(edge.replaced(k=[chain.state(made.stamp_ns)]))
        hidden = se2.compose(graph.poses_of(last), motion)
        return additions.update()._replace(hidden=hidden), chain

    def keep(self, source: str, chain: bs.BiasChain) -> None:
        """Keep the chain of an update that the graph has taken."""
        self.sources.setdefault(source, SourceState()).bias = chain

    def commit(self) -> None:
        for new in self.new:
            state = self.sources.setdefault(new.source, SourceState())
            if new.measured is measurements.LoopClosure:
                state.edges.append_one((new.stamp_ns, new.number))
            else:
                state.measured.append_one(
                    (new.stamp_ns, new.number, new.held_by, new.noise.tolist()))
            if new.needs_bias or new.stamp_ns < 0:
                continue    # neither a rotation nor odometry has a loss
            settings = self._settings(new.source, new.measured)
            for number in (new.number, *([new.held_by] if new.held_by >= 0 else ())):
                self._reweighting.add(number, settings.applied_loss, settings.rejection_threshold)
            if new.held_by >= 0:
                self._reweighting.set_base_weight(new.number, 0.0)
        for source, chain in self._chains.items():
            self.keep(source, chain)

    def _settings(self, source: str, kind: type = measurements.GlobalPose) -> MeasurementSource:
        return self.config.measurement_source(source, kind)

    def _state(self, source: str) -> SourceState:
        return self.sources.get(source, SourceState())

    def has(self, source: str) -> bool:
        """Tell whether a source has, or had, measurements in the map."""
        state = self._state(source)
        return state.n_ever + state.n_otherwise > 0

    def _errors(self, queued: Queued) -> bs.CorrelatedErrors | None:
        """Return the correlated errors that a measurement is treated with; None for white ones."""
        settings = self._settings(queued.source, queued.measured)
        return (self._state(queued.source).errors if settings.finds_correlation
                else _given(settings))

    def treatment(self, source: str) -> tuple[object, ...]:
        """Return what changes when measurements of a source would be treated otherwise."""
        bias = self._state(source).bias
        return (self.errors_in_use(source),
                *(() if bias is None else (len(bias), *bias.nodes[-1:].tolist())))

    def preview(self, queued: Queued) -> Factors:
        """Return a measurement as an edge to the last state of the bias before it, or to -1."""
        chain = self._state(queued.source).bias or bs.BiasChain()
        return bs.held_by_bias(queued, chain, self._errors(queued))

    def errors_in_use(self, source: str) -> bs.CorrelatedErrors | None:
        """Return the statistics of the errors of a source in use; None for white errors."""
        state = self.sources.get(source)
        if state is not None and (state.bias is None or state.errors is not None):
            return state.errors
        return _given(self._settings(source))

    def set_errors(self, source: str, errors: bs.CorrelatedErrors | None,
                   bias: bs.BiasChain | None) -> None:
        """Treat the measurements of a source with other errors, whose bias is in the graph."""
        state = self.sources[source]
        self.abandon(state.bias)
        state.errors, state.bias = errors, bias
        self._reports.pop(source, None)

    def abandon(self, bias: bs.BiasChain | None) -> None:
        """Let the states of a bias that holds no measurement leave with the next nodes."""
        self._abandoned += [] if bias is None else bias.nodes.tolist()

    def _newest_states(self, graph: Graph, dimension: int) -> dict[str, int]:
        """Return the id of the newest state of each chain with states of so many coordinates."""
        newest = {source: int(state.bias.nodes[-1]) for source, state in self.sources.items()
                  if state.bias is not None and len(state.bias) > 0}
        return {source: node for source, node in newest.items()
                if graph.dimension[graph.node_rows(node)] == dimension}

    def gyro_rates(self, graph: Graph) -> dict[str, float]:
        """Return the newest estimate of the bias of each gyroscope [rad/s]."""
        return {source: float(graph.poses_of(node)[0])
                for source, node in self._newest_states(graph, 1).items()}

    def calibrations(self, graph: Graph,
                     covariance: Callable[[int], Covariance]) -> dict[str, bs.Calibration]:
        """Return what each odometry is calibrated by, given covariances of nodes."""
        found = dict[str, bs.Calibration]()
        if graph.has_touched:
            return found    # until an update that failed is followed by one that does not
        for source, node in self._newest_states(graph, 2).items():
            rate, scale, _ = graph.poses_of(node).tolist()
            sigmas = np.sqrt(np.diagonal(covariance(node)))
            found[source] = bs.Calibration(rate, float(sigmas[0]), scale, float(sigmas[1]))
        return found

    def calibration(self, source: str, graph: Graph) -> OdometryErrors:
        """Return the constant errors that an odometry is calibrated by, if it is."""
        node = self._newest_states(graph, 2).get(source, -1)
        if node < 0 or not self.config.odometry_source(source).calibrate:
            return AS_CLAIMED
        rate, scale, _ = graph.poses_of(node).tolist()
        return OdometryErrors(rate=rate, scale=scale)

    def finding(self) -> list[str]:
        """Return the sources whose errors are estimated and that have measurements."""
        return [source for source, state in self.sources.items()
                if state.n_ever > 0 and self._settings(source).finds_correlation]

    def edges(self) -> dict[str, IntArray]:
        """Return the ids of the edges between poses, by source, without primary odometry."""
        return {source: state.edges['id'] for source, state in self.sources.items()
                if len(state.edges) > 0}

    def held(self) -> dict[str, tuple[IntArray, IntArray]]:
        """Return the stamps of all measurements in the map [ns], and ids of what holds them."""
        return {source: (state.measured['stamp_ns'], state.held())
                for source, state in self.sources.items() if self.has(source)}

    def leaving_biases(self, factors: IntArray, others: Mapping[str, bs.BiasChain],
                       graph: Graph) -> list[int]:
        """Return the ids of the biases that nothing needs once constraints have left the graph."""
        biases = [*self._abandoned]
        ends = graph.factor_records['ends'][~np.isin(graph.factor_ids, factors), 2]
        thirds = np.unique(graph.node_ids[ends[ends >= 0]])
        for source, state in self.sources.items():
            measured = state.measured.values
            stamps_ns = measured['stamp_ns'][~np.isin(measured['id'], factors)]
            if state.bias is not None and not self.has(source):
                stamps_ns = state.bias.begins_ns[np.isin(state.bias.nodes, thirds)]
            oldest_ns = int(np.min(stamps_ns)) if len(stamps_ns) > 0 else None
            for chain in (state.bias, others.get(source)):
                biases += [] if chain is None else chain.leaving(oldest_ns)
        return biases

    def forget(self, nodes: IntArray, factors: IntArray) -> dict[str, IntArray]:
        """Return the numbers of the measurements that are left, after forgetting the others."""
        gone = {*nodes.tolist()}
        self._abandoned = [node for node in self._abandoned if node not in gone]
        return {source: state.forget(nodes, factors) for source, state in self.sources.items()}

    def origin(self, number: int) -> tuple[str, int]:
        """Return the source of a constraint, '' if unknown, and the stamp of its measurement."""
        for source, state in self.sources.items():
            some = state.measured.values
            for row in some[(some['id'] == number) | (some['held_by'] == number)]:
                return source, int(row['stamp_ns'])
            if number in state.edges['id']:
                return source, -1
        return '', -1

    def bias_origin(self, node: int) -> tuple[str, int]:
        """Return the source of a bias, by its id, '' if unknown, and when its bin begins."""
        for source, state in self.sources.items():
            if state.bias is not None and node in state.bias.nodes:
                at = np.flatnonzero(state.bias.nodes == node)[0]
                return source, int(state.bias.begins_ns[at])
        return '', -1

    def saved(self) -> dict[str, SourceState]:
        """Return a copy of the state of each source."""
        return deepcopy(self.sources)

    def restore(self, saved: Mapping[str, SourceState]) -> None:
        """
        Restore what `saved` has returned.

        If the settings of a source now ask for another error model, its constraints stay in the
        graph as they are, and new measurements start a model of their own.
        """
        self.sources = deepcopy({**saved})
        for source, state in self.sources.items():
            if not self.has(source):
                continue
            settings = self._settings(source)
            errors = state.errors if settings.finds_correlation else _given(settings)
            wanted_ns, bin_ns = (0 if errors is None else bs.Process.correlated(errors).bin_ns,
                                 0 if state.bias is None else state.bias.bin_ns)
            found = state.errors is not None
            if bin_ns != wanted_ns or found > settings.finds_correlation:
                self.sources[source] = SourceState(
                    edges=state.edges, n_otherwise=state.n_otherwise + len(state))

    def reports(self, graph: Graph) -> dict[str, SourceReport]:
        """Return how well the newest measurements of each source fit the estimate."""
        for source, state in self.sources.items():
            _, before = self._reports.get(source, (None, 0))
            if state.n_ever - before > SOURCES.more_residuals * min(len(state), before):
                report = self.report(source, graph)
                self._reports[source] = report, state.n_ever if report.n > 0 else 0
        return {source: report for source, (report, _) in self._reports.items()
                if report.energy > 0.0}

    def report(self, source: str, graph: Graph) -> SourceReport:
        """Return how well the newest measurements of a source fit the estimate."""
        state = self.sources[source]
        used = state.measured.values[graph.weights[graph.factor_rows(state.held())] > 0.0]
        return source_report.report(
            graph, used['stamp_ns'], used['id'], in_use=self.errors_in_use(source),
            found=self._settings(source).finds_correlation)


def _given(settings: MeasurementSource) -> bs.CorrelatedErrors | None:
    """Return the statistics of errors with a given time constant; None without."""
    if settings.finds_correlation or settings.correlation_time == 0.0:
        return None
    return bs.CorrelatedErrors(settings.correlation_time, 1.0, SOURCES.white_share)


def _order(queued: Queued) -> tuple[int, int]:
    """Sort by kind, and by stamp but for closures and odometry."""
    if queued.needs_bias:
        return 2, queued.stamp_ns
    return (1, queued.stamp_ns) if queued.is_in_map else (0, 0)
