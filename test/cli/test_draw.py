# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tool `pose-graph draw`: files that it writes, what it says, and what it refuses."""

import json
from pathlib import Path
import re
import struct
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from saved_graphs import SECOND, straight_line

from pose_graph_ros.cli.arguments import VIEWS
from pose_graph_ros.cli.draw import N_MOST
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.config import BackendConfig, MeasurementSource
from pose_graph_ros.core.io.graph_files import write_graph
from pose_graph_ros.core.measurements import GlobalPose

IDENTITY = '1 0 0 1 0 1'
# ids with a gap, a fixed node, a closure, a landmark, a position and a pose
SMALL = f"""
VERTEX_SE2 10 0 0 0
VERTEX_SE2 11 1 0 1.57
VERTEX_SE2 12 1 1 3.14
VERTEX_SE2 15 0 1 -1.57
VERTEX_XY 20 0.5 3
FIX 10
EDGE_SE2 10 11 1 0 1.57 {IDENTITY}
EDGE_SE2 11 12 1 0 1.57 {IDENTITY}
EDGE_SE2 12 15 1 0 1.57 {IDENTITY}
EDGE_SE2 15 10 1 0 1.57 {IDENTITY}
EDGE_SE2_XY 12 20 1 2 1 0 1
EDGE_SE2_XY 15 20 1 2 1 0 1
EDGE_PRIOR_SE2_XY 12 1 1 1 0 1
EDGE_PRIOR_SE2 15 0 1 -1.57 {IDENTITY}
"""


@pytest.fixture(name='small')
def small_file(tmp_path: Path) -> Path:
    path = tmp_path / 'small.g2o'
    path.write_text(SMALL, encoding='utf-8')
    return path


def texts(path: Path) -> list[str]:
    """Return all texts in an SVG file."""
    return [''.join(each.itertext()).strip() for each in ET.parse(path).getroot().iter(
        '{http://www.w3.org/2000/svg}text')]


def hidden(drawn: list[str]) -> list[str]:
    return [text for text in drawn if re.fullmatch(r'[xlb]\d+', text)]


