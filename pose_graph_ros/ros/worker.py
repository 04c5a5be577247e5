# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The thread that owns the engine: the single writer of the graph, and what a person asks it for.

It imports no ROS. Callbacks post measurements and request updates or jobs; they never wait for a
solver. They read an immutable estimate that the thread replaces as a whole. While there is nothing
else to do after an update, the thread refines the estimate, and then waits.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
import logging
import math
import threading
import time
from typing import Any, TypeVar

import numpy as np

from pose_graph_ros.adapters.conversions import frame, Message, pose_in
from pose_graph_ros.adapters.sources import JUDGE, Measured, SET_POSE
from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import Estimate, UpdateReport
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry import covariance, geodesy, se2
from pose_graph_ros.core.io.journal import Chapter
from pose_graph_ros.core.io.journal_file import KnownPath, plain
from pose_graph_ros.core.judgement.texts import shortened
from pose_graph_ros.core.judgement.verdicts import Decision, SourceVerdicts
from pose_graph_ros.core.sources import bias, gyro
from pose_graph_ros.core.sources.source_report import SourceReport
from pose_graph_ros.ros.log import ANSWER, verdict_lines
from pose_graph_ros.ros.watchdog import Watchdog

logger = logging.getLogger(__name__)

Result = TypeVar('Result')
Job = Callable[[PoseGraphBackend], Result]

# The thread takes what has come in this time together, as it costs as much to wake it as to add a
# measurement: only an update makes a new estimate of them, and for that it takes all [s].
GATHERING = 0.1
# Time from one refinement to the next while updates follow one another: what each of them leaves
# is too little to be seen [s].
PAUSE = 1.0
MOST_JOBS = 100  # of a kind that wait; the oldest is dropped


@dataclass(frozen=True, slots=True)
class WorkerStatus:
    """A snapshot for the diagnostics."""

    processed: int = 0  # number of measurements that the engine has accepted or rejected
    # of measurements, by source and 'accepted' or a reason
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    # detail of the newest one, by source and reason
    refusals: Mapping[tuple[str, str], str] = field(default_factory=dict)
    pending: int = 0
    quarantined: int = 0
    set_aside: Sequence[str] = ()  # names of the newest of these
    report: UpdateReport | None = None  # of the newest update
    sources: Mapping[str, SourceReport] = field(default_factory=dict)  # how well each fits
    # what is believed of each
    verdicts: Mapping[str, SourceVerdicts] = field(default_factory=dict)
    biases: Mapping[str, float] = field(default_factory=dict)  # of gyroscopes [rad/s]
    calibrations: Mapping[str, bias.Calibration] = field(default_factory=dict)  # of odometries
    # of the rotations of each gyroscope from those of odometry
    differences: Mapping[str, gyro.Difference] = field(default_factory=dict)
    n_changes: int = 0  # number of changes of verdicts


