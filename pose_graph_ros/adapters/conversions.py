# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Convert ROS messages to measurements.

The functions accept any object with the fields of the message, from rclpy or from a bag reader,
its source, and what else it is read by: the frames of the robot and the datum of the map.
Invalid data never raises: they return an `Answer` with the reason. Covariances are passed on
unchanged; `core.sources.validation` applies the covariance policy of the source.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
import re
import threading
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np

from pose_graph_ros.core import config, exceptions, measurements as ms, quantities
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.geodesy import MapOrigin, TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray, Pose, wrap_one
from pose_graph_ros.core.judgement.texts import shortened
from pose_graph_ros.core.measurements import Answer, OdometrySample, rejected
from pose_graph_ros.core.odometry.motion import integrated

if TYPE_CHECKING:
    from pose_graph_ros.adapters.sources import Source

PLANAR = np.ix_((0, 1, 5), (0, 1, 5))  # rows and columns of x, y and yaw in a 6x6 covariance

_REFERENCE_NODE = re.compile(r'x(\d{1,18})')
_REFERENCE_TIME = re.compile(r'@(\d{1,10})(?:\.(\d{1,9}))?')
Message = Any
"""A ROS message of any reader."""
# What others can send without an end is kept as far as a robot needs it: of a name so many
# characters, of static frames those that came last.
LONGEST_NAME, MOST_FRAMES = 255, 2000


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
        self.plane: TangentPlane | None = None
        self.yaw = 0.0
        self.is_given = False  # whether the datum comes from the parameter, or a person
        self.is_of_graph = False  # whether the datum comes from a loaded graph
        self.altitude = math.nan  # of the newest fix in the graph that has one [m]
        self.waits = wait  # whether fixes are refused without a plane, until a call of `renew`
        # a plane lies on the ellipsoid until an altitude is known; east and north do not change
        self._to_lift = False
        # fixes are placed by the thread of the engine
        self._lock = threading.Lock()
        if len(given) > 0:
            self.give(*given)

    def give(self, latitude: float, longitude: float, yaw: float = 0.0) -> None:
        """Use a given datum from now on; raises ValueError if it is not on Earth."""
        plane = TangentPlane(latitude, longitude, yaw=yaw)
        with self._lock:
            self.plane, self.yaw, self.is_given = plane, float(yaw), True
            self.waits, self._to_lift = False, True

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
                self.plane = plane = TangentPlane(*((latitude, longitude) if plane is None else (
                    plane.latitude, plane.longitude)), self.altitude if known else 0.0, self.yaw)
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
        raise exceptions.ConfigError(f'parameter {error}') from error


class Antenna(NamedTuple):
    """Position of the antenna of a receiver on the robot."""

    lever_arm: FloatArray  # antenna in the frame of the robot, shape (2,) [m]
    origin: str  # `parameter`, `tf_static`, or `none` if unknown (the lever arm is then zero)


class StaticFrames:
    """Static transforms; for each child frame the newest one is used."""

    def __init__(self) -> None:
        # parent, rotation and translation by child frame, the newest last
        self._frames: dict[str, tuple[str, FloatArray, FloatArray]] = {}
        # number of those that were dropped, or ignored as they cannot be used
        self.counts: Counter[tuple[str, str]] = Counter()

    def receive(self, message: Message) -> None:
        """Add the transforms of a tf2_msgs/TFMessage; invalid ones are ignored."""
        for item in message.transforms:
            parent, child = frame(item.header.frame_id), frame(item.child_frame_id)
            t, q = item.transform.translation, item.transform.rotation
            norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
            translation = np.array([t.x, t.y, t.z])
            if (parent in ('', child) or child == '' or not 1e-6 < norm < math.inf
                    or not np.all(np.abs(translation) < 1e3)
                    or max(len(parent), len(child)) > LONGEST_NAME):
                self.counts['tf_static', 'ignored'] += 1
                continue
            x, y, z, w = q.x / norm, q.y / norm, q.z / norm, q.w / norm
            # SciPy's would make each start 0.3 s longer
            rotation = np.array([
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]])
            self._frames.pop(child, None)
            self._frames[child] = parent, rotation, translation
            if len(self._frames) > MOST_FRAMES:
                del self._frames[next(iter(self._frames))]
                self.counts['tf_static', 'dropped'] += 1

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


# --- the messages

def stamp_ns(message: Message, offset_ns: int = 0) -> int:
    """Return the stamp of a message's header plus an offset [ns]; a stamp of 0 stays 0."""
    stamp = message.header.stamp
    whole = int(stamp.sec) * quantities.NANOSECONDS + int(stamp.nanosec)
    return whole + offset_ns if whole > 0 else whole


def yaw_of(q: Message) -> float | None:
    """Return the yaw of a quaternion of any norm [rad]; None if the norm is zero or not finite."""
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - (
        q.z * q.z)) if math.isfinite(norm) and norm > 1e-12 else None


