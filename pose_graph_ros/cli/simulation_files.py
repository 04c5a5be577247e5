# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write what was simulated: a bag or g2o files, and what was false, moved or left out in it."""

from collections.abc import Iterable, Iterator
import heapq
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
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.io.g2o_writing import g2o_text
from pose_graph_ros.offline.simulation.graph import SimulatedGraph
from pose_graph_ros.offline.simulation.motion import PERIOD_S
from pose_graph_ros.offline.simulation.recording import Course, Recording
from pose_graph_ros.offline.simulation.settings import (
    CLOSURES,
    FIXES,
    GYRO,
    Jump,
    ODOMETRY,
    POSES,
    Setup,
    TRUTH,
)

ODOMETRY_VARIANCES = (1e-3, 1e-3, 1e6, 1e6, 1e6, 3e-2)  # constant, as many drivers set them


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
