# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write the results of a run: corrected path, picture, summary and table of errors."""

from collections.abc import Mapping
from contextlib import suppress
import json
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pose_graph_ros.adapters.bag_inputs import Inputs, read_inputs, read_static_frames
from pose_graph_ros.adapters.bags import BagError, BagReader, MessageError
from pose_graph_ros.adapters.conversions import planar_pose, stamp_ns
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.cli.evaluation import Drive, evaluate, format_table, summary
from pose_graph_ros.cli.picture import draw_drive
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.tum import write_tum
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import Fix, GlobalPose, LoopClosure, OdometrySample

TRUTH_TYPES = ('nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped',
               'geometry_msgs/msg/PoseWithCovarianceStamped')


def collect_drive(
    bag: BagReader, inputs: Inputs, values: Mapping[str, Any], corrected: Trajectory,
    truth_topic: str | None, *, origin: MapOrigin | None = None,
    states: Mapping[Key, State] = MappingProxyType({}),
) -> Drive:
    """
    Return the corrected path together with the measurements of the bag that went into the graph.

    Parameters
    ----------
    bag : BagReader
    inputs : Inputs
    values : mapping
        All parameters of the node.
    corrected : Trajectory
        Result, `T_map_base`.
    truth_topic : str or None
        Topic of true poses in the map.
    origin : MapOrigin, optional
        Datum of the graph.
    states : mapping, optional
        What is believed; all that is missing is.

    Raises
    ------
    BagError
        If `truth_topic` is missing or of an unsupported type.

    """
    reader = MessageReader(values)
    for frames in read_static_frames(bag):
        reader.frames.receive(frames.decode())
    if origin is not None:
        reader.datum.keep(origin)
    preferred = inputs.of(Kind.ODOMETRY)[0]
    odometry: dict[int, np.ndarray] = {}
    observed: list[tuple[int, np.ndarray | Fix, np.ndarray, bool]] = []
    unused: list[bool] = []
    loops: list[tuple[int, int]] = []
    loop_states: list[State] = []
    for source, message, held_out in read_inputs(bag, inputs):
        try:
            measurement = reader.read(source, message.decode())
        except MessageError:
            continue
        match measurement:
            case Fix(stamp, _, _, lever_arm):
                observed.append((stamp, measurement, lever_arm, held_out))
            case GlobalPose(stamp, pose, _):
                observed.append((stamp, pose[:2], np.zeros(2), held_out))
            case LoopClosure(stamp, _, _, int(reference)):
                loops.append((reference, stamp))
                loop_states.append(states.get((source, stamp, reference), State.BELIEVED))
            case OdometrySample(stamp, pose) if source == preferred:
                odometry.setdefault(stamp, pose)
        if len(observed) > len(unused):
            stamp = observed[-1][0]
            unused.append(not states.get((source, stamp, None), State.BELIEVED).in_graph)
    stamps = np.array([row[0] for row in observed], dtype=np.int64)
    inside = corrected.covers(stamps)
    # without the datum of the graph: the first fix that can have been used in it is placed first
    for at in sorted(range(len(observed)), key=lambda at: bool(observed[at][3] or not inside[at])):
        stamp, position, arm, held_out = observed[at]
        if isinstance(position, Fix):
            observed[at] = stamp, position.place(), arm, held_out
    positions = np.array([row[1] for row in observed]).reshape(-1, 2)
    arms = np.array([row[2] for row in observed]).reshape(-1, 2)
    if np.any(arms):  # from the antenna to the robot, with the heading of the corrected path
        turn = corrected.at(stamps[inside]) * (0.0, 0.0, 1.0)
        positions[inside] -= se2.transform(turn, arms[inside])
    return Drive(
        odometry=_trajectory(odometry), fix_stamps_ns=stamps, fix_positions=positions,
        fix_held_out=np.array([row[3] for row in observed], dtype=bool), corrected=corrected,
        truth=None if truth_topic is None else read_truth(bag, truth_topic),
        loop_stamps_ns=np.array(loops, dtype=np.int64).reshape(-1, 2), loop_states=loop_states,
        fix_unused=np.array(unused, dtype=bool),
        map_axes=('east', 'north') if len(inputs.of(Kind.FIX)) > 0 and not any(values['datum'][2:])
        else ('x', 'y'))


def read_truth(bag: BagReader, topic: str) -> Trajectory:
    """
    Return the true poses in a bag; invalid messages are ignored.

    Parameters
    ----------
    bag : BagReader
    topic : str

    Raises
    ------
    BagError
        If the topic is missing or of an unsupported type.

    """
    info = bag.topics.get(topic)
    if info is None or info.type not in TRUTH_TYPES:
        what = 'no topic' if info is None else f'type {info.type} of'
        raise BagError(f'{bag.path}: {what} {topic} (--truth); expected one of '
                       f'{", ".join(TRUTH_TYPES)}; the bag has {bag.describe()}')
    poses: dict[int, np.ndarray] = {}
    for bag_message in bag.messages([topic]):
        with suppress(MessageError):
            message = bag_message.decode()
            pose = planar_pose(message.pose if info.type == TRUTH_TYPES[1] else message.pose.pose)
            if pose is not None:
                poses.setdefault(stamp_ns(message), pose)
    return _trajectory(poses)


def _trajectory(poses: Mapping[int, np.ndarray]) -> Trajectory:
    stamps = np.array(sorted(poses), dtype=np.int64)
    return Trajectory(stamps, np.array([poses[stamp] for stamp in stamps.tolist()]).reshape(-1, 3))


def write_results(drive: Drive, folder: Path, title: str, facts: Mapping[str, Any]) -> str:
    """
    Return a table of errors, after writing `path.tum`, `drive.png` and `summary.json`.

    Parameters
    ----------
    drive : Drive
    folder : Path
        Created if it does not exist.
    title : str
        Of the picture.
    facts : mapping
        Further entries of the summary.

    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = evaluate(drive)
    write_tum(drive.corrected, folder / 'path.tum')
    draw_drive(drive, folder / 'drive.png', title)
    text = json.dumps(summary(drive, rows, facts), indent=2)
    (folder / 'summary.json').write_text(text + '\n', encoding='utf-8')
    return format_table(rows)
