# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert GNSS fixes for the engine, by the datum and the lever arms of the antennas."""

from collections.abc import Mapping, Sequence
from functools import partial
import math
import threading
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.conversions import frame, Message, stamp_ns, StaticFrames
from pose_graph_ros.adapters.sources import Source
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import covariance
from pose_graph_ros.core.geometry.geodesy import MapOrigin, TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import Answer, Fix, rejected


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
        self._waits = wait
        # a plane lies on the ellipsoid until an altitude is known; east and north do not change
        self._to_lift = self.is_given
        # fixes are placed by the thread of the engine
        self._lock = threading.Lock()

    @property
    def is_awaited(self) -> bool:
        """Whether fixes are refused until a call of `renew`."""
        return self._waits and self.plane is None

    def keep(self, origin: MapOrigin) -> None:
        """Use the datum of a loaded graph from now on."""
        with self._lock:
            self.plane, self.yaw, self.altitude = (
                TangentPlane(*origin), origin.yaw, origin.altitude)
            self._waits = self._to_lift = False
            self.is_of_graph = True

    def renew(self) -> None:
        """Make the next fix that is used the datum."""
        with self._lock:
            self.plane, self._waits, self._to_lift = None, False, False

    def plane_for(self, latitude: float, longitude: float, altitude: float) -> TangentPlane:
        """Return the plane for a fix that is used, which becomes the datum if there is none."""
        with self._lock:
            if math.isfinite(altitude):
                self.altitude = altitude
            known = math.isfinite(self.altitude)
            if self.plane is None:
                self.plane = TangentPlane(
                    latitude, longitude, self.altitude if known else 0.0, self.yaw)
                self._to_lift = not known
            elif self._to_lift and known:
                self.plane = TangentPlane(
                    self.plane.latitude, self.plane.longitude, self.altitude, self.yaw)
                self._to_lift = False
            return self.plane

    def place(self, latitude: float, longitude: float, altitude: float) -> FloatArray:
        """Return the position in the map of a fix that is used, shape (2,) [m]."""
        plane = self.plane_for(latitude, longitude, altitude)
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


class FixReader:
    """Converts the NavSatFix messages of one source to fixes."""

    def __init__(
        self, source: Source, datum: Datum, frames: StaticFrames, base_frame: str,
    ) -> None:
        self.source = source  # may be replaced at any time
        self._datum, self._frames, self._base_frame = datum, frames, base_frame
        self.antenna: Antenna | None = None  # antenna of the newest fix; None before the first
        self.without_lever_arm = 0  # number of fixes that were read while the antenna was unknown

    def read(self, message: Message) -> Fix | Answer:
        """
        Return the fix in a sensor_msgs/NavSatFix, or the reason for rejecting it.

        An unknown covariance is returned as zeros.
        """
        if message.status.status == -1:
            return rejected('no_fix', 'the receiver reports no fix')
        latitude, longitude, altitude = message.latitude, message.longitude, message.altitude
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            return rejected('not_finite', f'latitude {latitude}, longitude {longitude}')
        # an altitude of NaN means that it is unknown, and passes
        if abs(latitude) > 90.0 or abs(longitude) > 360.0 or abs(altitude) > 1e5:
            return rejected('out_of_range', f'latitude {latitude}, longitude {longitude}, '
                                            f'altitude {altitude}')
        stamp = stamp_ns(message, self.source.time_offset_ns)
        if stamp <= 0:
            return rejected('zero_stamp', 'a fix without a stamp')
        if self._datum.is_awaited:
            return rejected('no_datum', 'wait_for_datum is set: call ~/set_datum, or set datum')
        cov = np.zeros((2, 2))
        if message.position_covariance_type != 0:
            cov = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)[:2, :2]
        if np.all(np.isfinite(cov)):
            with np.errstate(over='ignore', invalid='ignore'):
                cov = covariance.turned(cov, self._datum.yaw)
        self.antenna = self._find_antenna(frame(message.header.frame_id))
        self.without_lever_arm += self.antenna.origin == 'none'
        return Fix(stamp, partial(self._datum.place, latitude, longitude, altitude), cov,
                   self.antenna.lever_arm)

    def _find_antenna(self, frame_id: str) -> Antenna:
        given = np.array(self.source.lever_arm, dtype=np.float64)
        if np.any(given):
            return Antenna(given, 'parameter')
        found = self._frames.transform(frame_id, self._base_frame)
        return Antenna(given, 'none') if found is None else Antenna(found[1][:2], 'tf_static')
