# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All settings of the engine and their defaults.

The ROS parameters, the yaml files and the tables in the documentation take their defaults from
here. All constructors raise ConfigError if a value is out of range.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
import math
from typing import Any, ClassVar

from pose_graph_ros.core.exceptions import ConfigError

# Sigma of a heading that is uniform on the circle [rad].
FLAT_GUESS = math.pi / math.sqrt(3.0)
# Correlation time of a source whose errors tell whether they are correlated, and for how long.
FOUND = -1.0


def require(settings: object, *names: str, positive: bool = False) -> None:
    """Raise ConfigError unless the named settings are finite and not negative."""
    for name in names:
        value = getattr(settings, name)
        if not math.isfinite(value) or value < 0.0 or (positive and value == 0.0):
            what = 'a positive number' if positive else 'a number that is not negative'
            raise ConfigError(f'{type(settings).__name__}.{name}: expected {what}, got {value!r}')


def require_same(what: str, present: object, wanted: object, *names: str) -> None:
    """
    Raise ConfigError if one of the named settings differs, as it cannot change while it runs.
    """
    for name in names:
        old, new = getattr(present, name), getattr(wanted, name)
        if old != new:
            raise ConfigError(
                f'{what}.{name}: cannot change while it runs, expected {old!r}, got {new!r}')


def check(settings: Any, *positive: str, but: str = '') -> None:
    """
    Raise ConfigError unless numbers are valid and choices are members of their enumerations.

    Those of the given names are positive, and all but one are finite and not negative.
    """
    for name, default in ((each.name, each.default) for each in fields(settings)):
        value = getattr(settings, name)
        if isinstance(default, Enum) and not isinstance(value, type(default)):
            raise ConfigError(f'{type(settings).__name__}.{name}: expected one of '
                              f'{", ".join(map(str, type(default)))}, got {value!r}')
        if isinstance(default, float | int) and name != but:
            require(settings, name, positive=name in positive)


class Settings:
    """Settings that are checked by `check` when they are made."""

    __slots__ = ()
    POSITIVE: ClassVar[tuple[str, ...]] = ()  # names of the numbers that cannot be 0

    def __post_init__(self) -> None:
        check(self, *self.POSITIVE)


class Loss(Enum):
    """
    Loss of a constraint as a function of its energy; see `graph.reweighting`.

    A threshold of 3 sigma keeps 96 % (Cauchy), 89 % (truncated, Geman-McClure), 99 % (Huber, DCS)
    of the accuracy of least squares where no measurement is wrong; Tukey needs 5 sigma for 95 %.
    """

    NONE = 'none'
    HUBER = 'huber'
    CAUCHY = 'cauchy'
    GEMAN_MCCLURE = 'geman_mcclure'
    DCS = 'dcs'
    TUKEY = 'tukey'
    TRUNCATED = 'truncated'


class Robust(Enum):
    """How a source is protected from its wrong measurements."""

    # the back end decides which ones to believe (`core.judgement`); a loss applies to these
    JUDGED = 'judged'
    LOSS = 'loss'  # all are used, with the robust loss of the source
    NONE = 'none'  # all are used, as if the source had no robust loss


class Heading(Enum):
    """Whether the heading of a global pose is used."""

    AUTO = 'auto'  # if its variance is positive and smaller than that of a uniform distribution
    ALWAYS = 'always'  # the default replaces an unknown variance
    NEVER = 'never'


class NoiseFrom(Enum):
    """Source of the noise of odometry."""

    MODEL = 'model'  # `OdometryNoise`, from the length of the path and the turns
    TWIST = 'twist'  # covariance of the twist in each message, times the time to the next message


class Integrate(Enum):
    """What the motion by odometry is taken from."""

    POSE = 'pose'  # the pose in each message
    TWIST = 'twist'  # the twist in each message, integrated over the time between messages


@dataclass(frozen=True, slots=True)
class OdometryNoise(Settings):
    """
    Random-walk noise of odometry: variances grow with the path length and the turns.

    The noise of an increment is the sum of the noise of its parts. Except for the small floors,
    the spacing of the hidden nodes therefore does not change the covariance of the estimate.
    """

    POSITIVE = 'sigma_floor_position', 'sigma_floor_heading'

    sigma_distance: float = 0.05  # sigma along the direction of travel [m per sqrt(m) travelled]
    sigma_lateral: float = 0.03  # sigma across the direction of travel [m per sqrt(m) travelled]
    # sigma of the heading by distance [rad per sqrt(m) travelled]
    sigma_heading_distance: float = 0.01
    sigma_heading_turn: float = 0.05  # sigma of the heading by turns [rad per sqrt(rad) turned]
    # sigma of the position added per increment [m]; keeps the information finite at rest
    sigma_floor_position: float = 0.002
    sigma_floor_heading: float = 0.0005  # sigma of the heading added per increment [rad]


