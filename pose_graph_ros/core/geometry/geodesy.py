# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Conversion between latitude and longitude and the map, a tangent plane of the WGS 84 ellipsoid.

The map's origin is the datum, where its x axis points east and its y axis north, both rotated by
the datum's yaw. PROJ's geocentric and topocentric conversions are exact at any latitude and,
unlike UTM, have no zones and no grid convergence.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyproj

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray


class MapOrigin(NamedTuple):
    """Position of a map's origin on the Earth, and direction of its x axis."""

    latitude: float  # WGS 84 [degrees]
    longitude: float  # WGS 84 [degrees]
    altitude: float = 0.0  # height above the ellipsoid [m]
    yaw: float = 0.0  # angle of the x axis from east, counter-clockwise [rad]

    def __str__(self) -> str:
        return (f'[{self.latitude:.9f}, {self.longitude:.9f}] at {self.altitude:.2f} m '
                f'with yaw {self.yaw:.6f}')


class TangentPlane:
    """
    Local tangent plane at a datum; ValueError if that is out of range or not finite.

    Parameters
    ----------
    latitude, longitude : float, of the datum, WGS 84 [degrees]
    altitude : float, of the datum above the ellipsoid [m]
    yaw : float, angle of the map's x axis from east, counter-clockwise [rad]

    """

    def __init__(self, latitude: float, longitude: float, altitude: float = 0.0,
                 yaw: float = 0.0) -> None:
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0
                and np.isfinite(altitude) and np.isfinite(yaw)):
            raise ValueError(
                'datum: expected latitude in [-90, 90], longitude in [-360, 360] and finite '
                f'altitude and yaw, got {latitude}, {longitude}, {altitude}, {yaw}')
        self.latitude, self.longitude = float(latitude), float(longitude)
        self.altitude, self.yaw = float(altitude), float(yaw)
        self._projection = pyproj.Transformer.from_pipeline(
            '+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad '
            '+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 '
            f'+lat_0={self.latitude!r} +lon_0={self.longitude!r} +h_0={self.altitude!r}')
        self._map = np.array([0.0, 0.0, yaw])

    @property
    def origin(self) -> MapOrigin:
        """The datum."""
        return MapOrigin(self.latitude, self.longitude, self.altitude, self.yaw)

    def to_map(self, latitude: npt.ArrayLike, longitude: npt.ArrayLike,
               altitude: npt.ArrayLike) -> FloatArray:
        """
        Return map coordinates of points, shape (..., 2) [m].

        Parameters
        ----------
        latitude, longitude : array_like, shape (...), WGS 84 [degrees]
        altitude : array_like, shape (...), above the ellipsoid [m]

        """
        east, north, _ = self._projection.transform(longitude, latitude, altitude)
        return se2.transform(se2.inverse(self._map), np.stack((east, north), axis=-1))

    def to_geodetic(self, position: FloatArray, altitude: float | None = None) -> FloatArray:
        """
        Return latitude, longitude [degrees] and altitude [m], shape (..., 3), of points.

        Parameters
        ----------
        position : ndarray, shape (..., 2), in the map [m]
        altitude : float, optional
            Of all points above the ellipsoid [m]. Default: the points lie in the plane.

        """
        east_north = se2.transform(self._map, position)
        east, north = east_north[..., 0], east_north[..., 1]
        up = np.zeros_like(east)
        # each reduces the error by the square of the angle between the verticals at the point and
        # at the datum
        for _ in range(1 if altitude is None else 4):
            longitude, latitude, height = self._projection.transform(
                east, north, up, direction='INVERSE')
            if altitude is not None:
                up = up + altitude - height
        return np.stack((latitude, longitude, height), axis=-1)


def distances(point: MapOrigin, latitude: npt.ArrayLike, longitude: npt.ArrayLike) -> FloatArray:
    """Return the geodesic distances of points, given in degrees, from one point [m]."""
    latitude, longitude = (
        np.atleast_1d(np.asarray(numbers, dtype=np.float64)) for numbers in (latitude, longitude))
    _, _, metres = pyproj.Geod(ellps='WGS84').inv(
        np.full(longitude.shape, point.longitude), np.full(latitude.shape, point.latitude),
        longitude, latitude)
    return np.asarray(metres)
