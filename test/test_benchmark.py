# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark still fits to the package: its modules load, and drives of its own are made."""

import importlib
from pathlib import Path
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
# What needs GTSAM, which only the benchmark installs.
PEERS = {'gtsam_peer', 'peer'}


def test_the_benchmark_loads_and_makes_its_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT)
    for path in sorted((ROOT / 'benchmark').rglob('*.py')):
        if path.stem not in PEERS:
            importlib.import_module('.'.join(path.relative_to(ROOT).with_suffix('').parts))
    drive = sys.modules['benchmark.inputs'].CART.drive(0)
    assert len(drive.fixes) > 10
    assert np.all(np.isfinite(drive.fixes))


def test_a_graph_in_parts_has_the_optimum_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT)
    partition, worlds = (importlib.import_module(f'benchmark.{name}') for name in (
        'partition', 'worlds'))
    *_, last = partition.in_parts(worlds.drive(2000), 4)
    assert last['parts'] > 2
    assert last['off'] < partition.SAME
    assert abs(last['above']) < 1e-8
