# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Saved graphs that nodes have left: by a window, and by thinning."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from saved_graphs import assert_same_value
from test_thinning_backend import driven, settings
from test_window import drive, Event, run, WINDOW
from tum_files import read_tum

from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, OdometrySource, POSITIONS
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.io.g2o import read_g2o, STANDING_FOR
from pose_graph_ros.core.io.graph_files import read_graph, SavedGraph, write_graph
from pose_graph_ros.core.measurements import OdometrySample


def through_files(saved: SavedGraph, folder: Path) -> SavedGraph:
    loaded = read_graph(write_graph(saved, folder / 'map')[1])
    assert_same_value(loaded, saved)
    return loaded


def interrupted(
    events: Sequence[Event], config: BackendConfig, folder: Path,
) -> tuple[Estimate, Estimate, SavedGraph]:
    """Return final estimates of a drive and of one that was saved halfway, and what was saved."""
    at = 12 * (len(events) // 24)
    once, first = (run(some, None, PoseGraphBackend(config)) for some in (events, events[:at]))
    saved = first.saved()
    second = run(events[at:], None, PoseGraphBackend.restored(
        config, through_files(saved, folder)))
    found = []
    for backend in (once, second):
        assert backend.optimize().status is Status.CONVERGED
        found.append(backend.estimate())
    return *found, saved


def test_a_drive_of_two_odometries_goes_on_with_its_window_as_without_saving(
    tmp_path: Path,
) -> None:
    rng, events = np.random.default_rng(5), []
    for source, what in drive(1500)[0]:
        events.append((source, what))
        if isinstance(what, OdometrySample):
            events.append(('visual', OdometrySample(
                what.stamp_ns + 30_000_000, se2.compose(
                    np.array([1.0, 2.0, -1.0]), what.pose + rng.normal(0.0, 1e-3, 3)))))
    # noise that is learnt is begun anew from a file
    told = BackendConfig(
        window=WINDOW, odometry={'odom': OdometrySource(sigma_scale=1.0)},
        measurements={'fix': replace(POSITIONS, correlation_time=0.0)})
    one, other, saved = interrupted(events, told, tmp_path)
    assert one.n_edges > 1.5 * (one.n_hidden - one.n_frozen)
    assert len(saved.rows.priors) > 0
    assert len(saved.nodes.frozen) > 40
    assert len(saved.nodes.streams['visual'].stamps_ns) < 1000
    assert one.n_frozen == other.n_frozen > len(saved.nodes.frozen)
    np.testing.assert_allclose(one.path.poses, other.path.poses, atol=1e-3)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=0.02, atol=1e-6)


def test_one_without_alignment_keeps_its_fixed_node_and_is_aligned_later(tmp_path: Path) -> None:
    events, _ = drive(1500, first_fix=1000, closures=0)
    one, other, saved = interrupted(events, BackendConfig(window=WINDOW), tmp_path)
    assert len(saved.nodes.frozen) > 0
    assert saved.rows.fixed[0]
    assert saved.rows.node_ids[0] == saved.nodes.ids[0]
    assert one.alignment is other.alignment is AlignmentState.ALIGNED
    np.testing.assert_allclose(one.path.poses, other.path.poses, atol=1e-3)


def test_other_programs_get_the_whole_path_and_edges_instead_of_priors(tmp_path: Path) -> None:
    backend = run(drive(1500)[0], WINDOW)
    saved, estimate = backend.saved(), backend.estimate()
    g2o, _, tum = write_graph(saved, tmp_path / 'map')
    text = g2o.read_text()
    assert f'{STANDING_FOR}dense priors, ' in text
    assert 'of which there are 1: ' in text
    path = read_tum(tum)
    np.testing.assert_array_equal(path.stamps_ns, saved.nodes.stamps_ns)
    np.testing.assert_allclose(path.poses, estimate.path.poses[:len(path)], atol=1e-12)
    file = read_g2o(g2o)
    factors = backend.graph.factors
    assert file.graph.n_factors > np.count_nonzero((factors.j >= 0) | (factors.weight > 0.0))


def test_nodes_that_were_thinned_out_come_back_with_their_places(tmp_path: Path) -> None:
    backend, _ = driven(settings(2.0))
    saved = backend.saved()
    assert len(saved.nodes.thinned['numbers']) > 50
    restored = PoseGraphBackend.restored(settings(2.0), through_files(saved, tmp_path))
    path = read_tum(tmp_path / 'map.tum')
    estimate = backend.estimate()
    assert estimate is not None
    np.testing.assert_array_equal(saved.path, estimate.path.poses[:len(saved.path)])
    np.testing.assert_allclose(path.poses, saved.path, atol=1e-12)
    np.testing.assert_array_equal(restored.estimate().path.poses, estimate.path.poses)
