# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every array of a saved graph has the type and the shape that its annotation says."""

from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from saved_graphs import CORRELATED, feed_all
from test_delay_invariance import DRIVES

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.saved_columns import as_matrix, as_pose, Choices, Column

KINDS = {int: np.int64, float: np.float64, bool: np.bool_}


def columns(value: Any, where: str) -> Iterator[tuple[str, Column | Choices, Any]]:
    """Return all annotated columns of a saved state, at any depth."""
    for name, hint in get_type_hints(type(value), include_extras=True).items():
        inner, place = getattr(value, name), f'{where}.{name}'
        if get_origin(hint) is Annotated:
            yield place, get_args(hint)[1], inner
        elif isinstance(inner, Mapping):
            for key, each in inner.items():
                yield from columns(each, f'{place}.{key}')
        elif is_dataclass(inner):
            yield from columns(inner, place)


def test_the_columns_of_a_saved_graph_are_as_annotated() -> None:
    odometry, measurements = DRIVES[1, False]
    backend = PoseGraphBackend(CORRELATED)
    feed_all(backend, sorted(odometry + measurements)[:300])
    found = list(columns(backend.saved(), 'saved'))
    assert len(found) > 30
    for place, column, array in found:
        kind = int if isinstance(column, Choices) else column.kind
        assert array.dtype == KINDS[kind], place
        assert array.shape[1:] == getattr(column, 'shape', ()), place


def test_poses_and_matrices_become_plain_numbers_to_the_bit() -> None:
    numbers = np.array([[0.1, -0.0, 1e300], [1.0, 2.0, 3.0], [-4.0, 5e-324, 6.0]])
    for row in numbers:
        assert np.array(as_pose(row)).tobytes() == row.tobytes()
    matrix = as_matrix(numbers)
    assert np.array(matrix).tobytes() == numbers.tobytes()
    assert all(type(number) is float for row in matrix for number in row)


@pytest.mark.parametrize('shape', [(2,), (4,), (0,)])
def test_a_pose_has_three_numbers(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match='unpack'):
        as_pose(np.zeros(shape))
