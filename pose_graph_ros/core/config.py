# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All settings of the engine and their defaults, in one place.

The ROS parameters, the yaml file and the README's table take their defaults from here.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.measurements import HeadingOnly, LoopClosure, Measurement
from pose_graph_ros.core.sources import (
    HEADINGS,
    LOOP_CLOSURES,
    MeasurementSource,
    OdometrySource,
    POSITIONS,
    require,
)

# Motion since the last hidden node below these is standing still: odometry jitters [m, rad].
REST_DISTANCE = 0.05
REST_HEADING = 0.05


@dataclass(frozen=True, slots=True)
class NodePolicy:
    """When odometry makes a new hidden node: after enough motion, or as a slow heartbeat."""

    minimum_travel_distance: float = 1.0
    """Distance from the last hidden node that makes the next one [m]."""
    minimum_travel_heading: float = 0.3
    """Turn since the last hidden node that makes the next one [rad]."""
    minimum_interval: float = 0.2
    """Never more hidden nodes than one in this time [s]; bounds the graph at high speed."""
    moving_interval: float = 1.0
    """A hidden node at the latest after this time, unless the robot stands still [s]."""
    heartbeat: float = 10.0
    """A hidden node at the latest after this time, even when standing still [s]."""

    def __post_init__(self) -> None:
        require(self, 'minimum_travel_distance', 'minimum_travel_heading', 'minimum_interval')
        require(self, 'moving_interval', 'heartbeat', positive=True)

    def due(self, distance: float, turned: float, elapsed: float) -> bool:
        """
        Tell whether a node is due.

        Parameters
        ----------
        distance, turned, elapsed : float
            From the last hidden node: straight distance [m], angle [rad] and time [s].

        """
        far = distance >= self.minimum_travel_distance or turned >= self.minimum_travel_heading
        moved = distance >= REST_DISTANCE or turned >= REST_HEADING
        return ((far and elapsed >= self.minimum_interval)
                or (moved and elapsed >= self.moving_interval) or elapsed >= self.heartbeat)


@dataclass(frozen=True, slots=True)
class AlignmentPolicy:
    """When the angle between odometry and map counts as known from positions alone."""

    sigma_heading: float = 0.15
    """The closed-form angle must be at least this certain [rad]."""
    minimum_baseline: float = 1.0
    """The positions must span at least this length [m] ..."""
    baseline_in_sigmas: float = 5.0
    """... and at least this many sigmas of a position."""

    def __post_init__(self) -> None:
        require(self, 'sigma_heading', 'minimum_baseline', 'baseline_in_sigmas', positive=True)


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """Gauss-Newton with Levenberg-Marquardt damping where a step would raise chi2."""

    max_iterations: int = 50
    """Iterations at the most."""
    step_tolerance: float = 1e-8
    """Converged when no coordinate would move by more than this any more [m, rad]."""
    initial_damping: float = 0.0
    """Factor on the diagonal of H in the first iteration; 0 is Gauss-Newton."""

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise ConfigError(f'SolverConfig.max_iterations: expected >= 1, '
                              f'got {self.max_iterations!r}')
        require(self, 'step_tolerance', positive=True)
        require(self, 'initial_damping')


@dataclass(frozen=True, slots=True)
class SmootherConfig:
    """How exact the incremental smoother is, and how much work a step may do."""

    alpha: float = 0.02
    """A node that has moved by less than this many sigmas moves no other node."""
    budget: float = 0.001
    """Squared linearization error [sigma^2] that a step may leave in all that it has moved ..."""
    budget_share: float = 6e-6
    """... and for each node that it has moved: the smaller of both counts."""
    max_iterations: int = 5
    """Iterations of one update at the most; what is left over is done in the next."""

    def __post_init__(self) -> None:
        require(self, 'alpha', 'budget', 'budget_share')
        if self.max_iterations < 1:
            raise ConfigError(f'SmootherConfig.max_iterations: expected >= 1, '
                              f'got {self.max_iterations!r}')


@dataclass(frozen=True, slots=True)
class BackendConfig:
    """Settings of `PoseGraphBackend`."""

    nodes: NodePolicy = field(default_factory=NodePolicy)
    alignment: AlignmentPolicy = field(default_factory=AlignmentPolicy)
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    """For the timer: what is left over is done at the next update."""
    closing: SolverConfig = field(
        default_factory=lambda: SolverConfig(max_iterations=400, step_tolerance=1e-10))
    """For the full optimisation at the end of a stream; an outage can make it converge slowly."""
    odometry: Mapping[str, OdometrySource] = field(default_factory=dict)
    """Sources of odometry by name, the preferred one first; defaults for others."""
    measurements: Mapping[str, MeasurementSource] = field(default_factory=dict)
    """Other sources by name; those that are not named have the defaults of what they send."""
    odometry_patience: float = 2.0
    """Another odometry makes the hidden nodes when the one that did is so much behind [s]."""

    def __post_init__(self) -> None:
        require(self, 'odometry_patience', positive=True)

    def odometry_source(self, name: str) -> OdometrySource:
        """Return the settings of a source of odometry."""
        return self.odometry.get(name, OdometrySource())

    def measurement_source(self, name: str, kind: type[Measurement]) -> MeasurementSource:
        """Return the settings of a source of measurements of a kind."""
        defaults = {LoopClosure: LOOP_CLOSURES, HeadingOnly: HEADINGS}
        return self.measurements.get(name, defaults.get(kind, POSITIONS))

    def changed_to(self, wanted: 'BackendConfig') -> 'BackendConfig':
        """
        Return the wanted settings, if a back end with these can take them while it runs.

        What decides how the past was kept stays: where odometry has its noise from, which is
        summed up sample by sample, and how errors live on, for which the graph holds states.

        Raises
        ------
        ConfigError
            If something else is wanted there: what it is, and what is wanted.

        """
        _require_same('SmootherConfig', self.smoother, wanted.smoother)
        for name in sorted({*self.odometry, *wanted.odometry}):
            _require_same(f'{name}: OdometrySource.noise_from',
                          self.odometry_source(name).noise_from,
                          wanted.odometry_source(name).noise_from)
        default = MeasurementSource()
        for name in sorted({*self.measurements, *wanted.measurements}):
            old = self.measurements.get(name, default)
            new = wanted.measurements.get(name, default)
            for setting in ('correlation_time', 'correlation', 'white_share'):
                _require_same(f'{name}: MeasurementSource.{setting}',
                              getattr(old, setting), getattr(new, setting))
        return wanted


def _require_same(what: str, present: object, wanted: object) -> None:
    if wanted != present:
        raise ConfigError(
            f'{what}: cannot change while it runs, expected {present!r}, got {wanted!r}')
