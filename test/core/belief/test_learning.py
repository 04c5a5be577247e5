# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The noise of sources and of odometry: the density by an oracle, what is found, what is not."""

import numpy as np
import numpy.typing as npt
import pytest

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.belief.bank import Bank, Odometry
from pose_graph_ros.core.belief.filter import log_density
from pose_graph_ros.core.belief.learning import (
    axes_of,
    claimed,
    Found,
    Known,
    Learnt,
    log_prior,
    moved,
    NO_SLOW,
    noise_at,
    search,
    TURN,
    WAY,
)
from pose_graph_ros.core.belief.rows import MEASURED
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import upper
from pose_graph_ros.core.odometry.motion import AS_CLAIMED
from pose_graph_ros.core.sources.bias import CorrelatedErrors

SECOND = 1_000_000_000
ALL = Known(claimed(1), odometry=True, sources=(0,))


def errors(
    rng: np.random.Generator, n: int, period: float, tau: float, white: float,
) -> np.ndarray:
    """Return errors of variance 1, shape (n, 2), of which a part is white; all for a tau of 0."""
    noise = rng.standard_normal((n, 2))
    if tau == 0.0:
        return noise
    kept, slow = np.exp(-period / tau), rng.standard_normal((n, 2))
    for k in range(1, n):
        slow[k] = kept * slow[k - 1] + np.sqrt(1.0 - kept**2) * slow[k]
    return np.sqrt(1.0 - white) * slow + np.sqrt(white) * noise


def a_drive(
    seed: int, *, n: int = 200, period: float = 1.0, tau: float = 0.0, white: float = 0.1,
    sigma: float = 1.0, drift: float = 1.0, wrong: float = 0.0, turns: float = 1.0,
    speed: float = 1.0, longer: float = 0.0, rate: float = 0.0,
) -> Bank:
    """
    Return a bank with the positions of a drive, of a claimed sigma of 1 m.

    The noise of odometry is `drift` times what it says, that of turns `turns` times that; it takes
    the way for `longer`, and turns by `rate` [rad/s] more.
    """
    rng = np.random.default_rng(seed)
    steps = np.column_stack((np.full(n, speed * period), np.zeros(n), 0.1 * np.sin(np.arange(n))))
    cov = speed * period * np.diag((0.0025, 0.0009, 1e-4))
    slips = drift * rng.standard_normal((n, 3)) * np.sqrt(np.diagonal(cov)) * (1.0, 1.0, turns)
    told = steps * (1.0 + longer, 1.0, 1.0) + (0.0, 0.0, rate * period)
    true, seen = np.zeros((n, 3)), np.zeros((n, 3))
    true[0, 2] = rng.uniform(-3.0, 3.0)
    for k in range(1, n):
        true[k] = se2.compose(true[k - 1], se2.compose(steps[k], slips[k]))
        seen[k] = se2.compose(seen[k - 1], told[k])
    rows = np.zeros(n, MEASURED)
    rows['mean'][:, :2] = true[:, :2] + sigma * errors(rng, n, period, tau, white)
    jumps = rng.random(n) < wrong
    rows['mean'][jumps, :2] += rng.uniform(-50.0, 50.0, (np.sum(jumps), 2))
    rows['id'] = rows['node'] = np.arange(n)
    rows['stamp_ns'] = stamps_ns = (period * SECOND * np.arange(n)).astype(np.int64)
    rows['judged'], rows['slow'], rows['noise'] = 1, 1.0, (1.0, 0.0, 1.0)
    adjoint = se2.adjoint(seen[1:])
    sums = np.cumsum(adjoint @ cov @ np.swapaxes(adjoint, 1, 2), axis=0)
    bank = Bank()
    bank.insert(rows, Odometry(np.arange(n), seen, np.vstack((np.zeros(6), upper(sums))).copy(),
                               np.arange(n), stamps_ns, AS_CLAIMED))
    return bank


def found(bank: Bank, known: Known = ALL) -> Learnt:
    return to_the_end(search(bank, known)).best


