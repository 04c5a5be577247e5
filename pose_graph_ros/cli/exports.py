# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write the corrected path in the formats that other programs read."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pose_graph_ros.adapters.fixes import Datum
from pose_graph_ros.cli.arguments import Exports
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.path_files import (
    csv_lines,
    geojson_lines,
    gpx_lines,
    kitti_lines,
    kml_lines,
)
from pose_graph_ros.core.measurements import Measurement, OdometrySample
from pose_graph_ros.core.prediction import predict

LINES = {'geojson': geojson_lines, 'kml': kml_lines, 'gpx': gpx_lines}


class ExportError(PoseGraphError, ValueError):
    """A path cannot be written in a format."""


def require_datum(exports: Exports, *, known: bool) -> None:
    """Raise `ExportError` if a format needs a place on the Earth, and there is none."""
    if exports.strict and exports.on_earth and not known:
        raise ExportError(
            f'--export {exports.on_earth}: the place of the map on the Earth is unknown; give '
            "fixes (--fix TOPIC), or poses in a map with a known datum (--global-pose TOPIC -p "
            "'datum:=[LATITUDE, LONGITUDE]')")


def write_exports(
    exports: Exports, folder: Path, title: str, *, backend: PoseGraphBackend, estimate: Estimate,
    datum: Datum | None,
) -> list[Path]:
    """
    Return the files that were written into a folder, `path.kitti` and so on.

    Parameters
    ----------
    title : str, name of the track
    estimate : Estimate, the present one of the back end, with the path
    datum : Datum, optional, of the map

    Raises
    ------
    ExportError
        If a format needs a place on the Earth, which is unknown, after all others are written.

    """
    written = []
    # before the first measurement in the map, its place on the Earth is unknown
    placed = (datum is not None and datum.plane is not None
              and estimate.alignment is not AlignmentState.LOCAL)
    for name in exports.formats:
        if name == 'kitti':
            lines = kitti_lines(estimate.path)
        elif name == 'csv':
            lines = csv_lines(estimate.path, covariances(backend, estimate))
        elif placed:
            assert datum is not None
            lines = _on_earth(LINES[name], estimate, datum, title)
        else:
            continue
        written.append(folder / f'path.{name}')
        write_lines(written[-1], lines)
    require_datum(exports, known=placed)
    return written


def covariances(backend: PoseGraphBackend, estimate: Estimate) -> FloatArray:
    """Return those of the path, shape (N, 3, 3); raises `ExportError` if the solver failed."""
    try:
        return backend.path_covariances(estimate)
    except ValueError as error:
        raise ExportError(f'there are no covariances: {error}') from error


def _on_earth(
    lines: Callable[..., Iterator[str]], estimate: Estimate, datum: Datum, title: str,
) -> Iterator[str]:
    return lines(estimate.path.stamps_ns, datum.geodetic(estimate.path.poses[:, :2])[:, :2], title)


def write_lines(path: Path, lines: Iterator[str]) -> None:
    """Write a text file."""
    with path.open('w', encoding='utf-8') as file:
        file.writelines(f'{line}\n' for line in lines)


class LivePoses:
    """
    Poses at the messages of odometry, each by the newest estimate that there was by then.

    As in the node, odometry goes on from the estimate of the last update, and the graph is updated
    as often; but each update is ready at once.

    Parameters
    ----------
    frequency : float, of updates [Hz], by the stamps of odometry

    """

    def __init__(self, frequency: float) -> None:
        self._period_ns = round(1e9 / frequency)
        self._estimate: Estimate | None = None
        self._next_ns = self._newest_ns = 0
        self._stamps: list[int] = []
        self._poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []

    def is_due(self, sample: OdometrySample | Measurement, n_nodes: int) -> bool:
        """
        Return whether the graph is to be updated with a measurement.

        Parameters
        ----------
        n_nodes : int, hidden nodes

        """
        return (isinstance(sample, OdometrySample) and n_nodes > 0
                and sample.stamp_ns >= self._next_ns)

    def updated(self, backend: PoseGraphBackend) -> None:
        """Take the estimate of an update."""
        self._estimate = backend.estimate(with_path=False)
        if self._estimate is not None:
            self._next_ns = self._estimate.stamp_ns + self._period_ns

    def add(self, sample: OdometrySample | Measurement, source: str) -> None:
        """
        Add the pose at a sample of the primary odometry, unless it is late.

        Parameters
        ----------
        source : str

        """
        estimate = self._estimate
        if not isinstance(sample, OdometrySample) or estimate is None or (
                estimate.primary != source or sample.stamp_ns <= self._newest_ns):
            return
        self._newest_ns = sample.stamp_ns
        found = predict(estimate, sample)
        self._stamps.append(sample.stamp_ns)
        self._poses.append(found.T_map_base)
        self._covariances.append(found.covariance)

    def lines(self) -> Iterator[str]:
        """Yield the lines of a table, as that of the path."""
        return csv_lines(Trajectory(np.array(self._stamps, dtype=np.int64),
                                    np.array(self._poses).reshape(-1, 3)),
                         np.array(self._covariances).reshape(-1, 3, 3))
