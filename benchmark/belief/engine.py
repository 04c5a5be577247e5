# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ours on a drive, online and at the end: with defaults, and as an oracle that knows."""

import time

import numpy as np

from benchmark.drives import Drive, feed, off_truth, rms, SECOND
from benchmark.fixes import doubted
from benchmark.recordings import drain
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, MeasurementSource, OdometrySource
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import OdometrySample

RECEIVERS = 'fix', 'second'
SETTLED_S = 30.0
"""What is before does not count online."""


DEFAULTS = OdometrySource()


def config(source: MeasurementSource, odometry: OdometrySource = DEFAULTS) -> BackendConfig:
    """Return settings of both receivers and of odometry."""
    return BackendConfig(odometry={'odom': odometry},
                         measurements=dict.fromkeys(RECEIVERS, source))


def fix_stamps(drive: Drive) -> IntArray:
    """Return the stamps of the fixes of all receivers."""
    others = np.array([event.stamp_ns for _, event in drive.others], dtype=np.int64)
    return np.union1d(drive.stamps_ns, others)


def error(path: Trajectory, drive: Drive) -> float:
    """Return the rms of a path to the truth, at the stamps of all fixes [m]."""
    stamps = fix_stamps(drive)
    stamps = stamps[path.covers(stamps) & drive.truth.covers(stamps)]
    return rms((path.at(stamps) - drive.truth.at(stamps))[:, :2])


def run(
    drive: Drive, settings: BackendConfig, asked: Drive | None = None,
) -> tuple[Trajectory, dict[str, float]]:
    """
    Update after each fix; return the path at the end, and figures by column of the page.

    Where the newest pose is asked for online, another drive with more fixes may say.
    """
    backend, events = PoseGraphBackend(settings), drive.events()
    at_ns, n_asked = fix_stamps(asked or drive), 0
    settled_ns = drive.odometry.stamps_ns[0] + round(SETTLED_S * SECOND)
    newest: list[tuple[FloatArray, FloatArray]] = []
    arrived, begin = False, time.thread_time()
    for source, event in events:
        if not isinstance(event, OdometrySample):
            backend.add_measurement(event, source)
            arrived = True
            continue
        backend.add_odometry(event)
        is_asked = n_asked < len(at_ns) and event.stamp_ns >= at_ns[n_asked]
        if not arrived and not is_asked:
            continue
        arrived = False
        backend.update()
        if is_asked:
            n_asked = int(np.searchsorted(at_ns, event.stamp_ns, side='right'))
        if is_asked and event.stamp_ns >= settled_ns and drive.truth.covers(event.stamp_ns):
            estimate = backend.estimate(with_path=False)
            if estimate is not None and estimate.alignment is AlignmentState.ALIGNED:
                newest.append(off_truth(backend, drive.truth))
        drain(backend)
    ended = time.thread_time()
    estimate = finished(backend)
    end_seconds = time.thread_time() - ended
    path, covariances = estimate.path, backend.path_covariances(estimate)
    inside = drive.truth.covers(path.stamps_ns)
    off = path.poses[inside] - drive.truth.at(path.stamps_ns[inside])
    right = {(name, one.stamp_ns) for name, one in events if name in RECEIVERS} - drive.wrong
    refused = doubted(backend)
    off_newest = np.array([one for one, _ in newest]).reshape(-1, 3)
    claimed = np.array([one for _, one in newest]).reshape(-1, 3, 3)
    return path, {
        'online': rms(off_newest[:, :2]),
        'wrong believed': len(drive.wrong - refused) / len(drive.wrong) if drive.wrong else np.nan,
        'right doubted': len(right & refused) / len(right),
        'NEES': _nees(off, covariances[inside]), 'NEES online': _nees(off_newest, claimed),
        'ms per fix': 1e3 * (ended - begin) / len(fix_stamps(drive)), 'end [s]': end_seconds}


def finished(backend: PoseGraphBackend) -> Estimate:
    """Decide on the whole drive."""
    backend.optimize()
    estimate = backend.estimate()
    assert estimate is not None
    return estimate


def at_end(drive: Drive, settings: BackendConfig) -> Trajectory:
    """Return the path by all of a drive; with few updates, as what happens online is not asked."""
    backend = PoseGraphBackend(settings)
    # with none, odometry alone may lead to a start too far off for the optimiser
    for _ in feed(backend, drive.events(), 10.0):
        pass
    return finished(backend).path


def _nees(off: FloatArray, covariances: FloatArray) -> float:
    """Return the mean of e^T C^-1 e / 2 of positions; 1 if what was claimed is right."""
    position = off[:, :2, None]
    return float(np.mean(np.swapaxes(position, 1, 2) @ np.linalg.solve(
        covariances[:, :2, :2], position))) / 2.0
