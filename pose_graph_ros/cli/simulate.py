# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulate a drive with known ground truth, and write it as a rosbag2 or as a g2o file."""

import argparse
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
import heapq
import json
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from pose_graph_ros.adapters.bag_writer import BagWriter
from pose_graph_ros.cli.bag_messages import (
    fix_messages,
    loop_closure_messages,
    Message,
    odometry_messages,
    pose_messages,
    rate_messages,
)
from pose_graph_ros.cli.progress import watched
from pose_graph_ros.cli.simulation_options import changed, PICTURES, refuse_what_graphs_lack
from pose_graph_ros.core.exceptions import ConfigError, FileWriteError
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.io.atomic_files import write_files
from pose_graph_ros.core.io.g2o_writing import g2o_text
from pose_graph_ros.core.io.path_files import tum_text
from pose_graph_ros.offline.simulation.graph import graph_of, SimulatedGraph
from pose_graph_ros.offline.simulation.motion import PERIOD_S
from pose_graph_ros.offline.simulation.recording import Course, course, record, Recording
from pose_graph_ros.offline.simulation.settings import (
    CLOSURES,
    DURATIONS_S,
    FIXES,
    GYRO,
    Gyro,
    Jump,
    NODE_DISTANCES,
    ODOMETRY,
    POSES,
    Setup,
    TRUTH,
)
from pose_graph_ros.offline.simulation.worlds import WORLDS

GRAPH_SUFFIX = '.g2o'
ODOMETRY_VARIANCES = (1e-3, 1e-3, 1e6, 1e6, 1e6, 3e-2)  # constant, as many drivers set them


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.plot is not None and options.plot.suffix not in PICTURES:
        raise ConfigError(f'--plot {options.plot}: the name must end in {", ".join(PICTURES)}')
    beside = {kind: options.out.with_name(f'{options.out.stem}_truth.{kind}'
                                          if options.out.suffix == GRAPH_SUFFIX else
                                          f'{options.out.name}_truth.{kind}')
              for kind in ('json', 'tum', 'g2o')}
    is_graph = options.out.suffix == GRAPH_SUFFIX
    if is_graph:
        refuse_what_graphs_lack(options)
    elif options.node_distance is not None:
        raise ConfigError(f'--node-distance: only a graph has nodes, but {options.out} is a bag; '
                          f'expected a name that ends in {GRAPH_SUFFIX}')
    written = [options.out, beside['json'], *([beside['tum']] if options.tum else []),
               *([beside['g2o']] if is_graph else [])]
    for path in written:
        if path.exists():
            raise FileWriteError(f'{path}: exists already, not overwritten')
    way = course(WORLDS[options.world], options.seed,
                 options.duration or DURATIONS_S[options.world],
                 lambda usual: changed(usual, options))
    about = {'world': options.world, 'seed': options.seed,
             'duration_s': float(way.motion.time[-1])}
    files = dict[Path, bytes]()
    simulated: SimulatedGraph | Recording
    if is_graph:
        simulated = graph_of(way, options.node_distance or NODE_DISTANCES[options.world])
        about |= about_graph(way, simulated)
        files = {path: text.encode() for path, text in zip(
            (options.out, beside['g2o']), graph_texts(simulated), strict=True)}
    else:
        simulated = record(way)
        about |= write_recording(simulated, options.out)
    text = json.dumps(about, indent=2)
    files[beside['json']] = f'{text}\n'.encode()
    if options.tum:
        files[beside['tum']] = tum_text(simulated.truth).encode()
    write_files(files)
    if options.plot is not None:
        _draw(simulated, options.plot, next(_lines(about)))
        written.append(options.plot)
    if options.json:
        print(text)
        return 0
    for line in _lines(about):
        print(line)
    print('written: ' + ', '.join(map(str, written)))
    return 0


def _draw(simulated: SimulatedGraph | Recording, file: Path, title: str) -> None:
    # matplotlib takes half a second to load
    from pose_graph_ros.cli import picture  # noqa: PLC0415

    scene = (picture.scene_of_graph(simulated) if isinstance(simulated, SimulatedGraph)
             else picture.scene_of_recording(simulated))
    picture.draw(scene, file, title)


