# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The statistics of errors: the likelihood by an oracle, what is found, and what is not."""

from dataclasses import replace
import itertools

import numpy as np
import pytest

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import (
    FactorKind,
    Factors,
    upper,
)
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, OdometryErrors
from pose_graph_ros.core.sources import error_estimate
from pose_graph_ros.core.sources.error_estimate import measured_path, PathOdometry, search
from pose_graph_ros.core.sources.error_likelihood import (
    chain_motions,
    filtered,
    MeasuredPath,
    NO_ODOMETRY,
    RATE_VARIANCE,
    SCALE_VARIANCE,
)
from pose_graph_ros.core.sources.settings import SOURCES

SECOND = 1_000_000_000


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
    seed: int, *, n: int = 200, period: float = 1.0, tau: float = 0.0, white: float = 0.05,
    sigma: float = 1.0, drift: float = 1.0, wrong: float = 0.0, turns: float = 1.0,
    speed: float = 1.0, longer: float = 0.0, rate: float = 0.0,
) -> MeasuredPath:
    """
    Return a drive with positions of a claimed sigma of 1 m.

    The noise of odometry is `drift` times what it says, that of turns `turns` times that; it takes
    the way for `longer`, and turns by `rate` [rad/s] more.
    """
    rng = np.random.default_rng(seed)
    steps = np.column_stack((
        np.full(n, speed * period), np.zeros(n), 0.1 * np.sin(np.arange(n))))
    cov = speed * period * np.diag((0.0025, 0.0009, 1e-4))
    slips = drift * rng.standard_normal((n, 3)) * np.sqrt(np.diagonal(cov)) * (1.0, 1.0, turns)
    true = np.zeros((n, 3))
    true[0, 2] = rng.uniform(-3.0, 3.0)
    for k in range(1, n):
        true[k] = se2.compose(true[k - 1], se2.compose(steps[k], slips[k]))
    seen = true[:, :2] + sigma * errors(rng, n, period, tau, white)
    jumps = rng.random(n) < wrong
    seen[jumps] += rng.uniform(-50.0, 50.0, (np.sum(jumps), 2))
    told = steps * (1.0 + longer, 1.0, 1.0) + (0.0, 0.0, rate * period)
    return MeasuredPath(period * np.arange(n), seen, np.ones(n), np.zeros((n, 2)), told,
                        np.tile(cov, (n, 1, 1)), np.tile((cov[0, 0], 0.0, cov[1, 1]), (n, 1)),
                        levers(told, np.full(n, period)), np.zeros((n, 2)))