def planar_pose(pose: Message) -> FloatArray | Answer:
    """Return (x, y, yaw) of a Pose, shape (3,), unless it is not finite or has no rotation."""
    p, q = pose.position, pose.orientation
    if (yaw := yaw_of(q)) is None or not (math.isfinite(p.x) and math.isfinite(p.y)):
        return rejected('not_finite', f'position ({p.x}, {p.y}), quaternion ({q.x}, {q.y}, {q.z}, '
                                      f'{q.w})')
    return np.array((p.x, p.y, wrap_one(yaw)))


def odometry(message: Message, source: 'Source', _by: Surroundings) -> OdometrySample | Answer:
    """
    Return the sample in a nav_msgs/Odometry, or the reason for rejecting it.

    The covariance of its pose is accumulated over the drive, so it is not used.
    """
    if isinstance(pose := planar_pose(message.pose.pose), Answer):
        return pose
    x, y, _ = pose.tolist()
    if max(abs(x), abs(y)) > ms.LARGEST_COORDINATE:
        return rejected('too_large', f'odometry pose {pose.tolist()}')
    given, integrated_twist = message.twist.twist, config.Integrate.TWIST.value
    speed = math.hypot(given.linear.x, given.linear.y)
    twist = planar_twist(given) if source.integrate == integrated_twist else None
    if isinstance(twist, Answer):
        return twist
    return OdometrySample(stamp_ns(message, source.time_offset_ns), pose, speed if math.isfinite(
        speed) else 0.0, twist_variance(message.twist.covariance), twist)


def planar_twist(twist: Message) -> Pose | Answer:
    """Return (v_x, v_y, yaw rate) of a Twist, or the reason for rejecting it."""
    x, y, rate = float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
    return (x, y, rate) if all(map(math.isfinite, (x, y, rate))) else rejected(
        'not_finite', f'twist ({x}, {y}), yaw rate {rate}')


def twist_variance(values: Sequence[float]) -> FloatArray | None:
    """Return the variances of v_x, v_y and yaw rate, shape (3,); None if they are unknown."""
    # element by element: NumPy operations on three elements take ten times as long
    variance = float(values[0]), float(values[7]), float(values[35])
    usable = all(0.0 <= value <= covariance.LARGEST_VARIANCE for value in variance)
    return np.array(variance) if usable and any(variance) else None


def global_pose(message: Message, source: 'Source', by: Surroundings) -> ms.GlobalPose | Answer:
    """Return the pose in the map of a PoseWithCovarianceStamped, or why it is rejected."""
    return pose_in(message, (by.map_frame,), source.time_offset_ns)


def pose_in(message: Message, frames: Sequence[str], offset_ns: int = 0) -> ms.GlobalPose | Answer:
    """
    Return the pose in a PoseWithCovarianceStamped, or the reason for rejecting it.

    It is in one of some frames, or in the first of them if it names none.
    """
    if (named := frame(message.header.frame_id)) not in ('', *frames):
        return rejected('wrong_frame', f'expected frame {" or ".join(map(repr, frames))}, got '
                                       f'{shortened(named)!r}')
    return pose if isinstance(pose := planar_pose(message.pose.pose), Answer) else ms.GlobalPose(
        stamp_ns(message, offset_ns), pose, _planar(message.pose.covariance))


def heading(message: Message, source: 'Source', by: Surroundings) -> ms.HeadingOnly | Answer:
    """
    Return the heading in a sensor_msgs/Imu with an absolute yaw, or the reason for rejecting it.
    """
    if message.orientation_covariance[0] == -1.0:   # by the definition of the message
        return rejected('no_orientation', 'the sensor reports no orientation')
    if (yaw := yaw_of(message.orientation)) is None:
        q = message.orientation
        return rejected('not_finite', f'quaternion ({q.x}, {q.y}, {q.z}, {q.w})')
    return ms.HeadingOnly(stamp_ns(message, source.time_offset_ns), float(se2.wrap(
        yaw + source.yaw_offset - by.datum.yaw)), float(message.orientation_covariance[8]))


def loop_closure(message: Message, source: 'Source', _by: Surroundings) -> ms.LoopClosure | Answer:
    """
    Return the loop closure in a PoseWithCovarianceStamped, or the reason for rejecting it.

    The frame of the header names the other pose: a hidden node, such as `x42`, or the pose at a
    stamp [s], such as `@1695.250000000`.
    """
    if isinstance(pose := planar_pose(message.pose.pose), Answer):
        return pose
    offset_ns, named = source.time_offset_ns, message.header.frame_id
    stamp, cov = stamp_ns(message, offset_ns), _planar(message.pose.covariance)
    if (node := _REFERENCE_NODE.fullmatch(named)) is not None:
        return ms.LoopClosure(stamp, pose, cov, reference_node=int(node[1]))
    if (time := _REFERENCE_TIME.fullmatch(named)) is not None:
        return ms.LoopClosure(stamp, pose, cov, reference_ns=(int(
            time[1]) * quantities.NANOSECONDS + int((time[2] or '').ljust(9, '0')) + offset_ns))
    return rejected('wrong_frame', f'expected a hidden node such as x42 or a time such as '
                                   f'@1695.250000000, got {shortened(named)!r}')


