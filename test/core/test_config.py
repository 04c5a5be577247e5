# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings: defaults that pass, values that cannot be, and when a node is due."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pose_graph_ros.core.config import (
    AlignmentPolicy,
    BackendConfig,
    CovariancePolicy,
    Loss,
    MeasurementSource,
    NodePolicy,
    OdometryNoise,
    OdometrySource,
    SolverConfig,
)
from pose_graph_ros.core.exceptions import ConfigError

NUMBERS = [(kind, item.name)
           for kind in (NodePolicy, OdometryNoise, OdometrySource, CovariancePolicy,
                        MeasurementSource, AlignmentPolicy, SolverConfig, BackendConfig)
           for item in fields(kind) if isinstance(getattr(kind(), item.name), float)]


@pytest.mark.parametrize(('kind', 'name'), NUMBERS)
@pytest.mark.parametrize('value', [-0.5, np.nan, np.inf, -np.inf])
def test_no_setting_is_negative_or_not_finite(kind: type, name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f'{kind.__name__}.{name}: expected .* got {value}'):
        replace(kind(), **{name: value})


@pytest.mark.parametrize(('kind', 'name', 'value'), [
    (MeasurementSource, 'loss', 'huber'), (OdometrySource, 'loss', 1),
    (OdometrySource, 'noise_from', 'twist'),
    (CovariancePolicy, 'heading', Loss.NONE)])
def test_a_choice_is_a_member_of_its_enumeration(kind: type, name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f'{kind.__name__}.{name}: expected one of .*, got'):
        kind(**{name: value})


@pytest.mark.parametrize(('distance', 'turned', 'elapsed', 'due'), [
    (0.0, 0.0, 0.0, False),
    (1.0, 0.0, 0.2, True),
    (1.0, 0.0, 0.1, False),      # too soon
    (0.9, 0.29, 1.9, False),     # too little
    (0.0, 0.3, 0.2, True),
    (0.1, 0.0, 2.0, True),       # slow, but moving
    (0.0, 0.1, 2.0, True),
    (0.04, 0.04, 9.9, False),    # odometry that jitters at rest
    (0.0, 0.0, 10.0, True),      # the heartbeat
])
def test_a_node_is_due_after_enough_motion_or_time(
    distance: float, turned: float, elapsed: float, *, due: bool,
) -> None:
    policy = NodePolicy(minimum_travel_distance=1.0, minimum_travel_heading=0.3,
                        minimum_interval=0.2, moving_interval=2.0, heartbeat=10.0)
    assert policy.due(distance, turned, elapsed) == due