def errors_in(bank: Bank) -> CorrelatedErrors | None:
    return found(bank).errors(0)


@pytest.mark.parametrize('constant', [False, True])
def test_the_density_is_that_of_the_full_covariance(*, constant: bool) -> None:
    """On a straight line with a known heading the positions are jointly Gaussian."""
    n, tau, slow, odometry, white = 12, 7.0, 0.8, 1.5, 0.3
    rng = np.random.default_rng(0)
    seconds = np.cumsum(rng.uniform(0.5, 2.0, n))
    variance = np.full(n, 1.3)
    rows = np.zeros(n, MEASURED)
    rows['mean'][:, 0] = np.arange(n)
    rows['mean'][:, :2] += 0.3 * rng.standard_normal((n, 2))
    rows['slow'], rows['noise'] = variance, variance[:, None] * (1.0, 0.0, 1.0)
    rows['motion'], rows['way'] = (1.0, 0.0, 0.0), (0.04, 0.0, 0.09)
    since = np.diff(seconds, prepend=0.0)
    rows['lever'] = np.column_stack((np.zeros(n), 0.5 * since, since))
    sigma = np.sqrt(variance)
    bias = slow * np.outer(sigma, sigma) * np.exp(
        -np.abs(np.subtract.outer(seconds, seconds)) / tau)
    steps = np.minimum.outer(np.arange(n), np.arange(n))
    # what a heading that grows in time makes of the way so far
    swept = np.append(0.0, np.cumsum(0.5 * (seconds[1:] + seconds[:-1]) - seconds[0]))
    expected = -n * np.log(2.0 * np.pi) + n * np.log(1.0 - BANK.outliers)
    for axis, own, first, each, shape in ((0, 0.04, 0.0, BANK.scale**2, np.arange(n)),
                                          (1, 0.09, 0.1, BANK.rate**2, swept)):
        # the position at the start is unknown; a wrong heading there turns the whole line
        full = (bias + white * np.diag(variance) + odometry * own * steps
                + 1e4 * variance[0] + first * np.outer(np.arange(n), np.arange(n))
                + constant * each * np.outer(shape, shape))
        off = rows['mean'][:, axis] - np.arange(n) * (axis == 0) - rows['mean'][0, axis]
        expected -= 0.5 * (np.linalg.slogdet(full)[1] + off @ np.linalg.solve(full, off))
    noise = noise_at((np.log2(odometry), 1.0, np.log2(white), np.log2(slow), np.log2(tau)))
    constants = np.array((0.0, 0.0, BANK.rate**2, BANK.scale**2)) * constant
    density = log_density(rows, np.zeros(n), 1, noise, 0.0, constants)
    assert density == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(('tau', 'period', 'n'), [
    (10.0, 2.0, 300), (60.0, 1.0, 400), (60.0, 5.0, 300)])
def test_the_time_constant_is_found_within_a_factor(tau: float, period: float, n: int) -> None:
    every = [errors_in(a_drive(seed, n=n, period=period, tau=tau)) for seed in range(3)]
    known = [each for each in every if each is not None]
    assert len(known) == 3
    assert tau / 2.5 < np.median([each.tau for each in known]) < 2.5 * tau
    assert all(0.4 < each.correlated + each.white < 3.0 for each in known)
    assert all(each.white < 0.3 for each in known)


@pytest.mark.parametrize('settings', [
    {}, {'n': 30}, {'period': 5.0}, {'sigma': 2.0}, {'sigma': 0.7}, {'drift': 0.3},
    {'drift': 3.0}, {'wrong': 0.2}], ids=str)
def test_white_errors_are_not_taken_for_slow_ones(settings: dict[str, float]) -> None:
    """Nor the drift of odometry that is better or worse than it says, nor wrong positions."""
    taken = [errors_in(a_drive(seed, **settings)) for seed in range(5)]
    assert sum(each is not None for each in taken) <= 1     # by chance in one of a hundred


