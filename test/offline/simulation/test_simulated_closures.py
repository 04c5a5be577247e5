# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Closures of a simulation: share and groups of false ones, and what they measure."""

from dataclasses import replace

import numpy as np
import pytest

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.offline.simulation.recording import course, record, Recording
from pose_graph_ros.offline.simulation.settings import CLOSURES, FalseClosures, Setup
from pose_graph_ros.offline.simulation.worlds import WORLDS


def with_closures(world: str, seconds: float, rate: float = 1.0, **false: float) -> Recording:
    """Return a recording with these false closures; the other settings are the world's."""
    def change(usual: Setup) -> Setup:
        assert usual.closures is not None
        return replace(usual, closures=replace(usual.closures, rate=rate, false=replace(
            usual.closures.false, singles=0, groups=0, loose=False) if not false else replace(
                usual.closures.false, **{'singles': 0, 'groups': 0, 'loose': False, **false})))
    return record(course(WORLDS[world], 3, seconds, change))


@pytest.mark.parametrize(('world', 'seconds'), [('drive', 900.0), ('hall', 900.0),
                                                ('grid', 500.0)])
def test_the_share_and_the_groups_of_false_closures_are_as_asked(
    world: str, seconds: float,
) -> None:
    drive = with_closures(world, seconds, share=0.3, groups=3, size=5)
    closures = drive.measured[CLOSURES]
    false = closures.wrong >= 0
    assert np.mean(false) == pytest.approx(0.3, abs=0.5 / len(false))
    assert drive.missing_groups == 0
    groups, sizes = np.unique(closures.wrong[false], return_counts=True)
    assert sizes.tolist() == [5] * 3 + [1] * (int(np.sum(false)) - 15)
    assert np.all(np.diff(closures.stamps_ns[:, 1]) >= 0)

    settings = drive.setup.closures
    assert settings is not None
    poses = drive.truth.at(closures.stamps_ns[false])
    apart = np.hypot(*(poses[:, 1] - poses[:, 0])[:, :2].T)
    assert np.all(apart > settings.false.min_distance - 0.01)
    # all of them say that it is nearly one place
    measured = closures.values[false]
    assert np.median(np.hypot(*measured[:, :2].T)) < 2.0 * settings.radius
    # and those of a group say the same of where the second stretch is
    for group in groups[sizes == 5]:
        of_group = closures.wrong == group
        ends, said = drive.truth.at(closures.stamps_ns[of_group]), closures.values[of_group]
        seen = se2.compose(se2.compose(ends[:, 0], said), se2.inverse(ends[:, 1]))
        at = se2.compose(seen, ends[0, 1])    # the first pose of it, by each
        assert np.max(np.ptp(at[:, :2], axis=0)) < 6.0 * settings.sigmas[0] + 8.0 * (
            settings.sigmas[2] * 4 * settings.false.spacing)


def test_true_closures_have_their_sigmas_and_the_rate_that_was_asked_for() -> None:
    drive = with_closures('hall', 3600.0)
    whole, part = (each.measured[CLOSURES] for each in (drive, with_closures('hall', 3600.0, 0.3)))
    assert np.all(whole.wrong == -1)
    assert len(part.values) == pytest.approx(
        0.3 * len(whole.values), abs=4.0 * np.sqrt(0.21 * len(whole.values)))
    # a smaller rate leaves some of them out, and changes none
    assert set(part.stamps_ns[:, 1].tolist()) < set(whole.stamps_ns[:, 1].tolist())
    settings = drive.setup.closures
    assert settings is not None
    inside = np.all(drive.truth.covers(whole.stamps_ns), axis=1)
    ends = drive.truth.at(whole.stamps_ns[inside])
    error = se2.between(se2.between(ends[:, 0], ends[:, 1]), whole.values[inside])
    np.testing.assert_allclose(np.std(error, axis=0), settings.sigmas, rtol=0.2)


def test_more_in_groups_than_there_shall_be_is_refused() -> None:
    with pytest.raises(ConfigError, match='9 groups of 5 false closures are 45, but a share of'):
        with_closures('hall', 200.0, share=0.1, groups=9, size=5)


def test_where_nothing_looks_alike_groups_are_missing_and_counted() -> None:
    drive = record(course(WORLDS['hall'], 1, 200.0, lambda usual: replace(
        usual, closures=replace(usual.closures, false=FalseClosures(
            singles=3, min_distance=1000.0)))))
    assert drive.missing_groups == 3
    assert np.all(drive.measured[CLOSURES].wrong == -1)