@dataclass(frozen=True, slots=True)
class OdometrySource:
    """Settings of a source of odometry."""

    noise: OdometryNoise = field(default_factory=OdometryNoise)
    noise_from: NoiseFrom = NoiseFrom.MODEL
    integrate: Integrate = Integrate.POSE
    covariance_scale: float = 1.0  # factor on the covariance of every increment
    # factor on the sigmas of the primary odometry; 0 for one that fixes and poses show
    sigma_scale: float = 0.0
    # whether bias of the yaw rate and error of the scale are estimated while it is the primary one
    calibrate: bool = False
    # sigmas of these two in the beginning [rad/s, 1], and of their random walks in sqrt(h)
    calibration_sigma: tuple[float, float] = (0.005, 0.02)
    calibration_walk: tuple[float, float] = (0.0005, 0.002)
    # a sample that is older by stamp than the newest one by up to this is still used [s]
    reorder_window: float = 0.25
    maximum_speed: float = 60.0  # a faster motion counts as a jump of the odometry [m/s]

    def __post_init__(self) -> None:
        check(self, 'covariance_scale', 'maximum_speed')
        for name in ('calibration_sigma', 'calibration_walk'):
            if not all(0.0 < each < math.inf for each in getattr(self, name)):
                raise ConfigError(f'{name}: expected positive ones, got {getattr(self, name)}')


class RateNoise(Enum):
    """Source of the noise of a gyroscope."""

    # variance of the rate in each message, if it is positive, else `sigma_rate`
    MESSAGE = 'message'
    MODEL = 'model'  # `sigma_rate`


@dataclass(frozen=True, slots=True)
class GyroSource(Settings):
    """
    Settings of a gyroscope, whose yaw rate is integrated between hidden nodes.

    Its error is white noise and a bias, which is a random walk.
    """

    POSITIVE = ('sigma_rate', 'sigma_bias', 'sigma_bias_walk', 'bias_period', 'maximum_gap',
                'covariance_scale')

    noise_from: RateNoise = RateNoise.MESSAGE
    # white noise of the rate, as the angle random walk that it integrates to [rad/sqrt(s)]
    sigma_rate: float = 1e-3
    sigma_bias: float = 0.02  # sigma of the bias when the sensor is switched on [rad/s]
    sigma_bias_walk: float = 3e-5  # random walk of the bias [rad/s/sqrt(s)]
    sigma_turn: float = 2e-3  # error of the scale, as a random walk by turns [rad/sqrt(rad)]
    bias_period: float = 10.0  # the bias has a new state this often [s]
    # longest time between two samples over which the rate is integrated [s]
    maximum_gap: float = 0.25
    covariance_scale: float = 1.0  # factor on the variance of every integrated angle
    # a sample that is older by stamp than the newest one by up to this is still used [s]
    reorder_window: float = 0.25


@dataclass(frozen=True, slots=True)
class CovariancePolicy:
    """How the covariances of a source are validated; see `sources.validation`."""

    # whether invalid covariances are repaired; otherwise the measurement is rejected
    repair: bool = True
    # sigmas that replace every covariance: position [m], heading [rad]; empty for none
    override: tuple[float, ...] = ()
    scale: float = 1.0  # factor on the covariance
    position_floor: float = 0.01  # lower bound of the sigma of a position [m]
    heading_floor: float = 0.001  # lower bound of the sigma of a heading [rad]
    # upper bound of the sigma of a position [m]; replaces infinite ones
    position_ceiling: float = 1000.0
    default_position: float = 5.0  # sigma of a position if it is unknown [m]
    default_heading: float = 0.3  # sigma of a heading if it is unknown [rad]
    heading: Heading = Heading.AUTO

    def __post_init__(self) -> None:
        check(self, 'scale', 'position_floor', 'heading_floor', 'position_ceiling',
              'default_position', 'default_heading')
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
    """Settings of a source of global poses, positions, headings or loop closures."""

    covariance: CovariancePolicy = field(default_factory=CovariancePolicy)
    robust: Robust = Robust.LOSS
    loss: Loss = Loss.NONE  # of what is believed; see `applied_loss`
    rejection_threshold: float = 3.0  # threshold k of the loss [sigma]
    # of measurements with stamps closer than this only the first to arrive is used [s]
    minimum_period: float = 0.0
    # time constant of the errors [s]; 0 for white noise, `FOUND` for one that they show
    correlation_time: float = 0.0

    def __post_init__(self) -> None:
        check(self, 'rejection_threshold',
              but='correlation_time' if self.finds_correlation else '')

    @property
    def finds_correlation(self) -> bool:
        """Whether the time constant of the errors is found from them."""
        return self.correlation_time == FOUND

    @property
    def applied_loss(self) -> Loss:
        """The loss of its constraints in the graph."""
        return Loss.NONE if self.robust is Robust.NONE else self.loss


