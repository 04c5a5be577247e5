# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Filters of others are asked by lines of text; here a trivial one stands for them."""

from dataclasses import replace
from pathlib import Path
import sys

import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmark import drives, filters

PROGRAM = """#!{python}
from math import cos, sin
import sys
last, x = None, None
for line in sys.stdin:
    word, *numbers = line.split()
    numbers = [float(number) for number in numbers]
    if word == 'start' and not {waits}:
        x, y, yaw = numbers
    elif word == 'start':
        yaw = numbers[2]
    elif word == 'odometry':
        since, last = numbers[0] - (last or numbers[0]), numbers[0]
        if x is None:
            print('none')
            continue
        vx, vy, w = numbers[1:4]
        x += since * (cos(yaw) * vx - sin(yaw) * vy)
        y += since * (sin(yaw) * vx + cos(yaw) * vy)
        yaw += since * w
        print(x, y, yaw, 4.0, 0.0, 4.0)
    elif word == 'fix':
        x, y = numbers[1:3]
print('seconds 0.25')
"""


def program(folder: Path, *, waits: bool) -> Path:
    """Return dead reckoning between fixes, perhaps without a pose before the first of them."""
    file = folder / 'filter'
    file.write_text(PROGRAM.format(python=sys.executable, waits=waits), encoding='utf-8')
    file.chmod(0o755)
    return file


@pytest.fixture
def drive() -> drives.Drive:
    return drives.simulated(0, 90.0)


def test_a_filter_that_adds_up_what_it_gets_drives_the_path_of_odometry(
    tmp_path: Path, drive: drives.Drive,
) -> None:
    silent = drive.only(np.zeros(len(drive.fixes), dtype=bool))
    online = filters.ask(program(tmp_path, waits=False), filters.lines(silent))
    path = drive.odometry.poses
    start = drive.truth.at(drive.odometry.stamps_ns[0])
    expected = se2.compose(start, se2.between(path[0], path))
    np.testing.assert_allclose(online.poses[:, :2], expected[:, :2], atol=1e-3)
    assert online.seconds == 0.25


def test_fixes_come_in_their_turn_and_what_is_before_the_first_pose_does_not_count(
    tmp_path: Path, drive: drives.Drive,
) -> None:
    exact = replace(drive, fixes=drive.truth.at(drive.stamps_ns)[:, :2])
    online = filters.ask(program(tmp_path, waits=True), filters.lines(exact))
    before = drive.odometry.stamps_ns < drive.stamps_ns[0]
    np.testing.assert_array_equal(np.isnan(online.poses[:, 0]), before)
    found = filters.figures(exact, online)
    assert found.rms < 1.0
    assert found.nees == pytest.approx(0.5 * found.rms**2 / 4.0, rel=1e-9)
    assert found.first == pytest.approx(float(np.count_nonzero(before)) / 10.0, abs=0.11)
    assert np.isnan(found.back)


def test_a_peer_that_is_missing_has_no_column_and_the_best_of_the_others_is_bold() -> None:
    one = filters.Figures(0.5, 1.0, np.nan, np.nan, 1.0, 0.7, 10.0, 8.0)
    page = filters.page([
        (filters.Case(seed, 'clean', 'good', Path(), {}),
         {'ours': replace(one, rms=rms), 'FusionCore': replace(one, rms=0.75)})
        for seed, rms in ((7, 0.5), (8, 0.6))], 'command')
    assert '| scenario | odometry | ours | FusionCore |\n' in page
    assert '| clean | good | **0.55 (0.5 to 0.6)** | 0.75 (0.75 to 0.75) |' in page
    assert '| clean | 2 | 2 | 1.37 (1.25) |' in page
