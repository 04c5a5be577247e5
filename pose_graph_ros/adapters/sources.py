# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The sources of measurements by the ROS parameters, and the settings of the engine for them."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
import math
from typing import Any

from pose_graph_ros.core import config
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.gyro_config import GyroSource, Integrate, RateNoise

NANOSECONDS = 1_000_000_000
_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


class Kind(Enum):
    """Kind of a source; the value of its parameter `type`."""

    ODOMETRY = 'odometry'
    GLOBAL_POSE = 'global_pose'
    FIX = 'fix'
    IMU = 'imu'
    LOOP_CLOSURE = 'loop_closure'
    TWIST = 'twist'
    GYRO = 'gyro'

    @property
    def message_type(self) -> str:
        """Type of the messages."""
        return MESSAGE_TYPES[self]

    @property
    def is_odometry(self) -> bool:
        """Whether the source is one of odometry."""
        return self in ODOMETRY_KINDS


MESSAGE_TYPES = {
    Kind.ODOMETRY: 'nav_msgs/msg/Odometry', Kind.GLOBAL_POSE: _POSE,
    Kind.FIX: 'sensor_msgs/msg/NavSatFix', Kind.IMU: 'sensor_msgs/msg/Imu',
    Kind.LOOP_CLOSURE: _POSE, Kind.TWIST: 'geometry_msgs/msg/TwistWithCovarianceStamped',
    Kind.GYRO: 'sensor_msgs/msg/Imu'}
IN_MAP = (Kind.FIX, Kind.GLOBAL_POSE)
"""Kinds of sources of positions in the map."""
ODOMETRY_KINDS = (Kind.ODOMETRY, Kind.TWIST)

SET_POSE = 'set_pose'  # name under which poses that a user sets are counted
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
    'filtered_odometry': ('odometry/filtered', MESSAGE_TYPES[Kind.ODOMETRY],
                          'newest pose and twist'),
    'filtered_fix': ('gps/filtered', MESSAGE_TYPES[Kind.FIX], 'newest pose on the Earth'),
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
    lever_arm: tuple[float, ...] = (0.0, 0.0)
    """Antenna of fixes in the frame of the robot (x, y) [m]; zero if not given."""
    yaw_offset: float = 0.0  # added to the yaw of an IMU [rad]
    mounting: str = 'tf'
    """How a gyroscope is mounted: `tf` (by /tf_static), or its z axis points `up` or `down`."""
    integrates_twist: bool = False  # whether the motion of odometry is that of its twists


def source_list(values: Mapping[str, Any]) -> tuple[Source, ...]:
    """Return the sources by the checked parameters, odometry in the order of preference."""
    return tuple(
        Source(name, Kind(values[f'{name}.type']), values[f'{name}.topic'],
               round(values[f'{name}.time_offset'] * NANOSECONDS),
               tuple(values.get(f'{name}.lever_arm', (0.0, 0.0))),
               values.get(f'{name}.yaw_offset', 0.0),
               values.get(f'{name}.mounting', 'tf'), _integrates_twist(name, values))
        for name in source_names(values['sources']))


def _integrates_twist(name: str, values: Mapping[str, Any]) -> bool:
    return values[f'{name}.type'] == Kind.TWIST.value or (
        values.get(f'{name}.integrate') == Integrate.TWIST.value)


def source_names(listed: list[str]) -> list[str]:
    """Return the names of all sources: the listed ones and `loop_closure`."""
    return [*listed, *([] if CLOSURES in listed else [CLOSURES])]


# Parameters of a source by the setting that the error messages of the engine name.
_SETTINGS = {'CovariancePolicy.position_ceiling': 'sigma_ceiling',
             'CovariancePolicy.heading_floor': 'sigma_floor'}


