# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recordings of odometry and loop closures with a truth, fed online, and what became of them.

A closure is right if it is at most 3 m off, and far off beyond 6 m: the distance between the end
that it measures and the true one, seen from its true start. Errors of paths are those after the
best rigid motion, as nothing ties them to the truth. The truth decides nothing but figures.
"""

from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
import time

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    LOOP_CLOSURES,
    NoiseFrom,
    OdometrySource,
    Robust,
)
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import BoolArray, composed, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.io.g2o import read_g2o
from pose_graph_ros.core.judgement.closures import forward
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.measurements import LoopClosure, OdometrySample
from pose_graph_ros.offline.simulation.worlds import path_length

SECOND = 1_000_000_000
TRUE, FAR = 3.0, 6.0
"""Largest error of a true closure, and the one beyond which a closure is far off [m]."""
UPDATE_EVERY = 10
"""New hidden nodes after which the graph is updated, as `pose-graph replay` does."""
SMALLEST_RMS = 0.5
"""Of odometry: what the path is compared with while driving is at least this [m]."""
CLOSURES = 'loop_closure'
B25B = ('false_loops/B25b_0.150.g2o', 'false_loops/Bicocca25b_GT_GPS.g2o',
        'false_loops/B25b_timestamps.txt')
M3500 = 'graphs/input_M3500_g2o.g2o', 'graphs/manhattanOlson3500_groundtruth.txt'


@dataclass(frozen=True, slots=True)
class Recording:
    """N poses of odometry, and M loop closures."""

    name: str
    stamps_ns: IntArray
    """Shape (N,)."""
    chain: Factors
    """Odometry from each pose to the next."""
    truth: Trajectory
    twist_variance: FloatArray | None = None
    """What the odometry itself claims, shape (3,) per second; None: the model is used."""
    ends: IntArray = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    """Stamps of the reference and of the other end [ns], shape (M, 2)."""
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    """`T_reference_base`, shape (M, 3)."""
    covariances: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))
    """In the axes of the reference, shape (M, 3, 3)."""
    arrival_ns: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Shape (M,), not descending."""

    @property
    def odometry(self) -> FloatArray:
        """`T_odom_base`, shape (N, 3)."""
        return composed(np.zeros(3), self.chain.mean)

    def errors(self) -> FloatArray:
        """Return how far off the closures are, shape (M,) [m]."""
        true = se2.between(*(self.truth.at(stamps) for stamps in self.ends.T))
        return np.asarray(np.hypot(*(self.poses - true)[:, :2].T))

    def only(self, chosen: BoolArray | IntArray) -> 'Recording':
        """Return the recording with some of its closures."""
        return replace(self, ends=self.ends[chosen], poses=self.poses[chosen],
                       covariances=self.covariances[chosen], arrival_ns=self.arrival_ns[chosen])

    def ordered(self, arrival_ns: IntArray) -> 'Recording':
        """Return the recording with other times of arrival, shape (M,)."""
        order = np.argsort(arrival_ns, kind='stable')
        return replace(self.only(order), arrival_ns=arrival_ns[order])

    def config(self, robust: Robust) -> BackendConfig:
        """Return the settings of a run: the defaults, but for `robust`."""
        source = OdometrySource(noise_from=NoiseFrom.MODEL if self.twist_variance is None
                                else NoiseFrom.TWIST)
        return BackendConfig(odometry={'odom': source},
                             measurements={CLOSURES: replace(LOOP_CLOSURES, robust=robust)})

    def steps(self) -> Iterator[tuple[OdometrySample, list[LoopClosure]]]:
        """Yield the samples of odometry, each with the closures that arrive after it."""
        closures = [LoopClosure(stamp, pose, cov, reference_ns=reference)
                    for (reference, stamp), pose, cov in zip(
                        self.ends.tolist(), self.poses, self.covariances, strict=True)]
        stops = np.searchsorted(self.arrival_ns, self.stamps_ns, side='right')
        stops[-1] = len(closures)
        begin = 0
        for stamp, pose, end in zip(
                self.stamps_ns.tolist(), self.odometry, stops.tolist(), strict=True):
            yield (OdometrySample(stamp, pose, twist_variance=self.twist_variance),
                   closures[begin:end])
            begin = end

    def loops(self) -> Factors:
        """Return the closures as edges, their information in the axes of the later pose."""
        i, j = np.searchsorted(self.stamps_ns, self.ends).T
        information = [np.linalg.inv(covariance.turned(each, float(pose[2])))
                       for each, pose in zip(self.covariances, self.poses, strict=True)]
        return Factors(i, j, self.poses, np.array(information),
                     np.full(len(i), FactorKind.LOOP_CLOSURE))

    def closing(self, loops: Factors) -> 'Recording':
        """Return the recording with further closures, which come when their later node has."""
        ends = np.column_stack((self.stamps_ns[loops.i], self.stamps_ns[loops.j]))
        turned = np.array([
            covariance.turned(np.linalg.inv(information), -float(mean[2]))
            for information, mean in zip(loops.information, loops.mean, strict=True)])
        arrival = np.concatenate((self.arrival_ns, ends.max(axis=1)))
        return replace(
            self, ends=np.concatenate((self.ends, ends)),
            poses=np.concatenate((self.poses, loops.mean)), arrival_ns=arrival,
            covariances=np.concatenate((self.covariances, turned.reshape(-1, 3, 3)))
            ).ordered(arrival)


