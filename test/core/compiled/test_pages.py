# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Memory of arrays that grow."""

from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.core.compiled import pages


def resident() -> float:
    """Return the memory of this process [MB]."""
    return int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1]) * 4096e-6


DTYPE = np.dtype([('x', 'f8', (3,)), ('n', 'i4')])


@pytest.mark.parametrize('rows', [3, 100_000])
def test_arrays_are_zeros_of_their_own(rows: int) -> None:
    one, other = pages.zeros((rows, 2), DTYPE), pages.zeros((rows, 2), DTYPE)
    assert one.shape == (rows, 2)
    assert one.dtype == DTYPE
    assert not np.any(one['x'])
    one['n'] = 7
    assert not np.any(other['n'])


def test_what_was_given_back_is_zero_and_can_be_written_to_again() -> None:
    array = pages.zeros((100_000, 2), DTYPE)
    array['n'] = 7
    pages.give_back(array)
    assert not np.any(array['n'])
    array['n'] = 8
    assert np.all(array['n'] == 8)


def test_only_what_is_written_to_takes_memory() -> None:
    before = resident()
    array = pages.zeros((100_000_000,), np.float64)
    array[:5_000_000] = 1.0
    written = resident() - before
    assert 35.0 < written < 60.0
    pages.give_back(array)
    assert resident() - before < written - 35.0
