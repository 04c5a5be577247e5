# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The facade of the engine, for the node, the offline tools and the tests."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Self

import numpy as np

from pose_graph_ros.core import disagreement as dg, measurements as ms, parts, transaction as tr
from pose_graph_ros.core.alignment import Alignment
from pose_graph_ros.core.batch import final_optimization
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.error_tuner import ErrorTuner
from pose_graph_ros.core.estimate import Estimate, UpdateReport
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.forgetting import Forgetting
from pose_graph_ros.core.geometry import geodesy, se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import graph_view, reweighting
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.io.graph_files import SavedGraph
from pose_graph_ros.core.judgement import judge, verdicts as vd
from pose_graph_ros.core.odometry import hidden_nodes, motion
from pose_graph_ros.core.refiner import Refiner
from pose_graph_ros.core.smoother.incremental import DIVERGED, IncrementalSmoother, Refinement
from pose_graph_ros.core.sources import factor_builder, source_report
from pose_graph_ros.core.sources.kinds import attach, observed, validate
from pose_graph_ros.core.sources.pipeline import MeasurementPipeline
from pose_graph_ros.core.sources.queued import Queued


class PoseGraphBackend:
    """
    Online back end of pose-graph SLAM.

    Odometry creates the hidden nodes and the edges between them, and the smoother solves for each
    new node at once. A measurement waits until odometry has reached its stamp, is attached to the
    hidden node before that stamp, and is added to the graph by the next update. An update first
    aligns the odometry frame with the map, if they are not aligned yet. Constraints that make an
    update fail are set aside until the next full optimisation. Stamps are integer nanoseconds.

    Parameters
    ----------
    config : BackendConfig, optional
    smoother : IncrementalSmoother, optional, empty; only tests pass one

    """

    def __init__(self, config: BackendConfig | None = None,
                 smoother: IncrementalSmoother | None = None) -> None:
        self._config = config or BackendConfig()
        self._smoother = smoother or IncrementalSmoother(self._config.smoother)
        self.interrupt = self._smoother.interrupt
        self.graph = self._smoother.graph  # which only this object may change
        self._nodes = hidden_nodes.HiddenNodes(self._config, self._make_node)
        self.odometry = self._nodes.streams  # by source, to be read only
        self._newest_node_covariance = np.zeros((3, 3))  # in map axes
        self._reweighting = reweighting.Reweighting()
        factors = self._factors = factor_builder.FactorBuilder(self._config, self._reweighting)
        self._judge = judge.Judge(self._smoother, self._reweighting, self._nodes, factors)
        self.verdicts, self.verdict_totals = self._judge.verdicts, self._judge.totals
        self.verdict_changes = self._judge.changes
        self.gyro_biases = factors.gyro_rates
        self.calibrations = partial(factors.calibrations, self.graph, self._smoother.covariance)
        self._tuner = ErrorTuner(
            self._smoother, self._nodes, factors, self._reweighting, self._judge)
        pipeline = self._pipeline = MeasurementPipeline(self._nodes, self._config)
        self.gyro_differences = pipeline.gyros.differences
        self.counts = pipeline.counts  # of answers by source and 'accepted' or the reason
        self.refusals = pipeline.refusals  # details of the newest ones by source and reason
        # source and both stamps [ns] of the newest loop closures that were refused
        self.refused_closures = pipeline.refused_closures
        self._quarantine: list[Queued] = []
        self._alignment = Alignment(self._nodes, self._judge.fixes)
        self.parts = parts.Parts(  # what it is made of, for tools
            self.graph, self._nodes, self._factors, self._reweighting, self._alignment,
            pipeline, self._quarantine, self._judge, self._smoother)
        self.disagreement = partial(dg.find, self.parts)
        self._refiner = Refiner(self.parts, self._tuner)
        self._forgetting = Forgetting(self._tuner, self.parts)
        self._settled, self._chi2 = True, 0.0
        self._chi2_due = parts.Turns()
        self._waits = False  # whether the queue waits until the graph is solved
        # most constraints that the next update adds; and the number of updates that were
        # interrupted since one has added all that waits
        self._most, self.n_interrupted = 2**62, 0

    def configure(self, config: BackendConfig) -> None:
        """Change the settings for later input; raises as `BackendConfig.changed_to` does."""
        self._config = self._config.changed_to(config)
        self._nodes.configure(config)
        self._pipeline.gyros.configure(config)
        self._pipeline.config = self._factors.config = config

    @property
    def node_stamps_ns(self) -> IntArray:
        """Stamps of the hidden nodes [ns], shape (N,), a read-only view."""
        return self._nodes.stamps_ns

    @property
    def n_waiting(self) -> int:
        """Number of measurements that wait for odometry to reach their stamps, or for a beacon."""
        return len(self._pipeline.waiting) + len(self._pipeline.beacons)

    @property
    def pending(self) -> Sequence[tuple[str, ms.PoseMeasurement]]:
        """The measurements that wait, with their sources, which a saved graph does not have."""
        return self._pipeline.pending

    def take_pending(self, pending: Iterable[tuple[str, ms.PoseMeasurement]]) -> None:
        """Take what was `pending` in an engine whose saved graph this one continues."""
        for source, measurement in pending:
            self._pipeline.take(measurement, source)

    @property
    def n_quarantined(self) -> int:
        """Number of constraints that were set aside because the solver fails with them."""
        return len(self._quarantine)

    def set_aside(self, n: int) -> list[str]:
        """Return the names of the newest n constraints that were set aside."""
        return dg.queued(self._quarantine[-n:], self.parts)

    @property
    def revision(self) -> int:
        """Changes if odometry jumps or its primary source changes: older estimates are stale."""
        jumps = sum(stream.n_jumps_seen for stream in self._nodes.streams.values())
        return jumps + 1_000_000_000 * self._nodes.n_primaries

    def reports(self) -> dict[str, source_report.SourceReport]:
        """Return for each source how well its measurements fit the estimate."""
        return self._factors.reports(self.graph)

    def view(self) -> graph_view.GraphView | None:
        """Return a copy of the graph for display; None before the first odometry."""
        return graph_view.view(self.graph, self._judge.drawn_rows())

    def measured(self) -> dict[str, IntArray]:
        """Return the stamps of all measurements in the map in the graph [ns], by source."""
        return {source: stamps for source, (stamps, _) in self._factors.held().items()}

    def largest_energies(self, n: int) -> list[dg.ConstraintEnergy]:
        """Return the n constraints with the largest energies, with names, in descending order."""
        return dg.largest(self.parts, n)

    def decide(self, name: str, decision: vd.Decision) -> ms.Answer:
        """Return the answer to a decision on a `Verdict.id`; the next update applies it."""
        self._refiner.restart()
        return self._judge.decide(name, decision)

    def add_odometry(self, sample: ms.OdometrySample, source: str = 'odom') -> ms.Answer:
        """Return the answer to a sample; `NodePolicy` may ask for a hidden node at it."""
        answer = self._pipeline.count(source, self._nodes.add_sample(sample, source))
        self._collect()
        return answer

    def _collect(self) -> None:
        """Collect secondary edges and counts of odometry; attach measurements that are due."""
        self._pipeline.queue += [Queued(*edge) for edge in self._nodes.take_secondary_edges()]
        self._pipeline.count_sorted(self._nodes.streams)
        for source, stream in self._nodes.streams.items():
            if stream.n_jumps > 0:
                self.counts[source, 'jump'] = stream.n_jumps
        self._pipeline.attach_due()
        if len(self._pipeline.beacons) > 0:
            self._pipeline.queue += self._pipeline.beacons.take_ready(
                self.graph, self._apply, aligned=self._alignment.is_aligned)

    def _apply(self, change: GraphUpdate) -> bool:
        """Change the graph at once; return whether the solver could follow."""
        result = self._smoother.update(change)
        self.counts['solver', 'failed'] += result.status is Status.FAILED
        return result.status is not Status.FAILED

    def _make_node(self, made: hidden_nodes.NewNode) -> int:
        """Append a hidden node to the graph; return its id, or -1 if the solver failed."""
        if made.information is None:
            first = self.graph.next_ids.node
            self._smoother.update(GraphUpdate(hidden=made.mean[None], fix=(first,)))
            return first
        chain = None
        if made.moving > 0.0:
            change, chain = self._factors.next_node(made, self.graph)
            result = self._smoother.update(change)
        else:
            result = self._smoother.extend(made.mean, made.information)
        if result.status is Status.FAILED:
            # the next sample tries again, with a longer motion
            self.counts['solver', 'failed'] += 1
            return -1
        if chain is not None:
            self._factors.keep(made.source, chain)
        self._settled = self._settled and result.status is Status.CONVERGED
        self._newest_node_covariance = self._smoother.newest_covariance()
        return self.graph.newest_pose

    def add_measurement(self, measurement: ms.Measurement, source: str) -> ms.Answer:
        """
        Return the answer to a measurement that is added, in any order of stamps.

        The graph does not depend on the order. The answer is pending if odometry has not reached
        the stamp; `counts` contains the later answer.
        """
        return self._pipeline.add(measurement, source)

    def set_pose(self, pose: ms.GlobalPose, source: str) -> ms.Answer:
        """
        Return the answer to a pose of the robot that the user sets.

        Before the graph is aligned, this adds a global pose. Afterwards it means that the robot
        was moved without odometry: a new node at the pose follows the last one by a loose edge.
        A stamp outside the odometry is replaced by the nearest one inside.
        """
        self.finish()
        if self.graph.n_nodes == 0:
            return self._pipeline.count(source, ms.rejected('before_odometry', 'no odometry yet'))
        first_ns = max(int(self.node_stamps_ns[0]), self._nodes.last_frozen_ns)
        pose = replace(pose, stamp_ns=min(max(pose.stamp_ns, first_ns), self._nodes.covered_ns))
        if not self._alignment.is_aligned:
            return self.add_measurement(pose, source)
        return self._pipeline.count(source, self._relocate(pose, source))

    def _relocate(self, pose: ms.GlobalPose, source: str) -> ms.Answer:
        """Return the answer to a pose at which a new hidden node is made after all odometry."""
        policy = self._config.measurement_source(source, ms.GlobalPose).covariance
        validated, last_ns = validate(pose, policy), self._nodes.covered_ns
        if isinstance(validated, ms.Answer):
            return validated
        given = validated.measurement
        begin, end = attach(self._nodes, pose.stamp_ns), attach(self._nodes, last_ns)
        if isinstance(begin, ms.Answer) or isinstance(end, ms.Answer) or not isinstance(
                given, ms.GlobalPose):
            return ms.rejected('no_odometry', 'none at that time')
        first, last, newest = self.graph.poses_of([begin.node, end.node, int(self._nodes.ids[-1])])
        moved = se2.between(se2.compose(first, begin.motion), se2.compose(last, end.motion))
        now = se2.compose(given.pose, moved)
        # the motion to the new node is unknown [m, m, rad]
        noise = np.diag((1000.0, 1000.0, 3.0)) ** 2
        node = self._nodes.relocate(se2.between(newest, now), noise)
        if node < 0:
            return ms.rejected('failed', 'the solver failed')
        self._collect()
        self._pipeline.queue.append(observed(
            source, replace(given, stamp_ns=last_ns + 1, pose=now),
            motion.Attachment(node, np.zeros(3), np.zeros((3, 3)))))
        return ms.ACCEPTED

    def update(self) -> UpdateReport:
        """
        Add all new constraints to the graph and update the estimate; to be called by a timer.

        The work depends on how much the new constraints change, not on the size of the graph.
        Constraints that make it fail are set aside and named by the report. After an interruption
        one is tried alone, and set aside if that takes too long again; then two, and so on.
        """
        pipeline, most = self._pipeline, self._most
        pipeline.queue, rest = pipeline.queue[:most], pipeline.queue[most:]
        report, untried = self._update()
        pipeline.queue = untried + pipeline.queue + rest
        self._forgetting.step(self._config)
        if self.graph.memory.interrupted:
            if most == len(untried) == 1:
                self._quarantine.append(pipeline.queue.pop(0))
            self._most, self.n_interrupted = 1, self.n_interrupted + 1
        elif len(rest) == 0:
            self._most, self.n_interrupted = 2**62, 0
        else:
            self._most = 2 * most
        return report

    def _update(self, *, at_once: bool = False) -> tuple[UpdateReport, list[Queued]]:
        """Return the report of an update, and the constraints for which it had no time."""
        return tr.update_isolated(partial(self._add_queue, at_once=at_once), self.parts)

    def _settle(self) -> bool:
        """Tell whether an update without new constraints succeeds."""
        return tr.succeeds(self._smoother, GraphUpdate())

    def _add_queue(self, *, at_once: bool) -> tuple[UpdateReport, list[Queued]]:
        """Add the constraints in the queue and solve; return those that it could not add."""
        if self.graph.n_nodes == 0:
            return UpdateReport(Status.CONVERGED), []
        if self._waits and self._judge.solves_later and not at_once:
            self._judge.work()
            return UpdateReport(Status.MAX_ITERATIONS, chi2=self._chi2), []
        queue: list[Queued] = []
        T_map_graph, graph = None, self.graph
        with tr.Transaction() as transaction:
            transaction.callback(self._alignment.load, self._alignment.saved())
            T_map_graph = self._alignment.find(graph, self._pipeline.queue)
            queue = self._pipeline.take_ready(aligned=self._alignment.is_aligned)
            if len(queue) == 0 and self._settled:
                return UpdateReport(Status.CONVERGED, chi2=self._chi2), []
            freed: list[int] = []
            if T_map_graph is not None:
                transaction.callback(graph.set_poses, graph.poses.copy())
                moved = se2.compose(T_map_graph, graph.poses)
                graph.set_poses(np.where(graph.is_bias[:, None], graph.poses, moved))
                # measurements fix the gauge from now on, and the first node is no longer fixed
                freed = graph.node_ids[graph.fixed].tolist()
            change = self._factors.build(queue, graph)._replace(free=freed)
            transaction.callback(self._judge.rollback)
            change = self._judge.before(self._factors.new, change, self._nodes.newest_ns)
            # but what has waited for a whole pause does not wait for another one
            at_once = at_once or self._waits or T_map_graph is not None
            result = tr.checked(self._judge.solve(change, at_once=at_once))
        self._waits = transaction.failure == DIVERGED and not at_once
        if self._waits:
            self._refiner.restart()
            return UpdateReport(Status.MAX_ITERATIONS, chi2=self._chi2), queue
        if transaction.failure != '':
            # a graph that was moved and moved back must be eliminated again
            self._settled = self._settled and T_map_graph is None
            return UpdateReport(Status.FAILED, transaction.failure, chi2=self._chi2), queue
        if T_map_graph is not None:
            self._nodes.move_frozen(T_map_graph)
        self._factors.commit()
        self._judge.commit()
        self._refiner.restart()
        result, self._settled = self._refiner.reweight(result)
        # in a larger graph an update does not change all weights of odometry
        self._tuner.step(1000)
        self._recheck_alignment()
        self._evaluate()
        return UpdateReport(result.status, '', len(queue), result.iterations,
                            self._chi2, result.relinearized, result.eliminated, result.visited), []

    def refine(self) -> Refinement:
        """Do an iteration from the estimate of an update to the optimum; `optimize` needs none."""
        is_new = not self._refiner.finished
        result = self._refiner.refine()
        if is_new and result.finished:
            self._evaluate(at_once=True)
        return result

    def _evaluate(self, *, at_once: bool = False) -> None:
        """Update chi2, now and then if the graph is large, and the newest node's covariance."""
        if at_once or self._chi2_due(self.graph.n_nodes):
            self._chi2 = self._smoother.chi2()
        if not self.graph.has_touched:  # else the solver has failed
            self._newest_node_covariance = self._smoother.newest_covariance()

    def _recheck_alignment(self) -> None:
        """Rotate and optimise the graph anew if the angle between odometry and map is wrong."""
        poses = self._alignment.check(self.graph)
        if poses is None:
            return
        graph = self.graph
        oldest = int(graph.node_ids[np.argmax(graph.is_pose)])  # that thinning has left
        left, chi2 = graph.poses_of(oldest), self._smoother.chi2()
        with tr.Transaction() as transaction:
            transaction.callback(graph.set_poses, graph.poses.copy())
            graph.set_poses(poses)
            if tr.checked(self._optimize_whole()).chi2 >= chi2:
                raise LinearSolveError('the graph lies better as it was')
        if transaction.failure != '':
            self._settle()  # eliminates everything again
            return
        self.counts['alignment', 'done_over'] += 1
        # the frozen part of the path stays in front of the rest
        self._nodes.move_frozen(se2.compose(graph.poses_of(oldest), se2.inverse(left)))

    def finish(self) -> None:
        """Process all samples in the reorder windows, without waiting for older ones."""
        self._pipeline.finish()
        self._collect()

    def optimize(self) -> UpdateReport:
        """Optimise the whole graph with all quarantined constraints; for the end of a stream."""
        self.finish()
        report = tr.update_with_all(partial(self._update, at_once=True), self.parts)
        if self.graph.n_nodes == 0:
            return report
        self._forgetting.step(self._config)
        optimized = UpdateReport(Status.FAILED, chi2=self._chi2)
        with tr.Transaction() as transaction:
            self.graph.memory.check()
            self._tuner.decide()
            self._settle()
            self._judge.finish(transaction)
            self._settle()  # what is believed again
            optimized = self._optimize_whole()
            tr.checked(optimized)
        return report.after(optimized._replace(reason=transaction.failure))

    def _optimize_whole(self) -> UpdateReport:
        """Optimise the whole graph; a failure leaves all poses and weights unchanged."""
        result = final_optimization.optimize(
            self.graph, self._reweighting, self._config.final_optimization)
        if result.status is not Status.FAILED and self.graph.has_touched:
            # the solver has not updated the factorisation of the smoother
            updated = self._smoother.update(GraphUpdate())
            if updated.status is Status.FAILED:
                result = replace(result, status=Status.FAILED, reason=updated.reason)
        if result.status is Status.FAILED:
            self._settled = False
            self.counts['solver', 'failed'] += 1
            return UpdateReport(Status.FAILED, result.reason, chi2=self._chi2)
        self._settled = self._refiner.finished = result.status is not Status.MAX_ITERATIONS
        self._chi2 = result.chi2
        self._newest_node_covariance = self._smoother.newest_covariance()
        return UpdateReport(result.status, '', 0, result.iterations, result.chi2)

    def estimate(self, *, with_path: bool = True) -> Estimate | None:
        """Return the estimate, None before the first odometry; its path takes linear time."""
        if self.graph.n_nodes == 0:
            return None
        return parts.estimate(
            self.parts, self._newest_node_covariance, self._chi2, with_path=with_path)

    def path_covariances(self, estimate: Estimate) -> FloatArray:
        """Return those at the path of the present estimate; see `core.parts`."""
        return parts.path_covariances(self.parts, estimate)

    def saved(self, datum: geodesy.MapOrigin | None = None, *, texts: bool = True) -> SavedGraph:
        """Return the graph with its state since the last update; see `parts.capture`."""
        self._tuner.finish_change()
        return parts.capture(
            self.parts, self._newest_node_covariance, self._chi2, datum, texts=texts)

    @classmethod
    def restored(cls, config: BackendConfig | None, saved: SavedGraph) -> Self:
        """Return a back end that continues a saved graph; see `parts.restore`."""
        backend = cls(config)
        parts.restore(backend.parts, saved)
        backend._tuner.restored()
        backend._forgetting.restored()
        backend._newest_node_covariance = np.array(saved.newest_covariance)
        # the next update eliminates all nodes
        backend._settled, backend._chi2 = False, saved.chi2
        return backend
