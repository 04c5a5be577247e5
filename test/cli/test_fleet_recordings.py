# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What paths, patterns, lists and URLs mean, and what of a bag says that it has changed."""

import os
from pathlib import Path
import shutil
from zipfile import ZipFile

from fleet_bags import write_drives
import pytest

from pose_graph_ros.adapters.bags import BagError, open_bag
from pose_graph_ros.cli.fleet.recordings import (
    content_of,
    files_of,
    find_recordings,
    local_copy,
    Recording,
    without_suffix,
)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drives(tmp_path_factory.mktemp('bag'), 1)[0]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Folders with bags of all kinds, and what is none."""
    for name in ('july/one/metadata.yaml', 'july/one/one_0.mcap', 'july/one/one_1.mcap',
                 'july/cut/cut_0.db3', 'july/cut/cut_0.db3-wal', 'july/cut/notes.txt',
                 'july/loose/a.mcap', 'july/loose/b.bag', 'july/loose/c.mcap',
                 'july/packed/metadata.yaml', 'july/packed/packed_0.mcap.zstd',
                 'july/logs/node.log', 'july/lost/metadata.yaml', 'june/x.mcap',
                 'out/drives/k.mcap'):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return tmp_path


def found(tree: Path, *words: str) -> list[str]:
    return [os.path.relpath(each.path, tree) for each in find_recordings(words, tree / 'out')]


JULY = ['july/cut', 'july/loose/a.mcap', 'july/loose/b.bag', 'july/loose/c.mcap', 'july/one',
        'july/packed']


def test_bags_are_found_at_any_depth(tree: Path) -> None:
    assert sorted(found(tree, f'{tree}/july')) == JULY
    assert sorted(found(tree, str(tree))) == [*JULY, 'june/x.mcap']     # but those of results
    assert found(tree, f'{tree}/july/one') == ['july/one']
    assert found(tree, f'{tree}/july/cut') == ['july/cut']


def test_patterns_and_lists_each_bag_once(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert found(tree, f'{tree}/*/loose/*.mcap') == ['july/loose/a.mcap', 'july/loose/c.mcap']
    assert sorted(found(tree, f'{tree}/j*')) == [*JULY, 'june/x.mcap']
    assert found(tree, f'{tree}/july/**/a.mcap', f'{tree}/july/loose/a.mcap') == [
        'july/loose/a.mcap']
    (tree / 'list.txt').write_text('# of July\n\n  july/one  \njune\njuly/logs\nnowhere.mcap\n')
    monkeypatch.chdir(tree)
    assert found(tree, 'list.txt') == ['july/one', 'june/x.mcap', 'july/logs', 'nowhere.mcap']
    with pytest.raises(BagError, match='july/logs: no bag, expected rosbag2 folders'):
        found(tree, 'july/logs')


def test_a_list_may_name_itself_and_begin_with_a_mark(
    tree: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tree)
    monkeypatch.setenv('HOME', str(tree / 'july'))
    (tree / 'list.txt').write_text('\ufeffjuly/one\r\n~/cut\r\nlist.txt\r\n', newline='')
    assert found(tree, 'list.txt') == ['july/one', 'july/cut', 'list.txt']


def test_a_bag_with_several_names_is_one_whatever_the_links(tree: Path) -> None:
    for link, target in (('july/alpha', 'one'), ('july/loose/0.mcap', 'a.mcap'),
                         ('july/again', '.')):
        (tree / link).symlink_to(target)
    assert sorted(found(tree, f'{tree}/july', f'{tree}/july/alpha')) == JULY
    assert found(tree, f'{tree}/july/alpha') == ['july/alpha']


def test_results_may_be_where_the_bags_are(tree: Path) -> None:
    shutil.move(tree / 'out/drives', tree / 'july/drives')
    words = [f'{tree}/july']
    assert sorted(os.path.relpath(each.path, tree) for each in find_recordings(
        words, tree / 'june/../july')) == JULY


def test_only_the_suffix_of_a_bag_file_is_taken_from_a_name(tree: Path) -> None:
    for path, name in (('june/x.mcap', 'x'), ('june/run 1.5', 'run 1.5'),
                       ('june/run 1.5.db3.zstd', 'run 1.5'), ('june/y.g2o', 'y')):
        assert find_recordings([f'{tree}/{path}'], tree / 'out')[0].name == name
        assert without_suffix(f'{tree}/{path}') == f'{tree}/june/{name}'


def test_drives_named_by_their_folder_are_not_one_that_was_cut_off(tree: Path) -> None:
    for day in (1, 2):
        (tree / f'june/june_{day}.mcap').write_bytes(b'')
    (tree / 'june/x.mcap').unlink()
    assert found(tree, f'{tree}/june') == ['june/june_1.mcap', 'june/june_2.mcap']


def test_a_name_that_is_no_text_stands_for_a_bag_that_fails(tree: Path) -> None:
    (tree / 'june' / os.fsdecode(b'bad\xff.mcap')).write_bytes(b'')
    assert find_recordings([f'{tree}/june'], tree / 'out')[0] == Recording(
        r'bad\xff', rf'{tree}/june/bad\xff.mcap')


def test_a_folder_that_cannot_be_read_is_told(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    def scandir(folder: str) -> object:
        if str(folder).endswith('loose'):
            raise PermissionError(13, 'Permission denied', str(folder))
        return real(folder)

    real = os.scandir
    monkeypatch.setattr(os, 'scandir', scandir)
    assert len(found(tree, f'{tree}/july')) == 3
    assert capsys.readouterr().err == f'left out: {tree}/july/loose: Permission denied\n'


def test_a_bag_is_all_that_belongs_to_it(tree: Path) -> None:
    assert [path.name for path in files_of(tree / 'july/cut')] == ['cut_0.db3', 'cut_0.db3-wal']
    assert [path.name for path in files_of(tree / 'july/cut/cut_0.db3')] == [
        'cut_0.db3', 'cut_0.db3-wal']
    assert [path.name for path in files_of(tree / 'july/packed')] == [
        'metadata.yaml', 'packed_0.mcap.zstd']
    assert files_of(tree / 'nowhere.mcap') == []


def test_the_stamp_changes_with_any_file_of_it(tree: Path) -> None:
    def stamp() -> str:
        return find_recordings([f'{tree}/july/one'], tree / 'out')[0].stamp

    before, content = stamp(), content_of(files_of(tree / 'july/one'))
    assert stamp() == before != ''
    os.utime(tree / 'july/one/one_1.mcap', ns=(1, 1))
    assert stamp() != before
    assert content_of(files_of(tree / 'july/one')) == content
    (tree / 'july/one/one_1.mcap').write_bytes(b'july/one/one_2.mcap')
    assert content_of(files_of(tree / 'july/one')) != content
    # contents that only together are the same
    for name, text in (('one_0.mcap', b'ab'), ('one_1.mcap', b'c')):
        (tree / 'july/one' / name).write_bytes(text)
    divided = content_of(files_of(tree / 'july/one'))
    for name, text in (('one_0.mcap', b'a'), ('one_1.mcap', b'bc')):
        (tree / 'july/one' / name).write_bytes(text)
    assert content_of(files_of(tree / 'july/one')) != divided


@pytest.mark.parametrize('pattern', ['', '/*', '/day*'])
def test_a_folder_behind_a_url_is_fetched_and_removed(
    bag: Path, tmp_path: Path, pattern: str,
) -> None:
    shutil.copytree(bag, tmp_path / 'bags' / 'day 00')
    recordings = find_recordings([f'file://{tmp_path}/bags{pattern}'], tmp_path / 'out')
    assert [(each.name, each.path) for each in recordings] == [
        ('day 00', f'file://{tmp_path}/bags/day 00')]
    assert recordings[0].is_remote
    assert recordings[0].stamp != ''
    with local_copy(recordings[0]) as copy:
        assert copy != tmp_path / 'bags/day 00'
        assert content_of(files_of(copy)) == content_of(files_of(bag))
        with open_bag(copy) as opened:
            assert '/odom' in opened.topics
    assert not copy.exists()


def test_a_file_in_an_archive_has_a_url_of_two_parts(bag: Path, tmp_path: Path) -> None:
    storage = next(path for path in bag.iterdir() if path.suffix in ('.mcap', '.db3'))
    archive = tmp_path / 'july.zip'
    with ZipFile(archive, 'w') as file:
        file.write(storage, f'robot/a{storage.suffix}')
        file.write(storage, f'robot/b{storage.suffix}')
    recordings = find_recordings([f'zip://**::file://{archive}'], tmp_path / 'out')
    assert [each.name for each in recordings] == ['a', 'b']
    with local_copy(recordings[1]) as copy:
        assert copy.name == f'b{storage.suffix}'
        assert copy.read_bytes() == storage.read_bytes()


def test_a_url_without_bags_or_a_file_system_is_told(tmp_path: Path) -> None:
    for url in (f'file://{tmp_path}', f'file://{tmp_path}/*.mcap', 'gopher://bags',
                f'zip://*::file://{tmp_path}/none.zip', f'file://{tmp_path}/none.mcap'):
        with pytest.raises(BagError) as raised:
            find_recordings([url], tmp_path / 'out')
        assert str(raised.value).startswith(f'{url}: ')
        assert '\n' not in str(raised.value)


def test_a_path_that_only_workers_see_is_left_to_them(tmp_path: Path) -> None:
    assert find_recordings(['/nowhere/run.mcap'], tmp_path) == [
        Recording('run', '/nowhere/run.mcap')]
