# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The TUM format: nanoseconds kept, headings in quaternions, mistakes named."""

from pathlib import Path
import re

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import random_poses

from pose_graph_ros.core import se2
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.io.tum import read_tum, write_tum
from pose_graph_ros.core.trajectory import Trajectory

# A heading goes through the sine and cosine of its half.
HEADING = 1e-15

stamps_ns = st.lists(st.integers(0, 2**62), min_size=0, max_size=8, unique=True).map(sorted)


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('tum')


def read(folder: Path, text: str) -> Trajectory:
    path = folder / 'path.tum'
    path.write_text(text, encoding='utf-8')
    return read_tum(path)


@given(stamps_ns, st.integers(0, 999))
def test_a_trajectory_comes_back(folder: Path, stamps: list[int], seed: int) -> None:
    trajectory = Trajectory(stamps, random_poses(np.random.default_rng(seed), len(stamps), 5e6))
    path = folder / 'round_trip.tum'
    write_tum(trajectory, path)
    back = read_tum(path)
    np.testing.assert_array_equal(back.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_array_equal(back.poses[:, :2], trajectory.poses[:, :2])
    np.testing.assert_allclose(
        se2.wrap(back.poses[:, 2] - trajectory.poses[:, 2]), 0.0, atol=HEADING)


@given(stamps_ns.map(lambda stamps: sorted({stamp - 2**61 for stamp in stamps})))
def test_stamps_before_the_epoch_come_back_too(folder: Path, stamps: list[int]) -> None:
    path = folder / 'negative.tum'
    write_tum(Trajectory(stamps, np.zeros((len(stamps), 3))), path)
    np.testing.assert_array_equal(read_tum(path).stamps_ns, stamps)


@pytest.mark.parametrize(('text', 'stamp'), [
    ('0', 0), ('5', 5_000_000_000), ('1.5', 1_500_000_000), ('.5', 500_000_000),
    ('1767225600.123456789', 1_767_225_600_123_456_789), ('7.', 7_000_000_000),
    ('1.0000000019', 1_000_000_001), ('1e1', 10_000_000_000), ('-1.5', -1_500_000_000)])
def test_stamps_are_read_to_the_nanosecond(folder: Path, text: str, stamp: int) -> None:
    assert read(folder, f'{text} 0 0 0 0 0 0 1').stamps_ns[0] == stamp


@pytest.mark.parametrize('yaw', [0.0, 1.0, -3.0, 3.1, -np.pi])
def test_the_heading_is_read_from_any_quaternion(folder: Path, yaw: float) -> None:
    s, c = float(np.sin(yaw / 2.0)), float(np.cos(yaw / 2.0))
    for sign in (1.0, -1.0):
        pose = read(folder, f'# x\n\n1 4 5 6 0 0 {sign * s!r} {sign * c!r}\n').poses[0]
        np.testing.assert_array_equal(pose[:2], [4.0, 5.0])
        assert abs(se2.wrap(pose[2] - yaw)) < 4.0 * HEADING
    # a little pitch does not turn it: q = yaw * pitch
    pitch = 0.2
    sp, cp = float(np.sin(pitch / 2.0)), float(np.cos(pitch / 2.0))
    pose = read(folder, f'1 0 0 0 {-s * sp!r} {c * sp!r} {s * cp!r} {c * cp!r}').poses[0]
    assert abs(se2.wrap(pose[2] - yaw)) < 4.0 * HEADING


MISTAKES = {
    'few': '2 0 0 0 0 0 1', 'many': '2 0 0 0 0 0 0 1 9', 'word': '2 0 zero 0 0 0 0 1',
    'stamp': 'two 0 0 0 0 0 0 1', 'inf_stamp': 'inf 0 0 0 0 0 0 1',
    'nan_stamp': 'nan 0 0 0 0 0 0 1', 'late_stamp': '1e30 0 0 0 0 0 0 1',
    'long_stamp': f'{10**25} 0 0 0 0 0 0 1', 'superscript': '² 0 0 0 0 0 0 1',
    'nan': '2 nan 0 0 0 0 0 1', 'inf': '2 0 inf 0 0 0 0 1', 'no_turn': '2 0 0 0 0 0 nan 1',
}


@pytest.mark.parametrize('name', MISTAKES)
def test_every_mistake_is_named_with_file_and_line(folder: Path, name: str) -> None:
    where = re.escape(str(folder / 'path.tum'))
    with pytest.raises(FileFormatError, match=f'^{where}:3: '):
        read(folder, f'# stamp x y z qx qy qz qw\n1 0 0 0 0 0 0 1\n{MISTAKES[name]}\n')


def test_stamps_that_do_not_increase_are_refused(folder: Path) -> None:
    line = '1 0 0 0 0 0 0 1\n'
    with pytest.raises(FileFormatError, match=r'path\.tum.*must increase'):
        read(folder, 2 * line)


def test_what_is_no_text_or_no_file_is_refused(folder: Path) -> None:
    binary = folder / 'binary.tum'
    binary.write_bytes(bytes(range(256)))
    for path in (binary, folder / 'missing.tum', folder):
        with pytest.raises(FileFormatError, match=re.escape(str(path))):
            read_tum(path)


numbers = st.one_of(st.floats().map(repr), st.integers().map(str), st.text(max_size=4))


@given(st.one_of(st.text(), st.lists(
    st.lists(numbers, min_size=8, max_size=8).map(' '.join)).map('\n'.join)))
def test_no_text_brings_the_reader_down(folder: Path, text: str) -> None:
    path = folder / 'fuzz.tum'
    path.write_bytes(text.encode('utf-8', 'surrogatepass'))
    try:
        with np.errstate(over='ignore', invalid='ignore'):
            trajectory = read_tum(path)
    except FileFormatError as error:
        problem = str(error)
    else:
        problem = str(path)
        assert np.all(np.isfinite(trajectory.poses))
    assert str(path) in problem
