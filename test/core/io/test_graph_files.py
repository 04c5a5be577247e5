# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of saved graphs: written completely or not at all, and refused if damaged."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
import functools
import hashlib
import json
from pathlib import Path
import tempfile
from typing import Any

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from saved_graphs import assert_same_value, feed_all, LINE_ODOMETRY, line_sample, straight_line
from test_delay_invariance import CORRELATED, DRIVES
from tum_files import read_tum

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.exceptions import FileFormatError, FileWriteError
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate, NextIds
from pose_graph_ros.core.io.g2o import read_g2o
from pose_graph_ros.core.io.graph_files import (
    graph_paths,
    read_datum,
    read_graph,
    SavedGraph,
    write_graph,
)


@functools.cache
def saved_drive() -> SavedGraph:
    """Return a graph with constraints of all kinds."""
    odometry, measurements = DRIVES[1, False]
    backend = PoseGraphBackend(CORRELATED)
    feed_all(backend, sorted(odometry + measurements)[:600])
    return backend.saved(MapOrigin(48.1, 11.6, 500.0, 0.25))


@functools.cache
def small_graph() -> SavedGraph:
    return straight_line().saved()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- names and contents --------------------------------------------------------------------------

@pytest.mark.parametrize('name', ['map', 'map.g2o', 'map.json', 'map.tum'])
def test_any_of_the_suffixes_or_none_names_all_three_files(tmp_path: Path, name: str) -> None:
    folder = tmp_path / 'new' / 'deep'
    written = write_graph(small_graph(), folder / name)
    assert written == graph_paths(folder / name)
    assert sorted(contents(folder)) == ['map.g2o', 'map.json', 'map.tum']
    assert_same_value(read_graph(folder / name), small_graph())


def test_other_programs_read_the_graph_and_the_path(tmp_path: Path) -> None:
    saved = saved_drive()
    g2o, side, tum = write_graph(saved, tmp_path / 'map')
    rows = saved.rows
    graph = read_g2o(g2o).graph
    np.testing.assert_array_equal(graph.poses, rows.poses[~rows.is_bias])
    assert len(graph.factors.edges) == np.sum(rows.factors.edges.kind != FactorKind.BIAS)
    assert len(graph.factors.observed) == np.sum(~rows.is_bias[rows.factors.observed.i])
    path = read_tum(tum)
    np.testing.assert_array_equal(path.stamps_ns, saved.nodes.stamps_ns)
    np.testing.assert_array_equal(path.poses[:, :2], rows.poses[saved.nodes.ids, :2])
    members = json.loads(side.read_text(encoding='ascii'))
    assert members['version'] == 8
    assert members['datum'] == {
        'latitude': 48.1, 'longitude': 11.6, 'altitude': 500.0, 'yaw': 0.25}
    assert members['nodes']['stamps_ns'] == saved.nodes.stamps_ns.tolist()
    assert 'gps' in members['sources']


# --- places -------------------------------------------------------------------------------------


def make_folder(path: Path) -> Path:
    path.mkdir()
    return path


@pytest.mark.parametrize('place', [
    lambda folder: make_folder(folder / 'map'),             # is a folder
    lambda folder: make_folder(folder / 'map.json').with_suffix(''),
    lambda folder: folder / 'file' / 'map',                 # a file is no folder
    lambda folder: folder / ('m' * 300),                    # too long
    lambda folder: folder / 'a\0b',
    lambda folder: Path('/proc/nowhere/map'),
    lambda folder: Path('')])
def test_a_place_that_cannot_be_written_to_is_refused(
    tmp_path: Path, place: Callable[[Path], Path],
) -> None:
    (tmp_path / 'file').write_text('mine')
    path = place(tmp_path)
    before = sorted(tmp_path.rglob('*'))
    with pytest.raises(FileWriteError):
        write_graph(small_graph(), path)
    assert sorted(tmp_path.rglob('*')) == before


# --- damaged files -------------------------------------------------------------------------------

@pytest.mark.parametrize('read', [read_graph, read_datum])
def test_files_that_are_not_there_or_not_readable_are_refused(
    tmp_path: Path, read: Callable[[Path], object],
) -> None:
    with pytest.raises(FileFormatError, match=r'map\.json: cannot be read'):
        read(tmp_path / 'map')
    for path in (tmp_path / 'a\0b', tmp_path / ('m' * 300), Path('')):
        with pytest.raises(FileFormatError):
            read(path)
    write_graph(small_graph(), tmp_path / 'map')
    (tmp_path / 'map.g2o').unlink()
    with pytest.raises(FileFormatError, match=r'map\.g2o: cannot be read'):
        read(tmp_path / 'map')


