# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The truth that a path is compared with: a topic of the bag, or a file.

A file has times in seconds on the clock of the stamps in the bag. It may be in a map of its own,
or on the Earth.
"""

import argparse
from array import array
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pose_graph_ros.adapters.bags import Bag, BagError, Span, WHOLE
from pose_graph_ros.adapters.conversions import planar_pose, stamp_ns
from pose_graph_ros.adapters.sources import GLOBAL_POSE, ODOMETRY
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import BoolArray, compose, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import fit_motion, Trajectory
from pose_graph_ros.core.io.path_files import PathFile, read_path, seconds_text
from pose_graph_ros.core.measurements import Answer
from pose_graph_ros.core.quantities import Radians

MOST_SAMPLES = 200_000  # of a path that are compared and drawn
LONGEST_GAP_NS = 2 * 10**9  # between true poses, within which a robot moves nearly straight
LEAST_ALIGNED = 3  # two places can be moved onto any path with their distance
POSE = 'geometry_msgs/msg/PoseStamped'
POSE_TYPES = (ODOMETRY.message_type, POSE, GLOBAL_POSE.message_type)  # that a truth can have


Heighted = tuple[Trajectory, FloatArray]
"""A path and the heights of its poses [m], NaN or none where they are unknown."""


class Truth(NamedTuple):
    """Where the truth is, if it is known, and whether it is moved to where it fits a path best."""

    topic: str | None = None
    file: Path | None = None
    content: PathFile | None = None
    is_aligned: bool = True

    def read(self, bag: Bag | None, span: Span = WHOLE,
             plane: TangentPlane | None = None) -> Heighted | None:
        """Return the true poses, if known, in the map of a plane if they are on the Earth."""
        if self.content is None:
            return None if self.topic is None or bag is None else read_truth(bag, self.topic, span)
        stamps, places, headings, is_on_earth = self.content
        heights = places[:, 2]
        if is_on_earth:
            plane = plane or TangentPlane(*places[0, :2])
            places = plane.to_map(places[:, 0], places[:, 1], np.where(
                np.isfinite(heights), heights, plane.altitude))
        return Trajectory(stamps, np.column_stack((places[:, :2], headings))), heights

    def placed(self, truth: Trajectory,
               path: Trajectory) -> tuple[Trajectory, Radians | None]:
        """Return the true poses where they are compared with a path, and the turn if moved."""
        inside = path.covers(truth.stamps_ns)
        if not np.any(inside):
            if self.file is not None:
                spans = (f'{seconds_text(int(each.stamps_ns[0]))} to '
                         f'{seconds_text(int(each.stamps_ns[-1]))} s' for each in (truth, path))
                raise FileFormatError(f'{self.file}: has times from {next(spans)}, none of them '
                                      f'in those of the path, from {next(spans)}')
            return truth, None
        if not self.is_aligned:
            return truth, None
        if self.file is not None and np.sum(inside) < LEAST_ALIGNED:
            raise FileFormatError(
                f'{self.file}: expected at least {LEAST_ALIGNED} poses in the time of the path, '
                f'as fewer are moved to where they fit any, got {np.sum(inside)}; or --no-align')
        pose = fit_motion(truth.poses[inside, :2], path.at(truth.stamps_ns[inside])[:, :2])
        placed = Trajectory(truth.stamps_ns, compose(pose, truth.poses))
        return placed, abs(float(pose[2]))


UNKNOWN = Truth()


def is_known(truth: Trajectory, stamps_ns: IntArray) -> BoolArray:
    """Return at which stamps the truth can be interpolated: not where it has a hole."""
    known = truth.covers(stamps_ns)
    before, after = (np.searchsorted(truth.stamps_ns, stamps_ns[known], side=side)
                     for side in ('right', 'left'))
    known[known] = truth.stamps_ns[after] - truth.stamps_ns[before - 1] <= LONGEST_GAP_NS
    return known


def truth_of(options: argparse.Namespace) -> Truth:
    """Return the truth that is asked for, after reading its file."""
    given, is_aligned = options.truth, options.align is not False
    return Truth(None, given, read_path(given), is_aligned) if isinstance(given, Path) else Truth(
        given, is_aligned=is_aligned)


def read_truth(bag: Bag, topic: str, span: Span = WHOLE) -> Heighted:
    """
    Return the true poses that were recorded in a span; invalid messages are ignored.

    Raises `BagError` if the topic is missing or of an unsupported type.
    """
    if (info := bag.topics.get(topic)) is None or info.type not in POSE_TYPES:
        what = 'no topic' if info is None else f'type {info.type} of'
        raise BagError(f'{bag.path}: {what} {topic} (--truth); expected one of '
                       f'{", ".join(POSE_TYPES)}; the bag has {bag.describe()}')
    samples, poses, heights = array('q'), array('d'), array('d')
    for bag_message in bag.messages([topic], span):
        with suppress(Exception):   # it may have other fields, by a definition in the bag
            message = bag_message.decode()
            given = message.pose if info.type == POSE else message.pose.pose
            if not isinstance(pose := planar_pose(given), Answer):
                heights.append(given.position.z)
                samples.append(stamp_ns(message))
                poses.extend(pose)
    return path_of(samples, poses, heights)


def path_of(samples: 'array[int]', poses: 'array[float]', heights: 'array[float]') -> Heighted:
    """Return samples as a path, the first one of equal stamps; of very many only some."""
    stride = 1
    while len(samples) // stride >= MOST_SAMPLES:
        stride *= 2
    stamps, first = np.unique(np.array(samples)[::stride], return_index=True)
    return (Trajectory(stamps, np.array(poses).reshape(-1, 3)[::stride][first]),
            np.array(heights)[::stride][first])
