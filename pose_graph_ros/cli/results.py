# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write the results of a run: corrected path, picture, summary and table of errors."""

from collections.abc import Mapping
from dataclasses import replace
import json
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pose_graph_ros.adapters.bag_inputs import Inputs, POSE_TYPES, poses_on, read_inputs, reader_of
from pose_graph_ros.adapters.bags import Bag, BagError, MessageError, Span, WHOLE
from pose_graph_ros.adapters.sources import Kind, ODOMETRY_KINDS
from pose_graph_ros.cli.evaluation import Drive, evaluate, format_table, place_truth, summary
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.path_files import write_tum
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import Fix, GlobalPose, LoopClosure, OdometrySample

# Largest number of samples of a path that are kept for comparison and the picture.
MOST_SAMPLES = 200_000


class PathCollector:
    """Samples of a path; of very many, only every second one is kept, or fewer."""

    def __init__(self) -> None:
        self._stamps = GrowingArray((), np.int64)
        self._poses = GrowingArray((3,), np.float64)
        self._count, self._stride = 0, 1

    def add(self, stamp_ns: int, pose: FloatArray) -> None:
        """
        Add a sample.

        Parameters
        ----------
        pose : ndarray, shape (3,)

        """
        if self._count % self._stride == 0:
            self._stamps.append_one(stamp_ns)
            self._poses.append_one(pose)
        self._count += 1
        if len(self._stamps) == MOST_SAMPLES:
            every_second = np.arange(0, MOST_SAMPLES, 2)
            self._stamps.select(every_second)
            self._poses.select(every_second)
            self._stride *= 2

    def path(self) -> Trajectory:
        """Return the samples by stamp; of several with the same stamp the first one."""
        stamps, first = np.unique(self._stamps.values, return_index=True)
        return Trajectory(stamps, self._poses.values[first])


class _Positions:
    """Measured positions, as columns."""

    def __init__(self) -> None:
        self.stamps = GrowingArray((), np.int64)
        self.positions = GrowingArray((2,), np.float64)
        self.arms = GrowingArray((2,), np.float64)
        self.held_out = GrowingArray((), np.bool_)
        self._fixes: dict[int, Fix] = {}

    def add(
        self, stamp_ns: int, position: FloatArray | Fix, arm: FloatArray, *, held_out: bool,
    ) -> None:
        """
        Add a position.

        Parameters
        ----------
        position : ndarray, shape (2,), or a fix that is not in the map yet
        arm : ndarray, shape (2,), of the antenna

        """
        if isinstance(position, Fix):
            self._fixes[len(self.stamps)] = position
            position = np.zeros(2)
        self.stamps.append_one(stamp_ns)
        self.positions.append_one(position)
        self.arms.append_one(arm)
        self.held_out.append_one(held_out)

    def place(self, inside: BoolArray) -> None:
        """Compute the positions of all fixes; the first one that can have been used goes first."""
        for at in sorted(self._fixes, key=lambda at: bool(
                self.held_out.values[at] or not inside[at])):
            self.positions.values[at] = self._fixes[at].place()


