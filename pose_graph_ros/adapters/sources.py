# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The kinds of sources, each one row of a table; sources by the ROS parameters, and their messages.

A row says what messages a kind has and what they become, which settings the engine has for it, and
by which parameters. What the engine does with the measurements, `core.sources.kinds` says.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
import math
from typing import Any

from pose_graph_ros.adapters import conversions, parameter_table as table
from pose_graph_ros.adapters.conversions import frame, Message
from pose_graph_ros.adapters.parameter_table import Change, Parameter
from pose_graph_ros.core import config
from pose_graph_ros.core.config import GyroSource, Integrate, MeasurementSource, OdometrySource
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.judgement.texts import shortened
from pose_graph_ros.core.measurements import Answer, Measurement, OdometrySample, rejected
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper
from pose_graph_ros.core.quantities import NANOSECONDS

# The graph is reset if the clock or the stamps of odometry jump back by more than this [ns].
CLOCK_JUMP_NS = NANOSECONDS
_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
_IMU = 'sensor_msgs/msg/Imu'

Measured = OdometrySample | Measurement
Values = Mapping[str, Any]
"""Checked parameters by name."""


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """A kind of sources."""

    name: str  # value of the parameter `type`
    message_type: str
    convert: Callable[[Message, 'Source', conversions.Surroundings], Measured | Answer]
    # of a source, but for those that have parameters
    settings: OdometrySource | MeasurementSource | GyroSource
    parameters: tuple[Parameter, ...]  # beside `OF_ALL`
    in_map: bool = False  # whether it tells where the robot is in the map
    on_earth: bool = False  # whether it tells where the map is on the Earth
    is_rare: bool = False  # whether its silence means nothing, and no message must get lost
    in_frames: bool = False  # whether its messages are in frames that /tf_static places
    names_frames: bool = False  # whether its frames are odom_frame and base_link_frame
    without_frame: str = ''  # what a message without a frame_id means
    part: str = ''  # the part of its messages that is used, if other kinds use other ones

    @property
    def is_odometry(self) -> bool:
        """Whether the source is one of odometry."""
        return isinstance(self.settings, OdometrySource)

    @property
    def is_motion(self) -> bool:
        """Whether its messages tell motions, and come without a gap."""
        return not isinstance(self.settings, MeasurementSource)


ODOMETRY = Kind('odometry', 'nav_msgs/msg/Odometry', conversions.odometry, OdometrySource(),
                (*table.OF_WHEELS, table.INTEGRATE), names_frames=True)
GLOBAL_POSE = Kind('global_pose', _POSE, conversions.global_pose, config.POSITIONS,
                   (*table.in_the_map(config.POSITIONS), table.HEADING), in_map=True,
                   without_frame='it is taken for {map}, the map_frame')
FIX = Kind('fix', 'sensor_msgs/msg/NavSatFix', conversions.fix, config.POSITIONS,
           (*table.in_the_map(config.POSITIONS), table.LEVER_ARM), in_map=True, on_earth=True,
           in_frames=True, without_frame='its antenna is taken to be in {base}: set '
           '{name}.lever_arm')
IMU = Kind('imu', _IMU, conversions.heading, config.HEADINGS,
           (*table.in_the_map(config.HEADINGS), table.YAW_OFFSET), part='orientation')
LOOP_CLOSURE = Kind('loop_closure', _POSE, conversions.loop_closure, config.LOOP_CLOSURES,
                    table.of_measurements(config.LOOP_CLOSURES), is_rare=True)
TWIST = Kind('twist', 'geometry_msgs/msg/TwistWithCovarianceStamped', conversions.twist,
             OdometrySource(integrate=Integrate.TWIST), table.OF_WHEELS, in_frames=True,
             without_frame='it is taken for {base}, the base_link_frame')
GYRO = Kind('gyro', _IMU, conversions.yaw_rate, GyroSource(), table.OF_GYROS, in_frames=True,
            without_frame='it is taken for {base}: set {name}.mounting', part='angular_velocity')
RANGE = Kind('range', 'sensor_msgs/msg/Range', conversions.beacon_range, config.RANGES, (
    *table.of_measurements(config.RANGES), table.LEVER_ARM, table.BEACONS), in_frames=True)
