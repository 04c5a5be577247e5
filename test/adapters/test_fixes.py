# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fixes in: the datum, the antennas, and what is refused."""

import math

from harness import fix, transform
import numpy as np
import pyproj
import pytest
from sensor_msgs.msg import NavSatFix

from pose_graph_ros.adapters.conversions import Datum, StaticFrames
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import MessageReader
from pose_graph_ros.core.measurements import Answer, Fix, Position


def fixes(**values: object) -> MessageReader:
    return MessageReader(checked({
        name.replace('__', '.'): value for name, value in values.items()}))


def placed(reader: MessageReader, message: NavSatFix) -> Position:
    """Return the position of a fix that the engine uses."""
    return reader.read('fix', message).placed()


def test_the_first_good_fix_is_the_datum() -> None:
    reader = fixes()
    bad = fix(1.0, 48.0, 11.0)
    bad.status.status = -1
    assert isinstance(reader.read('fix', bad), Answer)
    assert reader.read('fix', fix(0.0, 48.0, 11.0)).reason == 'zero_stamp'
    # one that the engine does not use is none
    assert isinstance(reader.read('fix', fix(1.5, 48.0, 11.0)), Fix)
    first = placed(reader, fix(2.0, 48.1, 11.6))
    assert isinstance(first, Position)
    assert first.position == pytest.approx([0.0, 0.0], abs=1e-9)
    second = placed(reader, fix(3.0, 48.101, 11.6))
    # a thousandth of a degree of latitude is 111 m
    assert second.position == pytest.approx([0.0, 111.2], abs=0.1)


def test_a_datum_with_a_yaw_turns_positions_and_covariances() -> None:
    reader = fixes(datum=[48.1, 11.6, math.pi / 2.0])
    message = fix(1.0, 48.101, 11.6)
    message.position_covariance = [1.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 9.0]
    measurement = placed(reader, message)
    assert measurement.position == pytest.approx([111.2, 0.0], abs=0.1)
    assert np.diagonal(measurement.covariance) == pytest.approx([4.0, 1.0])


@pytest.mark.parametrize('given', [[], [48.1, 11.6]])
def test_the_plane_is_at_the_first_altitude_that_is_known(given: list[float]) -> None:
    datum = Datum(given)
    assert math.isnan(datum.altitude)
    datum.place(48.1, 11.6, math.nan)
    assert math.isnan(datum.altitude)
    there = datum.place(48.101, 11.61, 1500.0)
    # the place of what has an altitude does not depend on the plane's
    assert there == pytest.approx(Datum([48.1, 11.6]).place(48.101, 11.61, 1500.0), abs=1e-9)
    assert (datum.plane.altitude, datum.altitude) == (1500.0, 1500.0)
    assert (datum.plane.latitude, datum.plane.longitude) == (48.1, 11.6)
    # one without is as high as the plane, and a later altitude moves nothing
    assert datum.place(48.101, 11.61, math.nan) == pytest.approx(there, abs=1e-3)
    datum.place(48.101, 11.61, 1600.0)
    assert (datum.plane.altitude, datum.altitude) == (1500.0, 1600.0)


def test_an_unknown_covariance_is_zeros() -> None:
    reader, message = fixes(), fix(1.0, 48.1, 11.6, sigma=2.0)
    assert reader.read('fix', message).covariance == pytest.approx(4.0 * np.eye(2))
    message.position_covariance_type = 0
    assert not np.any(reader.read('fix', message).covariance)


def test_fixes_wait_for_a_datum_if_they_are_told_to() -> None:
    reader = fixes(wait_for_datum=True)
    datum = reader.datum
    assert reader.read('fix', fix(1.0, 48.0, 11.0)).reason == 'no_datum'
    datum.renew()
    assert isinstance(placed(reader, fix(2.0, 48.1, 11.6)), Position)
    assert (datum.plane.latitude, datum.plane.longitude) == (48.1, 11.6)
    # one that is given need not be waited for
    assert isinstance(placed(fixes(datum=[48.1, 11.6], wait_for_datum=True),
                             fix(1.0, 48.0, 11.0)), Position)


GEOD = pyproj.Geod(ellps='WGS84')


@pytest.mark.parametrize('place', [
    (89.9, 30.0), (-89.9, -100.0), (10.0, 179.9999), (-16.5, -179.9999), (48.0, 11.9999),
    (64.0, 5.9999), (0.0, 0.0), (48.0, 12.0)])
@pytest.mark.parametrize('azimuth', [0.0, 37.0, 90.0, 145.0, 270.0])
def test_two_fixes_are_as_far_apart_as_on_the_earth(
    place: tuple[float, float], azimuth: float,
) -> None:
    """Near the poles, across the meridian of 180 degrees and borders of UTM zones."""
    longitude, latitude, _ = GEOD.fwd(place[1], place[0], azimuth, 100.0)
    here, there = fix(1.0, *place), fix(2.0, latitude, longitude)
    for message in (here, there):
        message.altitude = 0.0
    expected = 100.0 * np.array([math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))])
    for reader in (fixes(), fixes(datum=list(place))):
        start = placed(reader, here).position
        np.testing.assert_allclose(placed(reader, there).position - start, expected, atol=1e-3)
    # from a datum elsewhere the distance is the same
    reader = fixes(datum=[place[0], place[1] + 1e-4])
    step = placed(reader, there).position - placed(reader, here).position
    assert math.hypot(*step) == pytest.approx(100.0, abs=1e-3)


