# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bank of filters against plain matrices, and what is decided in simple drives."""

from itertools import pairwise

from hypothesis import given, settings, strategies as st
import numpy as np
import numpy.typing as npt
import pytest

from pose_graph_ros.core.belief.bank import as_claimed, Bank, is_believed, Odometry
from pose_graph_ros.core.belief.filter import RATE, SCALE
from pose_graph_ros.core.belief.hypotheses import ALONE, SLIPPED
from pose_graph_ros.core.belief.rows import MEASURED
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import upper
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, OdometryErrors

SECOND = 1_000_000_000
seeds = st.integers(0, 2**32 - 1)


class Drive:
    """A winding drive of 1 m/s with a node each second, its odometry, and a fix of 1 m at each."""

    def __init__(self, seed: int, n: int = 120, rate: float = 0.0) -> None:
        self.rng = rng = np.random.default_rng(seed)
        steps = np.column_stack((np.full(n, 1.0), np.zeros(n), 0.2 * np.sin(np.arange(n) / 9.0)))
        self.truth = np.zeros((n + 1, 3))
        self.means = steps + rng.standard_normal((n, 3)) * (0.05, 0.03, 0.01)
        self.means[:, 2] -= rate
        for k in range(n):
            self.truth[k + 1] = se2.compose(self.truth[k], steps[k])
        self.noises = np.tile(np.diag((0.05, 0.03, 0.01))**2, (n, 1, 1))
        self.fixes = self.truth[:, :2] + rng.standard_normal((n + 1, 2))
        self.source = np.zeros(n + 1, dtype=np.int64)

    def odometry(self, errors: OdometryErrors = AS_CLAIMED) -> Odometry:
        n, poses = len(self.means), np.zeros((len(self.means) + 1, 3))
        seconds = np.ones(n)
        motions = errors.motions(self.means, seconds)
        for k in range(n):
            poses[k + 1] = se2.compose(poses[k], motions[k])
        adjoint = se2.adjoint(poses[1:])
        sums = np.cumsum(
            adjoint @ errors.covariances(self.noises) @ np.swapaxes(adjoint, 1, 2), axis=0)
        return Odometry(np.arange(n + 1), poses, np.vstack((np.zeros(6), upper(sums))).copy(),
                        np.arange(n + 1), SECOND * np.arange(n + 1), errors)

    def rows(self) -> npt.NDArray[np.void]:
        n = len(self.fixes)
        rows = np.zeros(n, MEASURED)
        rows['id'] = rows['node'] = np.arange(n)
        rows['stamp_ns'] = SECOND * np.arange(n) + self.source
        rows['judged'] = 1
        rows['source'], rows['mean'][:, :2] = self.source, self.fixes
        rows['noise'][:, [0, 2]] = rows['slow'][:, None] = 1.0
        return rows

    def bank(self, errors: OdometryErrors = AS_CLAIMED) -> Bank:
        bank = Bank()
        bank.insert(self.rows(), self.odometry(errors))
        return bank


@settings(max_examples=30)
@given(seeds)
def test_motions_between_measurements_are_those_of_odometry(seed: int) -> None:
    drive = Drive(seed, 12)
    errors = OdometryErrors(2.0, 0.5, 0.01, 0.03)
    kept = np.unique(drive.rng.integers(0, 13, 5))
    bank, again = Bank(), Bank()
    bank.insert(drive.rows()[kept], drive.odometry())
    again.insert(drive.rows()[kept], drive.odometry(errors))
    for name in ('motion', 'turn', 'way', 'lever', 'travel'):   # without what odometry knows of
        np.testing.assert_allclose(again.rows[name], bank.rows[name], atol=1e-12)
    for row, (begin, end) in enumerate(pairwise(kept), 1):
        motion, turn, way = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        turned = [np.zeros(3), np.zeros(3)]
        for k in range(begin, end):
            back = se2.adjoint(se2.inverse(drive.means[k]))
            of_heading = np.zeros((3, 3))
            of_heading[2, 2] = drive.noises[k, 2, 2]
            turn = back @ turn @ back.T + of_heading
            way = back @ way @ back.T + drive.noises[k] - of_heading
            motion = se2.compose(motion, drive.means[k])
            for n, rate in enumerate((-1e-6, 1e-6)):
                turned[n] = se2.compose(turned[n], OdometryErrors(rate=rate).motions(
                    drive.means[k:k + 1], np.ones(1))[0])
        one = bank.rows[row]
        np.testing.assert_allclose(se2.wrapped(one['motion']), se2.wrapped(motion), atol=1e-9)
        np.testing.assert_allclose(one['turn'], upper(turn[None])[0], atol=1e-12)
        np.testing.assert_allclose(one['way'], way[[0, 0, 1], [0, 1, 1]], atol=1e-12)
        np.testing.assert_allclose(one['lever'], (turned[1] - turned[0]) / 2e-6, atol=1e-5)


