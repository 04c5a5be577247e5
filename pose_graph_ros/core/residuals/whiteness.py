# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether the residuals of a source are independent, and the correlation time that they suggest.

The time constant is that of `sources.autocorrelation`. As residuals are smaller than errors, it
comes out a little too small where the graph treats the errors as independent.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.residuals.source_residuals import SourceResiduals
from pose_graph_ros.core.sources import autocorrelation

# Number of the newest residuals that are used.
MOST_RESIDUALS = 20_000
# Half the width of the 95 % band of the autocorrelation of independent residuals, times sqrt(n).
BAND = 1.96


class Whiteness(NamedTuple):
    """Autocorrelation of the normalised residuals of a source."""

    lags: FloatArray
    """Shape (L,) [s]."""
    values: FloatArray
    """Shape (L,), from -1 to 1."""
    band: float
    """Values of independent residuals are between plus and minus this at 95 % of the lags."""
    tau: float
    """Time constant of the correlated part [s]; 0 if nothing is significant."""
    fitted: FloatArray
    """Model with this time constant at the lags, shape (L,); zeros without one."""


def whiteness(residuals: SourceResiduals) -> Whiteness | None:
    """Return the autocorrelation of the used residuals; None of fewer than 30 or of one stamp."""
    used = residuals.rows(np.flatnonzero(residuals.used)[-MOST_RESIDUALS:])
    used = used.rows(np.diff(used.stamps_ns, prepend=-1) > 0)
    if len(used.ids) < autocorrelation.LEAST_RESIDUALS:
        return None
    columns = np.flatnonzero(np.all(used.measured, axis=0))
    # a position has two coordinates of the same statistics; a heading is in other units
    columns = columns[columns < 2] if np.any(columns < 2) else columns
    if len(columns) == 0:
        return None
    values = used.errors[:, columns] / used.sigmas[:, columns]
    period = float(np.median(np.diff(used.stamps_ns))) * 1e-9
    variance = float(np.mean(values**2))
    if variance <= 0.0:
        return None
    lags, covariance = autocorrelation.autocovariances(used.stamps_ns, values)
    found = autocorrelation.estimate(used.stamps_ns, values)
    fitted = (found.sigma_correlated**2 / variance * np.exp(-lags * period / found.tau)
              if found.significant else np.zeros(len(lags)))
    return Whiteness(np.asarray(lags * period, dtype=np.float64), covariance / variance,
                     BAND / math.sqrt(values.size), found.tau, fitted)