def _lines(about: Mapping[str, Any]) -> Iterator[str]:
    """Yield what people want to know of a simulation."""
    yield (f'{about["world"]}, seed {about["seed"]}: {about["distance_m"]:.0f} m in '
           f'{about["duration_s"]:g} s')
    if 'topics' in about:
        yield from (f'  {topic:<14} {count}' for topic, count in about['topics'].items())
    else:
        yield (f'  {about["nodes"]} nodes, {about["edges"]} edges, {about["observed_nodes"]} '
               f'observed nodes; chi2 of the truth {about["chi2_of_the_truth"]:.6g}, of '
               f'{about["measured_numbers"]} numbers')
    false = len(about['false_closures'])
    yield f'  {about["true_closures"]} true and {false} false loop closures'
    if about['missing_groups'] > 0:
        yield (f'  warning: {about["missing_groups"]} false closures or groups of them found no '
               'places that are apart and driven in the same direction')


def simulate_drive(
    seed: int = 1, duration_s: float = 440.0, *, gyro: bool = False, heading_drift: float = 0.0,
) -> Recording:
    """
    Return a simulated drive; equal arguments give equal drives.

    Parameters
    ----------
    seed : int
        Seed of the sensor errors, the position within the lane and the waits at traffic lights.
    duration_s : float
        Length of the recording, 10 s or more [s]; the second lap begins after about 310 s.
    gyro : bool, whether with a gyroscope; all else is the same without
    heading_drift : float, what the heading by the wheels drifts by, per distance [rad/m]

    """
    def change(usual: Setup) -> Setup:
        return replace(usual, gyro=Gyro() if gyro else None,
                       wheels=replace(usual.wheels, heading_drift=heading_drift))
    return record(course(WORLDS['drive'], seed, duration_s, change))


def write_drive(drive: Recording, folder: str | Path, *, overwrite: bool = False) -> None:
    """
    Write a drive as a rosbag2 with `/odom`, `/gps/fix`, `/loop_closure` and `/ground_truth`.

    With a gyroscope it has `/imu/data` as well.

    Parameters
    ----------
    overwrite : bool, whether to replace an existing bag; otherwise one raises `BagError`

    """
    write_recording(drive, Path(folder), overwrite=overwrite)


def write_recording(
    drive: Recording, folder: Path, *, overwrite: bool = False,
) -> dict[str, Any]:
    """
    Write a recording as a rosbag2, message by message.

    Parameters
    ----------
    overwrite : bool, whether to replace an existing bag; otherwise one raises `BagError`

    Returns
    -------
    about : dict, what there is to say of it

    """
    total = sum(len(recorded) for _, recorded in drive.arrivals.values())
    messages = heapq.merge(*(
        _delivered(each, *drive.arrivals[topic]) for topic, each in _messages(drive).items()),
        key=itemgetter(2))
    with BagWriter(folder, overwrite=overwrite) as bag:
        for topic, type_name, recorded_ns, message in watched(messages, 'writing', total):
            bag.write(topic, type_name, recorded_ns, message)
    return _about_recording(drive)


def _messages(drive: Recording) -> dict[str, Iterator[Message]]:
    """Return the messages of all topics by stamp; of equally late ones the first is written."""
    setup = drive.setup
    topics = {
        ODOMETRY: odometry_messages(
            ODOMETRY, 'odom', drive.odometry, ODOMETRY_VARIANCES, drive.velocities),
        TRUTH: odometry_messages(TRUTH, 'map', drive.truth, (0.0,) * 6)}
    if setup.gyro is not None:
        topics[GYRO] = rate_messages(
            GYRO, drive.rate_stamps_ns, drive.rates,
            setup.claimed(GYRO) * setup.gyro.sigma / np.sqrt(PERIOD_S))
    if setup.fixes is not None:
        topics[FIXES] = fix_messages(FIXES, drive.fix_stamps_ns, drive.fixes,
                                     setup.claimed(FIXES) * setup.fixes.sigma)
    if setup.poses is not None:
        sigmas = setup.claimed(POSES) * np.array(setup.poses.sigmas)
        topics[POSES] = pose_messages(
            POSES, drive.pose_stamps_ns, drive.poses, np.diag(np.square(sigmas[[0, 0, 1]])))
    if setup.closures is not None:
        sigmas = setup.claimed(CLOSURES) * np.array(setup.closures.sigmas)
        topics[CLOSURES] = loop_closure_messages(
            CLOSURES, drive.loop_stamps_ns, drive.loop_poses, np.diag(np.square(sigmas)))
    return topics