def collect_drive(
    bag: Bag, inputs: Inputs, values: Mapping[str, Any], corrected: Trajectory,
    truth_topic: str | None, *, origin: MapOrigin | None = None,
    states: Mapping[Key, State] = MappingProxyType({}),
) -> Drive:
    """
    Return the corrected path together with the measurements of the bag that went into the graph.

    The truth is moved to where it fits the path best.

    Parameters
    ----------
    values : mapping, all parameters of the node
    corrected : Trajectory, result, `T_map_base`
    truth_topic : str or None, topic of true poses in the map
    origin : MapOrigin, optional, datum of the graph
    states : mapping, optional, what is believed; all that is missing is

    Raises
    ------
    BagError
        If `truth_topic` is missing or of an unsupported type.

    """
    reader = reader_of(bag, values)
    if origin is not None:
        reader.datum.keep(origin)
    preferred = inputs.of(*ODOMETRY_KINDS)[0]
    odometry, fixes = PathCollector(), _Positions()
    unused = GrowingArray((), np.bool_)
    fix_sources, loop_sources = list[str](), list[str]()
    loops: list[tuple[int, int]] = []
    loop_states: list[State] = []
    for source, message, held_out in read_inputs(bag, inputs):
        try:
            measurement = reader.read(source, message.decode())
        except MessageError:
            continue
        match measurement:
            case Fix(stamp, _, _, lever_arm):
                # without the datum of the graph, it is decided below which fix makes it
                fixes.add(stamp, measurement if origin is None else measurement.place(),
                          lever_arm, held_out=held_out)
            case GlobalPose(stamp, pose, _):
                fixes.add(stamp, pose[:2], np.zeros(2), held_out=held_out)
            case LoopClosure(stamp, _, _, int(reference)):
                loops.append((reference, stamp))
                loop_sources.append(source)
                loop_states.append(states.get((source, stamp, reference), State.BELIEVED))
            case OdometrySample(stamp, pose) if source == preferred:
                odometry.add(stamp, pose)
        if len(fixes.stamps) > len(unused):
            stamp = int(fixes.stamps.values[-1])
            unused.append_one(not states.get((source, stamp, None), State.BELIEVED).in_graph)
            fix_sources.append(source)
    stamps, arms = fixes.stamps.values, fixes.arms.values
    inside = corrected.covers(stamps)
    fixes.place(inside)
    positions = fixes.positions.values
    if np.any(arms):  # from the antenna to the robot, with the heading of the corrected path
        turn = corrected.at(stamps[inside]) * (0.0, 0.0, 1.0)
        positions[inside] -= se2.transform(turn, arms[inside])
    return place_truth(Drive(
        odometry=odometry.path(), fix_stamps_ns=stamps, fix_positions=positions,
        fix_held_out=fixes.held_out.values, corrected=corrected,
        truth=None if truth_topic is None else read_truth(bag, truth_topic, inputs.span),
        loop_stamps_ns=np.array(loops, dtype=np.int64).reshape(-1, 2), loop_states=loop_states,
        fix_unused=unused.values, fix_sources=fix_sources, loop_sources=loop_sources,
        map_axes=('east', 'north') if len(inputs.of(Kind.FIX)) > 0 and not any(values['datum'][2:])
        else ('x', 'y')))


def with_refused(drive: Drive, backend: PoseGraphBackend) -> Drive:
    """Return a drive with the measurements in the map that its graph has not, where it could."""
    estimate = backend.estimate(with_path=False)
    assert estimate is not None, 'a drive has a hidden node'
    stamps, begin_ns = drive.fix_stamps_ns, backend.node_stamps_ns[estimate.n_frozen]
    refused = ~drive.fix_held_out & (stamps >= begin_ns)
    names = np.array(drive.fix_sources, dtype=str)
    for source, added in backend.measured().items():
        at = np.flatnonzero((names == source) & np.isin(stamps, added) & ~drive.fix_held_out)
        # of several with one stamp the first one was added
        refused[at[np.unique(stamps[at], return_index=True)[1]]] = False
    return replace(drive, fix_refused=refused)


def read_truth(bag: Bag, topic: str, span: Span = WHOLE) -> Trajectory:
    """
    Return the true poses in a bag; invalid messages are ignored.

    Parameters
    ----------
    topic : str
    span : Span, when the messages were recorded

    Raises
    ------
    BagError
        If the topic is missing or of an unsupported type.

    """
    info = bag.topics.get(topic)
    if info is None or info.type not in POSE_TYPES:
        what = 'no topic' if info is None else f'type {info.type} of'
        raise BagError(f'{bag.path}: {what} {topic} (--truth); expected one of '
                       f'{", ".join(POSE_TYPES)}; the bag has {bag.describe()}')
    poses = PathCollector()
    for stamp, pose in poses_on(bag, topic, span):
        poses.add(stamp, pose)
    return poses.path()


def write_results(drive: Drive, folder: Path, title: str, facts: Mapping[str, Any]) -> str:
    """
    Return a table of errors, after writing `path.tum`, `drive.png` and `summary.json`.

    Parameters
    ----------
    folder : Path, created if it does not exist
    title : str, of the picture
    facts : mapping, further entries of the summary

    """
    # matplotlib takes half a second to load, and `--help` needs none of it
    from pose_graph_ros.cli.picture import draw_drive  # noqa: PLC0415

    folder.mkdir(parents=True, exist_ok=True)
    rows = evaluate(drive)
    write_tum(drive.corrected, folder / 'path.tum')
    draw_drive(drive, folder / 'drive.png', title)
    text = json.dumps(summary(drive, rows, facts), indent=2)
    (folder / 'summary.json').write_text(text + '\n', encoding='utf-8')
    return format_table(rows)