# defaults of a source of global poses or positions
POSITIONS = MeasurementSource(robust=Robust.JUDGED, loss=Loss.HUBER, correlation_time=FOUND)
# defaults of a source of headings; thinned, as an IMU sends many redundant ones
HEADINGS = MeasurementSource(minimum_period=0.5)
# settings of poses that a user sets: neither judged nor with a loss, as the user is believed
SET_POSES = MeasurementSource(robust=Robust.NONE)
# defaults of loop closures; those with an invalid covariance are rejected
LOOP_CLOSURES = MeasurementSource(covariance=CovariancePolicy(repair=False), robust=Robust.JUDGED)
# defaults of a source of ranges to beacons; most messages do not say how accurate they are
RANGES = MeasurementSource(covariance=CovariancePolicy(default_position=0.3), loss=Loss.CAUCHY)


# settings of a source that is not configured, here by the class of its measurements
DEFAULT_ODOMETRY, DEFAULT_GYRO = OdometrySource(), GyroSource()
DEFAULTS = {'GlobalPose': POSITIONS, 'Position': POSITIONS, 'Fix': POSITIONS,
            'HeadingOnly': HEADINGS, 'LoopClosure': LOOP_CLOSURES, 'Range': RANGES}


@dataclass(frozen=True, slots=True)
class NodePolicy(Settings):
    """Conditions for a new hidden node: enough motion, or a maximum time."""

    POSITIVE = 'moving_interval', 'heartbeat'

    # distance from the last hidden node at which the next one is created [m]
    minimum_travel_distance: float = 1.0
    # turn since the last hidden node at which the next one is created [rad]
    minimum_travel_heading: float = 0.3
    # minimum time between hidden nodes [s]; limits the size of the graph at high speed
    minimum_interval: float = 0.2
    moving_interval: float = 1.0  # maximum time between hidden nodes while the robot moves [s]
    heartbeat: float = 10.0  # maximum time between hidden nodes at standstill [s]

    def due(self, distance: float, turned: float, elapsed: float) -> bool:
        """Tell whether a node is due this far [m, rad] and long [s] after the last one."""
        far = distance >= self.minimum_travel_distance or turned >= self.minimum_travel_heading
        moved = distance >= 0.05 or turned >= 0.05  # beyond the jitter of odometry at rest
        return ((far and elapsed >= self.minimum_interval)
                or (moved and elapsed >= self.moving_interval) or elapsed >= self.heartbeat)


@dataclass(frozen=True, slots=True)
class SolverConfig(Settings):
    """Settings of Gauss-Newton with Levenberg-Marquardt damping, for a whole graph."""

    POSITIVE = 'max_iterations', 'step_tolerance'

    max_iterations: int = 50
    # converged if no coordinate of the next step is larger than this [m, rad]
    step_tolerance: float = 1e-8


@dataclass(frozen=True, slots=True)
class SmootherConfig(Settings):
    """Accuracy of the incremental smoother, and the work per update."""

    POSITIVE = ('max_iterations',)

    alpha: float = 0.035  # back-substitution stops at nodes that move by less than this [sigma]
    # Squared linearization error that a step may leave for good. What is above it, up to ten times
    # as much, is left to the next step; above that the step iterates again. Where chi2 and the
    # number of loops are above 200, the budget grows with the lower one, up to 1000 [sigma^2].
    budget: float = 0.002
    # the same limit per node that the step has moved; the smaller limit applies [sigma^2]
    budget_share: float = 2e-5
    max_iterations: int = 5  # maximum number of iterations per update; the next update continues