def closures(i: IntArray, j: IntArray, means: FloatArray, information: FloatArray) -> Factors:
    """Return closures between nodes, shape (M,); information of shape (3, 3) or (M, 3, 3)."""
    return Factors(i, j, means, np.broadcast_to(information, (len(i), 3, 3)),
                 np.full(len(i), FactorKind.LOOP_CLOSURE))


@dataclass(slots=True)
class Run:
    """What came of a recording."""

    backend: PoseGraphBackend
    path: Trajectory
    kept: BoolArray
    """Whether each closure takes part at the end, shape (M,)."""
    live: dict[int, tuple[float, float]]
    """Error of the newest pose, and rms of the path, after each update, by stamp [m]."""
    updates: FloatArray
    """Times of the updates [s]."""
    seconds: float
    """Of all calls of the back end."""
    longest_idle: float
    """Longest slice of work between updates [s]."""


def feed(recording: Recording, config: BackendConfig) -> Run:
    """Feed a recording online, in the order of arrival, and optimise at its end."""
    backend = PoseGraphBackend(config)
    live: dict[int, tuple[float, float]] = {}
    updates: list[float] = []
    idle, due = 0.0, UPDATE_EVERY
    begin = time.perf_counter()
    for step in recording.steps():
        add(backend, *step)
        if backend.graph.n_nodes >= due:
            due = backend.graph.n_nodes + UPDATE_EVERY
            start = time.perf_counter()
            backend.update()
            updates.append(time.perf_counter() - start)
            idle = max(idle, drain(backend))
            looked = time.perf_counter()
            estimate = backend.estimate()
            assert estimate is not None
            fit = fits(estimate.path, recording.truth)
            live[estimate.stamp_ns] = float(fit.last[-1]), float(fit.rms[-1])
            begin += time.perf_counter() - looked
    backend.optimize()
    seconds = time.perf_counter() - begin
    estimate = backend.estimate()
    assert estimate is not None
    return Run(backend, estimate.path, kept_closures(backend, recording), live,
               np.array(updates), seconds, idle)


def add(
    backend: PoseGraphBackend, sample: OdometrySample, closures: list[LoopClosure],
) -> None:
    """Add a sample of odometry, and closures."""
    backend.add_odometry(sample)
    for closure in closures:
        backend.add_measurement(closure, CLOSURES)


def drain(backend: PoseGraphBackend) -> float:
    """Do all work that waits between two updates; return the time of the longest slice [s]."""
    longest = 0.0
    while True:
        start = time.perf_counter()
        finished = backend.refine().finished
        longest = max(longest, time.perf_counter() - start)
        if finished:
            return longest


def kept_closures(backend: PoseGraphBackend, recording: Recording) -> BoolArray:
    """Return which closures take part, shape (M,)."""
    # several closures may be between the same two poses, right ones and wrong ones
    verdicts: defaultdict[tuple[int, int | None], deque[Verdict]] = defaultdict(deque)
    for verdict in backend.verdicts():
        if verdict.source == CLOSURES:
            verdicts[verdict.stamp_ns, verdict.reference_ns].append(verdict)
    if len(verdicts) == 0:
        return np.ones(len(recording.ends), dtype=bool)
    same = (verdicts[stamp, reference] for reference, stamp in recording.ends.tolist())
    return np.array([len(each) > 0 and each.popleft().state.in_graph for each in same], dtype=bool)


@dataclass(frozen=True, slots=True)
class Fit:
    """How far points are from others after the best rigid motion."""

    rms: FloatArray
    """Of points 0 to k, shape (N,) [m]."""
    last: FloatArray
    """Of point k, shape (N,) [m]."""


def fits(path: Trajectory, truth: Trajectory) -> Fit:
    """
    Fit every beginning of a path to the truth, each by a rigid motion of its own.

    With p and q the points as complex numbers, from their means, the best motion turns p by the
    angle of `p* q`, and leaves `|p|^2 + |q|^2 - 2 |p* q|`.
    """
    stamps = path.stamps_ns[truth.covers(path.stamps_ns)]
    p, q = ((trajectory.at(stamps)[:, :2] - trajectory.at(stamps)[0, :2]) @ (1.0, 1.0j)
            for trajectory in (path, truth))
    n = np.arange(1, len(stamps) + 1)
    mean_p, mean_q = np.cumsum(p) / n, np.cumsum(q) / n
    squares = (np.cumsum(np.abs(p)**2 + np.abs(q)**2) / n
               - np.abs(mean_p)**2 - np.abs(mean_q)**2)
    cross = np.cumsum(np.conj(p) * q) / n - np.conj(mean_p) * mean_q
    turn = np.exp(1j * np.angle(cross))
    return Fit(np.sqrt(np.maximum(squares - 2.0 * np.abs(cross), 0.0)),
               np.abs(q - mean_q - turn * (p - mean_p)))


