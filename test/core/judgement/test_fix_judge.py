# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Judging fixes over time, in drives in which some fixes, or odometry, are wrong."""

from collections.abc import Callable

import numpy as np
import pytest

from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, MeasurementSource, POSITIONS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray
from pose_graph_ros.core.judgement.verdicts import Decision, State, Verdict
from pose_graph_ros.core.measurements import GlobalPose, Measurement, OdometrySample, Position

SECOND = 1_000_000_000


class Drive:
    """A winding drive at 1 m/s: odometry at 5 Hz with noise, fixes of 0.5 m at 1 Hz."""

    def __init__(self, seconds: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        n = 5 * seconds
        self.time = np.arange(n) / 5.0
        self.motion = np.zeros((n, 3))
        self.motion[:, 0], self.motion[:, 2] = 0.2, 0.03 * np.sin(self.time / 7.0)
        self.noise = rng.standard_normal((n, 3)) * (0.02, 0.01, 0.004)
        self.truth = np.zeros((n, 3))
        for k in range(1, n):
            self.truth[k] = se2.compose(self.truth[k - 1], self.motion[k])
        self.rng = rng
        self.fix_time = np.arange(seconds) + 0.0
        self.fixes = self.truth[::5, :2] + 0.5 * rng.standard_normal((seconds, 2))
        self.sent = np.ones(seconds, dtype=bool)
        self.claimed = 0.5

    def between(self, begin: float, end: float) -> BoolArray:
        """Return which fixes have a stamp in an interval [s]."""
        return np.asarray((self.fix_time >= begin) & (self.fix_time < end))

    def move(self, begin: float, end: float, offset: tuple[float, float]) -> None:
        """Move the fixes of an interval."""
        self.fixes[self.between(begin, end)] += offset

    def slip(self, begin: float, distance: float) -> None:
        """Let odometry move farther than the robot for 5 s."""
        self.noise[(self.time >= begin) & (self.time < begin + 5.0), 0] += distance / 25.0

    def poses(self) -> list[OdometrySample]:
        odometry, samples = np.array((3.0, -2.0, 1.0)), []
        for k, time in enumerate(self.time):
            if k > 0:
                odometry = se2.compose(odometry, self.motion[k] + self.noise[k])
            samples.append(OdometrySample(SECOND + round(time * SECOND), odometry))
        return samples

    def measurements(self) -> list[tuple[str, Measurement]]:
        return [('fix', Position(
            SECOND + round(time * SECOND), where, self.claimed**2 * np.eye(2), np.zeros(2)))
            for time, where in zip(self.fix_time[self.sent], self.fixes[self.sent], strict=True)]


class Driven:
    """What the engine made of a drive: at each second and at the end."""

    def __init__(
        self, drive: Drive, more: list[tuple[str, Measurement]] | None = None,
        source: MeasurementSource = POSITIONS, final: bool = True,
    ) -> None:
        self.backend = backend = PoseGraphBackend(BackendConfig(
            measurements=dict.fromkeys(('fix', 'other'), source)))
        self.newest: dict[int, float] = {}
        self.doubting: dict[int, bool] = {}
        events = [('odom', sample) for sample in drive.poses()]
        events += drive.measurements() if more is None else more
        for name, event in sorted(events, key=lambda each: each[1].stamp_ns):
            if not isinstance(event, OdometrySample):
                backend.add_measurement(event, name)
                continue
            backend.add_odometry(event)
            if (event.stamp_ns - SECOND) % SECOND == 0:
                backend.update()
                estimate = backend.estimate(with_path=False)
                if estimate is None or estimate.alignment is not AlignmentState.ALIGNED:
                    continue
                at = (event.stamp_ns - SECOND) // SECOND
                k = round((estimate.stamp_ns - SECOND) * 5 / SECOND)
                self.newest[at] = float(np.hypot(
                    *(estimate.T_map_base - drive.truth[k])[:2]))
                totals = backend.verdict_totals()
                self.doubting[at] = 'fix' in totals and totals['fix'].doubting
        if final:
            backend.optimize()
        end = backend.estimate()
        assert end is not None
        k = np.round((end.path.stamps_ns - SECOND) * 5 / SECOND).astype(int)
        off: FloatArray = end.path.poses - drive.truth[k]
        self.rms = float(np.sqrt(np.mean(np.sum(off[:, :2]**2, axis=1))))
        self.doubted = {
            verdict.id for verdict in backend.verdicts() if verdict.state is State.DOUBTED}


def global_poses(
    drive: Drive, changed: Callable[[int, FloatArray], FloatArray],
) -> list[tuple[str, Measurement]]:
    """Return poses of 0.1 m and 0.02 rad at 1 Hz, changed by their time [s]."""
    return [('other', GlobalPose(SECOND + time * SECOND, se2.wrapped(changed(
        time, pose + drive.rng.standard_normal(3) * (0.1, 0.1, 0.02))),
        np.diag((0.01, 0.01, 0.0004)))) for time, pose in enumerate(drive.truth[::5])]


class Aside(Drive):
    """Fixes of 1 m at 3 m/s, the yaw rate is off: a minute without any, then 30 s all aside."""

    def __init__(self, seed: int, period: float) -> None:
        super().__init__(230, seed)
        rng, self.claimed = np.random.default_rng(seed + 1000), 1.0
        self.motion[:, 0], self.motion[:, 2] = 0.6, 0.12 * np.sin(self.time / period)
        self.noise[:, 2] = 0.004 * rng.standard_normal(len(self.time)) + 0.005 / 5.0
        for k in range(1, len(self.truth)):
            self.truth[k] = se2.compose(self.truth[k - 1], self.motion[k])
        self.fixes = self.truth[::5, :2] + rng.standard_normal((230, 2))
        self.sent[self.between(100.0, 160.0)] = False
        angle = np.random.default_rng(seed).uniform(-np.pi, np.pi)
        self.move(160.0, 190.0, (40.0 * np.cos(angle), 40.0 * np.sin(angle)))


def ids(drive: Drive, begin: float, end: float, source: str = 'fix') -> set[str]:
    """Return the ids of the fixes of an interval."""
    numbers = np.cumsum(drive.sent) - 1
    return {f'{source}/{number}' for number in numbers[drive.between(begin, end) & drive.sent]}


def slip_in_an_outage(drive: Drive) -> None:
    drive.sent[drive.between(30.0, 70.0)] = False
    drive.slip(50.0, 8.0)


def turn(drive: Drive) -> None:
    """Let odometry turn far more than the robot, once."""
    drive.noise[300, 2] += 2.0


def noisier(factor: float) -> Callable[[Drive], None]:
    def change(drive: Drive) -> None:
        drive.noise *= factor
    return change


def grow(drive: Drive) -> None:
    """Let an error grow for a minute."""
    since = np.where(drive.between(60.0, 130.0), drive.fix_time - 60.0, 0.0)
    drive.fixes += since[:, None] * np.array((0.0, 0.25))


@pytest.mark.parametrize(('seconds', 'change', 'wrong', 'most', 'settled', 'rms'), [
    (120, lambda drive: None, (0.0, 0.0), 1, 100, 0.4),
    (140, slip_in_an_outage, (0.0, 0.0), 1, 125, 3.0),
    # a receiver that is initialised wrongly for a minute
    (150, lambda drive: drive.move(60.0, 120.0, (-60.0, 80.0)), (60.0, 120.0), 1, 130, 1.5),
    # or at the beginning
    (100, lambda drive: drive.move(0.0, 20.0, (30.0, 20.0)), (0.0, 20.0), 3, 99, 1.0),
    # which it was for some seconds
    (140, lambda drive: drive.slip(60.0, 12.0), (0.0, 0.0), 2, 75, 0.5),
    (150, turn, (0.0, 0.0), 2, 125, 1.0),
    # odometry that is worse than it claims
    (200, noisier(2.0), (0.0, 0.0), 2, 190, 1.0), (200, noisier(4.0), (0.0, 0.0), 2, 190, 1.0),
    # which has drawn the path aside before it shows, so that what is right later does not fit
    (250, grow, (105.0, 130.0), 160, 249, 10.0)])
def test_what_is_wrong_is_doubted_and_the_path_finds_back(
    seconds: int, change: Callable[[Drive], None], wrong: tuple[float, float], *, most: int,
    settled: int, rms: float,
) -> None:
    drive = Drive(seconds)
    change(drive)
    driven = Driven(drive)
    bad = ids(drive, *wrong)
    assert bad <= driven.doubted
    assert len(driven.doubted - bad) <= most
    assert max(driven.newest[at] for at in range(settled, seconds)) < 2.0
    assert driven.rms < rms


def test_single_wrong_fixes_are_doubted() -> None:
    drive = Drive(120)
    wrong = drive.rng.random(120) < 0.2
    angle = drive.rng.uniform(0.0, 6.28, 120)
    far = drive.rng.uniform(20.0, 50.0, (120, 1))
    drive.fixes[wrong] += (far * np.column_stack((np.cos(angle), np.sin(angle))))[wrong]
    driven = Driven(drive)
    bad = {f'fix/{number}' for number in np.flatnonzero(wrong)}
    assert bad <= driven.doubted
    assert len(driven.doubted - bad) <= 1
    assert driven.rms < 0.45


def test_consistent_offset_after_an_outage_is_doubted_throughout() -> None:
    drive = Drive(150)
    drive.sent[drive.between(40.0, 80.0)] = False
    drive.move(80.0, 110.0, (25.0, -31.0))
    driven = Driven(drive)
    assert ids(drive, 80.0, 110.0) <= driven.doubted
    assert len(driven.doubted) <= 31
    assert all(driven.doubting[at] for at in range(84, 111))
    assert max(driven.newest[at] for at in range(80, 111)) < 5.0
    assert driven.rms < 1.5


@pytest.mark.parametrize('seed', [3, 4, 5])
def test_fixes_after_an_outage_do_not_throw_out_the_right_ones_before(seed: int) -> None:
    drive = Aside(seed, 5.0)
    assert Driven(drive).doubted == ids(drive, 160.0, 190.0)


@pytest.mark.parametrize('seed', range(3))
def test_an_offset_after_an_outage_is_no_slip_of_odometry(seed: int) -> None:
    driven = Driven(Aside(seed, 9.0), final=False)
    assert max(driven.newest[at] for at in range(160, 190)) < 20.0


def test_receivers_that_contradict_each_other_the_first_one_is_believed() -> None:
    drive = Drive(120)
    first = drive.measurements()
    other = [('other', Position(fix.stamp_ns + SECOND // 5, fix.position + np.array((20.0, 0.0)),
                                fix.covariance, np.zeros(2)))
             for _, fix in first[50:] if isinstance(fix, Position)]
    driven = Driven(drive, first + other)
    assert {f'other/{number}' for number in range(len(other) - 1)} <= driven.doubted
    assert driven.rms < 0.4
    totals = driven.backend.verdict_totals()
    assert totals['other'].doubting
    assert not totals['fix'].doubting


def test_poses_in_the_wrong_corridor() -> None:
    drive = Drive(120)
    driven = Driven(drive, global_poses(drive, lambda time, pose: se2.compose(
        pose, np.array((0.0, 5.0, np.pi)) * (50 <= time < 75))))
    assert {f'other/{number}' for number in range(50, 75)} <= driven.doubted
    assert len(driven.doubted) <= 27
    assert driven.rms < 0.5


def test_a_wrong_heading_that_stays_off_is_not_a_slip() -> None:
    drive = Drive(60)
    driven = Driven(drive, global_poses(
        drive, lambda time, pose: pose + np.array((3.0, 2.0, 0.5)) * (20 <= time < 28)))
    assert driven.doubted == {f'other/{number}' for number in range(20, 28)}
    assert driven.rms < 0.2


@pytest.mark.parametrize(('wrong', 'right'), [(5, 5), (8, 4), (3, 7)])
def test_errors_that_come_and_go_are_doubted_each_time(wrong: int, right: int) -> None:
    drive = Drive(200)
    for begin in range(60, 180, wrong + right):
        angle = drive.rng.uniform(-np.pi, np.pi)
        drive.move(begin, begin + wrong, (15.0 * np.cos(angle), 15.0 * np.sin(angle)))
    driven = Driven(drive)
    assert driven.doubted == {f'fix/{number}' for number in range(60, 200)
                              if (number - 60) % (wrong + right) < wrong and number < 180}
    assert max(driven.newest.values()) < 2.0
    assert driven.rms < 0.4


@pytest.mark.parametrize('scatter', [0.1, 1.0])
def test_a_fault_of_an_exact_receiver_is_exact_or_noisy(scatter: float) -> None:
    drive = Drive(200)
    drive.fixes = drive.truth[::5, :2] + 0.1 * drive.rng.standard_normal((200, 2))
    drive.claimed = 1.0
    drive.move(100.0, 130.0, (15.0, -8.0))
    at = drive.between(100.0, 130.0)
    drive.fixes[at] += scatter * drive.rng.standard_normal((30, 2))
    driven = Driven(drive)
    assert driven.doubted == ids(drive, 100.0, 130.0)
    assert max(driven.newest[at] for at in range(105, 200)) < 2.5   # m, by odometry meanwhile
    assert driven.rms < 0.3


def test_correlated_errors_are_judged_as_well() -> None:
    drive = Drive(120)
    drive.move(60.0, 80.0, (20.0, 15.0))
    driven = Driven(drive, source=MeasurementSource(
        robust=POSITIONS.robust, loss=POSITIONS.loss, correlation_time=5.0))
    assert ids(drive, 60.0, 80.0) <= driven.doubted
    assert len(driven.doubted) <= 22
    graph = driven.backend.graph
    for verdict in driven.backend.verdicts():
        assert bool(graph.weights[verdict.number] > 0.0) is verdict.state.in_graph
    assert driven.rms < 1.0


def test_decisions_of_a_person_are_kept_and_taken_back() -> None:
    driven = Driven(Drive(60), final=False)
    backend = driven.backend
    backend.verdict_changes()
    backend.decide('fix/30', Decision.OUT)
    backend.update()

    def verdict() -> Verdict:
        return next(each for each in backend.verdicts() if each.id == 'fix/30')

    assert verdict().state is State.DOUBTED
    assert verdict().contradicted_by == ()
    assert [change.id for change in backend.verdict_changes()] == ['fix/30']
    backend.decide('fix/30', Decision.AUTO)
    assert verdict().state is State.BELIEVED
    assert backend.decide('fix/999', Decision.IN).reason == 'unknown_id'
