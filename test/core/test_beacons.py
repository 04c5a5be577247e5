# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ranges to beacons at known and unknown places."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, RANGES, WindowConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import GlobalPose, OdometrySample, Range
from pose_graph_ros.core.sources.queued import located

SECOND = 1_000_000_000
BEACONS = {'a': (-4.0, 3.0), 'b': (22.0, -2.0), 'c': (18.0, 20.0), 'd': (-3.0, 16.0)}
ARM = np.array([0.4, -0.2])
SIGMA = 0.1
T_MAP_ODOM = np.array([30.0, -12.0, 1.1])
CONFIG = BackendConfig(measurements={'tags': RANGES})

Events = list[tuple[int, str, Any]]


def path(seconds: float) -> FloatArray:
    """Return the poses of a robot that drives two rounds of an oval."""
    times = np.arange(0.0, seconds, 0.1)
    theta = 0.1 * times + 0.8 * np.sin(0.2 * times)
    steps = np.column_stack((np.cos(theta), np.sin(theta))) * 0.1
    return np.column_stack((np.cumsum(steps, axis=0) - steps, se2.wrap(theta)))


TRUTH = path(120.0)


def drive(seed: int = 1, *, known: bool = False, wrong: float = 0.0) -> Events:
    """Return odometry that drifts, and a range to each beacon every half a second."""
    rng = np.random.default_rng(seed)
    events, pose = Events(), TRUTH[0]
    for k, truth in enumerate(TRUTH):
        stamp = (k + 10) * SECOND // 10
        if k > 0:
            step = se2.between(TRUTH[k - 1], truth)
            pose = se2.compose(pose, step * 1.02 + rng.normal(0.0, [0.004, 0.002, 0.004]))
        events.append((stamp, 'odom', OdometrySample(stamp, pose)))
        if k % 5 != 3:
            continue
        for name, place in BEACONS.items():
            distance = float(np.hypot(*(se2.transform(truth, ARM) - place)))
            off = rng.normal(0.0, SIGMA) + 6.0 * (rng.random() < wrong)
            events.append((stamp + 7_000_000, 'tags', Range(
                stamp, name, distance + off, SIGMA**2, ARM,
                se2.transform(T_MAP_ODOM, np.array(place)) if known else None)))
    return events


def run(events: Events, backend: PoseGraphBackend | None = None) -> PoseGraphBackend:
    backend = PoseGraphBackend(CONFIG) if backend is None else backend
    feed(backend, events)
    backend.optimize()
    return backend


def feed(backend: PoseGraphBackend, events: Events) -> None:
    for n, (_, source, each) in enumerate(events):
        (backend.add_odometry if source == 'odom' else backend.add_measurement)(each, source)
        if n % 50 == 0:
            backend.update()


def errors(backend: PoseGraphBackend, T: tuple[float, ...] = (0.0, 0.0, 0.0)) -> FloatArray:
    """Return how far the path is off the truth [m]."""
    found = backend.estimate().path
    at = np.round((found.stamps_ns / SECOND - 1.0) * 10.0).astype(int)
    true = se2.compose(np.array(T), TRUTH[np.minimum(at, len(TRUTH) - 1)])
    return np.hypot(*(found.poses - true)[:, :2].T)


def places(backend: PoseGraphBackend) -> dict[str, FloatArray]:
    return {name: backend.graph.poses_of(number)[:2]
            for name, number in backend.parts.pipeline.beacons.ids.items()}


def test_beacons_at_unknown_places_are_found_and_hold_the_path() -> None:
    alone = run([event for event in drive() if event[1] == 'odom'])
    backend = run(drive())
    assert np.max(errors(alone)) > 3.0
    assert np.max(errors(backend)) < 0.5
    for name, place in places(backend).items():
        assert np.hypot(*(place - BEACONS[name])) < 0.3, name
    assert len(places(backend)) == 4
    report = backend.reports()['tags']
    assert backend.counts['tags', 'accepted'] == report.n == 4 * len(TRUTH) // 5
    assert report.energy == pytest.approx(1.0, abs=0.2)
    assert any(each.kind == 'range' and each.source == 'tags' and ' near x' in each.name
               for each in backend.largest_energies(2000))


def test_wrong_ranges_have_little_weight() -> None:
    assert np.max(errors(run(drive(wrong=0.1)))) < 0.6


def test_the_order_of_arrival_does_not_matter() -> None:
    events, rng = drive(), np.random.default_rng(2)
    late = [(stamp if source == 'odom' else stamp + int(rng.integers(20 * SECOND)), source, each)
            for stamp, source, each in events]
    one, other = run(events), run(sorted(late, key=lambda event: event[0]))
    np.testing.assert_allclose(one.estimate().path.poses, other.estimate().path.poses, atol=1e-6)


def test_beacons_at_known_places_hold_the_path_in_the_map() -> None:
    start = GlobalPose(SECOND, se2.compose(T_MAP_ODOM, TRUTH[0]), np.diag((0.25, 0.25, 0.01)))
    events = drive(known=True)
    backend = PoseGraphBackend(CONFIG)
    feed(backend, events[:100])
    assert len(places(backend)) == 0, 'the graph does not lie in the map yet'
    assert backend.n_waiting > 0
    backend.add_measurement(start, 'start')
    run(events[100:], backend)
    assert np.max(errors(backend, tuple(T_MAP_ODOM))) < 0.4
    for name, place in places(backend).items():
        assert place == pytest.approx(se2.transform(T_MAP_ODOM, np.array(BEACONS[name])), abs=0.05)


def test_a_saved_graph_goes_on_with_its_beacons() -> None:
    events = drive()
    first = PoseGraphBackend(CONFIG)
    feed(first, events[:2000])
    first.update()
    second = PoseGraphBackend.restored(CONFIG, first.saved())
    assert places(second).keys() == places(first).keys() != set()
    for backend in (first, second):
        run(events[2000:], backend)
    np.testing.assert_allclose(
        first.estimate().path.poses, second.estimate().path.poses, atol=1e-6)


def test_beacons_stay_when_nodes_leave() -> None:
    backend = run(drive(), PoseGraphBackend(replace(CONFIG, window=WindowConfig(nodes=40))))
    assert backend.estimate().n_frozen > 20
    assert len(places(backend)) == 4
    # what has left was placed while the beacons were not known well
    assert np.max(errors(backend)) < 1.2
    assert errors(backend)[-1] < 0.3


def test_a_straight_way_does_not_tell_on_which_side_a_beacon_is() -> None:
    way = np.column_stack((np.arange(0.0, 20.0, 0.5), np.zeros(40)))
    place = np.array([7.0, 6.0])

    def found(points: FloatArray) -> FloatArray | None:
        return located(points, np.hypot(*(points - place).T), np.full(len(points), 0.1))

    assert found(way) is None
    bent = way + np.column_stack((np.zeros(40), np.maximum(way[:, 0] - 10.0, 0.0)))
    assert found(bent) == pytest.approx(place, abs=1e-3)
    for ranges in (np.zeros(40), np.full(40, 1e9), 1e8 * np.arange(40.0), 1e-9 * np.arange(40.0)):
        far = located(bent, ranges, np.full(40, 0.1))
        assert far is None or np.all(np.isfinite(far))
