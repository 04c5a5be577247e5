# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of one source of odometry or of measurements, and their defaults."""

from dataclasses import dataclass, field
from enum import Enum
import math

from pose_graph_ros.core.exceptions import ConfigError

# Sigma of a heading that is uniform on the circle [rad].
FLAT_GUESS = math.pi / math.sqrt(3.0)


def require(settings: object, *names: str, positive: bool = False) -> None:
    """Raise ConfigError unless the named settings are finite and not negative (or positive)."""
    for name in names:
        value = getattr(settings, name)
        if not math.isfinite(value) or value < 0.0 or (positive and value == 0.0):
            expected = 'a positive number' if positive else 'a number that is not negative'
            raise ConfigError(
                f'{type(settings).__name__}.{name}: expected {expected}, got {value!r}')


class Loss(Enum):
    """How the energy of a constraint counts; see `robust`."""

    NONE = 'none'
    HUBER = 'huber'
    CAUCHY = 'cauchy'


class Correlation(Enum):
    """How errors that live on from one measurement to the next are treated."""

    BIAS = 'bias'
    """Estimated, as a state of the source that wanders."""
    INFLATE = 'inflate'
    """By larger covariances."""


class Heading(Enum):
    """Whether the heading of a global pose is used."""

    AUTO = 'auto'
    """If its variance is positive and less than that of a flat guess."""
    ALWAYS = 'always'
    """If its variance says nothing, the default is taken."""
    NEVER = 'never'


class NoiseFrom(Enum):
    """What the noise of odometry is taken from."""

    MODEL = 'model'
    """The length of the path and the turns: `OdometryNoise`."""
    TWIST = 'twist'
    """The covariance of the twist in each message, times the time to the next one."""


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """
    Random-walk noise of odometry: variances grow with the path length and the turn.

    Composable by construction: the noise of a long increment is that of its parts added up, so
    that, but for the small floors, the spacing of the hidden nodes does not change the estimate's
    uncertainty.
    """

    sigma_distance: float = 0.05
    """Along the direction of travel [m per sqrt(m) travelled]."""
    sigma_lateral: float = 0.03
    """Across the direction of travel [m per sqrt(m) travelled]."""
    sigma_heading_distance: float = 0.01
    """Heading [rad per sqrt(m) travelled]."""
    sigma_heading_turn: float = 0.05
    """Heading [rad per sqrt(rad) turned]."""
    sigma_floor_position: float = 0.002
    """Position, once per increment [m]; keeps the information finite when standing still."""
    sigma_floor_heading: float = 0.0005
    """Heading, once per increment [rad]."""

    def __post_init__(self) -> None:
        require(self, 'sigma_distance', 'sigma_lateral', 'sigma_heading_distance',
                 'sigma_heading_turn')
        require(self, 'sigma_floor_position', 'sigma_floor_heading', positive=True)


@dataclass(frozen=True, slots=True)
class OdometrySource:
    """A source of odometry."""

    noise: OdometryNoise = field(default_factory=OdometryNoise)
    noise_from: NoiseFrom = NoiseFrom.MODEL
    covariance_scale: float = 1.0
    """Factor on the covariance of every increment."""
    reorder_window: float = 0.25
    """What comes later than a sample by up to this in stamps [s] is sorted in before it."""
    maximum_speed: float = 60.0
    """A faster motion is a jump of the odometry, not of the robot [m/s]."""
    loss: Loss = Loss.NONE
    rejection_threshold: float = 3.0
    """From so many sigmas on the loss holds back."""

    def __post_init__(self) -> None:
        require(self, 'covariance_scale', 'maximum_speed', 'rejection_threshold', positive=True)
        require(self, 'reorder_window')


@dataclass(frozen=True, slots=True)
class CovariancePolicy:
    """What becomes of the covariances of a source at the door; see `admission`."""

    repair: bool = True
    """Mend what is broken; else refuse it."""
    override: tuple[float, ...] = ()
    """Sigmas that are taken instead of any: position [m], heading [rad]; empty for none."""
    scale: float = 1.0
    """Factor on the covariance."""
    position_floor: float = 0.01
    """No position is believed to be better than this [m]."""
    heading_floor: float = 0.001
    """No heading is believed to be better than this [rad]."""
    position_ceiling: float = 1000.0
    """No position counts as worse than this [m]; infinite variances end here."""
    default_position: float = 5.0
    """Sigma of a position whose sender does not know it [m]."""
    default_heading: float = 0.3
    """Sigma of a heading whose sender does not know it [rad]."""
    heading: Heading = Heading.AUTO

    def __post_init__(self) -> None:
        require(self, 'scale', 'position_floor', 'heading_floor', 'position_ceiling',
                'default_position', 'default_heading', positive=True)
        if len(self.override) not in (0, 1, 2) or not all(
                0.0 < sigma < math.inf for sigma in self.override):
            raise ConfigError('CovariancePolicy.override: expected no, one or two positive '
                              f'sigmas, got {list(self.override)}')
        if self.position_ceiling < self.position_floor:
            raise ConfigError(
                'CovariancePolicy.position_ceiling: expected at least the floor '
                f'{self.position_floor}, got {self.position_ceiling}')
        if self.heading_floor > FLAT_GUESS:
            raise ConfigError('CovariancePolicy.heading_floor: expected less than that of a flat '
                              f'guess {FLAT_GUESS:.2f}, got {self.heading_floor}')


@dataclass(frozen=True, slots=True)
class MeasurementSource:
    """A source of global poses, positions, headings or loop closures."""

    covariance: CovariancePolicy = field(default_factory=CovariancePolicy)
    loss: Loss = Loss.NONE
    rejection_threshold: float = 3.0
    """From so many sigmas on the loss holds back."""
    minimum_period: float = 0.0
    """Of measurements whose stamps lie closer than this the first to come is used [s]."""
    correlation_time: float = 0.0
    """How long an error lives, its time constant [s]; 0 for white noise."""
    correlation: Correlation = Correlation.BIAS
    white_share: float = 0.05
    """Variance of what is white beside that, in parts of the variance, in [0, 1]."""

    def __post_init__(self) -> None:
        require(self, 'rejection_threshold', positive=True)
        require(self, 'minimum_period', 'correlation_time', 'white_share')
        if self.white_share > 1.0:
            raise ConfigError('MeasurementSource.white_share: expected a number in [0, 1], '
                              f'got {self.white_share!r}')


POSITIONS = MeasurementSource(loss=Loss.HUBER)
"""Defaults of a source of global poses or of positions: a few of them are always wrong."""
HEADINGS = MeasurementSource(minimum_period=0.5)
"""Defaults of a source of headings: an imu sends a hundred a second, which say the same."""
SET_POSES = MeasurementSource()
"""For poses that somebody sets who knows: they count in full."""
LOOP_CLOSURES = MeasurementSource(covariance=CovariancePolicy(repair=False))
"""A closure whose sender does not know how good it is does more harm than good."""
