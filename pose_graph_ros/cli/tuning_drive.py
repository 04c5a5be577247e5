# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The measurements of a bag, in memory, and what runs of the engine with some of them show."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.bag_inputs import Inputs, reader_of
from pose_graph_ros.adapters.bags import Bag
from pose_graph_ros.adapters.sources import backend_config, Kind
from pose_graph_ros.cli.replay import measurements_of, run_measurements
from pose_graph_ros.core.config import MeasurementSource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, Covariances, FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.texts import states_by_stamps
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import (
    Fix,
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.quantities import Metres, Radians, StampNs
from pose_graph_ros.core.sources.validation import validate, Validated
from pose_graph_ros.offline.tuning import likelihood as lk
from pose_graph_ros.offline.tuning.drive_rows import Measured, measured
from pose_graph_ros.offline.tuning.held_out import Errors, errors_at

LEAST = 20  # measurements of a source whose noise is estimated

Key = tuple[str, StampNs]
"""Source and stamp of a measurement."""


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


class Run(NamedTuple):
    """Result of a run of the engine."""

    path: Trajectory
    covariances: Covariances  # of the path, in map axes
    factors: Mapping[str, float]  # of the engine on the variances that a source claims
    doubted: frozenset[Key]  # measurements that contradict the others
    graph: Graph


class TuningDrive:
    """The measurements of a bag, the first million, all fixes in the same map."""

    def __init__(self, bag: Bag, inputs: Inputs, values: Mapping[str, Any]) -> None:
        stream = measurements_of(bag, inputs, reader_of(bag, values), Counter())
        measurements = list(islice(stream, 1_000_000))  # of about 700 bytes each
        self.is_cut = next(stream, None) is not None  # whether the bag has more
        self.measurements = _in_the_map(measurements)

    def odometry(self, source: str) -> list[OdometrySample]:
        """Return the samples of a source of odometry."""
        return [each for name, each in self.measurements
                if name == source and isinstance(each, OdometrySample)]

    def closures(self) -> list[tuple[str, LoopClosure]]:
        """Return the loop closures and their sources."""
        return [(name, each) for name, each in self.measurements
                if isinstance(each, LoopClosure)]

    def sources_of_poses(
        self, inputs: Inputs, values: Mapping[str, Any],
    ) -> list[SourceOfPoses]:
        """Return the sources with enough valid measurements in the map."""
        config, found = backend_config(values), []
        for name in inputs.of(Kind.FIX, Kind.GLOBAL_POSE, Kind.IMU):
            kept = [each for of, each in self.measurements if of == name
                    and isinstance(each, Position | GlobalPose | HeadingOnly)]
            source = None if len(kept) == 0 else _source_of_poses(
                name, kept, config.measurement_source(name, type(kept[0])))
            if source is not None:
                found.append(source)
        return found

    def run(self, values: Mapping[str, Any], without: Collection[Key] = ()) -> Run | None:
        """Return the result of the engine without some measurements; None if it has no path."""
        backend, _ = run_measurements((
            (name, each) for name, each in self.measurements
            if isinstance(each, OdometrySample) or (name, each.stamp_ns) not in without), values)
        estimate = backend.estimate()
        if estimate is None:
            return None
        factors = {
            name: 1.0 if report.in_use is None else report.in_use.correlated + report.in_use.white
            for name, report in backend.reports().items()}
        doubted = frozenset(
            (name, stamp) for (name, stamp, _), state
            in states_by_stamps(backend.verdicts()).items() if state is State.DOUBTED)
        return Run(estimate.path, backend.path_covariances(estimate), factors, doubted,
                   backend.graph)

    def errors(
        self, run: Run, values: Mapping[str, Any], inputs: Inputs, held_out: Collection[Key],
    ) -> list[Errors]:
        """Return the errors of a path at positions that were held out, for each source."""
        return [errors_at(run.path, run.covariances,
                          source.measured.rows(source.is_among(held_out)),
                          run.factors.get(source.name, 1.0))
                for source in self.sources_of_poses(inputs, values)]

    def closure_errors(self, run: Run, held_out: Collection[Key]) -> Errors:
        """Return the errors of a path at closures, in the frames of their references."""
        chosen = [each for name, each in self.closures()
                  if (name, each.stamp_ns) in held_out and each.reference_ns is not None]
        stamps = np.array([(each.reference_ns, each.stamp_ns) for each in chosen],
                          dtype=np.int64).reshape(-1, 2)
        inside = np.all(run.path.covers(stamps), axis=1)
        ends = run.path.at(stamps[inside])
        measured_poses = np.array([each.pose for each in chosen]).reshape(-1, 3)[inside]
        errors = measured_poses[:, :2] - se2.between(ends[:, 0], ends[:, 1])[:, :2]
        return Errors(stamps[inside, 1], errors, np.full((len(errors), 2, 2), np.nan))


def _source_of_poses(
    name: str, kept: Sequence[Position | GlobalPose | HeadingOnly], settings: MeasurementSource,
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
        assert isinstance(one.measurement, Position | GlobalPose | HeadingOnly)
        valid.append(one.measurement)
    if len(valid) < LEAST:
        return None
    columns = measured(valid)
    variances = 0.5 * (columns.values[:, lk.XX - lk.X] + columns.values[:, lk.YY - lk.X])
    variances = variances[variances > 0.0]
    headings = columns.values[:, lk.HEADING_VAR - lk.X]
    headings = headings[headings > 0.0]
    bounds = policy.position_floor**2, policy.position_ceiling**2
    inside = len(variances) == 0 or bool(
        np.min(variances) > 1.01 * bounds[0] and np.max(variances) < 0.99 * bounds[1])
    return SourceOfPoses(
        name, columns, is_constant=_is_same(variances) and _is_same(headings),
        is_scalable=inside and not repaired and len(policy.override) == 0,
        sigma=_median_sigma(variances), sigma_heading=_median_sigma(headings))


def _in_the_map(
    measurements: list[tuple[str, OdometrySample | Measurement]],
) -> list[tuple[str, OdometrySample | Measurement]]:
    """Return measurements with fixes placed; the first one that odometry covers goes first."""
    start = min((each.stamp_ns for _, each in measurements
                 if isinstance(each, OdometrySample)), default=0)
    order = sorted(range(len(measurements)), key=lambda k: measurements[k][1].stamp_ns < start)
    for k in order:
        name, each = measurements[k]
        if isinstance(each, Fix):
            measurements[k] = name, each.placed()
    return measurements


def _is_same(variances: FloatArray) -> bool:
    return len(variances) == 0 or bool(np.max(variances) < 1.05 * np.min(variances))


def _median_sigma(variances: FloatArray) -> float:
    return float(np.sqrt(np.median(variances))) if len(variances) > 0 else 0.0