def backend_config(values: Mapping[str, Any]) -> config.BackendConfig:
    """
    Return the settings of the engine by the checked parameters.

    Raises `ConfigError` if these contradict each other, or have no source of odometry.
    """
    odometry: dict[str, config.OdometrySource] = {}
    measurements, gyros = {SET_POSE: config.SET_POSES}, dict[str, GyroSource]()
    for source in source_list(values):
        own = {name.removeprefix(f'{source.name}.'): value for name, value in values.items()
               if name.startswith(f'{source.name}.')}
        try:
            if source.kind.is_odometry:
                odometry[source.name] = _odometry_source(own, source)
            elif source.kind is Kind.GYRO:
                gyros[source.name] = _gyro_source(own)
            else:
                measurements[source.name] = _measurement_source(own)
        except ConfigError as error:
            setting, _, rest = str(error).partition(': ')
            raise ConfigError(
                f'parameter {source.name}.{_SETTINGS.get(setting, setting)}: {rest}') from error
    if len(odometry) == 0:
        raise ConfigError('parameter sources: expected at least one of type odometry or '
                          f'twist, got {values["sources"]}')
    return config.BackendConfig(
        nodes=config.NodePolicy(
            minimum_travel_distance=values['minimum_travel_distance'],
            minimum_travel_heading=values['minimum_travel_heading'],
            minimum_interval=values['minimum_node_interval'],
            moving_interval=values['moving_node_interval'],
            heartbeat=values['node_heartbeat']),
        alignment=config.AlignmentPolicy(
            sigma_heading=values['alignment.sigma_heading'],
            minimum_baseline=values['alignment.minimum_baseline'],
            baseline_in_sigmas=values['alignment.baseline_in_sigmas']),
        odometry=odometry, measurements=measurements, gyros=gyros,
        odometry_patience=values['odometry_patience'],
        window=config.WindowConfig(
            seconds=values['window.seconds'], metres=values['window.metres'],
            nodes=math.ceil(values['window.nodes']), prior=config.Prior(values['window.prior'])),
        thinning=config.ThinningConfig(
            cell=values['thinning.cell'], angle=values['thinning.angle'],
            poses=math.ceil(values['thinning.poses']),
            newest=math.ceil(values['thinning.newest'])))


def _odometry_source(own: Mapping[str, Any], source: Source) -> config.OdometrySource:
    position, heading = own['sigma_floor']
    return config.OdometrySource(
        noise=config.OdometryNoise(
            sigma_distance=own['sigma_distance'], sigma_lateral=own['sigma_lateral'],
            sigma_heading_distance=own['sigma_heading_distance'],
            sigma_heading_turn=own['sigma_heading_turn'],
            sigma_floor_position=position, sigma_floor_heading=heading),
        noise_from=config.NoiseFrom(own['noise']), covariance_scale=own['covariance_scale'],
        integrate=Integrate.TWIST if source.integrates_twist else Integrate.POSE,
        sigma_scale=own['sigma_scale'],
        reorder_window=own['reorder_window'], maximum_speed=own['maximum_speed'],
        loss=config.Loss(own['robust_loss']), rejection_threshold=own['rejection_threshold'])


def _gyro_source(own: Mapping[str, Any]) -> GyroSource:
    same = ('sigma_rate', 'sigma_bias', 'sigma_bias_walk', 'sigma_turn', 'bias_period',
            'maximum_gap', 'covariance_scale', 'reorder_window')
    return GyroSource(RateNoise(own['noise']), **{name: own[name] for name in same})


def _measurement_source(own: Mapping[str, Any]) -> config.MeasurementSource:
    position_floor, heading_floor = own['sigma_floor']
    default_position, default_heading = own['default_sigma']
    return config.MeasurementSource(
        covariance=config.CovariancePolicy(
            repair=own['covariance_policy'] == 'repair',
            override=tuple(own['covariance_override']), scale=own['covariance_scale'],
            position_floor=position_floor, heading_floor=heading_floor,
            position_ceiling=own['sigma_ceiling'], default_position=default_position,
            default_heading=default_heading, heading=config.Heading(own.get('heading', 'auto'))),
        robust=config.Robust(own['robust']),
        loss=config.Loss(own['robust_loss']), rejection_threshold=own['rejection_threshold'],
        sigma_scale=own.get('sigma_scale', 0.0),
        # sources of loop closures have neither a minimum period nor correlated errors
        **{} if 'correlation_time' not in own else {
            'minimum_period': own['minimum_period'], 'correlation_time': own['correlation_time'],
            'correlation': config.Correlation(own['correlation_model']),
            'white_share': own['white_share']})
