# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is simulated: sensors with their errors, and disturbances. Defaults are those of the drive.

Topics stand for sensors, as one disturbs a topic. All constructors raise ConfigError if a value is
out of range. Times are seconds since the start of the simulation.
"""

from dataclasses import dataclass, field
from enum import StrEnum
import math
from typing import Any

from pose_graph_ros.core.config import check, require
from pose_graph_ros.core.exceptions import ConfigError

ODOMETRY, GYRO, FIXES, POSES, CLOSURES = (
    '/odom', '/imu/data', '/gps/fix', '/global_pose', '/loop_closure')
DURATIONS_S = {'drive': 440.0, 'hall': 900.0, 'grid': 1800.0}
NODE_DISTANCES = {'drive': 2.0, 'hall': 1.0, 'grid': 1.0}
"""Usual lengths of simulations, and distances of the nodes of a graph [m], by world."""
TRUTH = '/ground_truth'
START_NS = 1_746_518_400_250_000_000  # stamp of the start [ns]
LATENCY_S = {ODOMETRY: 0.004, GYRO: 0.002, FIXES: 0.13, POSES: 0.05, CLOSURES: 0.8, TRUTH: 0.004}
"""Usual time from the stamp of a measurement to its recording, by topic."""
TOPICS = (ODOMETRY, GYRO, FIXES, POSES, CLOSURES)
"""What can be disturbed."""


def _known(topic: str, known: tuple[str, ...] = TOPICS, what: str = '') -> None:
    if topic not in known:
        raise ConfigError(f'{what}expected a topic of {", ".join(known)}, got {topic}')


def _finite(name: str, values: tuple[float, ...], above: float = -math.inf) -> None:
    for value in values:
        if not above < value < math.inf:
            least = '' if above == -math.inf else f' above {above:g}'
            raise ConfigError(f'{name}: expected finite numbers{least}, got {value:g}')


class OdometryErrors(StrEnum):
    """Where the errors of odometry come from."""

    WHEELS = 'wheels'
    """Two wheels: wrong radii and track width, slip, a wandering heading."""
    MODEL = 'model'
    """A random walk, with the noise that the node assumes (`OdometryNoise`)."""


@dataclass(frozen=True, slots=True)
class Wheels:
    """Odometry of two wheels."""

    errors: OdometryErrors = OdometryErrors.WHEELS
    track_width: float = 1.5
    """Distance of the wheels [m]."""
    scale: tuple[float, float] = (1.0068, 1.0070)
    """Ratio of measured to true distance, left and right."""
    track_scale: float = 1.012
    """Ratio of assumed to true track width."""
    slip_events_per_s: float = 1.0 / 60.0
    """Of each wheel."""
    slip_s: float = 0.012
    """Relative excess of a wheel's speed in a slip event, integrated over it [s]."""
    wander: float = 1.2e-3
    """Standard deviation of the time-correlated error of the yaw rate [rad/s]."""
    wander_time_s: float = 40.0
    """Time constant of this error."""
    heading_drift: float = 0.0
    """What the heading drifts by, per distance [rad/m]."""
    start: tuple[float, float, float] | None = None
    """First pose in the frame of odometry, its heading minus the true one; by default 0."""

    def __post_init__(self) -> None:
        check(self, 'track_width', 'track_scale', 'wander_time_s', but='heading_drift')
        _finite('wheels: scale', self.scale, above=0.0)
        _finite('wheels: heading drift', (self.heading_drift,))


