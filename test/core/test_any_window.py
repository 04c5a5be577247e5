# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whatever the settings, the delays and what a person does: nodes leave, and no drive ends."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hypothesis import given, HealthCheck, settings, strategies as st
import numpy as np
from test_window import add, drive, Event, SECOND

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    FOUND,
    LOOP_CLOSURES,
    OdometrySource,
    POSITIONS,
    Robust,
    ThinningConfig,
    WindowConfig,
    WindowPrior,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.io.graph_files import read_graph, write_graph
from pose_graph_ros.core.judgement.verdicts import Decision
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample, Position, YawRate

LIMITS = ({}, {'nodes': 5}, {'nodes': 60}, {'seconds': 20.0}, {'metres': 30.0})
robust = st.sampled_from(Robust)


@st.composite
def configs(draw: st.DrawFn) -> BackendConfig:
    """Return settings with which nodes leave, most times."""
    fixes = replace(
        POSITIONS, robust=draw(robust), correlation_time=draw(st.sampled_from((0.0, FOUND, 10.0))))
    return BackendConfig(
        odometry={'odom': OdometrySource(calibrate=fixes.robust is not Robust.JUDGED)},
        window=WindowConfig(
            **draw(st.sampled_from(LIMITS)), prior=draw(st.sampled_from(WindowPrior))),
        thinning=ThinningConfig(
            cell=draw(st.sampled_from((0.0, 2.0))), newest=draw(st.sampled_from((1, 20)))),
        measurements={'fix': fixes, 'loop_closure': replace(LOOP_CLOSURES, robust=draw(robust))})


def disturbed(rng: np.random.Generator, delay: float) -> Sequence[Event]:
    """Return a drive with some wrong measurements, a gyroscope, and delays [s]."""
    events, truth = drive(int(rng.integers(300, 500)), fixes=int(rng.choice((0, 3, 20))))
    turn = float(se2.wrap(truth[1, 2] - truth[0, 2])) * 5.0
    arrivals: list[tuple[int, Event]] = []
    for source, event in events:
        late, said = 0, event
        if isinstance(event, OdometrySample):
            arrivals.append((event.stamp_ns, ('gyro', YawRate(
                event.stamp_ns, turn + 0.01 + rng.normal(0.0, 2e-3)))))
        elif delay > 0.0:
            late = round(rng.exponential(delay) * SECOND)
        if isinstance(event, Position) and rng.random() < 0.05:
            said = replace(event, position=event.position + rng.normal(0.0, 30.0, 2))
        arrivals.append((event.stamp_ns + late, (source, said)))
    return [event for _, event in sorted(arrivals, key=lambda item: item[0])]


def through_files(backend: PoseGraphBackend, config: BackendConfig, path: Path) -> (
        PoseGraphBackend):
    """
    Return what goes on from a file; its estimate is the same once the graph is in the map.

    But what waits for odometry is not saved, and corrects the newest pose already.
    """
    saved = backend.saved()
    write_graph(saved, path)
    again = PoseGraphBackend.restored(config, read_graph(path))
    before, after = backend.estimate(), again.estimate()
    assert before.n_hidden == after.n_hidden
    if before.alignment.value != 'unaligned' and saved.n_left_out == 0:
        np.testing.assert_allclose(after.T_map_base, before.T_map_base, atol=1e-6)
    return again


@given(st.integers(0, 2**32 - 1), configs(), st.sampled_from((0.0, 1.0, 30.0)))
@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_drive_ends(tmp_path: Path, seed: int, config: BackendConfig, delay: float) -> None:
    rng, backend, stamp = np.random.default_rng(seed), PoseGraphBackend(config), 0
    for source, event in disturbed(rng, delay):
        add(backend, (source, event))
        if source != 'odom' or event.stamp_ns < stamp + SECOND:
            continue
        stamp = event.stamp_ns
        backend.update()
        estimate = backend.estimate(with_path=False)
        if estimate is None:
            continue
        assert np.all(np.isfinite(estimate.T_map_base))
        assert np.all(np.linalg.eigvalsh(estimate.covariance) > 0.0)
        chance = rng.random()
        if chance < 0.03:
            backend = through_files(backend, config, tmp_path / 'graph')
        elif chance < 0.06:
            backend.optimize()
        elif chance < 0.09:
            backend.set_pose(GlobalPose(
                stamp, rng.normal(0.0, 5.0, 3), np.diag((0.1, 0.1, 0.01))), 'set')
        elif chance < 0.12:
            for verdict in backend.verdicts(3)[:1]:
                backend.decide(verdict.id, list(Decision)[int(rng.integers(3))])
        elif chance < 0.5:
            backend.refine()
    backend.optimize()
    estimate = backend.estimate()
    assert len(estimate.path.poses) == estimate.n_hidden + (
        estimate.path.stamps_ns[-1] > backend.node_stamps_ns[-1])
    assert np.all(np.isfinite(estimate.path.poses))
