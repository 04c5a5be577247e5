# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Fixes to positions in the map: where the map lies on the Earth, and where the antennas are.

No rclpy.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import covariance
from pose_graph_ros.core.measurements import Answer, Position, rejected
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.tangent_plane import MapOrigin, TangentPlane
from pose_graph_ros.ros.conversions import frame, Message, stamp_ns
from pose_graph_ros.ros.sources import Source
from pose_graph_ros.ros.static_frames import StaticFrames

STATUS_NO_FIX = -1
COVARIANCE_TYPE_UNKNOWN = 0
# No robot is further from the ellipsoid [m].
LARGEST_ALTITUDE = 1e5


class Datum:
    """
    Where the map lies on the Earth: as given, or where the first good fix was, or the next one.

    Parameters
    ----------
    given : sequence of float
        Latitude and longitude [degrees] and, if there are three numbers, the angle of the map's x
        axis from east [rad]; empty for the first fix.
    wait : bool
        Without one that is given, take no fix for it until `renew`.

    Raises
    ------
    ValueError
        If what is given is no point on the Earth.

    """

    def __init__(self, given: Sequence[float] = (), *, wait: bool = False) -> None:
        if len(given) not in (0, 2, 3):
            raise ValueError(f'datum: expected [latitude, longitude] or [latitude, longitude, '
                             f'yaw], got {list(given)}')
        self.yaw = float(given[2]) if len(given) == 3 else 0.0
        """Angle of the map's x axis from east [rad]."""
        self.plane: TangentPlane | None = None
        """The map's plane; None before there is a datum."""
        self.is_given = len(given) > 0
        """Whether a parameter tells it."""
        self.is_of_graph = False
        """Whether a graph that was loaded refers to it."""
        self.altitude = 0.0
        """Of the newest fix that tells one [m]."""
        if len(given) > 0:
            self.plane = TangentPlane(given[0], given[1], yaw=self.yaw)
        self._waits = wait
        # the altitude is that of the first fix; where east and north are does not depend on it
        self._to_lift = self.plane is not None

    def keep(self, origin: MapOrigin) -> None:
        """Take the datum of a graph that was loaded, for good."""
        self.plane, self.yaw, self.altitude = TangentPlane(*origin), origin.yaw, origin.altitude
        self._waits = self._to_lift = False
        self.is_of_graph = True

    def renew(self) -> None:
        """Let the next good fix be the datum."""
        self.plane, self._waits, self._to_lift = None, False, False

    def plane_for(
        self, latitude: float, longitude: float, altitude: float,
    ) -> TangentPlane | None:
        """Return the plane for a good fix, which may make it; None while it is waited for."""
        if math.isfinite(altitude):
            self.altitude = altitude
        if self.plane is None and not self._waits:
            self.plane = TangentPlane(latitude, longitude, self.altitude, self.yaw)
        elif self.plane is not None and self._to_lift:
            self.plane = TangentPlane(
                self.plane.latitude, self.plane.longitude, self.altitude, self.yaw)
            self._to_lift = False
        return self.plane


class Antenna(NamedTuple):
    """Where the antenna of a receiver is."""

    lever_arm: FloatArray
    """In the frame of the robot, shape (2,) [m]."""
    origin: str
    """`parameter`, `tf_static`, or `none` if nobody tells."""


class FixReader:
    """
    Reads the NavSatFix messages of one source.

    Parameters
    ----------
    source : Source
    datum : Datum
        That of the map, which is the same for all sources.
    frames : StaticFrames
        Tell the antenna's place if the source does not.
    base_frame : str
        Frame of the robot.

    Raises
    ------
    ValueError
        If the lever arm is none.

    """

    def __init__(
        self, source: Source, datum: Datum, frames: StaticFrames, base_frame: str,
    ) -> None:
        self.configure(source)
        self._datum, self._frames, self._base_frame = datum, frames, base_frame
        self.antenna: Antenna | None = None
        """As the newest fix was read; None before the first."""
        self.without_lever_arm = 0
        """Fixes that were read while nobody told where the antenna is."""

    def configure(self, source: Source) -> None:
        """Take time offset and lever arm for fixes from now on; ValueError as when made."""
        if len(source.lever_arm) != 2 or not np.all(np.isfinite(source.lever_arm)):
            raise ValueError(f'{source.name}.lever_arm: expected [x, y] in metres, got '
                             f'{list(source.lever_arm)}')
        self._source = source

    def position(self, message: Message) -> Position | Answer:
        """Read a sensor_msgs/NavSatFix; an unknown covariance comes back as zeros."""
        if message.status.status == STATUS_NO_FIX:
            return rejected('no_fix', 'the receiver says that it has no fix')
        latitude, longitude, altitude = message.latitude, message.longitude, message.altitude
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            return rejected('not_finite', f'latitude {latitude}, longitude {longitude}')
        # a receiver that does not know its altitude says NaN
        if abs(latitude) > 90.0 or abs(longitude) > 360.0 or abs(altitude) > LARGEST_ALTITUDE:
            return rejected('out_of_range', f'latitude {latitude}, longitude {longitude}, '
                                            f'altitude {altitude}')
        stamp = stamp_ns(message, self._source.time_offset_ns)
        if stamp <= 0:
            return rejected('zero_stamp', 'a fix without a stamp')
        plane = self._datum.plane_for(latitude, longitude, altitude)
        if plane is None:
            return rejected('no_datum', 'wait_for_datum is set: call ~/set_datum, or set datum')
        if not math.isfinite(altitude):
            altitude = plane.altitude
        cov = np.zeros((2, 2))
        if message.position_covariance_type != COVARIANCE_TYPE_UNKNOWN:
            cov = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)[:2, :2]
        if np.all(np.isfinite(cov)):
            with np.errstate(over='ignore', invalid='ignore'):
                cov = covariance.turned(cov, plane.yaw)
        self.antenna = self._find_antenna(frame(message.header.frame_id))
        self.without_lever_arm += self.antenna.origin == 'none'
        return Position(stamp, plane.to_map(latitude, longitude, altitude), cov,
                        self.antenna.lever_arm)

    def _find_antenna(self, frame_id: str) -> Antenna:
        given = np.array(self._source.lever_arm, dtype=np.float64)
        if np.any(given):
            return Antenna(given, 'parameter')
        place = self._frames.position(frame_id, self._base_frame)
        if place is None:
            return Antenna(given, 'none')
        return Antenna(place[:2], 'tf_static')