KINDS = {kind.name: kind
         for kind in (ODOMETRY, GLOBAL_POSE, FIX, IMU, LOOP_CLOSURE, TWIST, GYRO, RANGE)}
"""Kinds of sources by name."""

TYPE = Parameter('type', '', '', 'Type of the source.', choices=tuple(KINDS), change=Change.START)

SET_POSE, JUDGE = 'set_pose', 'judge'  # names under which what a person asks for is counted
CLOSURES = 'loop_closure'  # name of the source of loop closures that always exists
KNOWN_SOURCES = {'odom': (ODOMETRY, 'odom'), 'global_pose': (GLOBAL_POSE, 'global_pose'),
                 'fix': (FIX, 'gps/fix'), 'imu': (IMU, 'imu/data'),
                 CLOSURES: (LOOP_CLOSURE, 'loop_closure'), 'gyro': (GYRO, 'imu/data')}
"""Default kind and topic of the predefined sources."""


@dataclass(frozen=True, slots=True)
class Source:
    """One source of measurements, by its parameters."""

    name: str
    kind: Kind
    topic: str  # topic to which the node subscribes
    time_offset_ns: int = 0  # added to the stamps of its messages [ns]
    lever_arm: tuple[float, ...] = (0.0, 0.0)  # antenna of fixes on the robot [m]; 0: not given
    yaw_offset: float = 0.0  # added to the yaw of an IMU [rad]
    mounting: str = 'tf'  # of a gyroscope: by /tf_static, or its z axis points `up` or `down`
    integrate: str = Integrate.POSE.value  # what the motion of odometry is taken from
    # places of beacons in the map by name, as far as they are known [m]
    beacons: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def source_list(values: Values) -> tuple[Source, ...]:
    """Return the sources by the checked parameters, odometry in the order of preference."""
    found = []
    for name in source_names(values['sources']):
        own = _own(values, name)
        given = _same(own, Source)
        places: dict[str, tuple[float, float]] = {}
        for text in given.get('beacons', ()):
            try:
                beacon, x, y = text.split()
                places[beacon] = float(x), float(y)
                if not all(abs(each) < 1e7 for each in places[beacon]):
                    raise ValueError
            except ValueError:
                raise ConfigError(f'parameter {name}.beacons: expected name, x and y, such as '
                                  f'"anchor_1 12.5 -3.0", got {text!r}') from None
        found.append(Source(name, KINDS[own['type']], time_offset_ns=round(
            own['time_offset'] * NANOSECONDS), **given | {'beacons': places}))
    return tuple(found)


def _own(values: Values, source: str) -> dict[str, Any]:
    """Return the parameters of a source by their names without its own."""
    return {name.removeprefix(f'{source}.'): value for name, value in values.items()
            if name.startswith(f'{source}.')}


def source_names(listed: list[str]) -> list[str]:
    """Return the names of all sources: the listed ones and `loop_closure`."""
    return [*listed, *([] if CLOSURES in listed else [CLOSURES])]


# Parameters of a source by the setting that the error messages of the engine name.
_SETTINGS = {'CovariancePolicy.heading_floor': 'sigma_floor'}