@dataclass(frozen=True, slots=True)
class Gyro:
    """A gyroscope, at 100 Hz."""

    sigma: float = 5e-4
    """White noise, as the angle random walk [rad/sqrt(s)]."""
    bias: float = 0.01
    """Standard deviation of the bias at the start [rad/s]."""
    bias_walk: float = 2e-5
    """Of its walk [rad/s/sqrt(s)]."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class Fixes:
    """GNSS fixes."""

    period_s: float = 0.5
    white: float = 0.4
    """Standard deviation of the white error of a coordinate [m]."""
    correlated: float = 1.2
    """And of the time-correlated (first-order Gauss-Markov) one [m]."""
    correlation_s: float = 60.0
    """Time constant of the correlated error."""

    def __post_init__(self) -> None:
        check(self, 'period_s', 'correlation_s')
        if self.white == 0.0 and self.correlated == 0.0:
            raise ConfigError('fixes: expected a white or a correlated error above 0, got 0 and 0')

    @property
    def sigmas(self) -> tuple[float, float]:
        """Standard deviations of the coordinates, of both errors together [m]."""
        return (math.hypot(self.correlated, self.white),) * 2


@dataclass(frozen=True, slots=True)
class GlobalPoses:
    """Poses in the map, as of a localiser, with white errors."""

    period_s: float = 1.0
    sigmas: tuple[float, float, float] = (0.1, 0.1, 0.02)
    """[m, m, rad]"""

    def __post_init__(self) -> None:
        check(self, 'period_s')
        _finite('global poses: sigmas', self.sigmas, above=0.0)


@dataclass(frozen=True, slots=True)
class FalseClosures:
    """Loop closures between two different places that are taken for one."""

    share: float | None = None
    """Of all closures, those of groups included; None for as many `singles` as given instead."""
    singles: int = 0
    groups: int = 0
    """Groups that agree with one another: a stretch is taken for another one."""
    size: int = 4
    """Number of closures in a group."""
    min_distance: float = 40.0
    """Smallest distance of the two places [m]."""
    spacing: float = 6.0
    """Distance of the closures of a group [m]."""
    loose: bool = False
    """Whether those of a group agree roughly: each with an error of a part of `radius`."""
    from_s: float = 100.0
    """When they begin."""

    def __post_init__(self) -> None:
        check(self, 'spacing', 'size')
        if self.share is not None and not 0.0 <= self.share < 1.0:
            raise ConfigError(f'share of false closures: expected 0 to below 1, got {self.share}')

    def sizes(self, true: int) -> list[int]:
        """
        Return the sizes of all groups, a single one last, as so many true closures there are.

        Raises `ConfigError` if the groups alone are more than the share.
        """
        grouped, total = self.groups * self.size, self.groups * self.size + self.singles
        if self.share is not None and (
                total := round(self.share / (1.0 - self.share) * true)) < grouped:
            raise ConfigError(f'{self.groups} groups of {self.size} false closures are {grouped}, '
                              f'but a share of {self.share:g} beside {true} true ones is {total}')
        return [self.size] * self.groups + [1] * (total - grouped)


@dataclass(frozen=True, slots=True)
class Closures:
    """Loop closures, where a place is visited again in the same direction."""

    rate: float = 1.0
    """Share of the stretches with something to find, in which one is found."""
    sigmas: tuple[float, float, float] = (0.1, 0.1, math.radians(1.0))
    """[m, m, rad]"""
    spacing: float = 25.0
    """Length of the stretches of the path with at most one each [m]."""
    radius: float = 2.0
    """Largest distance [m], and"""
    angle: float = math.radians(20.0)
    """angle [rad] between the true poses."""
    min_time_s: float = 15.0
    """Smallest time, and"""
    min_distance: float = 50.0
    """driven distance [m] between them."""
    place_distance: float = 0.5
    """Distance of the places along the path that are compared [m]."""
    first_s: float = 0.0
    """Before this no place is seen."""
    false: FalseClosures = field(default_factory=FalseClosures)

    def __post_init__(self) -> None:
        if not 0.0 <= self.rate <= 1.0:
            raise ConfigError(f'rate of closures: expected 0 to 1, got {self.rate}')
        check(self, 'spacing', 'radius', 'angle', 'place_distance')
        _finite('closures: sigmas', self.sigmas, above=0.0)


@dataclass(frozen=True, slots=True)
class Outage:
    """A time in which a topic is silent, by the stamps (of a closure: the later one)."""

    topic: str
    begin_s: float
    end_s: float

    def __post_init__(self) -> None:
        _known(self.topic)
        _finite('outage', (self.begin_s, self.end_s))
        if self.end_s <= self.begin_s:
            raise ConfigError(f'outage of {self.topic}: expected an end after {self.begin_s:g} s, '
                              f'got {self.end_s:g} s')


@dataclass(frozen=True, slots=True)
class Jump:
    """
    A step of what a topic says.

    Odometry goes on from a pose that is moved in the frame of the robot, or begins again at its
    origin. Fixes and global poses are moved in map axes, for some time.
    """

    topic: str
    at_s: float
    step: tuple[float, float, float] | None
    """[m, m, rad]; None for odometry that begins again at its origin."""
    seconds: float = math.inf
    """How long fixes and poses are moved."""
    sigma: float = 0.0
    """Standard deviation by which the step of each fix or pose changes [m]."""

    def __post_init__(self) -> None:
        _known(self.topic, (ODOMETRY, FIXES, POSES), 'jump: ')
        _finite('jump', (self.at_s, *(self.step or ())))
        if self.step is None and self.topic != ODOMETRY:
            raise ConfigError(f'jump of {self.topic}: expected DX,DY, as only {ODOMETRY} can '
                              'begin again')
        if self.step is not None and self.topic == FIXES and self.step[2] != 0.0:
            raise ConfigError(f'jump of {FIXES}: expected DX,DY, got a heading of {self.step[2]}')
        if not self.seconds > 0.0 or (self.topic == ODOMETRY and self.seconds != math.inf):
            raise ConfigError(f'jump of {self.topic}: expected ' + (
                'no length of time, as odometry never comes back, ' if self.topic == ODOMETRY
                else 'a positive length of time, ') + f'got {self.seconds:g} s')


@dataclass(frozen=True, slots=True)
class Delay:
    """How long after their stamps the messages of a topic are recorded."""

    topic: str
    seconds: float
    jitter_s: float = 0.0
    """Added at random, 0 to this; longer than the period it puts messages out of order."""

    def __post_init__(self) -> None:
        _known(self.topic)
        require(self, 'seconds', 'jitter_s')


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How much the clock of a sensor is ahead: added to its stamps, not to the recording times."""

    topic: str
    seconds: float

    def __post_init__(self) -> None:
        _known(self.topic)
        _finite('clock offset', (self.seconds,))


