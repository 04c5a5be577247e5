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

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.gyro_config import GyroSource, Integrate
from pose_graph_ros.core.measurements import HeadingOnly, LoopClosure, Measurement
from pose_graph_ros.core.setting_checks import require, require_member, require_same
from pose_graph_ros.core.solver_config import SolverConfig

# Motion since the last hidden node below which the robot stands still [m], [rad].
REST_DISTANCE = 0.05
REST_HEADING = 0.05
# Sigma of a heading that is uniform on the circle [rad].
FLAT_GUESS = math.pi / math.sqrt(3.0)

# Correlation time of a source whose errors tell whether they are correlated, and for how long.
FOUND = -1.0


class Loss(Enum):
    """
    Loss of a constraint as a function of its energy; see `graph.losses`.

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

    JUDGED = 'judged'
    """The back end decides which ones to believe (`core.judgement`); a loss applies to these."""
    LOSS = 'loss'
    """All are used, with the robust loss of the source."""
    NONE = 'none'
    """All are used, as if the source had no robust loss."""


class Heading(Enum):
    """Whether the heading of a global pose is used."""

    AUTO = 'auto'
    """If its variance is positive and smaller than that of a uniform distribution."""
    ALWAYS = 'always'
    """The default replaces an unknown variance."""
    NEVER = 'never'


class NoiseFrom(Enum):
    """Source of the noise of odometry."""

    MODEL = 'model'
    """`OdometryNoise`, from the length of the path and the turns."""
    TWIST = 'twist'
    """Covariance of the twist in each message, times the time to the next message."""


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """
    Random-walk noise of odometry: variances grow with the path length and the turns.

    The noise of an increment is the sum of the noise of its parts. Except for the small floors,
    the spacing of the hidden nodes therefore does not change the covariance of the estimate.
    """

    sigma_distance: float = 0.05
    """Sigma along the direction of travel [m per sqrt(m) travelled]."""
    sigma_lateral: float = 0.03
    """Sigma across the direction of travel [m per sqrt(m) travelled]."""
    sigma_heading_distance: float = 0.01
    """Sigma of the heading by distance [rad per sqrt(m) travelled]."""
    sigma_heading_turn: float = 0.05
    """Sigma of the heading by turns [rad per sqrt(rad) turned]."""
    sigma_floor_position: float = 0.002
    """Sigma of the position added per increment [m]; keeps the information finite at rest."""
    sigma_floor_heading: float = 0.0005
    """Sigma of the heading added per increment [rad]."""

    def __post_init__(self) -> None:
        require(self, 'sigma_distance', 'sigma_lateral', 'sigma_heading_distance',
                 'sigma_heading_turn')
        require(self, 'sigma_floor_position', 'sigma_floor_heading', positive=True)

    def scaled(self, factor: float) -> 'OdometryNoise':
        """Return the noise with all sigmas times a factor."""
        return OdometryNoise(*(factor * getattr(self, each.name) for each in fields(self)))


@dataclass(frozen=True, slots=True)
class OdometrySource:
    """Settings of a source of odometry."""

    noise: OdometryNoise = field(default_factory=OdometryNoise)
    noise_from: NoiseFrom = NoiseFrom.MODEL
    integrate: Integrate = Integrate.POSE
    covariance_scale: float = 1.0
    """Factor on the covariance of every increment."""
    sigma_scale: float = 0.0
    """Factor on the sigmas of the primary odometry; 0 for one that fixes and poses show."""
    reorder_window: float = 0.25
    """A sample that is older by stamp than the newest one by up to this is still used [s]."""
    maximum_speed: float = 60.0
    """A faster motion counts as a jump of the odometry [m/s]."""
    loss: Loss = Loss.NONE
    rejection_threshold: float = 3.0
    """Threshold k of the loss [sigma]."""

    def __post_init__(self) -> None:
        require(self, 'covariance_scale', 'maximum_speed', 'rejection_threshold', positive=True)
        require(self, 'reorder_window', 'sigma_scale')
        require_member(self, 'noise_from', NoiseFrom)
        require_member(self, 'integrate', Integrate)
        require_member(self, 'loss', Loss)


@dataclass(frozen=True, slots=True)
class CovariancePolicy:
    """How the covariances of a source are validated; see `sources.validation`."""

    repair: bool = True
    """Whether invalid covariances are repaired; otherwise the measurement is rejected."""
    override: tuple[float, ...] = ()
    """Sigmas that replace every covariance: position [m], heading [rad]; empty for none."""
    scale: float = 1.0
    """Factor on the covariance."""
    position_floor: float = 0.01
    """Lower bound of the sigma of a position [m]."""
    heading_floor: float = 0.001
    """Lower bound of the sigma of a heading [rad]."""
    position_ceiling: float = 1000.0
    """Upper bound of the sigma of a position [m]; replaces infinite ones."""
    default_position: float = 5.0
    """Sigma of a position if it is unknown [m]."""
    default_heading: float = 0.3
    """Sigma of a heading if it is unknown [rad]."""
    heading: Heading = Heading.AUTO

    def __post_init__(self) -> None:
        require(self, 'scale', 'position_floor', 'heading_floor', 'position_ceiling',
                'default_position', 'default_heading', positive=True)
        require_member(self, 'heading', Heading)
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
    loss: Loss = Loss.NONE
    """Of what is believed; see `applied_loss`."""
    rejection_threshold: float = 3.0
    """Threshold k of the loss [sigma]."""
    minimum_period: float = 0.0
    """Of measurements with stamps closer than this only the first to arrive is used [s]."""
    correlation_time: float = 0.0
    """Time constant of the errors [s]; 0 for white noise, `FOUND` for one that they show."""

    def __post_init__(self) -> None:
        require(self, 'rejection_threshold', positive=True)
        require(self, 'minimum_period')
        if not self.finds_correlation:
            require(self, 'correlation_time')
        require_member(self, 'robust', Robust)
        require_member(self, 'loss', Loss)

    @property
    def finds_correlation(self) -> bool:
        """Whether the time constant of the errors is found from them."""
        return self.correlation_time == FOUND

    @property
    def applied_loss(self) -> Loss:
        """The loss of its constraints in the graph."""
        return Loss.NONE if self.robust is Robust.NONE else self.loss


POSITIONS = MeasurementSource(
    robust=Robust.JUDGED, loss=Loss.HUBER, correlation_time=FOUND)
"""Defaults of a source of global poses or positions."""
HEADINGS = MeasurementSource(minimum_period=0.5)
"""Defaults of a source of headings; thinned, as an IMU sends many redundant ones."""
SET_POSES = MeasurementSource(robust=Robust.NONE)
"""Settings of poses that a user sets: neither judged nor with a loss, as the user is believed."""
LOOP_CLOSURES = MeasurementSource(
    covariance=CovariancePolicy(repair=False), robust=Robust.JUDGED)
"""Defaults of a source of loop closures; those with an invalid covariance are rejected."""


@dataclass(frozen=True, slots=True)
class NodePolicy:
    """Conditions for a new hidden node: enough motion, or a maximum time."""

    minimum_travel_distance: float = 1.0
    """Distance from the last hidden node at which the next one is created [m]."""
    minimum_travel_heading: float = 0.3
    """Turn since the last hidden node at which the next one is created [rad]."""
    minimum_interval: float = 0.2
    """Minimum time between hidden nodes [s]; limits the size of the graph at high speed."""
    moving_interval: float = 1.0
    """Maximum time between hidden nodes while the robot moves [s]."""
    heartbeat: float = 10.0
    """Maximum time between hidden nodes at standstill [s]."""

    def __post_init__(self) -> None:
        require(self, 'minimum_travel_distance', 'minimum_travel_heading', 'minimum_interval')
        require(self, 'moving_interval', 'heartbeat', positive=True)

    def due(self, distance: float, turned: float, elapsed: float) -> bool:
        """
        Tell whether a new hidden node is due.

        Parameters
        ----------
        distance, turned, elapsed : float, since the last node: straight [m], turn [rad], time [s]

        """
        far = distance >= self.minimum_travel_distance or turned >= self.minimum_travel_heading
        moved = distance >= REST_DISTANCE or turned >= REST_HEADING
        return ((far and elapsed >= self.minimum_interval)
                or (moved and elapsed >= self.moving_interval) or elapsed >= self.heartbeat)


@dataclass(frozen=True, slots=True)
class AlignmentPolicy:
    """When the angle between odometry and map, computed from positions, counts as known."""

    sigma_heading: float = 0.15
    """Maximum sigma of the angle [rad]."""
    minimum_baseline: float = 1.0
    """Minimum extent of the positions [m]."""
    baseline_in_sigmas: float = 5.0
    """Minimum extent of the positions, in sigmas of a position."""

    def __post_init__(self) -> None:
        require(self, 'sigma_heading', 'minimum_baseline', 'baseline_in_sigmas', positive=True)


@dataclass(frozen=True, slots=True)
class SmootherConfig:
    """Accuracy of the incremental smoother, and the work per update."""

    alpha: float = 0.02
    """Back-substitution stops at nodes that move by less than this [sigma]."""
    budget: float = 0.001
    """Upper limit of the squared linearisation error that a step may leave [sigma^2]."""
    budget_share: float = 6e-6
    """The same limit per node that the step has moved; the smaller limit applies [sigma^2]."""
    max_iterations: int = 5
    """Maximum number of iterations per update; the next update continues."""

    def __post_init__(self) -> None:
        require(self, 'alpha', 'budget', 'budget_share')
        if self.max_iterations < 1:
            raise ConfigError(f'SmootherConfig.max_iterations: expected >= 1, '
                              f'got {self.max_iterations!r}')


class Prior(Enum):
    """What becomes of constraints whose hidden nodes leave the graph."""

    DENSE = 'dense'
    """One constraint of all their neighbours: exact but for the linearization."""
    SPARSE = 'sparse'
    """A few constraints of pairs of neighbours, with covariances that are no smaller."""


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """How much of the past the graph keeps: the smallest limit that is not 0; see `window`."""

    seconds: float = 0.0
    """Time before the newest hidden node [s]; 0 for no limit."""
    metres: float = 0.0
    """Path length before it [m]; 0 for no limit."""
    nodes: int = 0
    """Number of hidden nodes; 0 for no limit."""
    prior: Prior = Prior.DENSE

    def __post_init__(self) -> None:
        require(self, 'seconds', 'metres', 'nodes')
        require_member(self, 'prior', Prior)

    @property
    def is_limited(self) -> bool:
        """Whether there is any limit."""
        return self.nodes > 0 or self.seconds > 0.0 or self.metres > 0.0


@dataclass(frozen=True, slots=True)
class ThinningConfig:
    """Which hidden nodes leave where a place is driven often; see `window.thinning`."""

    cell: float = 0.0
    """Distance within which a node stands for others [m]; 0 for no thinning."""
    angle: float = math.pi / 2.0
    """Difference of headings below which it does [rad]."""
    poses: int = 1
    """So many must stay near one that leaves."""
    newest: int = 50
    """Number of newest hidden nodes that stay in any case."""

    def __post_init__(self) -> None:
        require(self, 'cell')
        require(self, 'angle', 'poses', 'newest', positive=True)


@dataclass(frozen=True, slots=True)
class BackendConfig:
    """Settings of `PoseGraphBackend`."""

    nodes: NodePolicy = field(default_factory=NodePolicy)
    alignment: AlignmentPolicy = field(default_factory=AlignmentPolicy)
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    """Of the update at each tick of the timer."""
    final_optimization: SolverConfig = field(
        default_factory=lambda: SolverConfig(max_iterations=400, step_tolerance=1e-10))
    """Of the full optimisation at the end of a stream; after outages it can converge slowly."""
    odometry: Mapping[str, OdometrySource] = field(default_factory=dict)
    """Sources of odometry by name, the preferred one first; others have the defaults."""
    measurements: Mapping[str, MeasurementSource] = field(default_factory=dict)
    """Sources of measurements by name; others have the defaults of their kind."""
    gyros: Mapping[str, GyroSource] = field(default_factory=dict)
    """Gyroscopes by name; others have the defaults."""
    odometry_patience: float = 2.0
    """Silence of the primary odometry source after which another one replaces it [s]."""
    window: WindowConfig = field(default_factory=WindowConfig)
    """What the graph keeps; the rest leaves it, and what it told stays as a prior."""
    thinning: ThinningConfig = field(default_factory=ThinningConfig)
    """Which hidden nodes leave where a place is driven often."""

    def __post_init__(self) -> None:
        require(self, 'odometry_patience', positive=True)

    def odometry_source(self, name: str) -> OdometrySource:
        """Return the settings of a source of odometry."""
        return self.odometry.get(name, OdometrySource())

    def gyro(self, name: str) -> GyroSource:
        """Return the settings of a gyroscope."""
        return self.gyros.get(name, GyroSource())

    @property
    def odometry_scale(self) -> float:
        """Factor on the sigmas of odometry of the preferred source; 0 for one that is found."""
        return next((source.sigma_scale for source in self.odometry.values()), 0.0)

    def measurement_source(self, name: str, kind: type[Measurement]) -> MeasurementSource:
        """
        Return the settings of a source of measurements.

        Parameters
        ----------
        name : str
        kind : type, of the measurement; selects the defaults of a source without settings

        """
        defaults = {LoopClosure: LOOP_CLOSURES, HeadingOnly: HEADINGS}
        return self.measurements.get(name, defaults.get(kind, POSITIONS))

    def changed_to(self, wanted: 'BackendConfig') -> 'BackendConfig':
        """
        Return the wanted settings if a back end with these settings can change to them.

        Settings of stored data cannot change: `noise_from` and `integrate`, as noise and twists
        are summed up sample by sample, the correlation of errors and the bias of a gyroscope, as
        the graph contains states for them, and the smoother.
        Raises ConfigError if one of these differs; the message names it with both values.
        """
        require_same(type(self).__name__, self, wanted, 'smoother')
        for name in sorted({*self.odometry, *wanted.odometry}):
            require_same(f'{name}: OdometrySource', self.odometry_source(name),
                         wanted.odometry_source(name), 'noise_from', 'integrate')
        for name in sorted({*self.gyros, *wanted.gyros}):
            require_same(f'{name}: GyroSource', self.gyro(name), wanted.gyro(name),
                         'sigma_bias', 'sigma_bias_walk', 'bias_period')
        default = MeasurementSource()
        for name in sorted({*self.measurements, *wanted.measurements}):
            require_same(f'{name}: MeasurementSource', self.measurements.get(name, default),
                         wanted.measurements.get(name, default), 'correlation_time')
        return wanted
