# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The soak in short: a robot's life with restarts, by its counts; `make soak` lives a month."""

import logging
from pathlib import Path
from types import SimpleNamespace

import pytest

from pose_graph_ros.adapters.conversions import Datum
from pose_graph_ros.core.config import BackendConfig, WindowConfig

ROOT = Path(__file__).resolve().parents[2]
WINDOW = 150    # hidden nodes
PARTS, RATE = 8, 4  # and the rate of odometry [Hz]
FULL = 4    # part from which on the windows of graph and learning are full
# A node that has left the graph may cost so much, with the room that arrays grow into [bytes], and
# the rest may be larger by so much by chance.
A_NODE, CHANCE = 100, 0.02


@pytest.fixture(scope='module')
def life(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Eight parts of ten minutes, with a kill in the first, and what was logged."""
    logged = list[str]()
    handler = logging.Handler(logging.INFO)
    handler.emit = lambda record: logged.append(record.getMessage())  # type: ignore[method-assign]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        from benchmark.soak import engine, life as lives  # noqa: PLC0415

        patch.setattr(lives, 'RATE', RATE)
        logging.getLogger('pose_graph_ros').addHandler(handler)
        parts = [*engine.run(
            lives.Life(1, PARTS / 6, Datum(engine.DATUM)), tmp_path_factory.mktemp('life'), 1 / 6,
            BackendConfig(window=WindowConfig(nodes=WINDOW)), kills={1})]
        logging.getLogger('pose_graph_ros').removeHandler(handler)
    return SimpleNamespace(parts=parts, logged=logged)


def test_every_measurement_is_accepted_or_refused_as_it_was_meant_over_all_restarts(
    life: SimpleNamespace,
) -> None:
    last = life.parts[-1]
    assert last.kills == 1
    assert (last.lost, last.forgotten, last.unexpected) == (0, 0, 0), last.answers
    assert last.answers['odom accepted'] == PARTS * 600 * RATE


def test_a_restart_moves_no_node(life: SimpleNamespace) -> None:
    assert life.parts[-1].moved <= 1e-9


def test_memory_grows_by_the_path_alone(life: SimpleNamespace) -> None:
    first, last = life.parts[FULL], life.parts[-1]
    assert last.kept == pytest.approx(first.kept, abs=20)
    path = 1e-6 * A_NODE * (last.nodes - first.nodes)
    assert last.held <= (1.0 + CHANCE) * first.held + path


def test_an_update_eliminates_as_little_as_in_the_beginning(life: SimpleNamespace) -> None:
    first, last = life.parts[FULL], life.parts[-1]
    assert last.update_work <= 1.5 * first.update_work


def test_nothing_is_logged_of_measurements(life: SimpleNamespace) -> None:
    assert life.logged == []
