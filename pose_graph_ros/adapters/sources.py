# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The sources of measurements by the ROS parameters, and the settings of the engine for them."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
import math
from typing import Any

from pose_graph_ros.core import config
from pose_graph_ros.core.config import GyroSource, Integrate, RateNoise
from pose_graph_ros.core.exceptions import ConfigError

NANOSECONDS = 1_000_000_000
# The graph is reset if the clock or the stamps of odometry jump back by more than this [ns].
CLOCK_JUMP_NS = NANOSECONDS
_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


class Kind(Enum):
    """Kind of a source; the value of its parameter `type`, and the type of its messages."""

    ODOMETRY = 'odometry', 'nav_msgs/msg/Odometry'
    GLOBAL_POSE = 'global_pose', _POSE
    FIX = 'fix', 'sensor_msgs/msg/NavSatFix'
    IMU = 'imu', 'sensor_msgs/msg/Imu'
    LOOP_CLOSURE = 'loop_closure', _POSE
    TWIST = 'twist', 'geometry_msgs/msg/TwistWithCovarianceStamped'
    GYRO = 'gyro', 'sensor_msgs/msg/Imu'

    message_type: str

    def __new__(cls, name: str, message_type: str = '') -> 'Kind':
        """Make a member whose value is its name alone."""
        kind = object.__new__(cls)
        kind._value_, kind.message_type = name, message_type
        return kind

    @property
    def is_odometry(self) -> bool:
        """Whether the source is one of odometry."""
        return self in ODOMETRY_KINDS


IN_MAP = (Kind.FIX, Kind.GLOBAL_POSE)
"""Kinds of sources of positions in the map."""
ODOMETRY_KINDS = (Kind.ODOMETRY, Kind.TWIST)

SET_POSE, JUDGE = 'set_pose', 'judge'  # names under which what a person asks for is counted
CLOSURES = 'loop_closure'  # name of the source of loop closures that always exists
KNOWN_SOURCES = {
    'odom': (Kind.ODOMETRY, 'odom'), 'global_pose': (Kind.GLOBAL_POSE, 'global_pose'),
    'fix': (Kind.FIX, 'gps/fix'), 'imu': (Kind.IMU, 'imu/data'),
    CLOSURES: (Kind.LOOP_CLOSURE, 'loop_closure'), 'gyro': (Kind.GYRO, 'imu/data')}
"""Default kind and topic of the predefined sources."""
DEFAULT_SOURCES = ('odom', 'global_pose', 'fix')


OUTPUTS = {
    'path': ('path', 'nav_msgs/msg/Path', 'corrected path'),
    'pose': ('pose', _POSE, 'newest pose'),
    'filtered_odometry': ('odometry/filtered', Kind.ODOMETRY.message_type,
                          'newest pose and twist'),
    'filtered_fix': ('gps/filtered', Kind.FIX.message_type, 'newest pose on the Earth'),
    'graph': ('graph', 'visualization_msgs/msg/MarkerArray', 'markers of the graph'),
    'verdicts': ('~/verdicts', 'diagnostic_msgs/msg/DiagnosticArray', 'verdicts'),
    'diagnostics': ('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', 'diagnostics')}
"""Default topic, type and content of the outputs."""


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
    integrates_twist: bool = False  # whether the motion of odometry is that of its twists


def source_list(values: Mapping[str, Any]) -> tuple[Source, ...]:
    """Return the sources by the checked parameters, odometry in the order of preference."""
    return tuple(_source(name, _own(values, name)) for name in source_names(values['sources']))