def plain(bank: Bank, noise: npt.NDArray[np.void], heading: float) -> tuple[float, FloatArray]:
    """Return what one hypothesis, by which all is good, comes to, by plain matrices."""
    rows, state, p = bank.rows, np.zeros(7), np.zeros((7, 7))
    weight = np.log(BANK.between_faults / (BANK.between_faults + BANK.fault) / BANK.headings)
    white, slow, tau = (noise[name][0, 0] for name in ('white', 'slow', 'tau'))
    state[:3] = *rows['mean'][0, :2], heading
    p[2:5, 2:5] = np.diag((BANK.heading, BANK.rate, BANK.scale))**2
    p[:2, :2] = (white + slow) * np.eye(2)
    p[5:, 5:], p[:2, 5:], p[5:, :2] = (sign * slow * np.eye(2) for sign in (1.0, -1.0, -1.0))

    def moved(x: FloatArray, row: npt.NDArray[np.void]) -> FloatArray:
        motion = row['motion'] + x[RATE] * row['lever']
        motion[:2] += x[SCALE] * row['motion'][:2]
        c, s = np.cos(x[2]), np.sin(x[2])
        part = np.exp(-row['lever'][2] / tau)
        return np.array((
            x[0] + c * motion[0] - s * motion[1], x[1] + s * motion[0] + c * motion[1],
            x[2] + motion[2], x[3], x[4], part * x[5], part * x[6]))

    for row in rows[1:]:
        jacobian = np.column_stack([
            (moved(state + step, row) - moved(state - step, row)) / 2e-6
            for step in 1e-6 * np.eye(7)])
        state = moved(state, row)
        axes = np.eye(3)
        c, s = np.cos(state[2]), np.sin(state[2])
        axes[:2, :2] = (c, -s), (s, c)
        turn = row['turn'][[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3)
        q = noise['turn'][0] * turn
        q[:2, :2] += noise['way'][0] * row['way'][[0, 1, 1, 2]].reshape(2, 2)
        p = jacobian @ p @ jacobian.T
        p[:3, :3] += axes @ q @ axes.T
        p[5:, 5:] += slow * (1.0 - np.exp(-2.0 * row['lever'][2] / tau)) * np.eye(2)
        h = np.zeros((2, 7))
        h[:, :2] = h[:, 5:] = np.eye(2)
        cov, error = h @ p @ h.T + white * np.eye(2), row['mean'][:2] - h @ state
        weight += (np.log(1.0 - BANK.outliers) - row['gap'] / BANK.between_faults
                   - 0.5 * (error @ np.linalg.solve(cov, error)
                            + np.linalg.slogdet(2.0 * np.pi * cov)[1]))
        gain = p @ h.T @ np.linalg.inv(cov)
        state, p = state + gain @ error, p - gain @ cov @ gain.T
    return float(weight), state


@pytest.mark.parametrize('slow', [0.0, 0.6])
def test_a_hypothesis_is_a_kalman_filter(slow: float) -> None:
    drive = Drive(1, 40)
    drive.fixes = drive.truth[:, :2] + 0.3 * drive.rng.standard_normal((41, 2))
    noise = as_claimed()
    noise['slow'], noise['tau'], noise['way'], noise['turn'] = slow, 7.0, 1.3, 0.7
    bank = drive.bank().again(noise)
    bank.decide()
    assert np.all(is_believed(bank.told(0).choice))
    weight, state = plain(bank, noise, 0.0)
    one = bank._bank[np.argmax(bank._bank['weight'][:bank._n])]
    # others that have joined it make it a little more likely
    assert weight - 1e-3 < one['weight'] < weight + 0.7
    np.testing.assert_allclose(one['state'][:7], state, atol=0.02)


@settings(max_examples=10)
@given(seeds)
def test_decisions_do_not_depend_on_the_order_of_arrival(seed: int) -> None:
    drive = Drive(seed, 60)
    wrong = drive.rng.random(61) < 0.2
    drive.fixes[wrong] += drive.rng.normal(0.0, 30.0, (int(wrong.sum()), 2))
    drive.source[drive.rng.random(61) < 0.4] = 1
    rows, odometry = drive.rows(), drive.odometry()
    whole, late = drive.bank(), Bank()
    whole.decide()
    order = drive.rng.permutation(61)
    for some in np.split(order, np.sort(drive.rng.integers(0, 61, 8))):
        if len(some) > 0:
            late.insert(rows[some], odometry)
            late.decide()
    assert late.told(0).choice.tolist() == whole.told(0).choice.tolist()
    assert late.evidence == pytest.approx(whole.evidence, abs=1e-6)
    # and what is taken back leaves nothing behind
    late.remove(rows['id'][50:])
    late.decide()
    late.insert(rows[50:], odometry)
    late.decide()
    assert late.told(0).choice.tolist() == whole.told(0).choice.tolist()


def test_changes_are_told_from_the_first_one_on() -> None:
    drive, told = Drive(3, 120), np.zeros(0, dtype=np.int64)
    drive.fixes[:30] += (40.0, 0.0)
    bank, n_turned = Bank(), 0
    for row in drive.rows():
        bank.insert(np.array([row]), drive.odometry())
        decided = bank.decide()
        n_turned += decided.first < len(told)
        told = np.append(told[:decided.first], decided.choice)
        assert told.tolist() == bank.told(0).choice.tolist()
    assert 1 <= n_turned <= 20
    assert np.flatnonzero(~is_believed(told)).tolist() == list(range(30))


@pytest.mark.parametrize('seed', range(3))
def test_what_has_happened_is_found(seed: int) -> None:
    drive = Drive(seed, 400, rate=0.005)
    single = np.array((20, 35, 50))
    drive.fixes[single] += drive.rng.uniform(20.0, 40.0, (3, 2))
    drive.fixes[120:150] += (30.0, -25.0)   # a fault
    drive.means[200, :2] += (12.0, 0.0)     # a slip
    bank = drive.bank()
    bank.decide()
    choices = bank.told(0).choice
    assert np.flatnonzero(~is_believed(choices)).tolist() == [*single, *range(120, 150)]
    assert np.all(choices[single] == ALONE)
    assert np.flatnonzero(choices == SLIPPED).tolist() == [201]


@pytest.mark.parametrize('seed', range(2))
def test_of_two_receivers_the_one_that_has_begun_to_differ_is_in_a_fault(seed: int) -> None:
    drive = Drive(seed, 300)
    drive.source[1::2] = 1
    wrong = (drive.source == 1) & (np.arange(301) > 150)
    drive.fixes[wrong] += (15.0, 0.0)
    bank = drive.bank()
    bank.decide()
    assert np.array_equal(~is_believed(bank.told(0).choice), wrong)


def test_the_oldest_rows_can_be_forgotten() -> None:
    drive = Drive(5, 200)
    drive.fixes[90:110] += (40.0, 10.0)
    whole, bank, rows = drive.bank(), Bank(), drive.rows()
    whole.decide()
    for k in range(0, 201, 3):
        bank.insert(rows[k:k + 3], drive.odometry())
        bank.decide()
        bank.forget(rows['id'][max(k - 60, 0):], 0)
    assert len(bank) in range(60, 61 + 2 * BANK.checkpoint)
    assert bank.told(0).choice.tolist() == whole.told(0).choice[-len(bank):].tolist()
    bank.forget(np.zeros(0, np.int64), 50)
    assert len(bank) in range(50, 51 + BANK.checkpoint)
    for newest in (None, 30):
        again = bank.again(as_claimed(), newest)
        assert again.done < 30
        while again.advance(7):
            pass
        again.decide()
        assert again.told(0).choice.tolist() == bank.told(0).choice.tolist()


def test_rows_can_be_forgotten_by_a_bank_that_is_filtered_again_and_has_decided_on_none() -> None:
    drive = Drive(5, 300)
    drive.fixes[290:] += (40.0, 10.0)
    bank = drive.bank()
    bank.decide()
    again = bank.again(as_claimed(), 200)
    again.advance(80)
    again.forget(drive.rows()['id'][170:], 100)
    assert len(again) < 200
    while again.advance(7):
        pass
    again.decide()
    assert again.told(0).choice.tolist() == bank.told(0).choice[-len(again):].tolist()


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('seen', [33, 45, 60])
def test_the_newest_pose_allows_for_wrong_fixes_at_the_start(seed: int, seen: int) -> None:
    """Nobody can tell yet, but that receivers may begin in a fault is known."""
    drive = Drive(seed)
    drive.fixes[:30] += (40.0 * np.cos(seed), 40.0 * np.sin(seed))
    drive.fixes, drive.source = drive.fixes[:seen], drive.source[:seen]
    bank = drive.bank()
    bank.decide()
    pose, covariance = bank.newest()
    off = (pose - drive.truth[seen - 1])[:2]
    assert off @ np.linalg.solve((covariance + bank.spread.covariance)[:2, :2], off) < 8.0**2


def test_of_a_good_start_the_newest_pose_is_known_soon() -> None:
    bank = Drive(0).bank()
    bank.decide()
    assert np.trace(bank.spread.covariance[:2, :2]) < 0.1


def test_the_newest_measurements_are_filtered_again_from_about_there_at_any_length() -> None:
    """Else learning from the newest ones would take longer and longer."""
    bank = Drive(6, 1500).bank()
    bank.decide()
    for newest in (150, 600, 1200):
        again = bank.again(as_claimed(), newest)
        n_again = len(again) - again.done
        assert newest <= n_again <= 1.25 * newest
        again.decide()
        assert again.told(0).choice[-100:].tolist() == bank.told(0).choice[-100:].tolist()
