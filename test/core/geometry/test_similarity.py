# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points are aligned by the best motion and scale there are."""

from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.similarity import fit_similarity

coordinates = st.floats(-1e3, 1e3)


@settings(max_examples=50)
@given(
    source=st.integers(2, 20).flatmap(
        lambda n: arrays(np.float64, (n, 2), elements=coordinates)),
    pose=arrays(np.float64, 3, elements=coordinates))
def test_it_recovers_any_rigid_motion(source: np.ndarray, pose: np.ndarray) -> None:
    target = se2.transform(pose, source)
    fitted = fit_similarity(source, target).pose
    np.testing.assert_allclose(se2.transform(fitted, source), target, atol=1e-6)
    if np.ptp(source, axis=0).max() > 1.0:
        np.testing.assert_allclose(
            se2.between(fitted, se2.wrapped(pose)), 0.0, atol=1e-6)


@settings(max_examples=30)
@given(
    source=arrays(np.float64, (6, 2), elements=coordinates),
    target=arrays(np.float64, (6, 2), elements=coordinates),
    other=arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)))
def test_no_other_rigid_motion_fits_better(
    source: np.ndarray, target: np.ndarray, other: np.ndarray,
) -> None:
    fitted = fit_similarity(source, target).pose
    best = np.sum((se2.transform(fitted, source) - target) ** 2)
    moved = np.sum((se2.transform(fitted + other, source) - target) ** 2)
    assert best <= moved * (1.0 + 1e-9) + 1e-6


def test_it_needs_points_and_turns_nothing_by_a_single_one() -> None:
    np.testing.assert_allclose(
        fit_similarity(np.array([[1.0, 2.0]]), np.array([[4.0, 6.0]])).pose, [3.0, 4.0, 0.0])
    for source, target in ((np.zeros((0, 2)), np.zeros((0, 2))), (np.zeros((2, 2)), np.zeros(2))):
        with pytest.raises(ValueError, match='equally many points'):
            fit_similarity(source, target)


def umeyama(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return rotation, translation and scale as in equations (39) to (43) of Umeyama 1991."""
    means = np.mean(source, axis=0), np.mean(target, axis=0)
    p, q = source - means[0], target - means[1]
    U, D, Vt = np.linalg.svd(q.T @ p / len(p))
    S = np.diag([1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R, scale = U @ S @ Vt, np.trace(np.diag(D) @ S) / np.mean(np.sum(p * p, axis=1))
    return R, means[1] - scale * R @ means[0], scale


@pytest.mark.parametrize('mirrored', [False, True])
def test_the_similarity_is_umeyamas(mirrored: bool) -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(50, 2)) * (5.0, 2.0)
    pose = np.array([1.0, -4.0, 2.5])
    target = 0.3 * se2.transform(pose, source * (1.0, -1.0 if mirrored else 1.0))
    target += 0.1 * rng.normal(size=target.shape)
    R, t, scale = umeyama(source, target)
    found = fit_similarity(source, target, with_scale=True)
    np.testing.assert_allclose(se2.rotation(found.pose[2]), R, atol=1e-12)
    np.testing.assert_allclose(found.pose[:2], t, atol=1e-12)
    assert found.scale == pytest.approx(scale, rel=1e-12)
    moved = found.apply(np.column_stack((source, np.zeros(50))))
    np.testing.assert_allclose(moved[:, :2], scale * source @ R.T + t, atol=1e-12)
