# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The facade that the node, the replay tool and the tests all drive.

Odometry makes the hidden nodes and the edges between them. A measurement waits until odometry has
reached its stamp, is bound to the hidden nodes before it, and joins the graph at the next update.
An update aligns the odometry frame with the map if that is still to do, applies what has come in
and optimises. If that fails, the graph goes back to where it was and what had come in is set aside
until the next full optimisation. Stamps are integer nanoseconds; there is no clock in here.
"""

from collections import Counter
from dataclasses import dataclass, field
import heapq
import itertools
import math
from typing import cast

import numpy as np

from pose_graph_ros.core import alignment, batch, binding, covariance, se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.config import BackendConfig, SolverConfig
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.estimate import AlignmentState, Estimate, UpdateReport
from pose_graph_ros.core.graph import Energies, Graph, GraphUpdate
from pose_graph_ros.core.linearize import observed_errors
from pose_graph_ros.core.measurements import (
    ACCEPTED,
    Answer,
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
    rejected,
    value_defect,
    Verdict,
)
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.starts import Solve, solve_from_two_starts
from pose_graph_ros.core.timeline import OdometryTimeline
from pose_graph_ros.core.trajectory import Trajectory

# Measurements that wait for odometry; a sender whose clock is ahead must not fill the memory.
MAX_PENDING = 10_000
# A global pose tells the alignment at once if its heading is at least this certain [rad].
ALIGNING_SIGMA = 0.5



@dataclass(slots=True)
class _Queue:
    """Constraints that are bound and join the graph at the next update, with their sources."""

    edges: list[Edges] = field(default_factory=list)
    observed: list[ObservedNodes] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.edges) + len(self.observed)


class PoseGraphBackend:
    """
    Online back end of pose-graph SLAM.

    Parameters
    ----------
    config : BackendConfig
    solve : callable
        Optimises a graph in place; `batch.optimize` unless a test passes another.

    """

    def __init__(
        self, config: BackendConfig | None = None, solve: Solve = batch.optimize,
    ) -> None:
        self._config = BackendConfig() if config is None else config
        self._solve = solve
        self._graph = Graph()
        self._timeline = OdometryTimeline()
        self._node_stamps = GrowingArray((), np.int64)
        self._node_odometry = np.zeros(3)
        """Odometry at the newest hidden node."""
        self._newest_node_covariance = np.zeros((3, 3))
        """In map axes, propagated by odometry since the last solve."""
        self._pending: list[tuple[int, int, str, Measurement]] = []
        self._arrival = itertools.count()
        self._queue = _Queue()
        self._quarantine = _Queue()
        self._seen: set[tuple[str, int, str]] = set()
        self._settled = True
        self._alignment = AlignmentState.LOCAL
        self._alignment_sigma = np.inf
        self._chi2 = 0.0
        self.counts: Counter[tuple[str, str]] = Counter()
        """How often each source got each answer: (source, 'accepted' or the reason)."""

    @property
    def graph(self) -> Graph:
        """The pose graph; its owner is this object."""
        return self._graph

    @property
    def node_stamps_ns(self) -> IntArray:
        """Stamps of the hidden nodes [ns], a read-only view."""
        return cast('IntArray', self._node_stamps.read_only)

    @property
    def odometry(self) -> Trajectory:
        """All odometry that came in, in the odometry frame."""
        return Trajectory(self._timeline.stamps_ns, self._timeline.poses)

    @property
    def n_pending(self) -> int:
        """Number of measurements that wait for odometry to reach their stamps."""
        return len(self._pending)

    @property
    def n_quarantined(self) -> int:
        """Number of constraints that were set aside after a failed solve."""
        return len(self._quarantine)

    def energies(self) -> Energies:
        """Return the energy of every constraint in the graph."""
        return self._graph.energies()

    def add_odometry(self, sample: OdometrySample, source: str = 'odom') -> Answer:
        """Take an odometry sample; make a hidden node and its edge if the policy says so."""
        return self._count(source, self._add_odometry(sample))

    def _add_odometry(self, sample: OdometrySample) -> Answer:
        if sample.stamp_ns <= 0:
            return rejected('zero_stamp', 'odometry without a stamp')
        broken = value_defect(sample.pose)
        if broken is not None:
            return rejected(broken, f'odometry pose {sample.pose.tolist()}')
        if len(self._timeline) > 0 and sample.stamp_ns <= self._timeline.stamps_ns[-1]:
            newest = int(self._timeline.stamps_ns[-1])
            return rejected(
                'duplicate_stamp' if sample.stamp_ns == newest else 'out_of_order',
                f'odometry at {sample.stamp_ns} after {newest}')
        pose = se2.wrapped(sample.pose)
        self._timeline.append(sample.stamp_ns, pose)
        if self._graph.n_nodes == 0:
            self._graph.apply(GraphUpdate(hidden=pose[None], fix=(0,)))
            self._node_stamps.append_one(sample.stamp_ns)
            self._node_odometry = pose
        else:
            self._extend(sample.stamp_ns, pose)
        while len(self._pending) > 0 and self._pending[0][0] <= sample.stamp_ns:
            _, _, waiting, measurement = heapq.heappop(self._pending)
            self._count(waiting, self._bind(measurement))
        return ACCEPTED

    def _extend(self, stamp_ns: int, pose: FloatArray) -> None:
        """Make a hidden node at the newest odometry, tied by an edge, if one is due."""
        last_ns = int(self.node_stamps_ns[-1])
        difference = pose - self._node_odometry
        if not self._config.nodes.due(
                math.hypot(difference[0], difference[1]), abs(float(se2.wrap(difference[2]))),
                (stamp_ns - last_ns) * 1e-9):
            return
        self._node_odometry = pose
        motion = self._timeline.motion(last_ns, stamp_ns)
        node = self._graph.n_nodes
        start = self._graph.poses[-1]
        noise = covariance.odometry_covariance(self._config.odometry_noise, *motion)
        self._newest_node_covariance = covariance.propagated(
            start, self._newest_node_covariance, motion.increment, noise)
        self._graph.apply(GraphUpdate(
            hidden=se2.compose(start, motion.increment)[None],
            edges=Edges([node - 1], [node], [motion.increment], [covariance.information(noise)],
                        [EdgeKind.ODOMETRY])))
        self._node_stamps.append_one(stamp_ns)

    def add_measurement(self, measurement: Measurement, source: str) -> Answer:
        """
        Take a global pose, a position or a loop closure, in any order of stamps.

        The answer is pending if odometry has not reached its stamp yet; what becomes of it later
        is in `counts`.
        """
        return self._count(source, self._add_measurement(measurement, source))

    def _add_measurement(self, measurement: Measurement, source: str) -> Answer:
        if not np.any(measurement.covariance) and not isinstance(measurement, LoopClosure):
            measurement = binding.with_default_covariance(measurement, self._config)
            self.counts[source, 'default_covariance'] += 1
        checked = binding.repaired(measurement, self._config)
        if isinstance(checked, Answer):
            return checked
        due_ns, reference = checked.stamp_ns, ''
        if isinstance(checked, LoopClosure):
            reference = f'{checked.reference_ns} {checked.reference_node}'
            due_ns = max(due_ns, checked.reference_ns or 0)
        key = (source, checked.stamp_ns, reference)
        if key in self._seen:
            return rejected('duplicate_stamp', f'{source} at {checked.stamp_ns} came before')
        waits = len(self._timeline) == 0 or due_ns > self._timeline.stamps_ns[-1]
        if waits and len(self._pending) >= MAX_PENDING:
            return rejected('too_many_pending', f'{MAX_PENDING} measurements wait for odometry')
        if not waits:
            answer = self._bind(checked)
            if answer.verdict is Verdict.ACCEPTED:
                self._seen.add(key)
            return answer
        self._seen.add(key)
        heapq.heappush(self._pending, (due_ns, next(self._arrival), source, checked))
        return Answer(Verdict.PENDING, 'pending', 'waits for odometry to reach its stamp')

    def _bind(self, measurement: Measurement) -> Answer:
        """Turn a measurement that odometry has reached into a constraint for the next update."""
        first_ns = int(self.node_stamps_ns[0])
        if measurement.stamp_ns < first_ns:
            return rejected('before_odometry',
                            f'stamp {measurement.stamp_ns}, odometry begins at {first_ns}')
        anchor = self._anchor(measurement.stamp_ns)
        if isinstance(measurement, LoopClosure):
            reference = self._reference(measurement)
            if isinstance(reference, Answer):
                return reference
            if reference.node == anchor.node:
                return rejected('same_node', f'both ends fall to hidden node {anchor.node}')
            self._queue.edges.append(
                binding.loop_closure_constraint(measurement, reference, anchor))
        elif isinstance(measurement, Position):
            self._queue.observed.append(binding.position_constraint(measurement, anchor))
        else:
            self._queue.observed.append(binding.global_pose_constraint(measurement, anchor))
        return ACCEPTED

    def _anchor(self, stamp_ns: int) -> binding.Anchor:
        return binding.anchored(stamp_ns, self.node_stamps_ns, self._timeline, self._config)

    def _reference(self, closure: LoopClosure) -> binding.Anchor | Answer:
        """Return the earlier end of a loop closure, named by stamp or by hidden node."""
        if closure.reference_ns is not None:
            if closure.reference_ns < self.node_stamps_ns[0]:
                return rejected('before_odometry', f'reference stamp {closure.reference_ns}')
            return self._anchor(closure.reference_ns)
        node = closure.reference_node
        if node is None or not 0 <= node < self._graph.n_nodes:
            return rejected('unknown_node', f'there is no hidden node {node}')
        return binding.Anchor(node, np.zeros(3), np.zeros((3, 3)))

    def update(self) -> UpdateReport:
        """Add what has come in to the graph and improve the estimate; for a timer."""
        return self._optimize(self._config.online, closing=False)

    def optimize(self) -> UpdateReport:
        """Optimise fully, once more with what had been set aside: the end of a stream."""
        self._queue.edges += self._quarantine.edges
        self._queue.observed += self._quarantine.observed
        self._quarantine = _Queue()
        self._settled = False
        return self._optimize(self._config.closing, closing=True)

    def _optimize(self, config: SolverConfig, *, closing: bool) -> UpdateReport:
        if self._graph.n_nodes == 0:
            return UpdateReport(Status.CONVERGED, '', 0, 0, 0.0)
        checkpoint = self._graph.checkpoint()
        alignment_before = self._alignment, self._alignment_sigma
        if self._alignment is not AlignmentState.ALIGNED:
            self._align()
        joining = self._joining()
        if len(joining) == 0 and self._settled:
            return UpdateReport(Status.CONVERGED, '', 0, 0, self._chi2)
        self._graph.apply(GraphUpdate(
            edges=Edges.joined(joining.edges), observed=ObservedNodes.joined(joining.observed)))
        try:
            result = solve_from_two_starts(self._graph, config, self._solve, closing=closing)
            reason = result.reason
        except Exception as error:
            # whatever it is: what came in must not stay half applied
            result, reason = None, f'{type(error).__name__}: {error}'
        if result is None or result.status is Status.FAILED:
            self._graph.restore(checkpoint)
            self._alignment, self._alignment_sigma = alignment_before
            self._quarantine.edges += joining.edges
            self._quarantine.observed += joining.observed
            self.counts['solver', 'failed'] += 1
            return UpdateReport(Status.FAILED, reason, 0, 0, self._chi2)
        self._settled = result.status is not Status.MAX_ITERATIONS
        self._chi2 = result.chi2
        if result.factorization is not None and result.free_nodes[-1] == self._graph.n_nodes - 1:
            self._newest_node_covariance = result.factorization.covariance(
                len(result.free_nodes) - 1)
        return UpdateReport(
            result.status, '', len(joining), result.iterations, result.chi2)

    def _joining(self) -> _Queue:
        """Take what can join the graph out of the queue; observed nodes wait for alignment."""
        joining = _Queue(edges=self._queue.edges)
        self._queue.edges = []
        if self._alignment is AlignmentState.ALIGNED:
            joining.observed, self._queue.observed = self._queue.observed, []
        return joining

    def _align(self) -> None:
        """Turn the whole graph into the map if the observed nodes in the queue tell the angle."""
        if len(self._queue.observed) == 0:
            return
        self._alignment = AlignmentState.UNALIGNED
        observed = ObservedNodes.joined(self._queue.observed)
        predicted = se2.compose(self._graph.poses[observed.node], observed.offset)
        sigma = np.full(len(observed), np.inf)
        full = observed.kind == ObservedKind.GLOBAL_POSE
        sigma[full] = np.sqrt(np.linalg.inv(observed.information[full])[:, 2, 2])
        if np.min(sigma) <= ALIGNING_SIGMA:
            best = int(np.argmin(sigma))
            self._turn(se2.compose(observed.mean[best], se2.inverse(predicted[best])),
                       float(sigma[best]))
            return
        variance = 1.0 / (0.5 * np.trace(observed.information[:, :2, :2], axis1=1, axis2=2))
        found = alignment.align(predicted[:, :2], observed.mean[:, :2], variance)
        self._alignment_sigma = found.sigma_heading
        if found.certain(self._config.alignment):
            self._turn(found.T_map_odom, found.sigma_heading)

    def _turn(self, T_map_graph: FloatArray, sigma: float) -> None:
        """Move the whole graph rigidly; from here on the map holds it, not its first node."""
        self._graph.set_poses(se2.compose(T_map_graph, self._graph.poses))
        self._graph.apply(GraphUpdate(free=(0,)))
        self._alignment, self._alignment_sigma = AlignmentState.ALIGNED, sigma

    def estimate(self) -> Estimate | None:
        """Return the present estimate; None before the first odometry."""
        if self._graph.n_nodes == 0:
            return None
        poses, stamps = self._graph.poses, self.node_stamps_ns
        newest_ns = int(self._timeline.stamps_ns[-1])
        motion = self._timeline.motion(int(stamps[-1]), newest_ns)
        newest = se2.compose(poses[-1], motion.increment)
        noise = covariance.odometry_covariance(
            self._config.odometry_noise, *motion, floor=False)
        cov = covariance.propagated(
            poses[-1], self._newest_node_covariance, motion.increment, noise)
        if self._alignment is AlignmentState.UNALIGNED:
            shift, cov = self._unaligned(newest)
            poses, newest = poses + shift, newest + shift
        if newest_ns > stamps[-1]:
            stamps, poses = np.append(stamps, newest_ns), np.vstack((poses, newest))
        odometry = self._timeline.pose(newest_ns)
        return Estimate(
            path=Trajectory(stamps, poses), T_odom_base=odometry, T_map_base=newest,
            T_map_odom=se2.compose(newest, se2.inverse(odometry)), covariance=cov,
            alignment=self._alignment, alignment_sigma=self._alignment_sigma, chi2=self._chi2,
            n_hidden=self._graph.n_nodes, n_edges=len(self._graph.edges),
            n_observed=len(self._graph.observed))

    def _unaligned(self, newest: FloatArray) -> tuple[FloatArray, FloatArray]:
        """
        Say where the robot is while the angle to the map is unknown, and how little that is.

        The graph is shifted onto the most certain position. With d the distance from there and
        an angle that is uniform on the circle, the mean square error of each coordinate is d^2,
        that of the heading pi^2 / 3.
        """
        # those that turned the graph in an update that failed are set aside
        waiting = self._queue.observed + self._quarantine.observed
        first = max(waiting, key=lambda item: float(np.trace(item.information[0, :2, :2])))
        error = observed_errors(self._graph.poses, first)[0]
        turn = np.eye(3)
        turn[:2, :2] = se2.rotation(first.mean[0, 2])
        shift = -(turn @ error)
        shift[2] = 0.0
        where = se2.compose(self._graph.poses[first.node], first.offset)[0]
        variance = float(np.sum((newest[:2] - where[:2])**2)
                         + 2.0 / np.trace(first.information[0, :2, :2]))
        return shift, np.diag((variance, variance, covariance.UNKNOWN_HEADING_VARIANCE))

    def _count(self, source: str, answer: Answer) -> Answer:
        if answer.verdict is Verdict.ACCEPTED:
            self.counts[source, 'accepted'] += 1
        elif answer.verdict is Verdict.REJECTED:
            self.counts[source, answer.reason] += 1
        return answer
