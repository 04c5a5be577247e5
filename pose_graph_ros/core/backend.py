# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The facade that the node, the replay tool and the tests all drive.

Odometry makes the hidden nodes and the edges between them, each of them solved for at once. A
measurement waits until odometry has reached its stamp, is bound to the hidden nodes before it, and
joins the graph at the next update. An update aligns the odometry frame with the map if that is
still to do and hands all that has come in to the smoother, whose work does not grow with the
graph. If that fails, everything is as before, and what had come in is set aside until the next
full optimisation. Stamps are integer nanoseconds; there is no clock in here.
"""

from collections import Counter
from dataclasses import replace
import math
from typing import Self

import numpy as np

from pose_graph_ros.core import alignment, batch, closing, covariance, se2, springs
from pose_graph_ros.core.admission import admit
from pose_graph_ros.core.aligning import Aligning, placed
from pose_graph_ros.core.anchoring import anchor_at
from pose_graph_ros.core.arrivals import Arrivals
from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.estimate import AlignmentState, Estimate, UpdateReport
from pose_graph_ros.core.graph import Energies, Graph, GraphUpdate
from pose_graph_ros.core.hidden_nodes import HiddenNodes
from pose_graph_ros.core.incremental import IncrementalSmoother, UpdateResult
from pose_graph_ros.core.joining import Joining, Queue, SourceReport
from pose_graph_ros.core.measurements import (
    ACCEPTED,
    Answer,
    GlobalPose,
    Measurement,
    OdometrySample,
    rejected,
)
from pose_graph_ros.core.reweighing import Reweighing
from pose_graph_ros.core.saved_graph import SavedGraph
from pose_graph_ros.core.saving import capture, Parts, restore
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.starts import Solve
from pose_graph_ros.core.tangent_plane import MapOrigin
from pose_graph_ros.core.trajectory import Trajectory

# A robot that was put elsewhere may have come from anywhere: sigmas [m, m, rad].
ELSEWHERE = (1000.0, 1000.0, 3.0)
# So often the weights of robust losses follow the estimate within one update.
REWEIGHINGS = 3


class PoseGraphBackend:
    """
    Online back end of pose-graph SLAM.

    Parameters
    ----------
    config : BackendConfig
    solve : callable
        Optimises a whole graph in place; `batch.optimize` unless a test passes another.
    smoother : IncrementalSmoother
        With an empty graph; one as configured unless a test passes another.

    """

    def __init__(
        self, config: BackendConfig | None = None, solve: Solve = batch.optimize,
        smoother: IncrementalSmoother | None = None,
    ) -> None:
        self._config = BackendConfig() if config is None else config
        self._solve = solve
        self._smoother = (
            IncrementalSmoother(self._config.smoother) if smoother is None else smoother)
        self._nodes = HiddenNodes(self._config, self._make_node)
        self._newest_node_covariance = np.zeros((3, 3))
        """In map axes."""
        self._reweighing = Reweighing()
        self._joins = Joining(self._config, self._reweighing)
        self._arrivals = Arrivals(self._nodes, self._joins)
        self._quarantine = Queue()
        self._settled = True
        self._aligning = Aligning(self._config)
        self._chi2 = 0.0

    def configure(self, config: BackendConfig) -> None:
        """Take other settings for what comes from now on; ConfigError for what must stay."""
        self._config = self._config.changed_to(config)
        self._nodes.configure(config)
        self._joins.configure(config)
        self._aligning.configure(config)

    @property
    def graph(self) -> Graph:
        """The pose graph; its owner is this object."""
        return self._smoother.graph

    @property
    def counts(self) -> Counter[tuple[str, str]]:
        """How often each source got each answer: (source, 'accepted' or the reason)."""
        return self._arrivals.counts

    @property
    def node_stamps_ns(self) -> IntArray:
        """Stamps of the hidden nodes [ns], a read-only view."""
        return self._nodes.stamps_ns

    @property
    def n_pending(self) -> int:
        """Number of measurements that wait for odometry to reach their stamps."""
        return len(self._arrivals.pending)

    @property
    def n_quarantined(self) -> int:
        """Number of constraints that were set aside after a failed solve."""
        return len(self._quarantine)

    @property
    def revision(self) -> int:
        """Changes whenever odometry jumps, or another one leads: the estimate is then stale."""
        jumps = sum(stream.n_jumps_seen for stream in self._nodes.streams.values())
        return jumps + 1_000_000_000 * self._nodes.n_leads

    def reports(self) -> dict[str, SourceReport]:
        """Return how well the measurements of each source fit the estimate."""
        return self._joins.reports(self.graph)

    def energies(self) -> Energies:
        """Return the energy of every constraint in the graph."""
        return self.graph.energies()

    def view(self) -> springs.GraphView | None:
        """Return what there is to see of the graph, in copies; None before the first odometry."""
        return springs.view(self.graph)

    def largest_energies(self, n: int) -> list[springs.Spring]:
        """Return the constraints with the largest energies, named, the largest one first."""
        return springs.largest(self.graph, self._nodes, self._joins, n)

    def add_odometry(self, sample: OdometrySample, source: str = 'odom') -> Answer:
        """Take an odometry sample; make a hidden node and its edge if the policy says so."""
        answer = self._arrivals.count(source, self._nodes.take(sample, source))
        self._collect()
        return answer

    def _collect(self) -> None:
        """Take what odometry has led to: edges, counts, and measurements that are due."""
        self._arrivals.queue.edges += self._nodes.edges
        self._nodes.edges.clear()
        for source, stream in self._nodes.streams.items():
            for reason, count in (('jump', stream.n_jumps), ('sorted', stream.n_sorted),
                                  ('stamp_ahead', stream.n_dropped)):
                if count > 0:
                    self.counts[source, reason] = count
        self._arrivals.bind_due()

    def _make_node(self, mean: FloatArray, information: FloatArray | None, source: str) -> int:
        """Append a hidden node to the graph; return its row, or -1 if that failed."""
        if information is None:
            self._smoother.update(GraphUpdate(hidden=mean[None], fix=(0,)))
            return 0
        result = self._smoother.extend(mean, information)
        if result.status is Status.FAILED:
            # the next sample makes the node, at the end of a longer motion
            self.counts['solver', 'failed'] += 1
            return -1
        self._settled = self._settled and result.status is Status.CONVERGED
        self._newest_node_covariance = self._smoother.newest_covariance()
        settings = self._config.odometry_source(source)
        self._reweighing.add_edge(
            self.graph.n_edges - 1, settings.loss, settings.rejection_threshold)
        return self.graph.newest_pose

    def add_measurement(self, measurement: Measurement, source: str) -> Answer:
        """
        Take a global pose, a position, a heading or a loop closure, in any order of stamps.

        The answer is pending if odometry has not reached its stamp yet; what becomes of it later
        is in `counts`.
        """
        return self._arrivals.take(measurement, source)

    def set_pose(self, pose: GlobalPose, source: str) -> Answer:
        """
        Take where the robot is from somebody who knows, whatever odometry tells of the way there.

        The pose counts at its stamp or, if that is not within odometry, at the nearest of it. In a
        graph that does not lie in the map yet it is a global pose like any other; else the robot
        was put elsewhere: the newest node is left behind, and the path goes on at the pose.
        """
        self.finish()
        if self.graph.n_nodes == 0:
            return self._arrivals.count(source, rejected('before_odometry', 'no odometry yet'))
        first_ns, last_ns = int(self.node_stamps_ns[0]), self._nodes.covered_ns
        pose = replace(pose, stamp_ns=min(max(pose.stamp_ns, first_ns), last_ns))
        if self._aligning.state is not AlignmentState.ALIGNED:
            return self.add_measurement(pose, source)
        admitted = admit(pose, self._joins.settings(source, GlobalPose).covariance)
        if isinstance(admitted, Answer):
            return self._arrivals.count(source, admitted)
        measurement = admitted.measurement
        begin, end = anchor_at(self._nodes, pose.stamp_ns), anchor_at(self._nodes, last_ns)
        if isinstance(begin, Answer) or isinstance(end, Answer) or not isinstance(
                measurement, GlobalPose):
            return self._arrivals.count(source, rejected('no_odometry', 'none at that time'))
        poses = self.graph.poses
        moved = se2.between(se2.compose(poses[begin.node], begin.motion),
                            se2.compose(poses[end.node], end.motion))
        now = se2.compose(measurement.pose, moved)
        row = self._nodes.put_elsewhere(
            se2.between(poses[self._nodes.rows[-1]], now), np.diag(ELSEWHERE) ** 2)
        if row < 0:
            return self._arrivals.count(source, rejected('failed', 'the solver failed'))
        self._collect()
        self._aligning.settle()
        self._arrivals.put(replace(measurement, stamp_ns=last_ns + 1, pose=now), source, row)
        return self._arrivals.count(source, ACCEPTED)

    def update(self) -> UpdateReport:
        """Add what has come in to the graph and improve the estimate; for a timer."""
        if self.graph.n_nodes == 0:
            return UpdateReport(Status.CONVERGED, '', 0, 0, 0.0)
        state = self._aligning.copy()
        T_map_graph = self._aligning.find(
            self.graph.poses, self._arrivals.queue.observed, self._nodes.lead)
        joining = self._joining()
        if len(joining) == 0 and self._settled:
            return UpdateReport(Status.CONVERGED, '', 0, 0, self._chi2)
        before: FloatArray | None = None
        if T_map_graph is not None:
            before = self.graph.poses.copy()
            self.graph.set_poses(se2.compose(T_map_graph, before))
        change = self._joins.begin(joining, self.graph)
        # from here on the map holds the graph, not its first node
        result = self._step(change if T_map_graph is None else change._replace(free=(0,)))
        if result.status is Status.FAILED:
            self._joins.undo()
            if before is not None:
                self.graph.set_poses(before)
                self._settled = False
            self._aligning.restore(state)
            self._quarantine.edges += joining.edges
            self._quarantine.observed += joining.observed
            self.counts['solver', 'failed'] += 1
            return UpdateReport(Status.FAILED, result.reason, 0, 0, self._chi2)
        self._joins.finish()
        self._aligning.hear(joining.observed)
        result = self._reweighed(result)
        self._realign()
        # the only thing here in proportion to the graph: 0.03 ms for 1000 nodes
        self._chi2 = self._smoother.chi2()
        self._newest_node_covariance = self._smoother.newest_covariance()
        return UpdateReport(
            result.status, '', len(joining), result.iterations, self._chi2, result.relinearized,
            result.eliminated, result.visited)

    def _step(self, update: GraphUpdate) -> UpdateResult:
        """Have the smoother make an update, whole or, whatever happens, not at all."""
        try:
            return self._smoother.update(update)
        except Exception as error:
            reason = f'{type(error).__name__}: {error}'
            return UpdateResult(Status.FAILED, reason, 0, 0, 0, 0, math.nan)

    def _reweighed(self, result: UpdateResult) -> UpdateResult:
        """Let the weights of robust losses follow the estimate that an update has led to."""
        self._settled = result.status is Status.CONVERGED
        for _ in range(REWEIGHINGS if len(self._reweighing) > 0 else 0):
            edges, observed = self._reweighing.changes(self.graph)
            if len(edges) + len(observed) == 0:
                return result
            self._settled = False
            again = self._step(GraphUpdate(weigh_edges=edges, weigh_observed=observed))
            if again.status is Status.FAILED:
                return result
            result = again
        return result

    def _joining(self) -> Queue:
        """Take what can join the graph out of the queue; observed nodes wait for alignment."""
        queue = self._arrivals.queue
        joining, queue.edges = Queue(edges=queue.edges), []
        if self._aligning.state is AlignmentState.ALIGNED:
            joining.observed, queue.observed = queue.observed, []
        else:
            self._arrivals.thin_unaligned()
        return joining

    def _realign(self) -> None:
        """Begin anew with another angle between odometry and map if the one in use is wrong."""
        T_map_odom = self._aligning.judge_again(self.graph.poses, self._nodes)
        if T_map_odom is None:
            return
        before = self.graph.poses.copy()
        poses = np.zeros_like(before)   # biases begin at 0
        poses[self._nodes.rows] = se2.compose(T_map_odom, self._nodes.odometry)
        self.graph.set_poses(poses)
        if self._solve_whole().status is Status.FAILED:
            self.graph.set_poses(before)
            self._step(GraphUpdate())   # everything is to be eliminated anew
        else:
            self.counts['alignment', 'done_over'] += 1

    def finish(self) -> None:
        """Wait for no older odometry any more: the newest samples count at the next update."""
        self._nodes.finish()
        self._collect()

    def optimize(self) -> UpdateReport:
        """Optimise fully, once more with what had been set aside: the end of a stream."""
        self.finish()
        report = self.update()
        if len(self._quarantine) > 0:
            self._arrivals.queue.edges += self._quarantine.edges
            self._arrivals.queue.observed += self._quarantine.observed
            self._quarantine = Queue()
            again = self.update()
            report = replace(again, new_constraints=report.new_constraints + again.new_constraints)
        if self.graph.n_nodes == 0:
            return report
        return report.after(self._solve_whole())

    def _solve_whole(self) -> UpdateReport:
        """Optimise the whole graph; if that fails all poses and weights are as before."""
        result = closing.optimize(
            self._smoother, self._reweighing, self._config.closing, self._solve)
        if result.status is Status.FAILED:
            self._settled = False
            self.counts['solver', 'failed'] += 1
            return UpdateReport(Status.FAILED, result.reason, 0, 0, self._chi2)
        self._settled = result.status is not Status.MAX_ITERATIONS
        self._chi2 = result.chi2
        self._newest_node_covariance = self._smoother.newest_covariance()
        return UpdateReport(result.status, '', 0, result.iterations, result.chi2)

    def estimate(self, *, with_path: bool = True) -> Estimate | None:
        """
        Return the present estimate; None before the first odometry.

        Parameters
        ----------
        with_path : bool
            Whether it has its path. That alone takes time in proportion to the graph, and memory.

        """
        graph = self.graph
        if graph.n_nodes == 0:
            return None
        node = graph.poses[self._nodes.rows[-1]]
        motion, noise, odometry = self._nodes.newest()
        newest = se2.compose(node, motion)
        cov = covariance.propagated(node, self._newest_node_covariance, motion, noise)
        state, sigma = self._aligning.copy()
        shift = np.zeros(3)
        if state is AlignmentState.UNALIGNED:
            # those that turned the graph in an update that failed are set aside
            shift, cov = alignment.guess(graph.poses, newest, Queue(observed=placed(
                self._arrivals.queue.observed + self._quarantine.observed)).all_observed())
            newest = newest + shift
        stamp_ns = max(self._nodes.newest_ns, int(self.node_stamps_ns[-1]))
        lead = self._nodes.lead
        return Estimate(
            stamp_ns=stamp_ns, T_odom_base=odometry, T_map_base=newest,
            T_map_odom=se2.compose(newest, se2.inverse(odometry)), covariance=cov,
            alignment=state, chi2=self._chi2, alignment_sigma=(
                math.sqrt(cov[2, 2]) if state is AlignmentState.ALIGNED else sigma),
            n_hidden=len(self._nodes), n_edges=graph.n_edges - self._joins.n_bias_edges,
            n_observed=self._joins.n_measurements, n_biases=graph.n_nodes - len(self._nodes),
            lead=lead, noise=self._config.odometry_source(lead).noise,
            trajectory=self._path(stamp_ns, newest, shift) if with_path else None)

    def _path(self, stamp_ns: int, newest: FloatArray, shift: FloatArray) -> Trajectory:
        """Return the path over all hidden nodes, moved by a shift, to the newest odometry."""
        stamps, poses = self.node_stamps_ns, self.graph.poses[self._nodes.rows]
        poses += shift
        if stamp_ns > stamps[-1]:
            stamps, poses = np.append(stamps, stamp_ns), np.vstack((poses, newest))
        return Trajectory(stamps, poses)

    def saved(self, datum: MapOrigin | None = None) -> SavedGraph:
        """Return all that has joined the graph; `update` first. See `saving.capture`."""
        return capture(self._parts(), self._newest_node_covariance, self._chi2, datum)

    @classmethod
    def restored(cls, config: BackendConfig | None, saved: SavedGraph) -> Self:
        """Return a back end that goes on from a saved graph; see `saving.restore`."""
        backend = cls(config)
        restore(backend._parts(), saved)
        backend._newest_node_covariance = np.array(saved.newest_covariance)
        backend._chi2 = saved.chi2
        backend._settled = False    # the next update eliminates everything
        return backend

    def _parts(self) -> Parts:
        return Parts(self.graph, self._nodes, self._joins, self._reweighing, self._aligning,
                     self._arrivals, self._quarantine)