class Worker:
    """
    Runs a backend in a thread of its own; a new graph gets a new worker.

    The thread calls `prepare` before its first work, with a function that tells whether to end;
    it may return another backend to run. `on_estimate` is called after each new estimate.
    """

    def __init__(
        self, backend: PoseGraphBackend, on_estimate: Callable[[PoseGraphBackend], None],
        prepare: Callable[[Callable[[], bool]], PoseGraphBackend | None] = lambda _: None,
        chapter: Chapter | None = None,
    ) -> None:
        self._backend, self._on_estimate, self._prepare = backend, on_estimate, prepare
        self.chapter = chapter  # of the journal, if there is one
        self.prepared = False  # whether the preparation has ended
        self.has_odometry = False  # whether any was posted
        self.is_optimal = False  # whether the whole graph was optimised since the last update
        self._inbox: deque[tuple[str, Measured]] = deque()
        self._update_wanted = False
        # of what, and the key that one of the same kind shares, which takes its place
        self._jobs: dict[tuple[str, object], tuple[Job[Any], Future[Any]]] = {}
        self._n_dropped = 0  # number of jobs that were too many
        self._stopping = False
        self.watchdog = Watchdog()
        # from when on the estimate is to be refined, and when that was done last [s]
        self._refine_at, self._refined_at = math.inf, -math.inf
        self._whole_at = -math.inf  # when the whole status was made last [s]
        # since the last estimate: the distance that nodes have moved [m], and measurements added
        self._refined, self._n_added = 0.0, 0
        self._condition = threading.Condition()
        self._revision = backend.revision
        self.durations = 0, 0.0, 0.0  # number, sum and longest of updates with a solve [s]
        # of odometries, that were told, also those of an engine that goes on
        self._jumps = Counter({name: each.n_jumps for name, each in backend.odometry.items()})
        self.estimate: Estimate | None = None  # the newest, without its path; replaced as a whole
        # the newest status; replaced as a whole
        self.status = WorkerStatus(counts=Counter(backend.counts))
        self.thread = threading.Thread(target=self._run, name='pose graph', daemon=True)

    def stop(self, timeout: float) -> bool:
        """Make the thread end, wait for it at most a time [s], and return whether it has ended."""
        with self._condition:
            self._stopping = True
            self._backend.interrupt()
            self._condition.notify()
        self.thread.join(timeout)
        return not self.thread.is_alive()

    @property
    def is_refined(self) -> bool:
        """Whether nothing is left to refine until the next update, and the status says so."""
        return self._refine_at == math.inf

    def rest(self) -> tuple[PoseGraphBackend, Sequence[tuple[str, Measured]]]:
        """Return the engine and what it has not got, after the thread has ended."""
        return self._backend, self._inbox

    def post(self, source: str, measurement: Measured) -> bool:
        """Return whether a measurement was handed over: not if the inbox is full."""
        with self._condition:
            if len(self._inbox) >= 100_000:
                return False
            self._inbox.append((source, measurement))
            if self.chapter is not None:
                self.chapter.measured(source, measurement)
            self.has_odometry = self.has_odometry or isinstance(measurement, ms.OdometrySample)
            if len(self._inbox) == 1:
                self._condition.notify()
        return True

    def request_update(self) -> None:
        """Request an update of the graph with all posted measurements."""
        with self._condition:
            self._update_wanted = True
            self._backend.interrupt()
            self._condition.notify()

    def call(self, job: Job[Result], what: str = 'a job', key: object = None) -> 'Future[Result]':
        """
        Return the future answer of a job, done in the thread after all posted measurements.

        One with a key takes the place of a job of the same kind and key that waits, and shares its
        answer; of a kind the newest `MOST_JOBS` wait. If it fails, that is logged and counted
        whether or not anybody reads the answer.
        """
        future: Future[Result] = Future()
        with self._condition:
            if self._stopping:
                future.cancel()
            else:
                name = what, future if key is None else key
                future = self._jobs.get(name, (job, future))[1]
                self._jobs[name] = job, future
                same = [each for each in self._jobs if each[0] == what]
                if len(same) > MOST_JOBS:
                    self._jobs.pop(same[0])[1].set_exception(
                        PoseGraphError(f'dropped: more than {MOST_JOBS} of {what} wait'))
                    self._n_dropped += 1
                self._backend.interrupt()
                self._condition.notify()
        return future

    def decide(self, message: Message) -> None:
        """Hand a decision to the engine, which answers in the log; an update follows at once."""
        name, text = shortened(message.key.strip()), shortened(message.value.strip().lower())

        def act(backend: PoseGraphBackend) -> None:
            self._note('decide', name, text)
            choices = [decision.value for decision in Decision]
            answer = backend.decide(name, Decision(text)) if text in choices else ms.rejected(
                'unknown_decision', f'expected one of {", ".join(choices)} as the value for the '
                f'key {name!r}, got {text!r}')
            refused = answer.status is ms.AnswerStatus.REJECTED
            backend.counts[JUDGE, answer.reason if refused else 'accepted'] += 1
            _tell(answer, 'nothing is decided', answer.detail)
            self.request_update()   # here, as jobs are done after one that was asked for before
        self.call(act, 'a decision', name)

    def set_pose(self, pose: ms.GlobalPose, map_frame: str) -> None:
        """Hand a pose to the engine, which answers in the log; an update follows at once."""
        def act(backend: PoseGraphBackend) -> None:
            x, y, yaw = pose.pose
            where = f'to ({x:.3f}, {y:.3f}, {yaw:.3f}) in {map_frame}'
            self._note('set_pose', plain(pose), SET_POSE)
            _tell(backend.set_pose(pose, SET_POSE), f'the pose is not set {where}',
                  f'the pose is set {where}')
            self.request_update()
        self.call(act, 'a pose that is set', 'the newest')

    def _run(self) -> None:
        try:
            self._backend = self._prepare(lambda: self._stopping) or self._backend
            self.prepared = True
            if not self._stopping:
                # before anything is solved again, what was there before
                self._publish()
        except Exception:
            # kernels are then compiled when they are first needed
            logger.exception('the preparation of the worker failed')
        self.prepared = True
        while True:
            with self._condition:
                wait = max(self._refine_at - time.monotonic(), 0.0)
                found = self._condition.wait_for(
                    lambda: len(self._inbox) > 0 or self._has_more_to_do(),
                    None if wait == math.inf else wait)
                # until there is an estimate no pose can be published
                if found and self.estimate is not None and wait > 0.0:
                    self._condition.wait_for(self._has_more_to_do, GATHERING)
                if self._stopping:
                    for _, future in self._jobs.values():
                        future.cancel()
                    return
                batch, self._inbox = self._inbox, deque()
                wanted, self._update_wanted = self._update_wanted, False
                jobs, self._jobs = self._jobs, {}
            refines = not (wanted or len(batch) + len(jobs) > 0)
            # no error may end the thread, which is the only one that adds measurements
            try:
                if refines:
                    self._refine()
                else:
                    self._process(batch, wanted=wanted)
            except Exception as error:
                self._refine_at = math.inf
                self._count_failure('a refinement' if refines else 'an update', error, len(batch))
            for (what, _), (job, future) in jobs.items():
                self._do(what, job, future)

    def _has_more_to_do(self) -> bool:
        """Tell whether more is asked for than to add measurements."""
        return self._stopping or self._update_wanted or len(self._jobs) > 0

    def _process(self, batch: Collection[tuple[str, Measured]], *, wanted: bool) -> None:
        """Add measurements, and update the graph if that is wanted."""
        for k, (source, measurement) in enumerate(batch):
            if self._stopping:
                self._inbox.extendleft(reversed([*batch][k:]))
                return
            try:
                if isinstance(measurement, ms.OdometrySample):
                    self._backend.add_odometry(measurement, source)
                else:
                    self._backend.add_measurement(measurement, source)
            except Exception as error:
                key = source, 'internal_error'
                self._backend.counts[key] += 1
                self._backend.refusals[key] = f'{type(error).__name__}: {error}'
                logger.exception('a measurement of %s could not be added', source)
        self.is_optimal = self.is_optimal and not wanted
        if self.chapter is not None:
            self.chapter.taken += len(batch)
        report = None
        if wanted:
            self._note('update')
            with self.watchdog.over(self._backend, 'an update'):
                report = self._update(self._backend.update)
        self._n_added += len(batch)
        # after a jump of the odometry the old estimate cannot be propagated
        stale = self._revision != self._backend.revision
        # an update to which nothing has come since the last estimate makes the same one
        if self.estimate is None or stale or (report is not None and (
                self._n_added + report.new_constraints + report.iterations > 0)):
            self._publish()
        if report is not None:
            # what is unfinished or to be tried is not put off
            self._refine_at = min(self._refine_at, 0.0 if (
                report.status is not Status.CONVERGED) else self._refined_at + PAUSE)
        self._report(report, len(batch))

    def _refine(self) -> None:
        """Refine a little, while there is nothing else to do; publish moves that can be seen."""
        with self.watchdog.over(self._backend, 'a refinement'):
            result = self._backend.refine()
        self._refined += result.moved
        # it judges again, too; and a move that can be seen [m]
        if (result.finished and self._report(None, 0, whole=True) > 0) or self._refined > 1e-3:
            self._publish()
        self._refine_at = 0.0
        if result.finished:
            self._refine_at, self._refined_at = math.inf, time.monotonic()

    def _do(self, what: str, job: Job[object], future: Future[object]) -> None:
        """Do a job and answer it, unless the thread is to end."""
        if self._stopping:
            future.cancel()
        if not future.set_running_or_notify_cancel():
            return
        try:
            with self.watchdog.over(self._backend, what):
                result = job(self._backend)
            future.set_result(result)
        except Exception as error:
            self._count_failure(what, error)
            future.set_exception(error)

    def optimize_fully(self, backend: PoseGraphBackend) -> UpdateReport:
        """Optimise the whole graph; a job for `call`."""
        self._note('optimize')
        report = self._update(backend.optimize)
        self.is_optimal = report.status is Status.CONVERGED
        self._publish()
        self._report(report, 0, whole=True)
        return report

    def _note(self, act: str, *values: object) -> None:
        """Note in the journal what the engine does now."""
        if self.chapter is not None:
            self.chapter.act(act, *values)

    def keep_path(self, path: Estimate) -> None:
        """Let the journal have a path that is about to be published, in this thread."""
        if self.chapter is not None and path.alignment is not AlignmentState.UNALIGNED:
            n = path.n_hidden   # without the newest odometry
            self.chapter.keep_path(KnownPath(path.path.stamps_ns[:n], path.path.poses[:n],
                                             path.alignment is AlignmentState.ALIGNED))

    def keep_state(self, datum: geodesy.MapOrigin | None) -> None:
        """Let the journal have the state of the engine, in this thread."""
        if (chapter := self.chapter) is not None and len(self._backend.node_stamps_ns) > 0:
            chapter.begin_checkpoint()
            chapter.checkpoint(self._backend.saved(datum, texts=False), self._backend.pending)

    def _count_failure(self, what: str, error: Exception, processed: int = 0) -> None:
        """Log and count an error; one of this project tells users why, and needs no traceback."""
        if is_ours := isinstance(error, PoseGraphError):
            logger.warning('%s: %s', what, error)
        else:
            logger.error('%s failed', what, exc_info=error)
        self._backend.counts['worker', 'refused_job' if is_ours else 'internal_error'] += 1
        self._report(None, processed)

    def _update(self, update: Callable[[], UpdateReport]) -> UpdateReport:
        start = time.monotonic()
        report = update()
        if report.iterations > 0:
            seconds = time.monotonic() - start
            count, total, longest = self.durations
            self.durations = count + 1, total + seconds, max(longest, seconds)
        if report.reason != '' and not self._backend.graph.memory.interrupted:
            logger.warning('the solver failed with what is set aside, the estimate is without it: '
                           '%s', report.reason)
        return report

    def _publish(self) -> None:
        self._revision, self._refined, self._n_added = self._backend.revision, 0.0, 0
        self.estimate = self._backend.estimate(with_path=False)
        if self.estimate is not None and not self._stopping:
            self._on_estimate(self._backend)

    def _report(self, report: UpdateReport | None, processed: int, *, whole: bool = False) -> int:
        """
        Replace the status; return the number of changes of verdicts, which are announced.

        It keeps the report of the last update if there is no new one. What people look at is made
        anew after a change of verdicts and a refinement, which follows the last update.
        """
        status, backend = self.status, self._backend
        for source, stream in backend.odometry.items():
            if stream.n_jumps > self._jumps[source]:
                logger.warning('%s jumped %s: its motion there is not used', source, stream.jump)
            self._jumps[source] = stream.n_jumps
        changes, now = backend.verdict_changes(), time.monotonic()
        if whole or len(changes) > 0 or now - self._whole_at >= PAUSE:
            self._whole_at = now
            status = replace(
                status, quarantined=backend.n_quarantined, set_aside=backend.set_aside(3),
                verdicts=backend.verdict_totals(), biases=backend.gyro_biases(backend.graph),
                calibrations=backend.calibrations(), differences=backend.gyro_differences(),
                sources=backend.reports())
        doubted = {source for source, each in status.verdicts.items() if each.doubting}
        for level, text, way in verdict_lines(changes, doubted):
            logger.log(level, '%s', text, extra={'way': way})
        counts = backend.counts + Counter({('worker', 'dropped_job'): self._n_dropped})
        self.status = replace(
            status, processed=status.processed + processed, counts=counts,
            refusals=dict(backend.refusals), pending=backend.n_waiting,
            report=status.report if report is None else report,
            n_changes=status.n_changes + len(changes))
        return len(changes)


