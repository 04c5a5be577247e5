# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run bags or a g2o file through the engine of the node, without ROS.

The replay is written for other programs: path and live poses in their formats, and a corrected
bag, a copy with the path, odometry in the map, and the transform to odom.
"""

import argparse
import bisect
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
import time
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters import bags, output_cdr, sources
from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import Bag, BagError, BagMessage, Inputs, MessageError, reader_of
from pose_graph_ros.adapters.conversions import Datum, frame
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import CLOSURES, Kind, KINDS, Measured, Values
from pose_graph_ros.cli import shared
from pose_graph_ros.cli.arguments import Exports, FULL, ON_EARTH
from pose_graph_ros.cli.drive import (
    collect_drive,
    Drive,
    drive_in,
    measured_in,
    Recorded,
    with_truth,
)
from pose_graph_ros.cli.graph_input import GRAPH_SUFFIXES, read_measurements
from pose_graph_ros.cli.run import document, Recorder, Run, Update
from pose_graph_ros.cli.truth import truth_of
from pose_graph_ros.core import alignment, exceptions
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import Estimate, predict, Prediction, UpdateReport
from pose_graph_ros.core.geometry.se2 import between_one, compose_one, Pose
from pose_graph_ros.core.geometry.trajectory import interpolated, PathCorrection, Trajectory
from pose_graph_ros.core.io import g2o, path_files
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.measurements import OdometrySample

UPDATE_EVERY = 10  # new hidden nodes after which the graph is updated, to stay near the optimum
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


class ExportError(exceptions.PoseGraphError, ValueError):
    """A path cannot be written in a format."""


def require_datum(exports: Exports, *, known: bool) -> None:
    """Raise `ExportError` if a format needs a place on the Earth, and there is none."""
    on_earth = [name for name in exports.formats if name in ON_EARTH]
    if exports.strict and len(on_earth) > 0 and not known:
        raise ExportError(
            f'--export {", ".join(on_earth)}: the place of the map on the Earth is unknown; give '
            "fixes (--fix TOPIC), or poses in a map with a known datum (--global-pose TOPIC -p "
            "'datum:=[LATITUDE, LONGITUDE]')")


def write_exports(exports: Exports, folder: Path, run: Run, datum: Datum | None,
                  full: Trajectory | None = None) -> list[Path]:
    """
    Return the files that were written into a folder, `path.kitti` and so on.

    The path is also given in full, with the poses between hidden nodes, if it is to be written.
    Raises `ExportError` if a format needs a place on the Earth, which is unknown, after all others
    are written.
    """
    written, path = list[Path](), run.estimate.path
    if full is not None:
        written.append(folder / 'path_full.tum')
        path_files.write_tum(full, written[-1])
    # before the first measurement in the map, its place on the Earth is unknown
    placed = (datum is not None and datum.plane is not None
              and run.estimate.alignment is not alignment.AlignmentState.LOCAL)
    for name in exports.formats:
        if name == 'kitti':
            lines = path_files.kitti_lines(path)
        elif name == 'csv':
            lines = path_files.csv_lines(path, run.covariances)
        elif placed and name in ON_EARTH:
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


class _Corrector:
    """Makes what is published with each message of the primary odometry."""

    def __init__(self, bag: Bag, inputs: Inputs, run: Run) -> None:
        path, values, self._source = run.estimate.path, run.values, run.estimate.primary
        self.topic = inputs.topics[self._source]
        self._has_poses = inputs.kinds[self._source] is KINDS['odometry']
        self.map_frame, self.odom_frame, self._base_frame = (
            frame(values[key]) for key in ('map_frame', 'odom_frame', 'base_link_frame'))
        self.correction = PathCorrection(path, interpolated(
            path, _samples(bag, inputs, run) if self._has_poses else ()))
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
        if not isinstance(sample := self._reader.read(self._source, source), OdometrySample):
            return
        stamp_ns, odometry = sample.stamp_ns, _pose(sample)
        if (pose := self.correction.at(stamp_ns, odometry)) is None:
            return
        covariance = self._covariances[bisect.bisect_right(self._stamps, stamp_ns) - 1]
        yield ODOMETRY, output_cdr.odometry_cdr(
            stamp_ns, Prediction(np.array(pose), UNKNOWN if np.isnan(covariance[0, 0])
                                 else covariance), source, self.map_frame, self._base_frame)
        if (self._has_poses and stamp_ns > self._newest_ns
                and frame(source.header.frame_id) == self.odom_frame):
            self._newest_ns = stamp_ns
            yield TF, output_cdr.transform_cdr(stamp_ns, np.array(compose_one(
                pose, between_one(odometry, (0.0, 0.0, 0.0)))), self.map_frame, self.odom_frame)


def _samples(bag: Bag, inputs: Inputs, run: Run) -> Iterator[tuple[int, Pose]]:
    """Yield stamps and poses of the primary odometry."""
    source, reader = run.estimate.primary, reader_of(bag, run.values)
    for message in bag.messages([inputs.topics[source]], inputs.span):
        with suppress(MessageError):
            sample = reader.read(source, message.decode())
            if isinstance(sample, OdometrySample):
                yield sample.stamp_ns, _pose(sample)


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
    thinned = Trajectory(path.stamps_ns[::step], path.poses[::step])
    writer.write(PATH, TYPES[PATH], bag.start_ns if begin_ns is None else begin_ns,
                 output_cdr.path_cdr(thinned, int(path.stamps_ns[-1]), corrector.map_frame))
    if begin_ns is not None and bags.STATIC_FRAMES[0] in bag.topics:
        for message in bag.messages([bags.STATIC_FRAMES[0]], bags.Span(None, begin_ns)):
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
            kept = [each for each in transforms if (frame(each.header.frame_id), frame(
                each.child_frame_id)) != (ours.map_frame, ours.odom_frame)]
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


# --- the tool

LivePoses = dict[int, Prediction]
"""By stamp."""


class Replayed(NamedTuple):
    """Result of running a bag through the engine."""

    backend: PoseGraphBackend
    report: UpdateReport  # of the final optimisation
    counts: Counter[tuple[str, str]]  # messages by source and answer
    recorder: Recorder
    seconds: float  # that it took

    @property
    def refused(self) -> set[Key]:
        """Loop closures that are not in the graph."""
        return {*self.recorder.refused, *self.backend.refused_closures}


def run(measurements: Iterable[tuple[str, Measured]], values: Values,
        live: LivePoses | None = None) -> Replayed:
    """
    Return a new engine after adding measurements and a full optimisation.

    Live poses are at the messages of odometry, each by the newest estimate that there was by then:
    as in the node, odometry goes on from the estimate of the last update, and the graph is updated
    as often, by the stamps of odometry; but each update is ready at once.
    """
    start, next_update, next_ns = time.monotonic(), UPDATE_EVERY, 0
    backend, recorder = PoseGraphBackend(sources.backend_config(values)), Recorder()
    estimate: Estimate | None = None
    for source, measurement in measurements:
        if isinstance(measurement, OdometrySample):
            backend.add_odometry(measurement, source)
        else:
            recorder.add_answer(source, measurement, backend.add_measurement(measurement, source))
        if backend.graph.n_nodes >= next_update if live is None else (
                isinstance(measurement, OdometrySample) and backend.graph.n_nodes > 0
                and measurement.stamp_ns >= next_ns):
            begin = time.thread_time()  # of this process, however busy the machine is
            report = backend.update()
            stamps_ns, spent = backend.node_stamps_ns, time.thread_time() - begin
            recorder.add_update(Update(
                int(stamps_ns[-1]), len(stamps_ns), 1e3 * spent, report.chi2))
            next_update = backend.graph.n_nodes + UPDATE_EVERY
            if live is not None and (
                    estimate := backend.estimate(with_path=False)) is not None:
                next_ns = estimate.stamp_ns + round(1e9 / values['frequency'])
        # at the samples of the primary odometry, unless they are late
        if (isinstance(measurement, OdometrySample) and live is not None and estimate is not None
                and estimate.primary == source
                and measurement.stamp_ns > next(reversed(live), 0)):
            live[measurement.stamp_ns] = predict(estimate, measurement)
    report = backend.optimize()
    return Replayed(backend, report, backend.counts, recorder, time.monotonic() - start)


class Finished(NamedTuple):
    """A replay at its end, and what only some of its files are made of."""

    run: Run
    facts: Mapping[str, Any]
    datum: Datum | None = None
    live: LivePoses | None = None
    full: Trajectory | None = None


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    done = replayed(options, shared.given_parameters(options), _silent if options.json else print)
    run, (datum, live, full) = done.run, done[2:]
    lines = document.write_results(run, options.out, done.facts)
    g2o.write_g2o(run.backend.graph, options.out / 'graph.g2o')
    exported = write_exports(options.export, options.out, run, datum, full)
    if live is not None:
        exported.append(options.out / 'live.csv')
        poses = np.array([each.T_map_base for each in live.values()]).reshape(-1, 3)
        covariances = np.array([each.covariance for each in live.values()]).reshape(-1, 3, 3)
        write_lines(exported[-1], path_files.csv_lines(
            Trajectory(np.array([*live], dtype=np.int64), poses), covariances))
    names = 'drive.png', 'summary.json', 'run.json', 'graph.g2o', *(each.name for each in exported)
    print((options.out / 'summary.json').read_text(encoding='utf-8').rstrip('\n') if options.json
          else '\n'.join([*lines, f'written: {options.out}/path.tum, {", ".join(names)}']))
    return 0 if run.report.status is Status.CONVERGED else 1


def _silent(_: str) -> None:
    """Tell nobody."""


def replayed(options: argparse.Namespace, given: Values,
             tell: Callable[[str], None] = _silent) -> Finished:
    """
    Return what comes of bags, or of a g2o file, with the parameters that are given.

    It tells which topics it reads. Files are not written, but for the bag that `--bag` asks for.
    """
    is_graph = any(path.suffix in GRAPH_SUFFIXES for path in options.bags)
    return _replayed_graph(options, given) if is_graph else _replayed_bags(options, given, tell)


def _replayed_bags(options: argparse.Namespace, given: Values,
                   tell: Callable[[str], None]) -> Finished:
    """Replay bags."""
    values, truth = checked(given), truth_of(options)
    with ExitStack() as stack:
        bag = stack.enter_context(bags.open_bag(*options.bags))
        inputs = shared.inputs_of(bag, options, values, options.hold_out, options.stretch)
        require_datum(options.export, known=len(values['datum']) > 0 or len(inputs.fixes) > 0)
        writer = None if options.new_bag is None else stack.enter_context(
            BagWriter(options.new_bag, latched=LATCHED))
        for source, topic in inputs.topics.items():
            tell(f'{source}: {topic}')
        reader, refused = reader_of(bag, values), Counter[tuple[str, str]]()
        live: LivePoses | None = {} if options.live else None
        result = run((each[:2] for each in measured_in(
            shared.watched_bag(bag, 'optimising'), inputs, reader, refused, held_out=False)),
            values, live)
        result = result._replace(counts=result.counts + refused)
        if len(result.backend.node_stamps_ns) == 0:
            topics = ' or '.join(inputs.topics[name] for name in inputs.odometry)
            why = ', '.join(f'{answer} {count}' for (source, answer), count
                            in sorted(result.counts.items()) if source in inputs.odometry)
            raise BagError(f'{bag.path}: no usable odometry on {topics}: {why or "no messages"}')
        plane = reader.datum.plane
        done = _run_of(options, result, drive_in(
            shared.watched_bag(bag, 'comparing'), inputs, values, result.backend, truth,
            origin=None if plane is None else plane.origin, refused=result.refused),
            values, inputs.kinds)
        if options.hold_out and not np.any(held_out := done.drive.fix_kinds['held out']):
            raise BagError(f'--hold-out {options.hold_out}: expected less, of {len(held_out)} '
                           'fixes none is held out')
        full = None
        if FULL in options.export.formats:
            full = done.estimate.path.filled(_Corrector(bag, inputs, done).correction, _samples(
                shared.watched_bag(bag, 'writing the path'), inputs, done))
        facts: dict[str, Any] = {
            'bags': [str(path) for path in options.bags], 'seconds': result.seconds}
        if writer is not None:
            facts['new_bag'] = write_corrected(
                writer, shared.watched_bag(bag, 'writing the bag'), inputs, done)
    return Finished(done, facts, reader.datum, live, full)


def _replayed_graph(options: argparse.Namespace, given: Values) -> Finished:
    """Replay a g2o file."""
    if len(options.bags) > 1 or any((options.new_bag, options.live, options.begin, options.until,
                                     options.hold_out, options.stretch)):
        raise BagError(f'{options.bags[0]}: expected one .g2o file alone, without --bag, --live, '
                       '--from, --until and --hold-out')
    require_datum(options.export, known=False)
    values, truth = checked({'odom.noise': 'twist', **given}), truth_of(options)
    if truth.topic is not None:
        raise BagError(f'--truth {truth.topic}: {options.bags[0]} has no topics; name a file')
    odometry = next(each.name for each in sources.source_list(values) if each.kind.is_odometry)
    measurements = [(odometry if isinstance(each, OdometrySample) else CLOSURES, each)
                    for each in read_measurements(options.bags[0], options.edge2)]
    result = run(measurements, values)
    drive = collect_drive(
        (Recorded(*each) for each in measurements), result.backend, odometry, result.refused)
    drive = with_truth(drive, truth, truth.read(None))
    samples = [(each.stamp_ns, _pose(each)) for _, each in measurements
               if isinstance(each, OdometrySample)]
    path, is_full = drive.corrected, FULL in options.export.formats
    done = _run_of(options, result, drive, values, {
        odometry: sources.ODOMETRY, CLOSURES: sources.LOOP_CLOSURE})
    return Finished(done, {'seconds': result.seconds}, full=path.filled(
        PathCorrection(path, interpolated(path, samples)), samples) if is_full else None)


def _run_of(options: argparse.Namespace, result: Replayed, drive: Drive, values: Values,
            kinds: Mapping[str, Kind]) -> Run:
    return Run(options.bags[0].stem, f'replay of {", ".join(path.name for path in options.bags)}',
               drive, result.backend, result.recorder, values, kinds, result.counts,
               result.report, result.seconds)