@pytest.mark.parametrize('view', VIEWS)
def test_a_picture_names_the_nodes_by_their_ids_in_the_file(view, small, tmp_path, capsys) -> None:
    out = tmp_path / 'small.svg'
    assert main(['draw', str(small), '--as', view, '-o', str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.out == f'written: {out}\n'
    drawn = texts(out)
    assert hidden(drawn) == ['x10', 'x11', 'x12', 'x15', 'l20']
    assert {'fixed (known): double border', 'landmark (hidden)'} <= set(drawn)
    unary = '2 terms of a single node are not in the picture'
    assert (unary in printed.err) == (view == 'mrf')
    assert (unary in ' '.join(drawn)) == (view == 'mrf')


def test_a_picture_is_the_same_each_time_and_transparent(small, tmp_path) -> None:
    outs = [tmp_path / name for name in ('one.svg', 'two.svg', 'one.png')]
    for out in outs:
        assert main(['draw', str(small), '--pattern', '--headings', '-o', str(out)]) == 0
    assert outs[0].read_bytes() == outs[1].read_bytes()
    png = outs[2].read_bytes()
    assert png.startswith(b'\x89PNG')
    width, height, _, colour_type = struct.unpack('>IIBB', png[16:26])
    assert width > 600
    assert height > 400
    assert colour_type == 6     # with alpha


def test_the_example_has_five_states_with_their_patterns(tmp_path) -> None:
    out = tmp_path / 'states.svg'
    assert main(['draw', '--example', '-o', str(out)]) == 0
    drawn = texts(out)
    assert [text[:2] for text in drawn if re.match(r'[a-e]\) ', text)] == [
        'a)', 'b)', 'c)', 'd)', 'e)']
    # in the diagram, and twice in the pattern
    assert [drawn.count(f'x{n}') for n in range(5)] == [15, 9, 3, 3, 3]


def test_json_has_what_is_drawn(small, tmp_path, capsys) -> None:
    out = tmp_path / 'small.svg'
    assert main(['draw', str(small), '--as', 'dbn', '--json', '-o', str(out)]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts['view'], facts['file']) == ('dbn', str(out))
    vertices = facts['diagrams'][0]['vertices']
    names = [vertex['name'] for vertex in vertices]
    arcs = {(names[arc['start']], names[arc['end']]) for arc in facts['diagrams'][0]['arcs']}
    assert {('x10', 'x11'), ('u0', 'x11'), ('l20', 'z2')} <= arcs
    assert vertices[0] == {'name': 'x10', 'role': 'pose', 'sort': None, 'fixed': True,
                           'used': True, 'nodes': ['x10'], 'at': vertices[0]['at']}


@pytest.mark.parametrize(('words', 'names'), [
    (['--nodes', '11:20'], ['x11', 'x12', 'x15', 'l20']),
    (['--nodes', '10,l20'], ['x10', 'l20']),
    (['--around', '11', '--hops', '1'], ['x10', 'x11', 'x12'])])
def test_a_part_is_drawn(words, names, small, tmp_path, capsys) -> None:
    out = tmp_path / 'part.svg'
    assert main(['draw', str(small), *words, '-o', str(out)]) == 0
    assert hidden(texts(out)) == names
    assert re.search(rf'{len(names)} of 5 hidden nodes; \d constraints lead to others',
                     capsys.readouterr().err)


def test_a_large_graph_is_refused_with_the_way_out(tmp_path, capsys) -> None:
    path = tmp_path / 'large.g2o'
    path.write_text(''.join(f'EDGE_SE2 {n} {n + 1} 1 0 0 {IDENTITY}\n' for n in range(N_MOST)),
                    encoding='utf-8')
    out = tmp_path / 'large.svg'
    assert main(['draw', str(path), '-o', str(out)]) == 2
    assert capsys.readouterr().err == (
        f'error: {path}: {N_MOST + 1} hidden nodes are too many for a picture, which has room '
        f'for {N_MOST}; draw a part with --around ID --hops K or --nodes A:B\n')
    assert not out.exists()
    assert main(['draw', str(path), '--nodes', '5:9', '-o', str(out)]) == 0


@pytest.mark.parametrize(('words', 'message'), [
    (['--nodes', '7'], 'error: --nodes: the graph has no hidden node 7; ids are 10 to 20'),
    (['--nodes', 'all'], "error: --nodes: expected ids such as 3,7,20:25, got 'all'"),
    (['--around', '7'], 'error: --around: the graph has no hidden node 7'),
    (['--example'], 'error: expected a graph or --example, and not both'),
    (['--hops', '1', '-o', 'no/such/folder.svg'], 'error: ')])
def test_wrong_input_is_refused_in_one_line(words, message, small, tmp_path, capsys) -> None:
    out = [] if '-o' in words else ['-o', str(tmp_path / 'out.svg')]
    assert main(['draw', str(small), *words, *out]) == 2
    error = capsys.readouterr().err
    assert error.startswith(message)
    assert error.count('\n') == 1


@pytest.mark.parametrize('suffix', ['.g2o', '.json'])
def test_a_saved_graph_has_its_biases(suffix, tmp_path) -> None:
    backend = straight_line(BackendConfig(measurements={
        'pose': MeasurementSource(correlation_time=5.0)}))
    for k in range(1, 10):
        backend.add_measurement(
            GlobalPose(k * SECOND, np.array((float(k), 0.0, 0.0)), np.eye(3)), 'pose')
    backend.update()
    saved, out = backend.saved(), tmp_path / 'map.svg'
    write_graph(saved, tmp_path / 'saved')
    words = ['draw', str(tmp_path / f'saved{suffix}'), '-o', str(out), '--pattern']
    assert main(words) == 0
    names = set(hidden(texts(out)))
    n_biases = np.count_nonzero(saved.rows.is_bias)
    assert len({name for name in names if name[0] == 'b'}) == n_biases > 1
    assert len({name for name in names if name[0] == 'x'}) == 10
