# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tangent plane at any place on the Earth, against geodesics."""

from hypothesis import given, strategies as st
import numpy as np
import pyproj
import pytest

from pose_graph_ros.core.geometry.geodesy import distances, MapOrigin, TangentPlane

# Of a position there and back.
ROUND_TRIP = 1e-6
# A geodesic of 1 km is longer than its chord by 1e-6 m, its end lies 8 cm below the plane.
MILLIMETRE = 1e-3

GEOD = pyproj.Geod(ellps='WGS84')
# The equator, the poles, the meridian of 180 degrees, a border of UTM zones, and homes.
PLACES = [
    (0.0, 0.0), (90.0, 0.0), (-90.0, 45.0), (89.9999, 10.0), (-89.99, -120.0), (17.5, 180.0),
    (-17.5, -180.0), (17.5, 179.99999), (48.0, 6.0), (48.0, 5.99999), (50.7, 7.1), (-33.9, 151.2),
    (71.0, 359.5),
]

positions = st.tuples(*2 * (st.floats(-10_000.0, 10_000.0),)).map(np.array)


@given(st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.floats(-100.0, 5000.0),
       st.floats(-4.0, 4.0), positions)
def test_positions_come_back_at_any_place(
    latitude: float, longitude: float, altitude: float, yaw: float, position: np.ndarray,
) -> None:
    plane = TangentPlane(latitude, longitude, altitude, yaw)
    geodetic = plane.to_geodetic(position)
    assert geodetic.shape == (3,)
    np.testing.assert_allclose(plane.to_map(*geodetic), position, atol=ROUND_TRIP)


@pytest.mark.parametrize('place', PLACES)
@pytest.mark.parametrize('distance', [1.0, 100.0, 1000.0])
def test_directions_and_distances_are_those_of_geodesics(
    place: tuple[float, float], distance: float,
) -> None:
    plane = TangentPlane(*place)
    azimuths = np.arange(0.0, 360.0, 30.0)
    latitude, longitude = np.full((2, 12), np.array(place)[:, None])
    there_longitude, there_latitude, _ = GEOD.fwd(longitude, latitude, azimuths,
                                                  np.full(12, distance))
    there = plane.to_map(there_latitude, there_longitude, np.zeros(12))
    azimuth = np.deg2rad(azimuths)
    # x is east, y is north
    expected = distance * np.column_stack((np.sin(azimuth), np.cos(azimuth)))
    np.testing.assert_allclose(there, expected, atol=MILLIMETRE)


def test_the_yaw_of_the_datum_turns_the_map() -> None:
    north = (50.71, 7.1, 0.0)
    straight = TangentPlane(50.7, 7.1).to_map(*north)
    assert straight[0] == pytest.approx(0.0, abs=ROUND_TRIP)
    assert straight[1] > 1000.0
    # the map's x axis points north: what lies north lies ahead
    turned = TangentPlane(50.7, 7.1, yaw=0.5 * np.pi).to_map(*north)
    np.testing.assert_allclose(turned, [straight[1], 0.0], atol=ROUND_TRIP)
    # a map turned by 30 degrees sees everything turned back by them
    yaw = np.deg2rad(30.0)
    turned = TangentPlane(50.7, 7.1, yaw=yaw).to_map(*north)
    np.testing.assert_allclose(
        turned, straight[1] * np.array([np.sin(yaw), np.cos(yaw)]), atol=ROUND_TRIP)


@pytest.mark.parametrize('arguments', [
    (90.1, 0.0), (-91.0, 0.0), (0.0, 361.0), (np.nan, 0.0), (0.0, np.nan), (0.0, 0.0, np.inf),
    (0.0, 0.0, 0.0, np.nan), (np.inf, 0.0)])
def test_a_datum_that_is_no_place_is_refused(arguments: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match='datum: expected latitude'):
        TangentPlane(*arguments)


def test_distances_go_along_the_earth_the_short_way_round() -> None:
    degree = 111_319.491
    for point, there, degrees in (
            (MapOrigin(0.0, 0.0), (0.0, 1.0), 1.0), (MapOrigin(0.0, 179.5), (0.0, -179.5), 1.0),
            (MapOrigin(0.0, 10.0), (0.0, 370.0), 0.0)):
        np.testing.assert_allclose(distances(point, *there), [degrees * degree], atol=1e-3)
    np.testing.assert_allclose(
        distances(MapOrigin(48.0, 11.0), [48.0, -48.0], [11.0, -169.0]), [0.0, 20_003_931.459],
        atol=1e-3)


@pytest.mark.parametrize('place', PLACES)
@pytest.mark.parametrize('altitude', [-50.0, 120.0, 900.0])
def test_points_at_an_altitude_are_above_the_same_positions(
    place: tuple[float, float], altitude: float,
) -> None:
    plane = TangentPlane(*place, altitude=120.0, yaw=0.3)
    grid = np.stack(np.meshgrid([-3000.0, 0.0, 800.0], [-500.0, 0.0, 7000.0]), axis=-1)
    geodetic = plane.to_geodetic(grid, altitude)
    np.testing.assert_allclose(geodetic[..., 2], altitude, atol=MILLIMETRE)
    np.testing.assert_allclose(
        plane.to_map(geodetic[..., 0], geodetic[..., 1], geodetic[..., 2]), grid,
        atol=MILLIMETRE)
