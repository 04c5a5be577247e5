# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Convert velocities in messages, which need the frame of the sensor: gyroscopes and twists."""

import math

import numpy as np

from pose_graph_ros.adapters.conversions import (
    frame,
    Message,
    planar_twist,
    stamp_ns,
    twist_variance,
)
from pose_graph_ros.adapters.sources import Kind, Source
from pose_graph_ros.adapters.static_frames import StaticFrames
from pose_graph_ros.core.geometry.scalar_se2 import compose_one, exp_one, Pose
from pose_graph_ros.core.measurements import Answer, OdometrySample, rejected, YawRate

# First element of the covariance of the angular velocity of an Imu without one.
NO_RATE = -1.0


class GyroReader:
    """
    Converts the Imu messages of one source to yaw rates of the robot.

    Parameters
    ----------
    frames : StaticFrames, used if the parameter `mounting` of the source says so
    base_frame : str, frame of the robot

    """

    def __init__(self, source: Source, frames: StaticFrames, base_frame: str) -> None:
        self.source = source
        """Gives the time offset and the mounting; may be replaced at any time."""
        self._frames, self._base_frame = frames, base_frame

    def read(self, message: Message) -> YawRate | Answer:
        """Return the yaw rate in a sensor_msgs/Imu, or the reason for rejecting it."""
        values = message.angular_velocity_covariance
        if values[0] == NO_RATE:
            return rejected('no_angular_velocity', 'the sensor reports no angular velocity')
        velocity, stamp = message.angular_velocity, stamp_ns(message, self.source.time_offset_ns)
        mounting, name = self.source.mounting, frame(message.header.frame_id)
        if mounting != 'tf' or name in ('', self._base_frame):
            rate, variance = -velocity.z if mounting == 'down' else velocity.z, values[8]
        else:
            rotation = self._frames.rotation(name, self._base_frame)
            if rotation is None:
                return rejected('unknown_frame', (
                    f'no transform from {name!r} to {self._base_frame!r} on /tf_static: publish '
                    f'it, or set {self.source.name}.mounting'))
            up = rotation[2]
            rate = float(up @ (velocity.x, velocity.y, velocity.z))
            variance = up @ np.asarray(values, dtype=float).reshape(3, 3) @ up
        if not math.isfinite(rate):
            return rejected('not_finite', (
                f'angular velocity ({velocity.x}, {velocity.y}, {velocity.z})'))
        return YawRate(stamp, float(rate), float(variance) if variance > 0.0 else 0.0)


class TwistReader:
    """
    Converts the TwistWithCovarianceStamped messages of one source to odometry.

    Its poses are twists integrated in the order of arrival. They are for outputs between two
    estimates; the engine integrates the twists anew in the order of their stamps.

    Parameters
    ----------
    frames : StaticFrames, gives the place of the sensor, if that is not the frame of the robot
    base_frame : str, frame of the robot

    """

    def __init__(self, source: Source, frames: StaticFrames, base_frame: str) -> None:
        self.source = source
        """Gives the time offset; may be replaced at any time."""
        self._frames, self._base_frame = frames, base_frame
        self._stamp_ns = 0
        self._pose, self._twist = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

    def read(self, message: Message) -> OdometrySample | Answer:
        """Return the odometry by a twist, or the reason for rejecting it."""
        twist = planar_twist(message.twist.twist)
        if isinstance(twist, Answer):
            return twist
        name = frame(message.header.frame_id)
        if name not in ('', self._base_frame):
            place = self._frames.planar(name, self._base_frame)
            if place is None:
                return rejected('wrong_frame', (
                    f'expected frame {self._base_frame!r} or one with a transform to it on '
                    f'/tf_static, got {name!r}'))
            twist = _at_base(twist, place)
        stamp = stamp_ns(message, self.source.time_offset_ns)
        if stamp > self._stamp_ns:
            time = (stamp - self._stamp_ns) * 1e-9 if self._stamp_ns > 0 else 0.0
            x, y, turn = (0.5 * (one + other) * time
                          for one, other in zip(self._twist, twist, strict=True))
            self._pose = compose_one(self._pose, exp_one((x, y, turn)))
            self._stamp_ns, self._twist = stamp, twist
        return OdometrySample(stamp, np.array(self._pose), math.hypot(twist[0], twist[1]),
                              twist_variance(message.twist.covariance), twist)


VELOCITY_READERS: dict[Kind, type[GyroReader] | type[TwistReader]] = {
    Kind.GYRO: GyroReader, Kind.TWIST: TwistReader}
"""Classes of readers, which all take the same arguments, by kind of source."""


def _at_base(twist: Pose, place: Pose) -> Pose:
    """Return the twist of the robot from that of a sensor at a place in its frame."""
    x, y, rate = twist
    c, s = math.cos(place[2]), math.sin(place[2])
    return c * x - s * y + rate * place[1], s * x + c * y - rate * place[0], rate
