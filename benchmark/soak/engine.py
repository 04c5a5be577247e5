# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A month through the engine with its journal, as the worker of the node uses them.

Now and then the robot is killed: its journal is copied as it is on the disk, all else is thrown
away, and an engine of what the copy holds goes on. Times are those of the processor.
"""

from collections import Counter
from collections.abc import Container, Iterator
from dataclasses import dataclass, field
import gc
from pathlib import Path
import shutil
import time

import numpy as np

from benchmark.parts import resident_bytes
from benchmark.soak.held import held
from benchmark.soak.life import Event, EXPECTED, Life, PIECE
from pose_graph_ros.adapters.conversions import Datum
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, WindowConfig
from pose_graph_ros.core.io.journal import Journal
from pose_graph_ros.core.io.journal_file import KnownPath
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.recovery import recovered

CONFIG = BackendConfig(window=WindowConfig(nodes=2000))
DATUM = 48.1, 11.6
SOURCES = 'odom', 'fix', 'loop_closure'
UPDATE_NS = 3_000_000_000   # between two updates
KILL_EVERY = 7  # pieces from one kill to the next; each day but the first begins with one
PATIENCE = 120.0    # longest wait for the disk [s]


@dataclass(slots=True)
class Hour:
    """What became of an hour, or of a part of one."""

    hours: float    # at work so far
    resident: float     # memory of the process [MB]
    held: float     # what the engine holds [MB]
    nodes: int  # hidden nodes of the path so far
    kept: int   # nodes in the graph
    update_mean: float  # [ms]
    update_p99: float
    update_max: float
    update_work: float  # cliques that an update eliminates, mean
    path: float     # time to copy the path, mean [ms]
    checkpoint: float   # time to copy the state, mean [ms]
    journal: float      # largest size of the file [MB]
    kills: int  # so far
    recovery: float     # time of the last recovery [s]
    moved: float    # largest distance between a path before a kill and after it [m, rad]
    rms: float  # of the newest pose, without the settling after a kill [m]
    path_rms: float     # of the whole path [m]
    lost: int   # measurements that are neither accepted nor refused nor waiting, so far
    forgotten: int  # those whose answer was another one when the journal was read, so far
    unexpected: int     # those refused for another reason than intended, so far
    answers: dict[str, int] = field(default_factory=dict)   # so far


class Robot:
    """An engine that is killed now and then, and what is counted of it."""

    def __init__(self, folder: Path, datum: Datum, config: BackendConfig) -> None:
        self._config, self._datum, self._folder = config, datum, folder / '0'
        self._folder.mkdir(parents=True)
        self.backend, self.kills = self._open(), 0
        self.sent = Counter[str]()
        self.before = Counter[tuple[str, str]]()    # answers that no engine counts any more
        self.checkpointed = Counter[tuple[str, str]]()  # those that the state has, not the log
        self.recovery, self.moved, self.forgotten = 0.0, 0.0, 0

    def _open(self) -> PoseGraphBackend:
        self.journal = Journal(self._folder / 'state.db', 1.0)
        found = self.journal.take()
        self.chapter = self.journal.begin()
        if found.trouble != '' or self.journal.failure != '':
            raise RuntimeError(f'{found.trouble} {self.journal.failure}')
        return recovered(self._config, found, self._datum.place)

    def feed(self, event: Event) -> None:
        """Hand a measurement to journal and engine."""
        source, measurement = event
        self.sent[source] += 1
        self.chapter.measured(source, measurement)
        if isinstance(measurement, OdometrySample):
            self.backend.add_odometry(measurement, source)
        else:
            self.backend.add_measurement(measurement, source)
        self.chapter.taken += 1

    def update(self) -> int:
        """Update and refine the graph; return how many cliques were eliminated."""
        self.chapter.act('update')
        report = self.backend.update()
        self.backend.verdict_changes()
        return report.eliminated

    def keep_path(self) -> None:
        """Let the journal have the path, and wait until it is on the disk."""
        estimate = self.backend.estimate()
        if estimate is not None:
            n = estimate.n_hidden
            self._wait(KnownPath(estimate.path.stamps_ns[:n], estimate.path.poses[:n],
                                 self.backend.parts.alignment.is_aligned))

    def keep_state(self) -> float:
        """Let the journal have the state; return how long it took to copy it [s]."""
        self.chapter.begin_checkpoint()
        begin = time.thread_time()
        saved = self.backend.saved(
            self._datum.plane.origin if self._datum.plane else None, texts=False)
        taken = time.thread_time() - begin
        self.chapter.checkpoint(saved, self.backend.pending)
        self.checkpointed = Counter(self.backend.counts)
        return taken

    def _wait(self, path: KnownPath) -> None:
        if not self.journal.put_at_once(self.chapter, path).wait(PATIENCE):
            raise TimeoutError('the journal does not write')

    def kill(self) -> None:
        """Kill the robot, and start it again."""
        self.keep_path()
        folder = self._folder.with_name(str(int(self._folder.name) + 1))
        shutil.copytree(self._folder, folder)
        old, counts = self.known_path(), Counter(self.backend.counts)
        self.journal.close(PATIENCE)
        shutil.rmtree(self._folder)
        del self.backend
        self._folder = folder
        begin = time.thread_time()
        self.backend = self._open()
        self.recovery, self.kills = time.thread_time() - begin, self.kills + 1
        new = self.known_path()
        if not np.array_equal(new.stamps_ns, old.stamps_ns):
            raise RuntimeError(f'{len(old.stamps_ns)} nodes, then {len(new.stamps_ns)}')
        if len(old.stamps_ns) > 0:
            self.moved = max(self.moved, float(np.max(np.abs(new.poses - old.poses))))
        counts.subtract(self.backend.counts)
        self.before.update(counts)
        # an engine that goes on counts what it has from the log
        counts.subtract(self.checkpointed)
        self.forgotten += sum(abs(n) for (source, answer), n in counts.items()
                              if source in SOURCES and answer != 'jump')
        self.checkpointed = Counter()

    def known_path(self) -> KnownPath:
        """Return the hidden nodes."""
        nodes = self.backend.parts.nodes
        return KnownPath(nodes.stamps_ns.copy(), nodes.poses(self.backend.graph))

    @property
    def answers(self) -> Counter[str]:
        """Numbers of answers by source and answer, over all kills."""
        found = self.before + self.backend.counts
        return Counter({f'{source} {answer}': n for (source, answer), n in found.items()
                        if source in SOURCES and answer != 'jump' and n != 0})

    @property
    def lost(self) -> int:
        """Number of measurements without an answer that do not wait."""
        return self.sent.total() - self.answers.total() - self.backend.n_waiting

    def close(self) -> None:
        """End the journal."""
        self.journal.close(PATIENCE)


def run(life: Life, folder: Path, part: float = 1.0, config: BackendConfig = CONFIG,
        kills: Container[int] = range(KILL_EVERY, 1_000_000, KILL_EVERY)) -> Iterator[Hour]:
    """Run a life with kills in some pieces, and yield what became of each part of it [h]."""
    robot, rng = Robot(folder, life.datum, config), np.random.default_rng((life.seed, 1))
    each = max(round(3600 * part / PIECE), 1)
    due, found = 0, _Found()
    for k, piece in enumerate(life.pieces(), 1):
        kill = rng.integers(len(piece.events)) if k in kills else -1
        if piece.begins and k > 1:
            robot.kill()
        for n, event in enumerate(piece.events):
            robot.feed(event)
            if n == kill:
                robot.kill()
            if event[0] == 'odom' and event[1].stamp_ns >= due:
                due = event[1].stamp_ns + UPDATE_NS
                found.update(robot, life)
        begin = time.thread_time()
        robot.keep_path()
        found.paths.append(time.thread_time() - begin)
        found.sizes.append(robot.journal.size)
        found.checkpoints.append(robot.keep_state())
        if k % each == 0:
            yield found.hour(robot, life, k * PIECE / 3600)
            found = _Found()
    robot.close()


class _Found:
    """What is measured in a part of a life."""

    def __init__(self) -> None:
        self.updates, self.work, self.squares = list[float](), list[int](), list[float]()
        self.paths, self.checkpoints, self.sizes = list[float](), list[float](), list[int]()

    def update(self, robot: Robot, life: Life) -> None:
        begin = time.thread_time()
        self.work.append(robot.update())
        self.updates.append(time.thread_time() - begin)
        robot.backend.refine()
        if len(self.updates) % 10 == 0 and (
                estimate := robot.backend.estimate(with_path=False)) is not None:
            off = estimate.T_map_base - life.truth_at(np.array([estimate.stamp_ns]))[0]
            self.squares.append(float(off[:2] @ off[:2]))

    def hour(self, robot: Robot, life: Life, hours: float) -> Hour:
        path, answers = robot.known_path(), robot.answers
        off = (path.poses - life.truth_at(path.stamps_ns))[:, :2]
        gc.collect()
        refused = {key: n for key, n in answers.items() if not key.endswith(' accepted')}
        ms = 1e3 * np.array(self.updates)
        return Hour(
            hours, 1e-6 * resident_bytes(), 1e-6 * held(robot.backend).total(),
            len(path.stamps_ns), robot.backend.graph.n_nodes,
            float(np.mean(ms)), float(np.percentile(ms, 99)), float(np.max(ms)),
            float(np.mean(self.work)), 1e3 * float(np.mean(self.paths)),
            1e3 * float(np.mean(self.checkpoints)), 1e-6 * max(self.sizes), robot.kills,
            robot.recovery, robot.moved, float(np.mean(self.squares))**0.5,
            float(np.mean(np.sum(off**2, axis=1)))**0.5, robot.lost, robot.forgotten,
            sum(n for key, n in refused.items() if key not in EXPECTED), dict(answers))
