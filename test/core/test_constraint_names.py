# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Constraints with the largest energies have the names of their sources, stamps and nodes."""

import re

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    Loss,
    MeasurementSource,
    NodePolicy,
    OdometrySource,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import (
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    OdometrySample,
    Position,
)

SECOND = 1_000_000_000


def driven() -> PoseGraphBackend:
    """Drive a circle twice, with all kinds of sources."""
    backend = PoseGraphBackend(BackendConfig(
        nodes=NodePolicy(minimum_travel_distance=1.0),
        odometry={name: OdometrySource(reorder_window=0.0) for name in ('wheels', 'visual')},
        measurements={
            'wander': MeasurementSource(correlation_time=20.0),
            'plain': MeasurementSource(),
            'robust': MeasurementSource(loss=Loss.HUBER, rejection_threshold=1.0)}))
    rng = np.random.default_rng(3)
    pose, step = np.zeros(3), np.array((0.5, 0.0, np.pi / 30.0))
    for k in range(121):
        stamp = k * SECOND
        if k > 0:
            pose = se2.compose(pose, step)
        for name in ('wheels', 'visual'):
            noise = rng.normal(0.0, 0.01, 3)
            backend.add_odometry(OdometrySample(stamp, pose + noise), name)
        where = pose[:2] + rng.normal(0.0, 0.3, 2)
        after = stamp - SECOND // 4
        if k == 2:
            backend.add_measurement(GlobalPose(after, pose, 0.01 * np.eye(3)), 'pose')
        elif k % 4 == 2:
            name = ('wander', 'plain', 'robust')[k // 4 % 3]
            backend.add_measurement(Position(after, where, 0.01 * np.eye(2), np.zeros(2)), name)
        if k % 40 == 39:
            backend.add_measurement(HeadingOnly(after, float(pose[2]), 0.01), 'imu')
        if k in {70, 100}:
            backend.add_measurement(LoopClosure(
                stamp, np.array((0.5, 0.0, 0.0)), 0.01 * np.eye(3),
                reference_ns=stamp - 60 * SECOND), 'scans')
        if k % 7 == 0:
            backend.update()
    backend.optimize()
    return backend


def test_every_constraint_has_the_name_of_its_source_and_of_its_ends() -> None:
    backend = driven()
    found = backend.largest_energies(10_000)
    energies = backend.graph.energies()
    assert len(found) == np.count_nonzero(energies.factors > 0.0)
    assert sum(each.energy for each in found) == pytest.approx(energies.chi2)
    assert [each.energy for each in found] == sorted((each.energy for each in found), reverse=True)
    names = [each.name for each in found]
    assert len(set(names)) == len(names)
    n = len(backend.node_stamps_ns)
    for source in ('wheels', 'visual'):
        ours = [each for each in found if each.source == source]
        assert {each.kind for each in ours} == {'odometry'}
        assert {each.name for each in ours} == {f'{source} x{k} - x{k + 1}' for k in range(n - 1)}
    stamps = backend.node_stamps_ns

    def node(seconds: float) -> int:
        return int(np.searchsorted(stamps, round(seconds * SECOND), side='right')) - 1

    assert {each.name for each in found if each.source == 'scans'} == {
        f'scans x{node(k - 60)} - x{node(k)}' for k in (70, 100)}
    expected = {'pose': {2}, 'imu': {39, 79, 119}} | {
        name: {k for k in range(6, 121, 4) if k // 4 % 3 == number}
        for number, name in enumerate(('wander', 'plain', 'robust'))}
    for source, instants in expected.items():
        ours = {each.name for each in found if each.source == source and each.kind != 'bias'}
        assert ours == {f'{source} at {k - 0.25:.3f} s near x{node(k - 0.25)}' for k in instants}
    kinds = {each.source: each.kind for each in found if each.kind != 'bias'}
    assert kinds == {
        'wheels': 'odometry', 'visual': 'odometry', 'scans': 'loop_closure',
        'pose': 'global_pose', 'imu': 'heading', 'wander': 'position', 'plain': 'position',
        'robust': 'position'}
    beforehand = [each for each in found if each.kind == 'bias']
    assert 1 <= len(beforehand) <= len(expected['wander'])
    width = 20.0 / 64
    for each in beforehand:
        began = re.fullmatch(r'error of wander at (\d+\.\d{3}) s', each.name)
        assert began is not None
        assert any(0.0 <= k - 0.25 - float(began[1]) < width + 1e-3 for k in expected['wander'])


def test_edges_of_a_new_primary_odometry_have_its_name() -> None:
    backend = PoseGraphBackend(BackendConfig(odometry={
        name: OdometrySource(reorder_window=0.0) for name in ('wheels', 'visual')}))
    rng = np.random.default_rng(1)
    for k in range(1, 61):
        for name in ('wheels', 'visual') if k <= 30 else ('visual',):
            backend.add_odometry(OdometrySample(
                k * SECOND, np.array((float(k), 0.0, 0.0)) + rng.normal(0.0, 0.01, 3)), name)
    backend.add_measurement(
        LoopClosure(50 * SECOND, np.array((35.0, 0.0, 0.0)), 0.01 * np.eye(3), 15 * SECOND),
        'scan')
    backend.optimize()
    names = {each.name for each in backend.largest_energies(10_000)}
    last = len(backend.node_stamps_ns) - 1
    assert f'visual x{last - 1} - x{last}' in names
    assert f'wheels x{last - 1} - x{last}' not in names
    assert {'wheels x3 - x4', 'visual x3 - x4'} <= names
