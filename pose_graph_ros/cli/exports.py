# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write a replay for other programs: path and live poses in their formats, and a corrected bag.

The bag is a copy with the path, odometry in the map, and the transform to odom.
"""

import bisect
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from pose_graph_ros.adapters import output_cdr
from pose_graph_ros.adapters.bag_inputs import Inputs, reader_of, STATIC_FRAMES
from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import Bag, BagMessage, MessageError, Span
from pose_graph_ros.adapters.conversions import frame
from pose_graph_ros.adapters.sources import KINDS, MessageReader
from pose_graph_ros.adapters.surroundings import Datum
from pose_graph_ros.cli.arguments import Exports
from pose_graph_ros.cli.run import Run
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate, predict, Prediction
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import between_one, compose_one, FloatArray, Pose
from pose_graph_ros.core.geometry.trajectory import interpolated, PathCorrection, Trajectory
from pose_graph_ros.core.io import path_files
from pose_graph_ros.core.measurements import Measurement, OdometrySample

LINES = {'geojson': path_files.geojson_lines, 'kml': path_files.kml_lines,
         'gpx': path_files.gpx_lines}
PATH, ODOMETRY, TF = '/path', '/odometry/filtered', '/tf'
"""Topics that are written, as those of the node."""
TYPES = {PATH: 'nav_msgs/msg/Path', ODOMETRY: 'nav_msgs/msg/Odometry',
         TF: 'tf2_msgs/msg/TFMessage'}
MESSAGES = message_types()
LATCHED = (PATH,)
UNKNOWN = output_cdr.UNKNOWN_VARIANCE * np.eye(3)
MOST_POSES = 100_000  # of a path in a message; of more only every second is written, or fewer


class ExportError(PoseGraphError, ValueError):
    """A path cannot be written in a format."""


def require_datum(exports: Exports, *, known: bool) -> None:
    """Raise `ExportError` if a format needs a place on the Earth, and there is none."""
    if exports.strict and exports.on_earth and not known:
        raise ExportError(
            f'--export {exports.on_earth}: the place of the map on the Earth is unknown; give '
            "fixes (--fix TOPIC), or poses in a map with a known datum (--global-pose TOPIC -p "
            "'datum:=[LATITUDE, LONGITUDE]')")


def write_exports(exports: Exports, folder: Path, run: Run, datum: Datum | None) -> list[Path]:
    """
    Return the files that were written into a folder, `path.kitti` and so on.

    Raises `ExportError` if a format needs a place on the Earth, which is unknown, after all others
    are written.
    """
    written, path = [], run.estimate.path
    # before the first measurement in the map, its place on the Earth is unknown
    placed = (datum is not None and datum.plane is not None
              and run.estimate.alignment is not AlignmentState.LOCAL)
    for name in exports.formats:
        if name == 'kitti':
            lines = path_files.kitti_lines(path)
        elif name == 'csv':
            lines = path_files.csv_lines(path, run.covariances)
        elif placed:
            assert datum is not None
            places = datum.geodetic(path.poses[:, :2])[:, :2]
            lines = LINES[name](path.stamps_ns, places, run.title)
        else:
            continue
        written.append(folder / f'path.{name}')
        write_lines(written[-1], lines)
    require_datum(exports, known=placed)
    return written


def write_lines(path: Path, lines: Iterator[str]) -> None:
    """Write a text file."""
    with path.open('w', encoding='utf-8') as file:
        file.writelines(f'{line}\n' for line in lines)


class LivePoses:
    """
    Poses at the messages of odometry, each by the newest estimate that there was by then.

    As in the node, odometry goes on from the estimate of the last update, and the graph is updated
    as often, by the stamps of odometry; but each update is ready at once.
    """

    def __init__(self, frequency: float) -> None:
        self._period_ns = round(1e9 / frequency)
        self._estimate: Estimate | None = None
        self._next_ns = self._newest_ns = 0
        self._stamps: list[int] = []
        self._poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []

    def is_due(self, sample: OdometrySample | Measurement, n_nodes: int) -> bool:
        """Return whether the graph is to be updated with a measurement."""
        return (isinstance(sample, OdometrySample) and n_nodes > 0
                and sample.stamp_ns >= self._next_ns)

    def updated(self, backend: PoseGraphBackend) -> None:
        """Take the estimate of an update."""
        self._estimate = backend.estimate(with_path=False)
        if self._estimate is not None:
            self._next_ns = self._estimate.stamp_ns + self._period_ns

    def add(self, sample: OdometrySample | Measurement, source: str) -> None:
        """Add the pose at a sample of the primary odometry, unless it is late."""
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
        return path_files.csv_lines(
            Trajectory(np.array(self._stamps, dtype=np.int64),
                       np.array(self._poses).reshape(-1, 3)),
            np.array(self._covariances).reshape(-1, 3, 3))


class _Corrector:
    """Makes what is published with each message of the primary odometry."""

    def __init__(self, bag: Bag, inputs: Inputs, run: Run) -> None:
        path, values, self._source = run.estimate.path, run.values, run.estimate.primary
        self.topic = inputs.topics[self._source]
        self._has_poses = inputs.kinds[self._source] is KINDS['odometry']
        self.map_frame, self.odom_frame, self._base_frame = (
            frame(values[key]) for key in ('map_frame', 'odom_frame', 'base_link_frame'))
        reader = MessageReader(values)

        def samples() -> Iterator[tuple[int, Pose]]:
            """Yield stamps and poses of odometry, if that has poses."""
            for message in bag.messages([self.topic], inputs.span) if self._has_poses else ():
                with suppress(MessageError):
                    sample = reader.read(self._source, message.decode())
                    if isinstance(sample, OdometrySample):
                        yield sample.stamp_ns, _pose(sample)
        self._correction = PathCorrection(path, interpolated(path, samples()))
        self._stamps, self._covariances = path.stamps_ns.tolist(), run.covariances
        self._newest_ns = 0
        # from the first message on again, as it remembers the stamps before
        self._reader = reader_of(bag, values)

    def outputs(self, message: BagMessage) -> Iterator[tuple[str, bytes]]:
        """Yield topics and serialised messages; none outside the path."""
        try:
            source = message.decode()
        except MessageError:
            return
        sample = self._reader.read(self._source, source)
        if not isinstance(sample, OdometrySample):
            return
        stamp_ns, odometry = sample.stamp_ns, _pose(sample)
        pose = self._correction.at(stamp_ns, odometry)
        if pose is None:
            return
        covariance = self._covariances[bisect.bisect_right(self._stamps, stamp_ns) - 1]
        yield ODOMETRY, output_cdr.odometry_cdr(
            stamp_ns, Prediction(np.array(pose), UNKNOWN if np.isnan(covariance[0, 0])
                                 else covariance), source, self.map_frame, self._base_frame)
        if (self._has_poses and stamp_ns > self._newest_ns
                and frame(source.header.frame_id) == self.odom_frame):
            self._newest_ns = stamp_ns
            yield TF, output_cdr.transform_cdr(
                stamp_ns, np.array(compose_one(pose, between_one(odometry, (0.0, 0.0, 0.0)))),
                self.map_frame, self.odom_frame)


def write_corrected(writer: BagWriter, bag: Bag, inputs: Inputs, run: Run) -> dict[str, int]:
    """
    Return how many messages were copied, with the result, and how many were not.

    These are `original`, copied as they are, `corrected`, poses of odometry in the map, and
    `left_out`, others on the topics that are written, or that ROS 1 has alone.

    With each message of the primary odometry comes its pose in the map by the whole recording,
    and the transform from map to odom if its frame is `odom_frame`. The path comes first, on a
    `LATCHED` topic.
    """
    corrector, path = _Corrector(bag, inputs, run), run.estimate.path
    begin_ns, step = inputs.span.begin_ns, -(-len(path) // MOST_POSES)
    writer.write(
        PATH, TYPES[PATH], bag.start_ns if begin_ns is None else begin_ns,
        output_cdr.path_cdr(Trajectory(path.stamps_ns[::step], path.poses[::step]),
                            int(path.stamps_ns[-1]), corrector.map_frame))
    if begin_ns is not None and STATIC_FRAMES[0] in bag.topics:
        for message in bag.messages([STATIC_FRAMES[0]], Span(None, begin_ns)):
            writer.copy(replace(message, recorded_ns=begin_ns))
    counts = {'original': 0, 'corrected': 0, 'left_out': 0}
    for message in bag.messages(list(bag.topics), inputs.span):
        counts['original' if _copy(writer, message, corrector) else 'left_out'] += 1
        if message.topic == corrector.topic:
            for topic, data in corrector.outputs(message):
                writer.write(topic, TYPES[topic], message.recorded_ns, data)
                counts['corrected'] += topic == ODOMETRY
    return counts


def _copy(writer: BagWriter, message: BagMessage, ours: _Corrector) -> bool:
    """Copy a message without what is written anew; return whether anything was left."""
    if message.topic in (PATH, ODOMETRY):
        return False
    try:
        if message.topic == TF and all(
                name.encode() in message.raw for name in (ours.map_frame, ours.odom_frame)):
            transforms = message.decode().transforms
            kept = [each for each in transforms if (
                frame(each.header.frame_id), frame(each.child_frame_id)) != (
                    ours.map_frame, ours.odom_frame)]
            if len(kept) < len(transforms):
                if len(kept) > 0:
                    writer.write(TF, TYPES[TF], message.recorded_ns, MESSAGES[TYPES[TF]](kept))
                return len(kept) > 0
        writer.copy(message)
    except MessageError:
        return False
    return True


def _pose(sample: OdometrySample) -> Pose:
    x, y, theta = sample.pose.tolist()
    return x, y, theta