def _own(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the parameters of a source by their names without its own."""
    return {name.removeprefix(f'{source}.'): value for name, value in values.items()
            if name.startswith(f'{source}.')}


def _source(name: str, own: Mapping[str, Any]) -> Source:
    kind, given = Kind(own['type']), _same(own, Source)
    if 'lever_arm' in given:
        given['lever_arm'] = tuple(given['lever_arm'])
    return Source(
        name, kind, time_offset_ns=round(own['time_offset'] * NANOSECONDS),
        integrates_twist=(kind is Kind.TWIST or own.get('integrate') == Integrate.TWIST.value),
        **given)


def source_names(listed: list[str]) -> list[str]:
    """Return the names of all sources: the listed ones and `loop_closure`."""
    return [*listed, *([] if CLOSURES in listed else [CLOSURES])]


# Parameters of a source by the setting that the error messages of the engine name.
_SETTINGS = {'CovariancePolicy.heading_floor': 'sigma_floor'}
DEFAULTS = {
    Kind.GLOBAL_POSE: config.POSITIONS, Kind.FIX: config.POSITIONS, Kind.IMU: config.HEADINGS,
    Kind.LOOP_CLOSURE: config.LOOP_CLOSURES}
"""Settings of the sources of measurements, but for those that have parameters."""


def backend_config(values: Mapping[str, Any]) -> config.BackendConfig:
    """
    Return the settings of the engine by the checked parameters.

    Raises `ConfigError` if these contradict each other, or have no source of odometry.
    """
    odometry: dict[str, config.OdometrySource] = {}
    measurements, gyros = {SET_POSE: config.SET_POSES}, dict[str, GyroSource]()
    for source in source_list(values):
        own = _own(values, source.name)
        try:
            if source.kind.is_odometry:
                odometry[source.name] = _odometry_source(own, source)
            elif source.kind is Kind.GYRO:
                gyros[source.name] = _gyro_source(own)
            else:
                measurements[source.name] = _measurement_source(own, DEFAULTS[source.kind])
        except ConfigError as error:
            setting, _, rest = str(error).partition(': ')
            raise ConfigError(
                f'parameter {source.name}.{_SETTINGS.get(setting, setting)}: {rest}') from error
    if len(odometry) == 0:
        raise ConfigError('parameter sources: expected at least one of type odometry or '
                          f'twist, got {values["sources"]}')
    return config.BackendConfig(
        nodes=config.NodePolicy(**_same(values, config.NodePolicy)),
        odometry=odometry, measurements=measurements, gyros=gyros,
        window=config.WindowConfig(
            seconds=values['window.seconds'], metres=values['window.metres'],
            nodes=math.ceil(values['window.nodes']),
            prior=config.WindowPrior(values['window.prior'])),
        thinning=config.ThinningConfig(cell=values['thinning.cell']))


def _odometry_source(own: Mapping[str, Any], source: Source) -> config.OdometrySource:
    return config.OdometrySource(
        noise=config.OdometryNoise(**_same(own, config.OdometryNoise)),
        noise_from=config.NoiseFrom(own['noise']),
        integrate=Integrate.TWIST if source.integrates_twist else Integrate.POSE,
        **_same(own, config.OdometrySource, but=('noise', 'integrate')))


def _gyro_source(own: Mapping[str, Any]) -> GyroSource:
    return GyroSource(RateNoise(own['noise']), **_same(own, GyroSource))


def _same(
    own: Mapping[str, Any], settings: type, but: Collection[str] = (),
) -> dict[str, Any]:
    """Return the parameters that are named as the settings that they are."""
    return {field.name: own[field.name] for field in fields(settings)
            if field.name in own and field.name not in but}


def _measurement_source(
    own: Mapping[str, Any], default: config.MeasurementSource,
) -> config.MeasurementSource:
    policy, loss = default.covariance, config.Loss(own['robust_loss'])
    floors = own.get('sigma_floor', (policy.position_floor, policy.heading_floor))
    return replace(
        default, covariance=replace(
            policy, override=tuple(own['covariance_override']), scale=own['covariance_scale'],
            position_floor=floors[0], heading_floor=floors[1],
            heading=config.Heading(own.get('heading', 'auto'))),
        robust=config.Robust(own['robust']), loss=loss,
        # for Tukey's loss that for 95 % of the accuracy of least squares [sigma]
        rejection_threshold=(5.0 if loss is config.Loss.TUKEY else default.rejection_threshold),
        correlation_time=own.get('correlation_time', 0.0))