# --- what a person asks for: poses that are set, and decisions on constraints

# Stamps that stand for the newest odometry (if the message has no stamp), and for the first
# odometry (if the message came before it) [ns].
NEWEST, FIRST = 2**62, 1


class SetPoseInput:
    """Keeps the newest pose that was set until there is odometry that it can be applied to."""

    def __init__(self, frames: Sequence[str]) -> None:
        self._frames = frames  # of map, odometry and robot
        self.waiting: tuple[str, ms.GlobalPose] | None = None     # and the frame that it is in

    def receive(self, message: Message, *, early: bool = False) -> ms.Answer | None:
        """Return why a message cannot be used; None if it can and is kept for `pop`."""
        if isinstance(given := pose_in(message, self._frames), ms.Answer):
            return given
        if (broken := ms.value_defect(given.pose)) is not None:
            return ms.rejected(broken, f'pose {given.pose.tolist()}')
        cov, variance = given.covariance, np.diagonal(given.covariance)
        if not (np.all(np.isfinite(cov)) and np.all(variance > 0.0)
                and np.all(variance <= covariance.LARGEST_VARIANCE)):
            cov = np.diag((0.5, 0.5, 0.26)) ** 2    # what RViz sends [m, m, rad]
        stamp = FIRST if early else given.stamp_ns
        self.waiting = frame(message.header.frame_id), ms.GlobalPose(
            stamp if stamp > 0 else NEWEST, given.pose, cov)
        return None

    def pop(self, estimate: Estimate) -> ms.GlobalPose | None:
        """Remove and return the pose, transformed to the map by an estimate; None for none."""
        waiting, self.waiting = self.waiting, None
        if waiting is None:
            return None
        named, given = waiting
        _, odom_frame, base_frame = self._frames
        T_map_frame = {odom_frame: estimate.T_map_odom, base_frame: estimate.T_map_base}.get(named)
        if T_map_frame is None:
            return given
        return ms.GlobalPose(given.stamp_ns, se2.compose(T_map_frame, given.pose),
                             covariance.turned(given.covariance, -float(T_map_frame[2])))


def _tell(answer: ms.Answer, refused: str, done: str) -> None:
    """Log an answer to a person."""
    if answer.status is ms.AnswerStatus.REJECTED:
        logger.warning('%s: %s: %s', refused, answer.reason, answer.detail, extra=ANSWER)
    else:
        logger.info('%s', done)
