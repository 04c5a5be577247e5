# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry and what was measured in the map, by stamp, as the rows of `likelihood`."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import (
    BackendConfig,
    MeasurementSource,
    NodePolicy,
    NoiseFrom,
    OdometrySource,
)
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.measurements import (
    GlobalPose,
    HeadingOnly,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.odometry.stream import OdometryStream
from pose_graph_ros.core.odometry.timeline import OdometryTimeline
from pose_graph_ros.core.quantities import Metres, Radians, StampNs
from pose_graph_ros.core.sources.validation import validate, Validated
from pose_graph_ros.offline.tuning import likelihood as lk

# Longest time between two rows [ns]: the noise of a motion is that of a nearly straight one.
STEP_NS = 1_000_000_000

Absolute = Position | GlobalPose | HeadingOnly
Key = tuple[str, StampNs]
"""Source and stamp of a measurement."""
LEAST = 20  # measurements of a source whose noise is estimated


class Measured(NamedTuple):
    """Measurements of one source in the map, with valid covariances, sorted by stamp."""

    stamps_ns: IntArray
    """Shape (M,) [ns]."""
    values: FloatArray
    """Columns X to HEADING_VAR of the rows of `likelihood`, shape (M, 9)."""

    def rows(self, which: BoolArray) -> 'Measured':
        """Return some of them."""
        return Measured(self.stamps_ns[which], self.values[which])

    @property
    def has_positions(self) -> bool:
        """Whether any of them has a position."""
        return bool(np.any(self.values[:, lk.XX - lk.X] > 0.0))

    @property
    def has_headings(self) -> bool:
        """Whether any of them has a heading."""
        return bool(np.any(self.values[:, lk.HEADING_VAR - lk.X] > 0.0))


class DriveRows(NamedTuple):
    """Rows of `likelihood`, by stamp."""

    stamps_ns: IntArray
    """Shape (N,) [ns]."""
    source: IntArray
    """Index of the source that has measured, -1 for none, shape (N,)."""
    rows: FloatArray
    """Shape (N, 18)."""

    @property
    def seconds(self) -> FloatArray:
        """Stamps since the first one, shape (N,) [s]."""
        return np.asarray((self.stamps_ns - self.stamps_ns[:1]) * 1e-9, dtype=np.float64)


class SourceOfPoses(NamedTuple):
    """What a source has measured in the map, by the settings of its covariances."""

    name: str
    measured: Measured
    is_constant: bool  # whether it always claims the same covariance
    is_scalable: bool  # whether what it claims is valid and not at a bound, so that a factor helps
    sigma: Metres  # median of a coordinate; 0 without positions
    sigma_heading: Radians  # median; 0 without headings

    def is_among(self, keys: Collection[Key]) -> BoolArray:
        """Return which of its measurements are among some."""
        return np.array([(self.name, stamp) in keys
                         for stamp in self.measured.stamps_ns.tolist()], dtype=bool)


def measured(measurements: Sequence[Absolute]) -> Measured:
    """Return measurements, which are valid, as columns."""
    stamps = np.array([each.stamp_ns for each in measurements], dtype=np.int64)
    values = np.zeros((len(measurements), lk.N_COLUMNS - lk.X))
    for row, each in zip(values, measurements, strict=True):
        if isinstance(each, HeadingOnly):
            row[[7, 8]] = each.heading, each.variance
            continue
        cov = each.covariance
        row[2:5] = cov[0, 0], cov[0, 1], cov[1, 1]
        if isinstance(each, Position):
            row[:2], row[5:7] = each.position, each.lever_arm
        else:
            row[:2], row[7], row[8] = each.pose[:2], each.pose[2], cov[2, 2]
    order = np.argsort(stamps, kind='stable')
    return Measured(stamps[order], values[order])


def timeline(samples: Sequence[OdometrySample], source: OdometrySource) -> OdometryTimeline:
    """Return the odometry of a drive without jumps, as the engine takes it."""
    stream = OdometryStream(source)
    for sample in samples:
        stream.add(sample)
        stream.settle_all(stream.newest_ns - round(source.reorder_window * 1e9))
    stream.settle_all(stream.newest_ns)
    return stream.timeline


def drive_rows(
    odometry: OdometryTimeline, sources: Mapping[str, Measured], config: BackendConfig,
) -> DriveRows:
    """
    Return the rows of a drive: where something was measured, and at least every second.

    What was measured where there is no odometry is left out.
    """
    stamps = odometry.stamps_ns
    if len(stamps) < 2:
        return DriveRows(np.empty(0, np.int64), np.empty(0, np.int64),
                         np.empty((0, lk.N_COLUMNS)))
    parts = [np.arange(stamps[0], stamps[-1], STEP_NS)]
    indices = [np.full(len(parts[0]), -1)]
    values = [np.zeros((len(parts[0]), lk.N_COLUMNS - lk.X))]
    for number, of in enumerate(sources.values()):
        inside = of.rows((of.stamps_ns >= stamps[0]) & (of.stamps_ns <= stamps[-1]))
        parts.append(inside.stamps_ns)
        indices.append(np.full(len(inside.stamps_ns), number))
        values.append(inside.values)
    together = np.concatenate(parts)
    order = np.argsort(together, kind='stable')
    together, source = together[order], np.concatenate(indices)[order]
    covered = np.array([odometry.covers(stamp) for stamp in together.tolist()])
    together, source = together[covered], source[covered]
    rows = np.zeros((len(together), lk.N_COLUMNS))
    rows[:, lk.X:] = np.concatenate(values)[order][covered]
    for k in range(1, len(rows)):
        motion = odometry.motion(int(together[k - 1]), int(together[k]))
        rows[k, :3] = motion.increment
        rows[k, 3:5] = motion.distance, motion.turn
        rows[k, 5:8] = motion.variance
    rows[1:, lk.NODES] = _nodes(rows[1:], np.diff(together) * 1e-9, config.nodes)
    return DriveRows(together, source.astype(np.int64), rows)


def _nodes(rows: FloatArray, elapsed: FloatArray, policy: NodePolicy) -> FloatArray:
    """Return how many hidden nodes the engine makes on motions, about, shape (N,)."""
    moves = np.maximum(rows[:, lk.LENGTH] / max(policy.minimum_travel_distance, 1e-3),
                       rows[:, lk.TURNED] / max(policy.minimum_travel_heading, 1e-3))
    moves = np.maximum(moves, np.where(rows[:, lk.LENGTH] > 1e-3,
                                       elapsed / policy.moving_interval, 0.0))
    if policy.minimum_interval > 0.0:
        moves = np.minimum(moves, elapsed / policy.minimum_interval)
    return np.maximum(moves, elapsed / policy.heartbeat)


def first_row(rows: DriveRows) -> int:
    """Return the index of the first row with a position; the number of rows without any."""
    found = np.flatnonzero((rows.source >= 0) & (rows.rows[:, lk.XX] > 0.0))
    return int(found[0]) if len(found) > 0 else len(rows.source)


def odometry_noise(source: OdometrySource) -> FloatArray:
    """Return the sigmas of odometry by its settings, shape (7,), in the order of `likelihood`."""
    noise, found = source.noise, np.zeros(lk.N_ODOMETRY)
    if source.noise_from is NoiseFrom.MODEL:
        found[:4] = (noise.sigma_distance, noise.sigma_lateral, noise.sigma_heading_distance,
                     noise.sigma_heading_turn)
    found[lk.FLOOR], found[lk.HEADING_FLOOR] = (
        noise.sigma_floor_position, noise.sigma_floor_heading)
    found[lk.GIVEN] = 1.0
    scale = source.sigma_scale or 1.0
    return np.asarray(found * scale * np.sqrt(source.covariance_scale))


def source_of_poses(
    name: str, kept: Sequence[Absolute], settings: MeasurementSource,
) -> SourceOfPoses | None:
    """Return the valid ones of some measurements; None if they are too few."""
    policy = settings.covariance
    valid, repaired, newest_ns = [], False, -10**18
    for each in sorted(kept, key=lambda one: one.stamp_ns):
        one = validate(each, policy)
        if not isinstance(one, Validated) or (
                each.stamp_ns - newest_ns < settings.minimum_period * 1e9):
            continue
        newest_ns = each.stamp_ns
        repaired = repaired or len(one.repairs) > 0
        assert isinstance(one.measurement, Absolute)
        valid.append(one.measurement)
    if len(valid) < LEAST:
        return None
    columns = measured(valid)
    variances, headings = (each[each > 0.0] for each in (
        0.5 * (columns.values[:, lk.XX - lk.X] + columns.values[:, lk.YY - lk.X]),
        columns.values[:, lk.HEADING_VAR - lk.X]))
    bounds = policy.position_floor**2, policy.position_ceiling**2
    inside = len(variances) == 0 or bool(
        np.min(variances) > 1.01 * bounds[0] and np.max(variances) < 0.99 * bounds[1])
    return SourceOfPoses(
        name, columns, is_constant=_is_same(variances) and _is_same(headings),
        is_scalable=inside and not repaired and len(policy.override) == 0,
        sigma=_median_sigma(variances), sigma_heading=_median_sigma(headings))


def _is_same(variances: FloatArray) -> bool:
    return len(variances) == 0 or bool(np.max(variances) < 1.05 * np.min(variances))


def _median_sigma(variances: FloatArray) -> float:
    return float(np.sqrt(np.median(variances))) if len(variances) > 0 else 0.0
