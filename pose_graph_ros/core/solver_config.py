# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of a batch optimisation; `config` has them with all others."""

from dataclasses import dataclass

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.setting_checks import require

# Least sigmas of loop closures to decide by whether to believe them, as claimed covariances are
# mostly too small [m, m, rad].
CLOSURE_FLOORS = (0.3, 0.3, 0.05)


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """Settings of Gauss-Newton with Levenberg-Marquardt damping, for a whole graph."""

    max_iterations: int = 50
    """Maximum number of iterations."""
    step_tolerance: float = 1e-8
    """Converged if no coordinate of the next step is larger than this [m, rad]."""

    def __post_init__(self) -> None:
        if self.max_iterations < 1:
            raise ConfigError(f'SolverConfig.max_iterations: expected >= 1, '
                              f'got {self.max_iterations!r}')
        require(self, 'step_tolerance', positive=True)