def test_the_datum_is_read_alone(tmp_path: Path) -> None:
    for saved in (small_graph(), saved_drive()):
        _, side, _ = write_graph(saved, tmp_path / 'map')
        assert read_datum(side) == saved.datum
    for datum in ([91.0, 0.0, 0.0, 0.0], 'here', [1.0]):
        rewrite(side, lambda members, wrong=datum: members.update(datum=wrong))
        with pytest.raises(FileFormatError, match=r'map\.json: expected a datum'):
            read_datum(side)
    rewrite(side, lambda members: members.pop('datum'))
    with pytest.raises(FileFormatError, match=r'map\.json: expected a datum'):
        read_datum(side)


def test_the_g2o_file_of_another_graph_is_refused(tmp_path: Path) -> None:
    write_graph(small_graph(), tmp_path / 'one')
    write_graph(saved_drive(), tmp_path / 'other')
    (tmp_path / 'one.g2o').replace(tmp_path / 'other.g2o')
    with pytest.raises(FileFormatError, match=r'other\.g2o: is damaged, or not the file'):
        read_graph(tmp_path / 'other')


@functools.cache
def files_of_a_line() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        write_graph(small_graph(), Path(folder) / 'map')
        return contents(Path(folder))


@given(st.sampled_from(['g2o', 'json']), st.floats(0.0, 1.0, exclude_max=True),
       st.integers(0, 255), st.booleans())
