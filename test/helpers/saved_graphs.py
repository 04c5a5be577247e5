# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives whose graphs are saved, what comes in them, and the comparison of saved graphs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import BackendConfig, OdometrySource
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.measurements import Measurement, OdometrySample

SECOND = 1_000_000_000

LINE_ODOMETRY = BackendConfig(odometry={'odom': OdometrySource()})


@dataclass(frozen=True)
class Event:
    """What comes from a source."""

    source: str
    what: OdometrySample | Measurement

    def __lt__(self, other: 'Event') -> bool:
        return (self.what.stamp_ns, self.source) < (other.what.stamp_ns, other.source)


def feed(backend: PoseGraphBackend, event: Event) -> str:
    if isinstance(event.what, OdometrySample):
        return backend.add_odometry(event.what, event.source).reason
    return backend.add_measurement(event.what, event.source).reason


def feed_all(backend: PoseGraphBackend, events: Iterable[Event]) -> None:
    """Add events to a back end, with an update after every tenth and at the end."""
    for k, event in enumerate(events):
        feed(backend, event)
        if k % 10 == 0:
            backend.update()
    backend.update()


def line_sample(time: float, at: float | None = None) -> OdometrySample:
    return OdometrySample(round(time * SECOND), np.array([time if at is None else at, 0.0, 0.0]))


def straight_line(config: BackendConfig = LINE_ODOMETRY) -> PoseGraphBackend:
    """Return a back end after a drive of 9 m, from 1 s to 10 s."""
    backend = PoseGraphBackend(config)
    for k in range(91):
        backend.add_odometry(line_sample(1.0 + 0.1 * k), 'odom')
    backend.finish()
    backend.update()
    return backend


def assert_same_value(one: Any, other: Any, where: str = '') -> None:
    """Assert that two values have the same types and numbers."""
    assert type(one) is type(other), where
    if isinstance(one, GrowingArray):
        one, other = one.values, other.values
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, err_msg=where)
    elif isinstance(one, Factors):
        assert_same_value(one.columns, other.columns, where)
    elif is_dataclass(one):
        for item in fields(one):
            assert_same_value(
                getattr(one, item.name), getattr(other, item.name), f'{where}.{item.name}')
    elif isinstance(one, Mapping):
        assert one.keys() == other.keys(), where
        for name, value in one.items():
            assert_same_value(value, other[name], f'{where}.{name}')
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same_value(a, b, f'{where}[{k}]')
    else:
        assert one == other, where