@pytest.mark.parametrize('settings', [
    {'drift': 0.1}, {'drift': 0.1, 'longer': 0.01}, {'drift': 0.1, 'rate': 0.002},
    {'drift': 0.3, 'turns': 3.0}, {'drift': 1.0, 'turns': 0.1}, {'drift': 3.0},
    {'drift': 3.0, 'wrong': 0.2}], ids=str)
def test_the_noise_of_way_and_turns_and_constant_errors_are_found(
    settings: dict[str, float],
) -> None:
    every = [found(a_drive(seed, n=400, speed=8.0, **settings)).odometry() for seed in range(5)]
    way = settings['drift']
    turn = way * settings.get('turns', 1.0)
    for each in every:
        assert 0.7 * way < np.sqrt(each.way) < max(1.5, 1.5 * way)  # fixes of 1 m hardly show it
        assert 0.5 * turn < np.sqrt(each.turn) < 4.0 * turn
    assert np.median([each.rate for each in every]) == pytest.approx(
        -settings.get('rate', 0.0), abs=5e-4 * max(turn, 1.0))
    assert np.median([each.scale for each in every]) == pytest.approx(
        -settings.get('longer', 0.0), abs=3e-3 * max(way, 1.0))  # wrong headings shorten the way


def test_what_is_given_is_not_learnt() -> None:
    bank = a_drive(1, n=300, drift=3.0, sigma=2.0)
    given = moved(claimed(1), {WAY: 2.0, TURN: 1.0})
    best = found(bank, Known(given, odometry=False, sources=(0,)))
    assert best.point[:2] == given[:2]
    assert best.point[axes_of(0)[0]] > 0.5
    assert found(bank, Known(given, odometry=True, sources=())).point[2:] == given[2:]
    assert np.all(best.constants == 0.0)


def test_evidence_counts_what_a_prior_says_and_prefers_the_truth() -> None:
    bank = a_drive(3, n=300, drift=3.0)
    every = to_the_end(search(bank, ALL)).every
    best = max(every.values(), key=lambda each: each.evidence)
    assert best.point[WAY] > 2.0
    assert best.point[3] == NO_SLOW
    for each in every.values():
        again = bank.again(noise_at(each.point), learns=True)
        again.decide()
        assert each.evidence == pytest.approx(again.evidence + log_prior(each.point, ALL))


def test_the_newest_measurements_are_learnt_from_alone() -> None:
    bank = a_drive(3, n=600)
    bank.decide()
    later: npt.NDArray[np.void] = bank.rows.copy()
    best = to_the_end(search(bank, ALL, newest=100)).best
    assert best.errors(0) is None
    assert np.array_equal(bank.rows, later)     # the bank stays as it is


def test_evidence_is_that_of_all_measurements_with_their_full_covariance() -> None:
    """Also of those that follow so closely that they decide nothing."""
    n, tau, slow, white, way = 40, 7.0, 0.8, 0.3, 2.0
    rng, seconds = np.random.default_rng(0), 0.25 * np.arange(n)
    rows = np.zeros(n, MEASURED)
    rows['id'] = rows['node'] = np.arange(n)
    rows['stamp_ns'] = stamps_ns = (SECOND * seconds).astype(np.int64)
    rows['slow'], rows['noise'] = 1.0, (1.0, 0.0, 1.0)
    rows['mean'][:, :2] = rng.standard_normal((n, 2))
    rows['mean'][:, 0] += np.arange(n)
    poses = np.arange(n)[:, None] * (1.0, 0.0, 0.0)
    sums = np.arange(n)[:, None] * (0.04, 0.0, 0.0, 0.04, 0.0, 1e-18)
    bank = Bank(noise_at((np.log2(way), 0.0, np.log2(white), np.log2(slow), np.log2(tau))))
    bank.begin_with(0, np.zeros(3), np.diag((4.0, 4.0, 1e-12)))
    bank.insert(rows, Odometry(
        np.arange(n), poses, sums, np.arange(n), stamps_ns, AS_CLAIMED))
    learning = bank.again(bank.noise, learns=True)
    learning.decide()
    steps = np.minimum.outer(np.arange(n), np.arange(n))
    common = slow * np.exp(-np.abs(np.subtract.outer(seconds, seconds)) / tau) + (
        white * np.eye(n) + 4.0 + way * 0.04 * steps)
    rest = seconds[-1] // 1 * (1.0 / BANK.between_faults + 1.0 / BANK.between_slips)
    expected = -n * np.log(2.0 * np.pi) + n * np.log(1.0 - BANK.outliers) - rest
    lever = 0.5 * seconds * np.arange(n)    # what the rate has turned the way by
    for off, constant in ((rows['mean'][:, 0] - np.arange(n), BANK.scale * np.arange(n)),
                          (rows['mean'][:, 1], BANK.rate * lever)):
        full = common + np.outer(constant, constant)
        expected -= 0.5 * (np.linalg.slogdet(full)[1] + off @ np.linalg.solve(full, off))
    assert learning.evidence == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize('seed', range(3))