@dataclass(frozen=True, slots=True)
class Duplicates:
    """Share of the messages of a topic that are recorded once more within a second."""

    topic: str
    share: float

    def __post_init__(self) -> None:
        _known(self.topic)
        if not 0.0 <= self.share <= 1.0:
            raise ConfigError(f'duplicates of {self.topic}: expected a share of 0 to 1, got '
                              f'{self.share:g}')


@dataclass(frozen=True, slots=True)
class ClaimedSigma:
    """Ratio of the sigmas that a topic claims to those of its errors; 1 if it is not given."""

    topic: str
    factor: float

    def __post_init__(self) -> None:
        # odometry comes without a covariance that can be wrong
        _known(self.topic, TOPICS[1:], 'claimed sigma: ')
        require(self, 'factor', positive=True)


@dataclass(frozen=True, slots=True)
class Setup:
    """Sensors, None for what is not there, and disturbances."""

    wheels: Wheels = Wheels()
    gyro: Gyro | None = None
    fixes: Fixes | None = None
    poses: GlobalPoses | None = None
    closures: Closures | None = None
    outages: tuple[Outage, ...] = ()
    jumps: tuple[Jump, ...] = ()
    delays: tuple[Delay, ...] = ()
    offsets: tuple[ClockOffset, ...] = ()
    duplicates: tuple[Duplicates, ...] = ()
    claims: tuple[ClaimedSigma, ...] = ()

    @property
    def sensors(self) -> dict[str, Any]:
        """The sensors that are there, by topic."""
        return {topic: sensor for topic, sensor in zip(TOPICS, (
            self.wheels, self.gyro, self.fixes, self.poses, self.closures), strict=True)
            if sensor is not None}

    def claimed(self, topic: str) -> float:
        """Return the factor on the sigmas that a topic claims."""
        return math.prod(each.factor for each in self.claims if each.topic == topic)

    def sigmas(self, topic: str) -> list[float]:
        """Return the sigmas that fixes, poses or closures claim."""
        return [self.claimed(topic) * sigma for sigma in self.sensors[topic].sigmas]

    def jumps_of(self, topic: str) -> list[Jump]:
        """Return the jumps of a topic."""
        return [each for each in self.jumps if each.topic == topic]
