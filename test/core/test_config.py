# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings: defaults that pass, values that cannot be, and when a node is due."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pose_graph_ros.core.config import (
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
                        MeasurementSource, SolverConfig, BackendConfig)
           for item in fields(kind) if isinstance(getattr(kind(), item.name), float)]


@pytest.mark.parametrize(('kind', 'name'), NUMBERS)
@pytest.mark.parametrize('value', [-0.5, np.nan, np.inf, -np.inf])
def test_no_setting_is_negative_or_not_finite(kind: type, name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f'{kind.__name__}.{name}: expected .* got {value}'):
        replace(kind(), **{name: value})


@pytest.mark.parametrize(('kind', 'name', 'value'), [
    (MeasurementSource, 'loss', 'huber'), (MeasurementSource, 'loss', 1),
    (OdometrySource, 'noise_from', 'twist'),
    (CovariancePolicy, 'heading', Loss.NONE)])
def test_a_choice_is_a_member_of_its_enumeration(kind: type, name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f'{kind.__name__}.{name}: expected one of .*, got'):
        kind(**{name: value})