def backend_config(values: Values) -> config.BackendConfig:
    """
    Return the settings of the engine by the checked parameters.

    Raises `ConfigError` if these contradict each other, or have no source of odometry.
    """
    odometry, gyros = dict[str, OdometrySource](), dict[str, GyroSource]()
    measurements = {SET_POSE: config.SET_POSES}
    for source in source_list(values):
        own = _own(values, source.name)
        try:
            match source.kind.settings:
                case OdometrySource() as settings:
                    odometry[source.name] = OdometrySource(
                        noise=config.OdometryNoise(**_same(own, config.OdometryNoise)),
                        noise_from=config.NoiseFrom(own['noise']),
                        integrate=Integrate(own.get('integrate', settings.integrate)),
                        **_same(own, OdometrySource, but=('noise', 'integrate')))
                case GyroSource():
                    gyros[source.name] = GyroSource(
                        config.RateNoise(own['noise']), **_same(own, GyroSource))
                case MeasurementSource() as settings:
                    policy, loss = settings.covariance, config.Loss(own['robust_loss'])
                    floors = own.get('sigma_floor', (policy.position_floor, policy.heading_floor))
                    measurements[source.name] = replace(
                        settings, covariance=replace(
                            policy, override=tuple(own['covariance_override']),
                            scale=own['covariance_scale'], position_floor=floors[0],
                            heading_floor=floors[1],
                            heading=config.Heading(own.get('heading', 'auto'))),
                        robust=config.Robust(own['robust']), loss=loss,
                        # for Tukey's loss that for 95 % of the accuracy of least squares [sigma]
                        rejection_threshold=(5.0 if loss is config.Loss.TUKEY
                                             else settings.rejection_threshold),
                        correlation_time=own.get('correlation_time', 0.0))
        except ConfigError as error:
            setting, _, rest = str(error).partition(': ')
            raise ConfigError(
                f'parameter {source.name}.{_SETTINGS.get(setting, setting)}: {rest}') from error
    if len(odometry) == 0:
        raise ConfigError('parameter sources: expected at least one of type odometry or '
                          f'twist, got {values["sources"]}')
    return config.BackendConfig(
        nodes=config.NodePolicy(**_same(values, config.NodePolicy)), odometry=odometry,
        measurements=measurements, gyros=gyros, window=config.WindowConfig(
            values['window.seconds'], values['window.metres'], math.ceil(values['window.nodes']),
            config.WindowPrior(values['window.prior'])),
        thinning=config.ThinningConfig(cell=values['thinning.cell']))


def _same(own: Mapping[str, Any], settings: type, but: Collection[str] = ()) -> dict[str, Any]:
    """Return the parameters that are named as the settings that they are."""
    names = [each.name for each in fields(settings) if each.name in own and each.name not in but]
    return {name: tuple(own[name]) if isinstance(own[name], list) else own[name] for name in names}


class MessageReader:
    """Converts the messages of all sources to measurements, by the checked parameters."""

    def __init__(self, values: Values, frames: conversions.StaticFrames | None = None,
                 keeper: TimeKeeper | None = None) -> None:
        self.sources = {source.name: source for source in source_list(values)}  # sources by name
        self.keeper = keeper or TimeKeeper([name for name, source in self.sources.items()
                                            if source.kind.is_odometry], CLOCK_JUMP_NS)
        self.frames = conversions.StaticFrames() if frames is None else frames
        self.datum = conversions.datum_of(values)
        self.surroundings = conversions.Surroundings(
            frame(values['map_frame']), frame(values['base_link_frame']), self.datum, self.frames)

    def configure(self, values: Values) -> None:
        """
        Use other time offsets, lever arms, yaw offsets and mountings for messages from now on.

        Sources, topics, frames, datum, static transforms and counts stay.
        """
        for source in source_list(values):
            before = self.sources[source.name]
            self.keeper.shift(source.name, source.time_offset_ns - before.time_offset_ns)
            self.sources[source.name] = source

    def read(self, name: str, message: Message) -> Measured | Answer:
        """Return the measurement in a message of a source, or the reason for rejecting it."""
        return measurement if isinstance(measurement := self.convert(name, message), Answer) else (
            self.keeper.judge(name, measurement).refusal or measurement)

    def convert(self, name: str, message: Message) -> Measured | Answer:
        """Return the same without a judgement of its stamp."""
        source = self.sources[name]
        try:
            for named in (message.header.frame_id, getattr(message, 'child_frame_id', '')):
                if len(named) > conversions.LONGEST_NAME:
                    return rejected('long_name', f'expected names of frames of at most '
                                    f'{conversions.LONGEST_NAME} characters, got '
                                    f'{shortened(named)!r}')
            measurement = source.kind.convert(message, source, self.surroundings)
        except Exception as error:  # fields of other types, by a definition in a bag
            return rejected('malformed', f'{type(error).__name__}: {error}')
        # the seconds have 31 bits, of which one hour is left for offsets
        return measurement if isinstance(measurement, Answer) or (
            measurement.stamp_ns <= (2**31 - 3600) * NANOSECONDS) else rejected(
                'stamp_out_of_range', f'{measurement.stamp_ns} ns')