def test_noise_by_which_hardly_anything_is_believed_is_not_the_best(seed: int) -> None:
    """Positions at 4 Hz with slow errors, and odometry that could as well be far worse."""
    bank = a_drive(seed, n=400, period=0.25, tau=30.0, sigma=2.0, white=0.02)
    worse = (5.0, 7.0, -6.0, NO_SLOW, 0.0)
    best = to_the_end(search(bank, ALL, begins=[worse])).best
    assert best.point[3] > NO_SLOW
    assert max(best.point[:2]) < 3.0


def test_where_other_noise_leads_to_spreads_the_newest_pose_by_its_evidence() -> None:
    def learnt(turn: float, evidence: float, variance: float, *pose: float) -> Learnt:
        return Learnt((0.0, turn), evidence, np.zeros(4), np.array(pose), variance * np.eye(3))
    best, other = learnt(0.0, -10.0, 1.0, 1.0, 2.0, 3.1), learnt(4.0, -11.0, 5.0, 21.0, 2.0, -3.1)
    found = Found(best, {each.point: each for each in (best, other)})
    off, weight = np.array((20.0, 0.0, 2.0 * np.pi - 6.2)), 1.0 / (1.0 + np.e)
    expected = weight * (np.outer(off, off) + 4.0 * np.eye(3))
    expected[:2, 2] = expected[2, :2] = 0.0     # where the robot was is not where it is used
    np.testing.assert_allclose(found.spread(best), expected, atol=1e-12)
    # what is known better by other noise is not known worse
    assert np.all(np.linalg.eigvalsh(found.spread(other))[:2] < 0.01)
    assert found.instead_of(other.point) is other, 'too little speaks against it'
    hopeless = other._replace(evidence=-50.0)
    found = Found(best, {each.point: each for each in (best, hopeless)})
    np.testing.assert_allclose(found.spread(best), 0.0, atol=1e-9)
    assert found.instead_of(hopeless.point) is best


def test_the_spread_by_noise_is_added_to_that_by_hypotheses_and_outlives_the_noise() -> None:
    bank, noise = a_drive(0, n=40), noise_at(claimed(1))
    bank.decide()
    before, bank.by_noise = bank.spread, np.diag((4.0, 4.0, 0.01))
    again = bank.again(noise)
    again.decide()
    np.testing.assert_allclose(again.spread.pose, before.pose)
    np.testing.assert_allclose(again.spread.covariance - before.covariance, bank.by_noise)


@pytest.mark.parametrize('seed', range(2))
def test_larger_slow_errors_are_tried_and_make_the_newest_pose_less_sure(seed: int) -> None:
    bank = a_drive(seed, n=400, period=0.25, tau=30.0, sigma=2.0, white=0.02)
    found = to_the_end(search(bank, ALL))
    best = found.best
    assert best.point[3] > NO_SLOW
    larger = [each for each in found.every.values() if each.point[3] >= best.point[3] + 1.0]
    assert max(each.evidence for each in larger) > best.evidence - 10.0
    alone = Found(best, {point: each for point, each in found.every.items()
                         if each not in larger})
    assert np.trace(found.spread(best)) > np.trace(alone.spread(best))