# --- antennas

class Transforms:
    def __init__(self, *transforms: object) -> None:
        self.transforms = transforms


HALF = math.sqrt(0.5)


def test_frames_are_composed_along_any_chain() -> None:
    frames = StaticFrames()
    frames.receive(Transforms(
        # the mast leans back by 90 degrees about y: its z points to the robot's x
        transform('base_link', '/mast', (1.0, 0.0, 0.5), (0.0, HALF, 0.0, HALF)),
        transform('mast', 'gps', (0.0, 0.25, 2.0))))
    np.testing.assert_allclose(
        frames.transform('gps', 'base_link')[1], [3.0, 0.25, 0.5], atol=1e-12)
    # a root above the base, turned to the left
    frames.receive(Transforms(
        transform('base_footprint', 'base_link', (0.0, 0.0, 0.3)),
        transform('base_footprint', 'roof', (0.0, 1.0, 2.0), (0.0, 0.0, HALF, HALF)),
        transform('roof', 'other', (0.5, 0.0, 0.0))))
    np.testing.assert_allclose(
        frames.transform('other', 'base_link')[1], [0.0, 1.5, 1.7], atol=1e-12)
    np.testing.assert_allclose(frames.transform('base_link', 'base_link')[1], 0.0, atol=1e-12)
    np.testing.assert_allclose(
        frames.transform('gps', 'base_footprint')[1], [3.0, 0.25, 0.8], atol=1e-12)
    assert frames.transform('nowhere', 'base_link') is None
    assert frames.transform('', 'base_link') is None


def test_the_antenna_is_where_the_parameter_says_else_where_tf_static_does() -> None:
    reader = MessageReader(checked({
        'sources': ['odom', 'fix', 'rear'], 'rear.type': 'fix', 'rear.lever_arm': [-1.0, 0.5]}))
    assert reader.read('fix', fix(1.0, 48.1, 11.6)).lever_arm.tolist() == [0.0, 0.0]
    by = reader.surroundings
    assert by.antennas['fix'].origin == 'none'
    assert by.without_lever_arm['fix'] == 1
    reader.frames.receive(Transforms(transform('base_link', 'gps', (0.75, -0.25, 1.0))))
    assert reader.read('fix', fix(2.0, 48.1, 11.6)).lever_arm.tolist() == [0.75, -0.25]
    assert by.antennas['fix'].origin == 'tf_static'
    assert by.without_lever_arm['fix'] == 1
    assert reader.read('rear', fix(2.0, 48.1, 11.6)).lever_arm.tolist() == [-1.0, 0.5]
    assert by.antennas['rear'].origin == 'parameter'


def test_another_lever_arm_is_taken_for_fixes_from_then_on_and_all_else_stays() -> None:
    values = checked({'fix.lever_arm': [0.5, 0.0]})
    reader = MessageReader(values)
    first = reader.read('fix', fix(1.0, 48.1, 11.6)).placed()
    plane = reader.datum.plane
    reader.frames.receive(Transforms(transform('base_link', 'gps', (0.75, -0.25, 1.0))))
    reader.configure({**values, 'fix.lever_arm': [1.5, 0.25], 'fix.time_offset': -0.5})
    second = reader.read('fix', fix(2.0, 48.1, 11.6)).placed()
    assert (first.lever_arm.tolist(), second.lever_arm.tolist()) == ([0.5, 0.0], [1.5, 0.25])
    assert second.stamp_ns == 1_500_000_000
    assert second.position == pytest.approx(first.position, abs=1e-9)
    assert reader.datum.plane is plane
    # zero: from the transforms that came before
    reader.configure({**values, 'fix.lever_arm': [0.0, 0.0]})
    assert reader.read('fix', fix(3.0, 48.1, 11.6)).lever_arm.tolist() == [0.75, -0.25]


def test_frames_that_are_none_and_circles_do_no_harm() -> None:
    frames = StaticFrames()
    here = (1.0, 0.0, 0.0)
    frames.receive(Transforms(
        transform('a', 'a', here), transform('', 'b', here), transform('a', '', here),
        transform('a', 'b', (math.nan, 0.0, 0.0)), transform('a', 'b', (math.inf, 0.0, 0.0)),
        transform('a', 'b', (1e300, 0.0, 0.0)), transform('a', 'b', here, (0, 0, 0, 0)),
        transform('a', 'b', here, (math.nan, 0, 0, 1))))
    assert frames.transform('b', 'a') is None
    frames.receive(Transforms(
        transform('a', 'b', here), transform('b', 'c', here), transform('c', 'a', here)))
    assert np.all(np.isfinite(frames.transform('c', 'a')[1]))
    assert frames.transform('c', 'elsewhere') is None