def fix(message: Message, source: 'Source', by: Surroundings) -> ms.Fix | Answer:
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
    if (stamp := stamp_ns(message, source.time_offset_ns)) <= 0:
        return rejected('zero_stamp', 'a fix without a stamp')
    if by.datum.waits and by.datum.plane is None:
        return rejected('no_datum', 'wait_for_datum is set: call ~/set_datum, or set datum')
    cov = np.zeros((2, 2))
    if message.position_covariance_type != 0:
        cov = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)[:2, :2]
    if np.all(np.isfinite(cov)):
        with np.errstate(over='ignore', invalid='ignore'):
            cov = covariance.turned(cov, by.datum.yaw)
    return ms.Fix(stamp, (latitude, longitude, altitude), by.datum.place, cov,
                  by.lever_arm(frame(message.header.frame_id), source))


def beacon_range(message: Message, source: 'Source', by: Surroundings) -> ms.Range | Answer:
    """
    Return the range in a sensor_msgs/Range, or the reason for rejecting it.

    Its frame is the name of the beacon, or those of antenna and beacon, such as `tag/anchor_1`.
    """
    antenna, _, beacon = frame(message.header.frame_id).rpartition('/')
    if beacon == '':
        return rejected('wrong_frame', 'expected the name of a beacon as the frame_id')
    distance, least, most = float(message.range), message.min_range, message.max_range
    if not math.isfinite(distance):
        return rejected('not_finite', f'range {distance} m')
    if most > least and not least <= distance <= most:
        return rejected('out_of_range', f'range {distance} m, not from {least} to {most} m')
    place = source.beacons.get(beacon)
    # older messages have no variance
    return ms.Range(stamp_ns(message, source.time_offset_ns), beacon, distance,
                    float(getattr(message, 'variance', 0.0)), by.lever_arm(antenna, source),
                    None if place is None else np.array(place))


def yaw_rate(message: Message, source: 'Source', by: Surroundings) -> ms.YawRate | Answer:
    """Return the yaw rate in a sensor_msgs/Imu, or the reason for rejecting it."""
    values = message.angular_velocity_covariance
    if values[0] == -1.0:   # by the definition of the message
        return rejected('no_angular_velocity', 'the sensor reports no angular velocity')
    velocity = message.angular_velocity
    if source.mounting != 'tf' or by.is_of_base(message):
        rate, variance = -velocity.z if source.mounting == 'down' else velocity.z, values[8]
    else:
        if (found := by.in_base(message)) is None:
            return rejected('unknown_frame', (
                f'no transform from {shortened(frame(message.header.frame_id))!r} to '
                f'{by.base_frame!r} on /tf_static: publish it, or set {source.name}.mounting'))
        up = found[0][2]
        rate = float(up @ (velocity.x, velocity.y, velocity.z))
        variance = up @ np.asarray(values, dtype=float).reshape(3, 3) @ up
    if not math.isfinite(rate):
        return rejected('not_finite', (
            f'angular velocity ({velocity.x}, {velocity.y}, {velocity.z})'))
    return ms.YawRate(stamp_ns(message, source.time_offset_ns), float(rate),
                      float(variance) if variance > 0.0 else 0.0)


def twist(message: Message, source: 'Source', by: Surroundings) -> OdometrySample | Answer:
    """Return the odometry by a TwistWithCovarianceStamped, or the reason for rejecting it."""
    if isinstance(twist := planar_twist(message.twist.twist), Answer):
        return twist
    if not by.is_of_base(message):
        if (found := by.in_base(message)) is None:
            return rejected('wrong_frame', (
                f'expected frame {by.base_frame!r} or one with a transform to it on '
                f'/tf_static, got {shortened(frame(message.header.frame_id))!r}'))
        # from that of the sensor at its place in the robot's frame
        (x, y, rate), (rotation, place) = twist, found
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        c, s = math.cos(yaw), math.sin(yaw)
        twist = (c * x - s * y + rate * float(place[1]),
                 s * x + c * y - rate * float(place[0]), rate)
    stamp = stamp_ns(message, source.time_offset_ns)
    whole = by.twists.get(source.name, IntegratedTwist())
    if stamp > whole.stamp_ns:  # one that is older changes nothing
        time = (stamp - whole.stamp_ns) * 1e-9 if whole.stamp_ns > 0 else 0.0
        moved = se2.compose_one(whole.pose, integrated(whole.twist, twist, time))
        by.twists[source.name] = whole = IntegratedTwist(stamp, moved, twist)
    return OdometrySample(stamp, np.array(whole.pose), math.hypot(twist[0], twist[1]),
                          twist_variance(message.twist.covariance), twist)


def _planar(covariance_6x6: Message) -> FloatArray:
    return np.asarray(covariance_6x6, dtype=float).reshape(6, 6)[PLANAR]
