# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on sigmas, their uncertainty, and the correlation of residuals, by their laws."""

import math

from honest_drive import HonestDrive
import numpy as np
import pytest

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.cli.replay import run
from pose_graph_ros.offline.source_residuals import fit, SourceResiduals, whiteness
from pose_graph_ros.offline.variance_components import analyse, Analysis


def made(errors: np.ndarray, sigma: float, taken: float = 0.0) -> SourceResiduals:
    """Residuals of positions once a second, of which the fit takes a variance."""
    n = len(errors)
    every = np.column_stack((errors, np.zeros(n)))
    return SourceResiduals(
        'fix', 'map', np.arange(n) * 10**9, every, np.tile((True, True, False), (n, 1)),
        np.tile(sigma**2 * np.diag((1.0, 1.0, 0.0)), (n, 1, 1)),
        np.tile(taken * np.eye(3), (n, 1, 1)), np.ones(n, dtype=bool), np.ones(n),
        np.arange(n))


def autoregressive(n: int, phi: float, seed: int) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=(n, 2))
    for k in range(1, n):
        values[k] = phi * values[k - 1] + math.sqrt(1.0 - phi**2) * values[k]
    return values


@pytest.mark.parametrize('ratio', [0.3, 1.0, 3.0])
def test_the_ratio_is_that_of_true_and_claimed_sigmas(ratio: float) -> None:
    errors = 0.5 * ratio * np.random.default_rng(1).normal(size=(2000, 2))
    found = fit(made(errors, 0.5))
    assert found.ratio == pytest.approx(ratio, rel=0.04)
    assert found.low < ratio < found.high < 1.1 * found.low
    assert [row.ratio for row in found.rows] == pytest.approx([ratio] * 2, rel=0.06)
    assert [row.sigma for row in found.rows] == pytest.approx([0.5] * 2)
    assert found.energy_expected == pytest.approx(2.0)
    assert found.energy_found == pytest.approx(2.0 * ratio**2, rel=0.08)


def test_what_the_fit_takes_is_not_expected() -> None:
    """Of a variance of 1 the fit takes 0.64: the residuals are 0.6 of the errors."""
    errors = 0.6 * np.random.default_rng(2).normal(size=(4000, 2))
    found = fit(made(errors, 1.0, taken=0.64))
    assert found.redundancy == pytest.approx(0.36)
    assert found.ratio == pytest.approx(1.0, abs=0.03)
    assert found.rows[0].expected == pytest.approx(0.6)


def test_the_interval_holds_95_percent_of_all_runs_also_of_correlated_errors() -> None:
    for phi in (0.0, 0.9):
        inside = 0
        for seed in range(100):
            found = fit(made(autoregressive(300, phi, seed), 1.0))
            inside += found.low < 1.0 < found.high
        assert 86 <= inside <= 99, phi


def test_few_wrong_measurements_do_not_decide() -> None:
    errors = np.random.default_rng(3).normal(size=(1000, 2))
    errors[::100] += 50.0
    assert fit(made(errors, 1.0)).ratio == pytest.approx(1.0, abs=0.1)


def test_what_determines_the_poses_alone_says_nothing() -> None:
    errors = 0.01 * np.random.default_rng(4).normal(size=(1000, 2))
    found = fit(made(errors, 1.0, taken=1.0 - 1e-4))
    assert found.says_nothing
    assert all(math.isnan(row.ratio) for row in found.rows)
    assert fit(made(errors[:3], 1.0)).says_nothing
    assert fit(made(np.empty((0, 2)), 1.0)).says_nothing


def test_whiteness_tells_the_correlation_time_of_correlated_errors_alone() -> None:
    white = whiteness(made(np.random.default_rng(5).normal(size=(2000, 2)), 1.0))
    assert white is not None
    assert white.tau == 0.0
    assert np.mean(np.abs(white.values) < white.band) > 0.8
    correlated = whiteness(made(autoregressive(4000, math.exp(-1.0 / 20.0), 6), 1.0))
    assert correlated is not None
    assert correlated.tau == pytest.approx(20.0, rel=0.3)
    assert correlated.fitted[0] == pytest.approx(correlated.values[0], abs=0.1)
    assert whiteness(made(np.ones((10, 2)), 1.0)) is None


def analysed(settings: dict[str, float], **drive: float) -> dict[str, Analysis]:
    measurements = HonestDrive(2, **drive).measurements()  # type: ignore[arg-type]
    return analyse(run(measurements, checked(settings)).backend.parts)


@pytest.mark.parametrize(('wrong', 'ratio'), [('times', 3.0), ('odometry_times', 3.0)])
def test_all_sources_together_tell_which_one_is_wrong(wrong: str, ratio: float) -> None:
    found = analysed({'global_pose.correlation_time': 0.0}, **{wrong: ratio}, closures=0)
    source = {'times': 'global_pose', 'odometry_times': 'odom'}[wrong]
    assert found[source].fit.ratio == pytest.approx(ratio, rel=0.25)
    for other in {'global_pose', 'odom'} - {source}:
        assert found[other].fit.ratio == pytest.approx(1.0, abs=0.2)
    true = {'global_pose': 1.0, 'odom': 1.0} | {source: ratio}
    # each by itself, the other one seems to be wrong as well, or the wrong one better
    alone = {name: fit(each.residuals) for name, each in found.items()}
    together, apart = (sum(abs(math.log(fits[name].ratio / true[name])) for name in true)
                       for fits in ({name: each.fit for name, each in found.items()}, alone))
    # and both say the same of what is claimed
    for name, each in alone.items():
        assert [row.sigma for row in found[name].fit.rows] == pytest.approx(
            [row.sigma for row in each.rows], rel=1e-3)
    assert together < apart
    assert not any(each.correlated for each in found.values())