def rms(path: Trajectory, truth: Trajectory) -> float:
    """Return the error of a path after the best rigid motion [m]."""
    return float(fits(path, truth).rms[-1])


def while_driving(run: Run, recording: Recording) -> tuple[float, float]:
    """
    Compare what is known while driving with odometry alone.

    At each update, path and newest pose are seen in the map of that moment: the path so far is
    fitted to the truth.

    Returns
    -------
    newest : float
        Ratio of the newest pose's rms, over the drive, to that of odometry.
    path : float
        Largest ratio of the rms of the path so far to that of odometry, or to `SMALLEST_RMS`.

    """
    odometry = fits(Trajectory(recording.stamps_ns, recording.odometry), recording.truth)
    at = np.searchsorted(recording.stamps_ns, list(run.live))
    newest, path = np.array(list(run.live.values())).T
    return (float(np.sqrt(np.mean(newest**2) / np.mean(odometry.last[at]**2))),
            float(np.max(path / np.maximum(odometry.rms[at], SMALLEST_RMS))))


def hidden_graph(run: Run) -> tuple[IntArray, Factors, Factors, BoolArray]:
    """
    Return what the peers get of a run.

    Returns
    -------
    stamps_ns : ndarray of int, shape (N,), of the hidden nodes
    chain : Factors, odometry
    loops : Factors, closures between nodes that are no neighbours
    believed : ndarray of bool, shape (M,), which of them take part at the end

    """
    edges = run.backend.graph.factors.edges
    chain = edges.rows(edges.kind == FactorKind.ODOMETRY)
    loops = edges.rows((edges.kind == FactorKind.LOOP_CLOSURE) & (np.abs(edges.j - edges.i) > 1))
    loops = forward(loops)
    return run.backend.node_stamps_ns, chain, loops, loops.weight > 0.0


def read_recording(graph: Path, truth: Path, stamps: Path | None = None) -> Recording:
    """
    Read a recording from files.

    Parameters
    ----------
    graph : Path
        g2o file with odometry between consecutive nodes, and loop closures between others.
    truth : Path
        g2o file with true poses, or with perfect edges from each node to the next. If it has
        another number of nodes it has no stamps, and is matched by the share of the path driven.
    stamps : Path, optional
        Stamps of the nodes [s], one in a line; default: one second between two nodes, and the
        odometry's noise is taken from its edges.

    """
    content = read_g2o(graph, 'toro')
    edges, n = content.graph.factors.edges, content.graph.n_nodes
    chain = np.flatnonzero(edges.j == edges.i + 1)
    chain = chain[np.unique(edges.i[chain], return_index=True)[1]]
    if len(chain) != n - 1:
        raise ValueError(f'{graph.name}: odometry between all consecutive nodes is expected')
    time_ns = (SECOND * np.arange(1, n + 1) if stamps is None
               else np.round(np.loadtxt(stamps)[:n] * SECOND).astype(np.int64))
    loops = edges.rows(np.setdiff1d(np.arange(len(edges)), chain))
    odometry = edges.rows(chain)
    return Recording(
        graph.stem, time_ns, odometry, _truth(truth, time_ns, odometry.mean),
        claimed_twist(odometry) if stamps is None else None).closing(loops)


def claimed_twist(chain: Factors) -> FloatArray:
    """Return what odometry with a pose in every second claims, shape (3,) per second."""
    return np.diagonal(np.linalg.inv(chain.information[0])).copy()


def _truth(file: Path, stamps_ns: IntArray, chain: FloatArray) -> Trajectory:
    lines = [line.split() for line in file.read_text(encoding='utf-8').splitlines()]
    poses = np.array([words[2:5] for words in lines if words[:1] == ['VERTEX_SE2']], dtype=float)
    if len(poses) == 0:
        steps = {int(words[1]): words[3:6] for words in lines
                 if words[:1] in (['EDGE2'], ['EDGE_SE2']) and int(words[2]) == int(words[1]) + 1}
        poses = composed(np.zeros(3), np.array([steps[k] for k in sorted(steps)], dtype=float))
    if len(poses) == len(stamps_ns):
        return Trajectory(stamps_ns, poses)
    shares = [path_length(path) for path in (composed(np.zeros(3), chain), poses)]
    shares = [share / share[-1] for share in shares]
    heading = np.unwrap(poses[:, 2])
    return Trajectory(stamps_ns, se2.wrapped(np.column_stack([
        np.interp(shares[0], shares[1], column) for column in (*poses[:, :2].T, heading)])))
