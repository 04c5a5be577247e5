# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The numbers by which measurements are kept, and the errors of their sources estimated."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """Meaning and unit of each number stand beside it."""

    # --- memory, where a sender's clock is ahead or the robot is not aligned for days
    most_waiting: int = 10_000  # measurements that wait for odometry
    most_unaligned: int = 5000  # measurements that wait for the alignment; the oldest are dropped
    most_refused: int = 1000  # refused loop closures that are remembered

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

    # --- search of the statistics of the errors of a source, and of odometry
    newest_positions: int = 2000  # that are used, and
    older_positions: int = 2000  # as many of all before them
    least_positions: int = 10
    kept_positions: int = 1000  # that have left the graph, when some are dropped
    per_step: int = 5000  # positions that are filtered in one step, of 0.3 us each
    nodes_per_step: int = 10_000  # nodes that are joined in one, of 0.1 us each
    # How much more likely something must be, in twice the difference of the logarithms: correlated
    # errors, which must only be more likely once they are believed, so that it does not flip to
    # and fro; and these for each time that the filter was lost, as odometry was wrong then.
    significant: float = 20.0
    per_lost: float = 100.0
    # The errors of odometry. The constant ones are states with a prior, which by itself keeps them
    # from being believed where little shows them. Beside correlated errors, which may be taken for
    # them, it is `significant`.
    significant_odometry: float = 6.0
    # one factor on its noise; and how much less likely larger ones may be
    significant_scale: float = 4.0
    # longest time constant, in times from the first to the last measurement: a shorter bound would
    # make the variance of an error that hardly changes in this time too small
    longest_time: float = 16.0
    least_shared: float = 0.2  # least correlation of consecutive measurements that matters
    # sigmas of logarithms before they are seen: of the total variance in units of the claimed one;
    # of white errors that are smaller, as the rest of the claim is mostly an error that changes
    # slowly; of the noise of way and of turn, as settings of turns are hardly ever known
    spread: float = 0.7
    smaller_spread: float = 0.5
    way_spread: float = 2.0
    turn_spread: float = 3.0
    # exponents of 2 on the lattice: smallest step, and bounds of the variances
    finest: float = 0.25
    least_exponent: float = -10.0
    most_exponent: float = 8.0
    # Those that searches begin with: correlated and white part; way and turn, also less than white
    # errors need; way and turn beside white errors.
    beginnings: tuple[tuple[float, float], ...] = (
        (0.0, -5.0), (0.0, -3.0), (-0.5, -2.0), (-1.0, -1.0))
    odometry_beginnings: tuple[tuple[float, float], ...] = ((0.0, 0.0), (-4.0, -4.0))
    white_beginnings: tuple[float, ...] = (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)
    headings: int = 16  # at which the filter starts; the best one is used


SOURCES = SourceSettings()
