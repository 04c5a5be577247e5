# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Simulate a drive with known ground truth, and write it as a rosbag2 or as a g2o file.

Messages are as drivers and scan matchers would publish them.
"""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
import heapq
import json
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from pose_graph_ros.adapters import bag_writer, conversions
from pose_graph_ros.cli.shared import watched
from pose_graph_ros.cli.simulation_options import changed, PICTURES, refuse_what_graphs_lack
from pose_graph_ros.core.exceptions import ConfigError, FileWriteError
from pose_graph_ros.core.geometry.se2 import Covariance, FloatArray, IntArray, Poses
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io import atomic_files, g2o, path_files
from pose_graph_ros.core.quantities import Metres, StampsNs
from pose_graph_ros.offline.simulation import recording, sensors, settings, worlds

GRAPH_SUFFIX = '.g2o'
ODOMETRY_VARIANCES = (1e-3, 1e-3, 1e6, 1e6, 1e6, 3e-2)  # constant, as many drivers set them
Message = tuple[str, str, int, Any]
"""Topic, type, time of recording [ns] and message; recorded at its stamp, if made here."""
_TYPES = bag_writer.message_types()
_ODOMETRY, _FIX = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/NavSatFix'
_IMU, _POSE = 'sensor_msgs/msg/Imu', 'geometry_msgs/msg/PoseWithCovarianceStamped'


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.plot is not None and options.plot.suffix not in PICTURES:
        raise ConfigError(f'--plot {options.plot}: the name must end in {", ".join(PICTURES)}')
    if is_graph := options.out.suffix == GRAPH_SUFFIX:
        refuse_what_graphs_lack(options)
    elif options.node_distance is not None:
        raise ConfigError(f'--node-distance: only a graph has nodes, but {options.out} is a bag; '
                          f'expected a name that ends in {GRAPH_SUFFIX}')
    name = options.out.stem if is_graph else options.out.name
    beside = {kind: options.out.with_name(f'{name}_truth.{kind}') for kind in (
        'json', *(['tum'] if options.tum else []), *(['g2o'] if is_graph else []))}
    written = [options.out, *beside.values()]
    for path in filter(Path.exists, written):
        raise FileWriteError(f'{path}: exists already, not overwritten')
    duration = options.duration or settings.DURATIONS_S[options.world]
    way = recording.course(worlds.WORLDS[options.world], options.seed, duration,
                           lambda usual: changed(usual, options))
    about = {'world': options.world, 'seed': options.seed,
             'duration_s': float(way.motion.truth.stamps_ns[-1] - settings.START_NS) / 1e9}
    files = dict[Path, bytes]()
    simulated: recording.SimulatedGraph | recording.Recording
    if is_graph:
        simulated = recording.graph_of(
            way, options.node_distance or settings.NODE_DISTANCES[options.world])
        n, loops, observed = len(simulated.truth), simulated.loops, simulated.observed
        about |= {
            'distance_m': float(way.motion.distance[-1]), 'nodes': n,
            'edges': n - 1 + len(loops), 'observed_nodes': len(observed),
            # the degrees of freedom of chi2 at the truth
            'measured_numbers': 3 * len(simulated.edges) + int(np.sum(
                np.diagonal(observed.information, 0, 1, 2) > 0.0)),
            'chi2_of_the_truth': simulated.graph(simulated.truth.poses).energies().chi2,
            **_closures(simulated.group, simulated.missing_groups, 'ids', np.column_stack(
                (loops.i, loops.j))),
            'wrong_observed_nodes': observed.i[simulated.wrong].tolist(),
            **_disturbances(way.setup)}
        for path, poses in ((options.out, simulated.start),
                            (beside['g2o'], simulated.truth.poses)):
            files[path] = g2o.g2o_text(simulated.graph(poses).rows()).encode()
    else:
        simulated = recording.record(way)
        about |= write_drive(simulated, options.out)
    text = json.dumps(about, indent=2)
    files[beside['json']] = f'{text}\n'.encode()
    if options.tum:
        files[beside['tum']] = path_files.tum_text(simulated.truth).encode()
    atomic_files.write_files(files)
    if options.plot is not None:
        # matplotlib takes half a second to load
        from pose_graph_ros.cli.picture import draw_simulated  # noqa: PLC0415

        draw_simulated(simulated, options.plot, next(_lines(about)))
        written.append(options.plot)
    print(text if options.json else '\n'.join(
        [*_lines(about), f'written: {", ".join(map(str, written))}']))
    return 0


def _lines(about: Mapping[str, Any]) -> Iterator[str]:
    """Yield what people want to know of a simulation."""
    yield (f'{about["world"]}, seed {about["seed"]}: {about["distance_m"]:.0f} m in '
           f'{about["duration_s"]:g} s')
    yield from (f'  {topic:<14} {count}' for topic, count in about.get('topics', {}).items())
    if 'nodes' in about:
        yield (f'  {about["nodes"]} nodes, {about["edges"]} edges, {about["observed_nodes"]} '
               f'observed nodes; chi2 of the truth {about["chi2_of_the_truth"]:.6g}, of '
               f'{about["measured_numbers"]} numbers')
    yield f'  {about["true_closures"]} true and {len(about["false_closures"])} false loop closures'
    if about['missing_groups'] > 0:
        yield (f'  warning: {about["missing_groups"]} false closures or groups of them found no '
               'places that are apart and driven in the same direction')


def write_drive(drive: recording.Recording, folder: Path, *,
                overwrite: bool = False) -> dict[str, Any]:
    """
    Write a recording as a rosbag2, message by message; return what there is to say of it.

    An existing bag raises `BagError`, unless it is to be replaced.
    """
    total = sum(len(recorded) for _, recorded in drive.arrivals.values())
    messages = heapq.merge(*(_delivered(each, *drive.arrivals[topic]) for topic, each in
                             _messages(drive).items()), key=itemgetter(2))
    with bag_writer.BagWriter(folder, overwrite=overwrite) as bag:
        for topic, type_name, recorded_ns, message in watched(
                messages, desc='writing', total=total):
            bag.write(topic, type_name, recorded_ns, message)
    fixes, poses, closures = (
        drive.measured[topic] for topic in (settings.FIXES, settings.POSES, settings.CLOSURES))
    about = {
        'distance_m': drive.distance, 'topics': {topic: len(recorded) for topic, (
            _, recorded) in drive.arrivals.items() if len(recorded) > 0},
        **_closures(closures.wrong, drive.missing_groups, 'stamps_ns', closures.stamps_ns),
        'wrong_fixes_ns': fixes.stamps_ns[fixes.wrong >= 0].tolist(),
        'wrong_global_poses_ns': poses.stamps_ns[poses.wrong >= 0].tolist(),
        **_disturbances(drive.setup)}
    for each, silenced in zip(about['outages'], drive.silenced, strict=True):
        each['left_out'] = silenced
    return about


def _messages(drive: recording.Recording) -> dict[str, Iterator[Message]]:
    """Return the messages of all topics by stamp; of equally late ones the first is written."""
    setup, (odometry, gyro, fixes, poses, closures) = drive.setup, settings.TOPICS
    topics = {
        odometry: odometry_messages(odometry, 'odom', drive.odometry, ODOMETRY_VARIANCES,
                                    drive.measured[odometry].values[:, 3:]),
        settings.TRUTH: odometry_messages(settings.TRUTH, 'map', drive.truth, (0.0,) * 6)}
    if setup.gyro is not None:
        stamps_ns, values, _ = drive.measured[gyro]
        sigma = setup.claimed(gyro) * setup.gyro.sigma / np.sqrt(worlds.PERIOD_S)
        nothing, variances = np.append(-1.0, np.zeros(8)), sigma**2 * np.eye(3).ravel()
        # yaw rates in base_link [rad/s], and nothing else
        topics[gyro] = ((gyro, _IMU, stamp, _TYPES[_IMU](
            _header(stamp, 'base_link'), _of('Quaternion', 0.0, 0.0, 0.0, 1.0), nothing,
            _of('Vector3', 0.0, 0.0, rate), variances, _of('Vector3', 0.0, 0.0, 0.0), nothing))
            for stamp, rate in zip(stamps_ns.tolist(), values.tolist(), strict=True))
    if setup.fixes is not None:
        topics[fixes] = fix_messages(fixes, *drive.measured[fixes][:2], setup.sigmas(fixes)[0])
    if setup.poses is not None:
        stamps_ns, values, _ = drive.measured[poses]
        topics[poses] = _poses(poses, stamps_ns, ['map'] * len(values), values,
                               np.diag(np.square(setup.sigmas(poses))))
    if setup.closures is not None:
        topics[closures] = loop_closure_messages(
            closures, *drive.measured[closures][:2], np.diag(np.square(setup.sigmas(closures))))
    return topics


def _delivered(messages: Iterable[Message], index: IntArray,
               recorded_ns: IntArray) -> Iterator[Message]:
    """Yield messages in the order in which they arrive; only those on their way are kept."""
    left = np.bincount(index).tolist()
    made, kept = enumerate(messages), dict[int, Message]()
    for k, recorded in zip(index.tolist(), recorded_ns.tolist(), strict=True):
        while k not in kept:
            number, message = next(made)
            kept[number] = message
        topic, type_name, _, message = kept[k]
        left[k] -= 1
        if left[k] == 0:
            del kept[k]
        yield topic, type_name, recorded, message


def _closures(group: IntArray, missing: int, what: str, ends: IntArray) -> dict[str, Any]:
    return {'true_closures': int(np.sum(group < 0)), 'false_closures': [
        {what: pair, 'group': number} for pair, number in zip(
            ends[group >= 0].tolist(), group[group >= 0].tolist(), strict=True)],
            'missing_groups': missing}


def _disturbances(setup: settings.Setup) -> dict[str, Any]:
    """Return what is disturbed, with times as stamps."""
    def stamp(seconds: float) -> int | None:
        return settings.START_NS + round(seconds * 1e9) if np.isfinite(seconds) else None

    return {
        'start_ns': settings.START_NS, 'outages': [
            {'topic': each.topic, 'begin_ns': stamp(each.begin_s), 'end_ns': stamp(each.end_s)}
            for each in setup.outages],
        'jumps': [{'topic': each.topic, 'at_ns': stamp(each.at_s), 'end_ns': stamp(
            each.at_s + each.seconds), 'step': each.step} for each in setup.jumps],
        **{name: [asdict(each) for each in found] for name, found in (
            ('delays', setup.delays), ('clock_offsets', setup.offsets),
            ('duplicates', setup.duplicates), ('claimed_sigmas', setup.claims))}}


def odometry_messages(topic: str, frame: str, path: Trajectory, variances: Sequence[float],
                      rates: FloatArray | None = None) -> Iterator[Message]:
    """
    Return nav_msgs/Odometry messages of poses of base_link in a frame.

    The six variances are those of the pose and of the twist. Rates are velocities in base_link,
    shape (N, 3) [m/s, m/s, rad/s]; by default those between consecutive poses.
    """
    covariance = np.diag(variances).ravel()
    rates = sensors.velocities(path) if rates is None else rates
    for stamp, pose, (vx, _, yaw_rate) in zip(
            path.stamps_ns.tolist(), path.poses.tolist(), rates.tolist(), strict=True):
        yield topic, _ODOMETRY, stamp, _TYPES[_ODOMETRY](
            _header(stamp, frame), 'base_link', _of('PoseWithCovariance', _pose(pose), covariance),
            _of('TwistWithCovariance', _of('Twist', _of('Vector3', vx, 0.0, 0.0), _of(
                'Vector3', 0.0, 0.0, yaw_rate)), covariance))


def fix_messages(topic: str, stamps_ns: StampsNs, geodetic: FloatArray,
                 sigma: Metres) -> Iterator[Message]:
    """
    Return sensor_msgs/NavSatFix messages, of rows of latitude, longitude [deg] and height [m].

    Sigma is that of east and of north; that of the height is twice as large.
    """
    status, kind = _TYPES['sensor_msgs/msg/NavSatStatus'], _TYPES[_FIX]
    covariance = sigma**2 * np.diag([1.0, 1.0, 4.0]).ravel()
    for stamp, fix in zip(stamps_ns.tolist(), geodetic.tolist(), strict=True):
        yield topic, _FIX, stamp, kind(
            _header(stamp, 'gps'), status(status.STATUS_FIX, status.SERVICE_GPS), *fix,
            covariance, kind.COVARIANCE_TYPE_DIAGONAL_KNOWN)


def loop_closure_messages(topic: str, stamps_ns: IntArray, poses: Poses,
                          covariance: Covariance) -> Iterator[Message]:
    """
    Return loop closures as geometry_msgs/PoseWithCovarianceStamped messages.

    Rows of stamps are those of the earlier and of the later pose; poses are the later ones in the
    frames of the earlier, each with the same covariance.
    """
    frames = [f'@{old // 10**9}.{old % 10**9:09d}' for old in stamps_ns[:, 0].tolist()]
    return _poses(topic, stamps_ns[:, 1], frames, poses, covariance)


def _poses(topic: str, stamps_ns: StampsNs, frames: Sequence[str], poses: Poses,
           covariance: Covariance) -> Iterator[Message]:
    """Return poses in frames with one covariance, as PoseWithCovarianceStamped messages."""
    spatial = np.diag([0.0, 0.0, 0.01, 3e-4, 3e-4, 0.0])
    spatial[conversions.PLANAR] = covariance
    for stamp, frame, pose in zip(stamps_ns.tolist(), frames, poses.tolist(), strict=True):
        yield topic, _POSE, stamp, _TYPES[_POSE](
            _header(stamp, frame), _of('PoseWithCovariance', _pose(pose), spatial.ravel()))


def _header(stamp_ns: int, frame: str) -> Any:
    time = _TYPES['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return _TYPES['std_msgs/msg/Header'](time, frame)


def _of(kind: str, *fields: Any) -> Any:
    """Return a message of geometry_msgs."""
    return _TYPES[f'geometry_msgs/msg/{kind}'](*fields)


def _pose(pose: list[float]) -> Any:
    x, y, theta = pose
    return _of('Pose', _of('Point', x, y, 0.0), _of(
        'Quaternion', 0.0, 0.0, float(np.sin(0.5 * theta)), float(np.cos(0.5 * theta))))
