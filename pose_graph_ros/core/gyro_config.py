# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of what measures velocities, gyroscopes and twists; see `config`."""

from dataclasses import dataclass
from enum import Enum

from pose_graph_ros.core.setting_checks import require, require_member


class Integrate(Enum):
    """What the motion by odometry is taken from."""

    POSE = 'pose'
    """The pose in each message."""
    TWIST = 'twist'
    """The twist in each message, integrated over the time between messages."""


class RateNoise(Enum):
    """Source of the noise of a gyroscope."""

    MESSAGE = 'message'
    """Variance of the rate in each message, if it is positive, else `sigma_rate`."""
    MODEL = 'model'
    """`sigma_rate`."""


@dataclass(frozen=True, slots=True)
class GyroSource:
    """
    Settings of a gyroscope, whose yaw rate is integrated between hidden nodes.

    Its error is white noise and a bias, which is a random walk.
    """

    noise_from: RateNoise = RateNoise.MESSAGE
    sigma_rate: float = 1e-3
    """White noise of the rate, as the angle random walk that it integrates to [rad/sqrt(s)]."""
    sigma_bias: float = 0.02
    """Sigma of the bias when the sensor is switched on [rad/s]."""
    sigma_bias_walk: float = 3e-5
    """Random walk of the bias [rad/s/sqrt(s)]."""
    sigma_turn: float = 2e-3
    """Error of the scale, as a random walk by turns [rad/sqrt(rad)]."""
    bias_period: float = 10.0
    """The bias has a new state this often [s]."""
    maximum_gap: float = 0.25
    """Longest time between two samples over which the rate is integrated [s]."""
    covariance_scale: float = 1.0
    """Factor on the variance of every integrated angle."""
    reorder_window: float = 0.25
    """A sample that is older by stamp than the newest one by up to this is still used [s]."""

    def __post_init__(self) -> None:
        require(self, 'sigma_rate', 'sigma_bias', 'sigma_bias_walk', 'bias_period', 'maximum_gap',
                'covariance_scale', positive=True)
        require(self, 'reorder_window', 'sigma_turn')
        require_member(self, 'noise_from', RateNoise)
