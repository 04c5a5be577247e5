# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The TUM format: stamps keep their nanoseconds, headings become quaternions."""

from pathlib import Path

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import random_poses
from tum_files import read_tum

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.path_files import write_tum

# Rounding of a heading by the sine and cosine of its half [rad].
HEADING = 1e-15

stamps_ns = st.lists(st.integers(-2**61, 2**62), min_size=0, max_size=8, unique=True).map(sorted)


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('tum')


@given(stamps_ns, st.integers(0, 999))
def test_a_trajectory_comes_back(folder: Path, stamps: list[int], seed: int) -> None:
    trajectory = Trajectory(stamps, random_poses(np.random.default_rng(seed), len(stamps), 5e6))
    path = folder / 'round_trip.tum'
    write_tum(trajectory, path)
    back = read_tum(path)
    np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_array_equal(back.poses[:, :2], trajectory.poses[:, :2])
    np.testing.assert_allclose(
        se2.wrap(back.poses[:, 2] - trajectory.poses[:, 2]), 0.0, atol=HEADING)
