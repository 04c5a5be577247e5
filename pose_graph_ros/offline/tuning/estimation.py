# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of all sources of odometry and of all that measure in the map, from one drive."""

from collections.abc import Callable, Mapping

import numpy as np

from pose_graph_ros.core.config import BackendConfig, NoiseFrom
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.timeline import OdometryTimeline
from pose_graph_ros.offline.tuning import likelihood as lk
from pose_graph_ros.offline.tuning.drive_rows import drive_rows, Measured, odometry_noise
from pose_graph_ros.offline.tuning.fit import Fit, fit
from pose_graph_ros.offline.tuning.problem import Parameter, Problem, Role

# Number of measurements of each source that are used; of more, every second, third, ...
MOST = 2000
# Least path by odometry that can tell of its noise [m].
LEAST_PATH = 5.0


def estimate(
    odometry: Mapping[str, OdometryTimeline], sources: Mapping[str, Measured],
    config: BackendConfig, tick: Callable[[], None] = lambda: None,
) -> dict[str, Fit]:
    """
    Return a fit for each source of odometry; only the first one has those of the other sources.

    Parameters
    ----------
    odometry : mapping, the primary one first
    sources : mapping, what was measured in the map; the indices of the fits are by this order
    config : BackendConfig, the settings
    tick : callable, called at each evaluation

    """
    thinned = {name: _thinned(of) for name, of in sources.items()}
    fits: dict[str, Fit] = {}
    errors = np.tile([1.0, 0.0, 1.0, 1.0], (len(sources), 1))
    for name, timeline in odometry.items():
        settings = config.odometry_source(name)
        sigmas = odometry_noise(settings)
        rows = drive_rows(timeline, thinned, config)
        if not np.any((rows.source >= 0) & (rows.rows[:, lk.XX] > 0.0)):
            continue
        numbers = [lk.GIVEN] if settings.noise_from is NoiseFrom.TWIST else range(4)
        parameters = [Parameter(Role.ODOMETRY, k, float(sigmas[k])) for k in numbers
                      if sigmas[k] > 0.0]
        if np.sum(rows.rows[:, lk.LENGTH]) < LEAST_PATH:
            parameters = []     # it stood
        if len(fits) == 0:
            parameters += [Parameter(role, k, 1.0) for k, of in enumerate(sources.values())
                           for role, there in ((Role.WHITE, of.has_positions),
                                               (Role.HEADING, of.has_headings)) if there]
        problem = Problem(rows, sigmas**2, errors, tick)
        fits[name] = fit(problem, parameters)
        if len(fits) == 1:
            errors = _errors(fits[name], len(sources))
    return fits


def _thinned(of: Measured) -> Measured:
    stride = -(-len(of.stamps_ns) // MOST)
    return Measured(of.stamps_ns[::stride], of.values[::stride]) if stride > 1 else of


def _errors(found: Fit, count: int) -> FloatArray:
    """Return the statistics of the errors of the sources, shape (S, 4)."""
    errors = np.empty((count, lk.N_SOURCE))
    for k, row in enumerate(errors):
        correlated = found.value(Role.CORRELATED, k, 0.0)
        white = found.value(Role.WHITE, k, 1.0)
        row[:] = (found.value(Role.TAU, k, 1.0), correlated,
                  found.value(Role.SHARE, k, 0.0) * correlated or white,
                  found.value(Role.HEADING, k, 1.0))
    return errors
