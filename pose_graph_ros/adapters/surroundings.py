# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What some messages cannot be read without: the frames of the robot, and the datum of the map.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
import threading
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry.geodesy import MapOrigin, TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray, Pose

if TYPE_CHECKING:
    from pose_graph_ros.adapters.sources import Source

Message = Any
"""A ROS message of any reader."""


def frame(name: str) -> str:
    """Return a frame id without a leading slash, which drivers from ROS 1 may still send."""
    return name.removeprefix('/')


class Datum:
    """
    The origin of the map on the Earth: a given one, or the position of the first fix in the graph.

    It is given as latitude and longitude [degrees] and, if there are three numbers, the angle of
    the map's x axis from east [rad]. Else a fix is used at once, or after a call of `renew`.
    """

    def __init__(self, given: Sequence[float] = (), *, wait: bool = False) -> None:
        self.yaw = float(given[2]) if len(given) == 3 else 0.0
        self.is_given = len(given) > 0  # whether the datum comes from the parameter
        self.is_of_graph = False  # whether the datum comes from a loaded graph
        self.plane = TangentPlane(given[0], given[1], yaw=self.yaw) if self.is_given else None
        self.altitude = math.nan  # of the newest fix in the graph that has one [m]
        self.waits = wait  # whether fixes are refused without a plane, until a call of `renew`
        # a plane lies on the ellipsoid until an altitude is known; east and north do not change
        self._to_lift = self.is_given
        # fixes are placed by the thread of the engine
        self._lock = threading.Lock()

    def keep(self, origin: MapOrigin) -> None:
        """Use the datum of a loaded graph from now on."""
        with self._lock:
            self.plane, self.is_of_graph = TangentPlane(*origin), True
            self.yaw, self.altitude = origin.yaw, origin.altitude
            self.waits = self._to_lift = False

    def renew(self) -> None:
        """Make the next fix that is used the datum."""
        with self._lock:
            self.plane, self.waits, self._to_lift = None, False, False

    def place(self, latitude: float, longitude: float, altitude: float) -> FloatArray:
        """
        Return the position in the map of a fix that is used, shape (2,) [m].

        It becomes the datum if there is none.
        """
        with self._lock:
            if math.isfinite(altitude):
                self.altitude = altitude
            known = math.isfinite(self.altitude)
            if (plane := self.plane) is None or (self._to_lift and known):
                where = (latitude, longitude) if plane is None else (
                    plane.latitude, plane.longitude)
                self.plane = plane = TangentPlane(
                    *where, self.altitude if known else 0.0, self.yaw)
                self._to_lift = not known
        return plane.to_map(
            latitude, longitude, altitude if math.isfinite(altitude) else plane.altitude)

    def geodetic(self, position: FloatArray) -> FloatArray:
        """
        Return latitude, longitude [degrees] and altitude [m] of points of the map, shape (..., 3).

        They lie at the altitude of the newest fix; this is the inverse of `place`. Raises
        ValueError without a datum.
        """
        if self.plane is None:
            raise ValueError('the map has no datum')
        return self.plane.to_geodetic(
            position, self.altitude if math.isfinite(self.altitude) else self.plane.altitude)


def datum_of(values: Mapping[str, Any]) -> Datum:
    """Return the datum by the checked parameters; raises `ConfigError` if it is not on Earth."""
    try:
        return Datum(values['datum'], wait=values['wait_for_datum'])
    except ValueError as error:
        raise ConfigError(f'parameter {error}') from error


class Antenna(NamedTuple):
    """Position of the antenna of a receiver on the robot."""

    lever_arm: FloatArray  # antenna in the frame of the robot, shape (2,) [m]
    origin: str  # `parameter`, `tf_static`, or `none` if unknown (the lever arm is then zero)


class StaticFrames:
    """Static transforms; for each child frame the newest one is used."""

    def __init__(self) -> None:
        # parent, rotation and translation by child frame
        self._frames: dict[str, tuple[str, FloatArray, FloatArray]] = {}

    def receive(self, message: Message) -> None:
        """Add the transforms of a tf2_msgs/TFMessage; invalid ones are ignored."""
        for item in message.transforms:
            parent, child = frame(item.header.frame_id), frame(item.child_frame_id)
            t, q = item.transform.translation, item.transform.rotation
            norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
            translation = np.array([t.x, t.y, t.z])
            if (parent in ('', child) or child == '' or not 1e-6 < norm < math.inf
                    or not np.all(np.abs(translation) < 1e3)):
                continue
            x, y, z, w = q.x / norm, q.y / norm, q.z / norm, q.w / norm
            # SciPy's would make each start 0.3 s longer
            rotation = np.array([
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]])
            self._frames[child] = parent, rotation, translation

    def transform(self, name: str, base: str) -> tuple[FloatArray, FloatArray] | None:
        """Return rotation and translation of a frame in another one; None if unknown."""
        of_name, of_base = self._chain(name), self._chain(base)
        for ancestor, (turn, point) in of_name.items():
            if ancestor in of_base:
                rotation, translation = of_base[ancestor]
                return rotation.T @ turn, rotation.T @ (point - translation)
        return None

    def _chain(self, name: str) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Return rotation and translation of a frame in itself and in each of its ancestors."""
        rotation, translation = np.eye(3), np.zeros(3)
        chain = {name: (rotation, translation)}
        while name in self._frames and len(chain) < 100:  # there may be a cycle
            name, turn, shift = self._frames[name]
            rotation, translation = turn @ rotation, turn @ translation + shift
            if name in chain:
                break
            chain[name] = rotation, translation
        return chain


class IntegratedTwist(NamedTuple):
    """
    A twist, and the pose that all up to it make, integrated in the order of arrival.

    That pose is for outputs between two estimates; the engine integrates the twists anew in the
    order of their stamps.
    """

    stamp_ns: int = 0
    pose: Pose = (0.0, 0.0, 0.0)
    twist: Pose = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What messages are read by beside their source, and what is noted of sources meanwhile."""

    map_frame: str
    base_frame: str
    datum: Datum
    frames: StaticFrames
    antennas: dict[str, Antenna] = field(default_factory=dict)  # of the newest fix, by source
    # number of fixes that were read while the antenna was unknown, by source
    without_lever_arm: Counter[str] = field(default_factory=Counter)
    twists: dict[str, IntegratedTwist] = field(default_factory=dict)  # by source

    def in_base(self, message: Message) -> tuple[FloatArray, FloatArray] | None:
        """Return rotation and translation of the frame of a message in the robot's, if known."""
        return self.frames.transform(frame(message.header.frame_id), self.base_frame)

    def is_of_base(self, message: Message) -> bool:
        """Tell whether a message is in the robot's frame, or names none."""
        return frame(message.header.frame_id) in ('', self.base_frame)

    def lever_arm(self, name: str, source: 'Source') -> FloatArray:
        """Return where the antenna of a message is, given its frame, and note it."""
        given, origin = np.array(source.lever_arm, dtype=np.float64), 'parameter'
        if not np.any(given):
            found = self.frames.transform(name, self.base_frame)
            origin = 'none' if found is None else 'tf_static'
            given = given if found is None else found[1][:2]
        self.antennas[source.name] = Antenna(given, origin)
        self.without_lever_arm[source.name] += origin == 'none'
        return given