@settings(max_examples=150)
def test_no_damage_goes_unnoticed(suffix: str, where: float, byte: int, cut: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name, each in files_of_a_line().items():
            (Path(folder) / name).write_bytes(each)
        path = Path(folder) / f'map.{suffix}'
        content = bytearray(path.read_bytes())
        at = int(where * len(content))
        if cut:
            del content[at:]
        else:
            content[at] = byte
        same = bytes(content) == path.read_bytes()
        path.write_bytes(content)
        if same:
            assert_same_value(read_graph(path), small_graph())
        else:
            for read in (read_graph, read_datum):
                with pytest.raises(FileFormatError, match=path.name):
                    read(path)


def rewrite(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Edit a JSON file and correct its checksum."""
    members = json.loads(path.read_text(encoding='ascii'))
    del members['sha256']
    change(members)
    body = (json.dumps(members)[1:]).encode('ascii')
    digest = hashlib.sha256(body).hexdigest().encode('ascii')
    path.write_bytes(b'{\n"sha256": "' + digest + b'",\n' + body)


def test_another_version_is_refused_and_says_who_wrote_it(tmp_path: Path) -> None:
    _, side, _ = write_graph(small_graph(), tmp_path / 'map')
    rewrite(side, lambda members: None)
    assert_same_value(read_graph(side), small_graph())  # the layout of the text does not matter

    def renew(members: dict[str, Any]) -> None:
        members['version'], members['created_by'] = 7, 'pose_graph_ros 9.9'

    rewrite(side, renew)
    refusal = r'of version 8, .*version 7, .*9\.9.*make it anew from the bag'
    with pytest.raises(FileFormatError, match=refusal):
        read_graph(side)


@pytest.mark.parametrize('body', [b'', b'"format": ', b'}}', b'"a": ' + b'[' * 10**5])
def test_what_is_no_json_is_refused_even_with_a_checksum(tmp_path: Path, body: bytes) -> None:
    _, side, _ = write_graph(small_graph(), tmp_path / 'map')
    digest = hashlib.sha256(body).hexdigest().encode('ascii')
    side.write_bytes(b'{\n"sha256": "' + digest + b'",\n' + body)
    with pytest.raises(FileFormatError, match='expected JSON'):
        read_graph(side)


def test_parts_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    _, side, _ = write_graph(saved_drive(), tmp_path / 'map')
    for change in (lambda members: members['graph']['rows'].update(node_ids=['x']),
                   lambda members: members.pop('nodes'),
                   lambda members: members['graph']['factor_weight'].append(1.0),
                   lambda members: members['graph']['rows']['factors'].update(i=[10**6] * 3)):
        write_graph(saved_drive(), tmp_path / 'map')
        rewrite(side, change)
        with pytest.raises(FileFormatError):
            PoseGraphBackend.restored(CORRELATED, read_graph(side))


def test_ids_with_gaps_come_back_and_are_those_of_the_g2o_file(tmp_path: Path) -> None:
    saved = small_graph()
    rows, nodes = saved.rows, saved.nodes
    losses = deepcopy(saved.losses)
    losses['id'][:] *= 3
    with_gaps = replace(
        saved, nodes=nodes._replace(ids=2 * nodes.ids + 5), rows=rows._replace(
            factors=rows.factors.renumbered(lambda ids: 2 * ids + 5),
            node_ids=2 * rows.node_ids + 5, factor_ids=3 * rows.factor_ids,
            next_ids=NextIds(1000, 1000)),
        losses=losses)
    g2o, side, _ = write_graph(with_gaps, tmp_path / 'gaps')
    assert_same_value(read_graph(side), with_gaps)
    assert g2o.read_text().startswith('VERTEX_SE2 5 ')
    backend = PoseGraphBackend.restored(LINE_ODOMETRY, read_graph(side))
    backend.add_odometry(line_sample(13.0), 'odom')
    backend.finish()
    backend.update()
    assert backend.graph.node_ids[:2].tolist() == [5, 7]
    assert backend.graph.node_ids[-1] >= 1000


def with_other_nodes(saved: SavedGraph, update: GraphUpdate) -> SavedGraph:
    graph = Graph()
    graph.fill(saved.rows)
    graph.apply(update)
    return replace(saved, rows=graph.rows())


def added(case: str) -> GraphUpdate:
    """Return nodes that are no poses, the first with id 10, and constraints on them."""
    turn, place, end, distance = (np.diag(numbers) for numbers in (
        (0.0, 0.0, 1e4 / 3.0), (4.0, 5.0, 0.0), (7.0, 0.0, 0.0), (1.0 / 0.3, 0.0, 0.0)))
    if case == 'turns, one without a bias':
        return GraphUpdate(
            biases=[(0.1 / 3.0, 0.0, 0.0)], dimensions=[1],
            factors=Factors.joined([
                Factors([1, 2], [2, 3], [(0.0, 0.0, 0.1), (0.0, 0.0, 0.2)], [turn, turn],
                        [FactorKind.TURN] * 2, [1.0, 0.5], [(0.0, 0.0, 0.0, 1.0)] * 2, [10, -1]),
                Factors.on([10], None, [(0.1, 0.0, 0.0)], [end], [FactorKind.GLOBAL_POSE])]))
    if case == 'biases of 1, 2 and 3 coordinates':
        return GraphUpdate(
            biases=[(0.1, 0.0, 0.0), (0.3, -0.7, 0.0), (1.0 / 7.0, 2.0, 0.1)],
            dimensions=[1, 2, 3],
            factors=Factors.joined([
                Factors([1, 2], [11, 12], [(1.0, 2.0, 0.0), (3.0, 4.0, 0.2)],
                        [place, place + turn], [FactorKind.BIAS] * 2, 1.0,
                        [(0.0, 0.0, 1.0, 1.0)] * 2),
                Factors.on([10, 11, 12], None, np.zeros((3, 3)), [end, place, place + turn],
                           [FactorKind.GLOBAL_POSE] * 3)]))
    return GraphUpdate(
        landmarks=[(3.0, 1.0 / 3.0), (5.0, -2.0)],
        factors=Factors.joined([
            Factors([0, 1, 2], [10, 11, 10], [(3.0, 1.0, 0.0), (4.0, -2.0, 0.0), (1.2, 0.0, 0.0)],
                    [place, place, distance],
                    [FactorKind.POINT, FactorKind.POINT, FactorKind.RANGE],
                    1.0, [(0.0,) * 4, (0.0,) * 4, (0.2, -0.1, 0.0, 0.0)]),
            Factors.on([11], None, [(5.0, -2.0, 0.0)], [place], [FactorKind.POSITION])]))


@pytest.mark.parametrize('case', [
    'turns, one without a bias', 'biases of 1, 2 and 3 coordinates', 'landmarks'])
def test_other_nodes_and_third_ends_come_back(tmp_path: Path, case: str) -> None:
    assert small_graph().rows.next_ids.node == 10
    saved = with_other_nodes(small_graph(), added(case))
    assert not np.array_equal(saved.rows.dimension, np.full(len(saved.rows.poses), 3))
    _, side, _ = write_graph(saved, tmp_path / 'map')
    loaded = read_graph(side)
    assert_same_value(loaded, saved)
    graph = Graph()
    graph.fill(loaded.rows)
    assert_same_value(graph.rows(), saved.rows)