def levers(motion: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Return how a yaw rate changes short motions."""
    return np.column_stack((-0.5 * seconds * motion[:, 1], 0.5 * seconds * motion[:, 0], seconds))


@pytest.mark.parametrize('constant', [False, True])
def test_the_likelihood_is_that_of_the_full_covariance(*, constant: bool) -> None:
    """On a straight line with a known heading the positions are jointly Gaussian."""
    n, tau, correlated, odometry, white = 12, 7.0, 0.8, 1.5, 0.3
    rng = np.random.default_rng(0)
    cov = np.diag((0.04, 0.09, 1e-12))
    seconds = np.cumsum(rng.uniform(0.5, 2.0, n))
    variance = rng.uniform(0.5, 2.0, n)
    position = np.column_stack((np.arange(n), np.zeros(n))) + 0.3 * rng.standard_normal((n, 2))
    given = MeasuredPath(seconds, position, variance, np.zeros((n, 2)),
                         np.tile((1.0, 0.0, 0.0), (n, 1)), np.tile(cov, (n, 1, 1)),
                         np.tile((0.04, 0.0, 0.09), (n, 1)), np.zeros((n, 3)), np.zeros((n, 2)))
    given = given._replace(lever=levers(given.motion, np.diff(seconds, prepend=0.0)))
    sigma = np.sqrt(variance)
    bias = correlated * np.outer(sigma, sigma) * np.exp(
        -np.abs(np.subtract.outer(seconds, seconds)) / tau)
    steps = np.minimum.outer(np.arange(n), np.arange(n))

    # what a heading that grows in time makes of the way so far
    swept = np.append(0.0, np.cumsum(0.5 * (seconds[1:] + seconds[:-1]) - seconds[0]))

    expected = 0.0
    for axis, first, slow, shape in ((0, 0.0, SCALE_VARIANCE, np.arange(n)),
                                     (1, 0.1, RATE_VARIANCE, swept)):
        # the position at the start is unknown; a wrong heading there turns the whole line
        full = (bias + white * np.diag(variance) + odometry * cov[axis, axis] * steps
                + 1e4 * variance[0] + first * np.outer(np.arange(n), np.arange(n))
                + constant * slow * np.outer(shape, shape))
        off = position[:, axis] - np.arange(n) * (axis == 0) - position[0, axis]
        expected += np.linalg.slogdet(full)[1] + off @ np.linalg.solve(full, off)
    found, n_lost, *_ = filtered(
        *given, tau, correlated, odometry, 3.0, white, 0.0, constant)   # no noise of turns
    assert n_lost == 0
    assert found == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(('tau', 'period', 'n'), [
    (5.0, 0.5, 200), (10.0, 5.0, 120), (60.0, 1.0, 400), (60.0, 5.0, 120), (300.0, 1.0, 900)])
def test_the_time_constant_is_found_within_a_factor(tau: float, period: float, n: int) -> None:
    found = [to_the_end(search(a_drive(seed, n=n, period=period, tau=tau))).errors
             for seed in range(3)]
    known = [each for each in found if each is not None]
    assert len(known) == 3
    assert tau / 2.5 < np.median([each.tau for each in known]) < 2.5 * tau
    assert all(0.4 < each.correlated + each.white < 3.0 for each in known)
    assert all(each.white < 0.3 for each in known)


@pytest.mark.parametrize('settings', [
    {}, {'n': 30}, {'n': 60, 'period': 0.1}, {'period': 5.0}, {'sigma': 2.0}, {'sigma': 0.7},
    {'drift': 0.3}, {'drift': 3.0}, {'wrong': 0.2}], ids=str)
def test_white_errors_are_not_taken_for_correlated_ones(settings: dict[str, float]) -> None:
    """Nor the drift of odometry that is better or worse than it says, nor wrong positions."""
    taken = [to_the_end(search(a_drive(seed, **settings))).errors for seed in range(12)]
    assert sum(errors is not None for errors in taken) <= 1     # by chance in one of a hundred


def test_errors_are_not_taken_for_white_or_correlated_to_and_fro() -> None:
    """It takes much to believe that they are correlated, and then much less to go on so."""
    changes = []
    for seed in range(6):
        # odometry whose headings say little, so that not much speaks for either
        whole, taken = a_drive(seed, n=400, tau=30.0, white=0.3, speed=5.0), [False]
        for n in (40, 52, 68, 88, 115, 150, 195, 253, 329, 400):
            drive = MeasuredPath(*(each[:n] for each in whole))
            taken.append(to_the_end(search(drive, correlated=taken[-1])).errors is not None)
        changes.append(sum(one != other for one, other in itertools.pairwise(taken)))
    assert max(changes) <= 1


@pytest.mark.parametrize(('drift', 'tau', 'n'), [
    (1.0, 0.0, 200), (1.0, 60.0, 400), (0.3, 60.0, 400), (2.0, 0.0, 600), (3.0, 0.0, 400),
    (3.0, 60.0, 600)])
def test_the_noise_of_odometry_is_found_where_it_is_more_than_claimed(
    drift: float, tau: float, n: int,
) -> None:
    """Odometry that is as it says keeps its noise; a better one as well, beside slow errors."""
    scales = [to_the_end(search(a_drive(seed, n=n, tau=tau, drift=drift))).odometry.way
              for seed in range(5)]
    scales = np.sqrt(scales).tolist()
    assert max(drift, 1.0) / 1.35 < np.median(scales) < 1.35 * max(drift, 1.0)
    assert drift > 1.0 or sum(scale > 1.0 for scale in scales) <= 1


@pytest.mark.parametrize('settings', [
    {'drift': 0.1}, {'drift': 0.3}, {'drift': 0.1, 'longer': 0.01}, {'drift': 0.1, 'rate': 0.002},
    {'drift': 0.3, 'turns': 3.0}, {'drift': 1.0, 'turns': 0.1}], ids=str)
def test_the_noise_of_way_and_turns_and_constant_errors_are_found(
    settings: dict[str, float],
) -> None:
    found = [to_the_end(search(a_drive(seed, n=400, speed=8.0, **settings))).odometry
             for seed in range(6)]
    way = settings['drift']
    turn = way * settings.get('turns', 1.0)
    for each in found:
        assert 0.7 * way < np.sqrt(each.way) < 1.5  # fixes of 1 m hardly show it
        assert 0.5 * turn < np.sqrt(each.turn) < 4.0 * turn
    assert np.median([each.rate for each in found]) == pytest.approx(
        -settings.get('rate', 0.0), abs=5e-4)
    assert np.median([each.scale for each in found]) == pytest.approx(
        -settings.get('longer', 0.0), abs=2e-3)


def line(n: int) -> Graph:
    """Return nodes at every metre, each with a position, the odd ones with a second edge."""
    graph, ahead = Graph(), np.arange(n - 1)
    graph.apply(GraphUpdate(
        hidden=np.column_stack((np.arange(n), np.zeros((n, 2)))), fix=(0,),
        factors=Factors.joined([
            Factors(
                np.append(ahead, ahead[::2]), np.append(ahead + 1, ahead[::2] + 1),
                np.tile((1.0, 0.0, 0.0), (n - 1 + len(ahead[::2]), 1)),
                np.concatenate((np.tile(100.0 * np.eye(3), (n - 1, 1, 1)),
                                np.tile(np.eye(3), (len(ahead[::2]), 1, 1)))),
                [FactorKind.ODOMETRY] * (n - 1 + len(ahead[::2]))),
            Factors.on(
                np.arange(n), np.tile((0.2, 0.1, 0.0), (n, 1)),
                np.column_stack((np.arange(n) + 0.2, np.full(n, 0.1), np.zeros(n))),
                np.tile(np.diag((4.0, 4.0, 0.0)), (n, 1, 1)), [FactorKind.POSITION] * n)])))
    return graph


def positions(graph: Graph) -> IntArray:
    """Return the ids of the positions of a graph."""
    return graph.factor_ids[graph.factors.j < 0]


def odometry_of(n: int, **errors: float) -> PathOdometry:
    """Return that of nodes at every second, with errors that the edges do not know of."""
    return PathOdometry(np.arange(n), SECOND * np.arange(n), AS_CLAIMED, OdometryErrors(**errors))


def test_a_path_has_the_motions_of_the_primary_odometry_in_the_order_of_stamps() -> None:
    graph, rng = line(30), np.random.default_rng(0)
    rows = np.sort(rng.choice(30, 12, replace=False))
    some = rng.permutation(rows)
    found = to_the_end(measured_path(
        graph, odometry_of(30), SECOND * (some + 5), positions(graph)[some]))
    np.testing.assert_allclose(found.seconds, rows - rows[0])
    np.testing.assert_allclose(found.position, np.column_stack((rows + 0.2, np.full(12, 0.1))))
    np.testing.assert_allclose(found.variance, 0.25)
    np.testing.assert_allclose(found.motion[1:, 0], np.diff(rows))
    np.testing.assert_allclose(found.noise[1:, 0, 0], 0.01 * np.diff(rows))
    np.testing.assert_array_equal(found.motion[0], 0.0)


def test_chained_motions_are_those_of_an_oracle() -> None:
    rng, n = np.random.default_rng(4), 20
    motion, seconds = rng.normal(0.0, 1.0, (n, 3)), rng.uniform(0.5, 2.0, n)
    root = rng.normal(0.0, 0.1, (n, 3, 3)) + np.eye(3)
    noise, until = root @ np.swapaxes(root, 1, 2), np.array((2, 2, 7, 20))
    information = np.ascontiguousarray(upper(np.linalg.inv(noise)))
    information[10] = 0.0
    got, spread, ways, lever = np.zeros((4, 3)), np.zeros((4, 3, 3)), *np.zeros((2, 4, 3))
    for part in ((0, 3), (3, 4)):
        chain_motions(motion, information, seconds, until, *part, got, spread, ways, lever)
    motion[10], noise[10] = 0.0, np.diag(NO_ODOMETRY)
    for k in range(1, 4):
        pose, cov, way = np.zeros(3), np.zeros((3, 3)), np.zeros((2, 2))
        for row in range(until[k - 1], until[k]):
            back = se2.adjoint(se2.inverse(motion[row]))
            pose, cov = se2.compose(pose, motion[row]), back @ cov @ back.T + noise[row]
            way = (back[:2, :2] @ way @ back[:2, :2].T + noise[row][:2, :2]
                   - np.outer(noise[row][:2, 2], noise[row][:2, 2]) / noise[row][2, 2])
        np.testing.assert_allclose(got[k, :2], pose[:2], atol=1e-12)
        assert se2.wrap(got[k, 2] - pose[2]) == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(spread[k], cov, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(ways[k], way[[0, 0, 1], [0, 1, 1]], rtol=1e-10, atol=1e-10)
        ends = []
        for rate in (-1e-4, 1e-4):
            turned = OdometryErrors(rate=rate).motions(motion, seconds)
            turned[10] = 0.0
            pose = np.zeros(3)
            for row in range(until[k - 1], until[k]):
                pose = se2.compose(pose, turned[row])
            ends.append(pose)
        by_rate = (ends[1] - ends[0]) / 2e-4
        np.testing.assert_allclose(lever[k, :2], by_rate[:2], rtol=1e-6, atol=1e-6)
        assert lever[k, 2] == pytest.approx(by_rate[2], rel=1e-6)


def test_a_path_without_known_errors_is_as_likely_with_them_as_states() -> None:
    """What is taken out of the motions is not taken out of their prior."""
    graph, ids = line(40), np.arange(40)
    values = []
    for errors in ({}, {'rate': 1e-5, 'scale': 1e-4}):
        path = to_the_end(measured_path(
            graph, odometry_of(40, **errors), SECOND * ids, positions(graph)))
        value, _, rate, scale, *_ = filtered(
            *path, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0, True)
        values.append((value, rate, scale))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-4, atol=1e-6)


def test_of_many_positions_the_newest_and_a_sample_of_the_others_are_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(error_estimate, 'SOURCES', replace(
        SOURCES, newest_positions=10, older_positions=5))
    graph = line(40)
    found = to_the_end(measured_path(
        graph, odometry_of(40), SECOND * np.arange(40), positions(graph)))
    assert len(found.seconds) == 15
    np.testing.assert_allclose(found.seconds[-10:], np.arange(30, 40))
