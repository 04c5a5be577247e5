# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of graphs stay in the folder that they are for, and those of others stay as they are."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
import subprocess

import pytest
from saved_graphs import straight_line

from pose_graph_ros.core.exceptions import ConfigError, FileFormatError, FileWriteError
from pose_graph_ros.core.io.graph_files import read_graph, write_graph
from pose_graph_ros.ros.stored_graphs import graph_path, with_folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with links, and files outside of it."""
    folder, outside = tmp_path / 'maps', tmp_path / 'outside'
    folder.mkdir()
    outside.mkdir()
    (folder / 'away').symlink_to(outside)
    (folder / 'link.json').symlink_to(outside / 'secret')
    (folder / 'loop').symlink_to(folder / 'loop')
    (folder / 'yard').mkdir()
    (folder / 'here').symlink_to(folder / 'yard')
    return folder


def named(name: str, folder: Path) -> Path:
    return graph_path(with_folder({'file_folder': str(folder), 'graph_file': name}))


@pytest.mark.parametrize('name', [
    '', '../map', 'yard/../../map.g2o', 'away/map', 'link', 'loop/map', '/etc/passwd', '/', '.',
    '~nobody_of_this_name/map', 'a\0b', 300 * 'x', 255 * 'x', 100 * 'ü' + 100 * 'x' + '.g2o',
    1_000_000 * 'x', 1_000_000 * '../', '{folder}/../map', '{folder}x/map'])
def test_a_name_that_leads_out_of_the_folder_or_is_none_is_refused_in_a_line(
    folder: Path, name: str,
) -> None:
    with pytest.raises(ConfigError, match=r'^parameter graph_file: expected .*, got ') as raised:
        named(name.replace('{folder}', str(folder)), folder)
    assert len(str(raised.value)) < 500
    assert len(str(raised.value).splitlines()) == 1


@pytest.mark.parametrize('name', [
    'map', 'map.g2o', 'yard/map', 'new/map', 'yard/../map', 'here/map', '{folder}/map'])
def test_a_name_in_the_folder_is_taken(folder: Path, name: str) -> None:
    found = named(name.replace('{folder}', str(folder)), folder)
    assert found.is_relative_to(folder)
    assert 'here' not in found.parts


def test_by_default_it_is_the_folder_of_the_file_at_the_start_or_the_working_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('HOME', str(tmp_path / 'home'))
    for name, expected in (('', '.'), ('map.g2o', '.'), ('maps/map', 'maps'), ('~/m/x', 'home/m')):
        values = with_folder({'graph_file': name, 'file_folder': ''})
        assert values['file_folder'] == str(tmp_path / expected)
        if name != '':
            assert graph_path(values) == tmp_path / expected / Path(name).name


def test_a_link_that_is_put_there_after_the_check_of_the_name_is_not_followed(
    folder: Path,
) -> None:
    saved = straight_line().saved()
    outside = write_graph(saved, folder.parent / 'outside' / 'map')
    path = named('map', folder)
    for each in outside:
        (folder / each.name).symlink_to(each)
    with pytest.raises(FileFormatError, match='leads out of'):
        read_graph(path, folder)
    assert len(read_graph(path).nodes.ids) == len(saved.nodes.ids)     # to a user it is a file


@pytest.mark.parametrize('name', ['map.g2o', 'map.json', 'map.tum'])
def test_a_file_that_is_not_of_a_saved_graph_is_not_overwritten(
    tmp_path: Path, name: str,
) -> None:
    saved = straight_line().saved()
    (tmp_path / name).write_text('{"mine": 1}\n')
    with pytest.raises(FileWriteError, match=rf'{name}: there already, and not of a saved graph'):
        write_graph(saved, tmp_path / 'map')
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == '{"mine": 1}\n'
    (tmp_path / name).unlink()
    for _ in range(2):
        write_graph(saved, tmp_path / 'map')


@contextmanager
def mounted(folder: Path, *options: str) -> Iterator[Path]:
    """Mount a file system of one page more than nothing; skip the test where that is forbidden."""
    folder.mkdir()
    if subprocess.run(['mount', '-t', 'tmpfs', *options, 'tmpfs', folder], check=False,
                      capture_output=True).returncode != 0:
        pytest.skip('no file system can be mounted here')
    try:
        yield folder
    finally:
        subprocess.run(['umount', folder], check=True)


def fill(folder: Path) -> None:
    (folder / 'full').touch()
    subprocess.run(['dd', 'if=/dev/zero', f'of={folder / "full"}'], check=False,
                   capture_output=True)


def make_read_only(folder: Path) -> None:
    subprocess.run(['mount', '-o', 'remount,ro', folder], check=True)


@pytest.mark.parametrize(('spoil', 'reason'), [(fill, 'No space left'), (
    make_read_only, 'Read-only file system')])
def test_on_a_full_disk_or_a_read_only_one_earlier_files_stay(
    tmp_path: Path, spoil: Callable[[Path], None], reason: str,
) -> None:
    with mounted(tmp_path / 'disk', '-o', 'size=64k') as folder:
        saved = straight_line().saved()
        before = {path: path.read_bytes() for path in write_graph(saved, folder / 'map')}
        spoil(folder)
        with pytest.raises(FileWriteError, match=f'map.g2o.* cannot be written: .*{reason}'):
            write_graph(saved, folder / 'map')
        assert {path: path.read_bytes() for path in before} == before
        assert {path.name for path in folder.iterdir()} <= {
            'map.g2o', 'map.json', 'map.tum', 'full'}