def _delivered(
    messages: Iterable[Message], index: IntArray, recorded_ns: IntArray,
) -> Iterator[Message]:
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


def graph_texts(simulated: SimulatedGraph) -> tuple[str, str]:
    """Return the texts of g2o files of a graph: at the poses by odometry, and at the true ones."""
    start, truth = (g2o_text(simulated.graph(poses).rows())
                    for poses in (simulated.start, simulated.truth.poses))
    return start, truth


def about_graph(way: Course, simulated: SimulatedGraph) -> dict[str, Any]:
    """Return what there is to say of a graph."""
    true = simulated.graph(simulated.truth.poses)
    n, closures = len(simulated.truth), len(simulated.group)
    loops = simulated.loops
    return {
        'distance_m': float(way.motion.distance[-1]), 'nodes': n,
        'edges': n - 1 + closures, 'observed_nodes': len(simulated.observed),
        'measured_numbers': _measured_numbers(simulated),
        'chi2_of_the_truth': true.energies().chi2,
        **_closures(simulated.group, simulated.missing_groups, 'ids', np.column_stack(
            (loops.i, loops.j))),
        'wrong_observed_nodes': simulated.observed.node[simulated.wrong].tolist(),
        **_disturbances(way.setup, int(way.truth.stamps_ns[0]))}


def _measured_numbers(simulated: SimulatedGraph) -> int:
    """Return how many numbers were measured, the degrees of freedom of chi2 at the truth."""
    information = simulated.observed.information
    return 3 * len(simulated.edges) + int(np.sum(np.diagonal(information, 0, 1, 2) > 0.0))


def _about_recording(drive: Recording) -> dict[str, Any]:
    setup = drive.setup
    about = {
        'distance_m': drive.distance,
        'topics': {topic: len(recorded) for topic, (_, recorded) in drive.arrivals.items()
                   if len(recorded) > 0},
        **_closures(drive.loop_group, drive.missing_groups, 'stamps_ns', drive.loop_stamps_ns),
        'wrong_fixes_ns': drive.fix_stamps_ns[drive.fix_is_wrong].tolist(),
        'wrong_global_poses_ns': drive.pose_stamps_ns[drive.pose_is_wrong].tolist(),
        **_disturbances(setup, drive.start_ns)}
    for each, silenced in zip(about['outages'], drive.silenced, strict=True):
        each['left_out'] = silenced
    return about


def _closures(
    group: IntArray, missing: int, what: str, ends: IntArray,
) -> dict[str, Any]:
    false = np.flatnonzero(group >= 0)
    return {'true_closures': int(np.sum(group < 0)),
            'false_closures': [{what: pair, 'group': number} for pair, number in zip(
                ends[false].tolist(), group[false].tolist(), strict=True)],
            'missing_groups': missing}


def _disturbances(setup: Setup, start_ns: int) -> dict[str, Any]:
    """Return what is disturbed, with times as stamps."""
    def stamp(seconds: float) -> int:
        return start_ns + round(seconds * 1e9)

    def end(jump: Jump) -> int | None:
        return stamp(jump.at_s + jump.seconds) if np.isfinite(jump.seconds) else None

    return {
        'start_ns': start_ns,
        'outages': [{'topic': each.topic, 'begin_ns': stamp(each.begin_s),
                     'end_ns': stamp(each.end_s)} for each in setup.outages],
        'jumps': [{'topic': each.topic, 'at_ns': stamp(each.at_s), 'end_ns': end(each),
                   'step': each.step} for each in setup.jumps],
        'delays': [{'topic': each.topic, 'seconds': each.seconds, 'jitter_s': each.jitter_s}
                   for each in setup.delays],
        'clock_offsets': [{'topic': each.topic, 'seconds': each.seconds}
                          for each in setup.offsets],
        'duplicates': [{'topic': each.topic, 'share': each.share} for each in setup.duplicates],
        'claimed_sigmas': [{'topic': each.topic, 'factor': each.factor}
                           for each in setup.claims]}