class WindowPrior(Enum):
    """What becomes of constraints whose hidden nodes leave the graph."""

    DENSE = 'dense'  # one constraint of all their neighbours: exact but for the linearization
    # a few constraints of pairs of neighbours, with covariances that are no smaller
    SPARSE = 'sparse'


@dataclass(frozen=True, slots=True)
class WindowConfig(Settings):
    """How much of the past the graph keeps: the smallest limit that is not 0; see `window`."""

    seconds: float = 0.0  # time before the newest hidden node [s]; 0 for no limit
    metres: float = 0.0  # path length before it [m]; 0 for no limit
    nodes: int = 0  # number of hidden nodes; 0 for no limit
    prior: WindowPrior = WindowPrior.DENSE


@dataclass(frozen=True, slots=True)
class ThinningConfig(Settings):
    """Which hidden nodes leave where a place is driven often; see `window.thinning`."""

    POSITIVE = 'angle', 'poses', 'newest'

    cell: float = 0.0  # distance within which a node stands for others [m]; 0 for no thinning
    angle: float = math.pi / 2.0  # difference of headings below which it does [rad]
    poses: int = 1  # so many must stay near one that leaves
    newest: int = 50  # number of newest hidden nodes that stay in any case


@dataclass(frozen=True, slots=True)
class BackendConfig(Settings):
    """Settings of `PoseGraphBackend`."""

    POSITIVE = ('odometry_patience',)

    nodes: NodePolicy = field(default_factory=NodePolicy)
    # of the update at each tick of the timer
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    # of the full optimisation at the end of a stream; after outages it can converge slowly
    final_optimization: SolverConfig = field(
        default_factory=lambda: SolverConfig(max_iterations=400, step_tolerance=1e-10))
    # sources of odometry by name, the preferred one first; others have the defaults
    odometry: Mapping[str, OdometrySource] = field(default_factory=dict)
    # sources of measurements by name; others have the defaults of their kind
    measurements: Mapping[str, MeasurementSource] = field(default_factory=dict)
    # gyroscopes by name; others have the defaults
    gyros: Mapping[str, GyroSource] = field(default_factory=dict)
    # silence of the primary odometry source after which another one replaces it [s]
    odometry_patience: float = 2.0
    # what the graph keeps; the rest leaves it, and what it told stays as a prior
    window: WindowConfig = field(default_factory=WindowConfig)
    # which hidden nodes leave where a place is driven often
    thinning: ThinningConfig = field(default_factory=ThinningConfig)

    def odometry_source(self, name: str) -> OdometrySource:
        """Return the settings of a source of odometry."""
        return self.odometry.get(name, DEFAULT_ODOMETRY)

    def gyro(self, name: str) -> GyroSource:
        """Return the settings of a gyroscope."""
        return self.gyros.get(name, DEFAULT_GYRO)

    @property
    def odometry_scale(self) -> float:
        """Factor on the sigmas of odometry of the preferred source; 0 for one that is found."""
        return next((source.sigma_scale for source in self.odometry.values()), 0.0)

    def measurement_source(self, name: str, kind: type) -> MeasurementSource:
        """Return the settings of a source, by default those of its kind of measurement."""
        return self.measurements.get(name, DEFAULTS[kind.__name__])

    def changed_to(self, wanted: 'BackendConfig') -> 'BackendConfig':
        """
        Return the wanted settings if a back end with these settings can change to them.

        Settings of stored data cannot change: `noise_from` and `integrate`, as noise and twists
        are summed up sample by sample, those of errors that the graph contains states for, and the
        smoother. Raises ConfigError if one of these differs; it names it with both values.
        """
        require_same(type(self).__name__, self, wanted, 'smoother')
        fixed = {'odometry': ('noise_from', 'integrate', 'calibrate', 'calibration_sigma',
                              'calibration_walk'),
                 'gyros': ('sigma_bias', 'sigma_bias_walk', 'bias_period'),
                 'measurements': ('correlation_time',)}
        for settings, names in fixed.items():
            present, later = getattr(self, settings), getattr(wanted, settings)
            for source in sorted({*present, *later}):
                # of a source that is not configured, the defaults
                kind = type(later.get(source) or present[source])
                old, new = (each.get(source, kind()) for each in (present, later))
                require_same(f'{source}: {kind.__name__}', old, new, *names)
        return wanted
