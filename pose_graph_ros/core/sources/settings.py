# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers by which measurements are kept, and how well they fit is reported."""

from typing import NamedTuple


class SourceSettings(NamedTuple):
    """Meaning and unit of each number stand beside it."""

    # --- memory, where a sender's clock is ahead or the robot is not aligned for days
    most_waiting: int = 10_000  # measurements that wait for odometry
    most_unaligned: int = 5000  # measurements that wait for the alignment; the oldest are dropped
    most_refused: int = 1000  # refused loop closures that are remembered
    most_in_second: int = 500  # measurements of a source with stamps within one second

    # --- biases
    bins: int = 64  # in one time constant of correlated errors
    white_share: float = 0.05  # of the variance, where a time constant is given
    least_own: float = 0.01  # of a variance that is not of the motion since the node, as a share
    # time without rotations after which a gyroscope may have been switched off and on again [s]
    switched_off: float = 60.0
    calibration_period: float = 10.0  # the calibration of odometry has a new state this often [s]

    # --- reports
    more_residuals: float = 0.05  # measurements after which one is renewed, as a share
    most_residuals: int = 5000  # the newest ones of a source, which are evaluated
    # mean squared residual below which whiteness is not tested [sigma^2]
    least_energy: float = 0.1
    far: float = 9.0  # mean squared residual from which on measurements fit badly [sigma^2],
    many: int = 30  # if they are so many
    least_residuals: int = 30  # for an autocorrelation
    longest_lag: float = 0.25  # as a share of the number of residuals
    next_lag: float = 1.25  # ratio of a lag to the one before
    faded: float = 0.2  # the fit ends below this share of the autocovariance at the first lag
    # correlation of consecutive residuals: in standard deviations of white noise, and the least
    significant_lag: float = 4.0
    least_correlation: float = 0.3

SOURCES = SourceSettings()
