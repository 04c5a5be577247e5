# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The g2o format: round trips bit for bit, files of other programs, and invalid files."""

from pathlib import Path
import re

from hypothesis import example, given, strategies as st
import numpy as np
import pytest
from random_graphs import random_edges, random_information, random_poses, snapshot

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import GraphFile, read_g2o, write_g2o

seeds = st.integers(0, 2**32 - 1)
IDENTITY = '1 0 0 1 0 1'


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp('g2o')


def read(folder: Path, text: str, edge2_order: str | None = None) -> GraphFile:
    path = folder / 'graph.g2o'
    path.write_text(text, encoding='utf-8')
    return read_g2o(path, edge2_order)


# --- round trips -----------------------------------------------------------------------------

def sorted_observed(observed: Factors) -> Factors:
    """Return the rows sorted by their numbers: a file does not keep their order across tags."""
    order = np.lexsort(np.vstack((observed.mean.T, observed.i)))
    return observed.rows(order)


def exactly(symmetric: np.ndarray) -> np.ndarray:
    """Return matrices that are symmetric to the last bit, as a file holds only one triangle."""
    upper = np.triu(symmetric)
    return upper + np.swapaxes(np.triu(symmetric, 1), -1, -2)


def graph_of_all_kinds(seed: int, n: int = 6) -> Graph:
    rng = np.random.default_rng(seed)
    edges = random_edges(rng, [0, 1, 4, 2, 0, 3, 5, 0], [1, 2, 0, 3, 1, 2, 0, 1])
    kind = np.where(edges.j - edges.i == 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
    information = exactly(random_information(rng, 4))
    mean, offset = random_poses(rng, 4, 5e6), random_poses(rng, 4)
    information[2:, 2, :] = information[2:, :, 2] = 0.0
    mean[2:, 2] = 0.0
    offset[[0, 2]] = 0.0      # a pose and a position without an offset, one of each with
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=random_poses(rng, n, 5e6), fix=(1, 4),
        factors=Factors.joined([
            Factors(edges.i, edges.j, edges.mean, exactly(edges.information), kind),
            Factors.on([5, 3, 3, 0], offset, mean, information,
                       [FactorKind.GLOBAL_POSE] * 2 + [FactorKind.POSITION] * 2)])))
    return graph


def assert_bit_equal(graph: Graph, expected: Graph) -> None:
    assert graph.poses.tobytes() == expected.poses.tobytes()
    assert graph.fixed.tobytes() == expected.fixed.tobytes()
    for ours, theirs in (
            (graph.factors.edges, expected.factors.edges),
            (sorted_observed(graph.factors.observed), sorted_observed(expected.factors.observed))):
        assert ours.records.tobytes() == theirs.records.tobytes()


@given(seed=seeds, renamed=st.booleans())
def test_a_graph_comes_back_bit_for_bit(folder: Path, seed: int, *, renamed: bool) -> None:
    graph = graph_of_all_kinds(seed)
    ids = np.array([-7, 3, 4, 100, 2**40, 2**62]) if renamed else None
    path = folder / 'round_trip.g2o'
    if renamed:     # the ids decide whether an edge is odometry
        edges = graph.factors.edges
        kind = np.where(np.diff(ids[np.column_stack((edges.i, edges.j))], axis=1)[:, 0] == 1,
                        FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
        other = Graph()
        other.apply(GraphUpdate(
            hidden=graph.poses, fix=(1, 4),
            factors=Factors.joined([
                Factors(edges.i, edges.j, edges.mean, edges.information, kind),
                graph.factors.observed])))
        graph = other
    write_g2o(graph, path, ids)
    file = read_g2o(path)
    assert file.has_start
    np.testing.assert_array_equal(file.ids, np.arange(6) if ids is None else ids)
    assert_bit_equal(file.graph, graph)
    lines = path.read_bytes().splitlines()
    write_g2o(file.graph, path, file.ids)
    assert sorted(path.read_bytes().splitlines()) == sorted(lines)


def test_what_is_not_used_is_a_comment(folder: Path) -> None:
    path, graph = folder / 'doubted.g2o', graph_of_all_kinds(1)
    graph.apply(GraphUpdate(remove=[2, 5], weigh={8: 0.0}))
    write_g2o(graph, path)
    read_back = read_g2o(path)
    assert read_back.skipped == {}
    np.testing.assert_array_equal(
        read_back.graph.factors.edges.mean, np.delete(graph.factors.edges.mean, [2, 5], axis=0))
    assert len(read_back.graph.factors.observed) == len(graph.factors.observed) - 1
    comments = [line for line in path.read_text().splitlines() if line.startswith('# not used ')]
    ends = [tuple(map(int, line.split()[4:6])) for line in comments if 'EDGE_SE2 ' in line]
    assert ends == [(int(graph.factors.i[k]), int(graph.factors.j[k])) for k in (2, 5)]
    assert len(comments) == 3


# --- files of other programs -----------------------------------------------------------------

def test_a_closure_with_a_switch_is_an_edge(folder: Path) -> None:
    file = read(folder, f"""
        VERTEX_SE2 0 0 0 0
        VERTEX_SE2 1 1 0 0
        VERTEX_SWITCH 2 1
        EDGE_SWITCH_PRIOR 2 1 1
        EDGE_SE2 0 1 1 0 0 {IDENTITY}
        EDGE_SE2_SWITCHABLE 1 0 2 -1 0.5 0.25 {IDENTITY}
    """)
    assert file.skipped == {}
    np.testing.assert_array_equal(file.ids, [0, 1])
    np.testing.assert_array_equal(file.graph.factors.edges.mean[1], [-1.0, 0.5, 0.25])
    np.testing.assert_array_equal(file.graph.factors.edges.i, [0, 1])
    with pytest.raises(FileFormatError, match=r':1: EDGE_SE2 is followed by 11 numbers, got 2'):
        read(folder, 'EDGE_SE2_SWITCHABLE 1 0')


def test_ids_may_have_gaps_start_anywhere_and_come_in_any_order(folder: Path) -> None:
    file = read(folder, f"""
        # a comment
        EDGE_SE2 450 441 1 2 0.5 {IDENTITY}
        VERTEX_SE2 450 4 5 6
        FIX 450
        VERTEX_SE2 441 1 2 3

        EDGE_SE2 441 442 1 0 0 {IDENTITY}
        VERTEX_SE2 442 7 8 9
    """)
    np.testing.assert_array_equal(file.ids, [441, 442, 450])
    np.testing.assert_allclose(
        file.graph.poses, se2.wrapped(np.array([[1, 2, 3], [7, 8, 9], [4, 5, 6.0]])))
    # a reversed edge stays so
    np.testing.assert_array_equal(file.graph.factors.edges.i, [2, 0])
    np.testing.assert_array_equal(file.graph.factors.edges.j, [0, 1])
    np.testing.assert_array_equal(file.graph.factors.edges.mean[0], [1.0, 2.0, 0.5])
    np.testing.assert_array_equal(
        file.graph.factors.edges.kind, [FactorKind.LOOP_CLOSURE, FactorKind.ODOMETRY])
    np.testing.assert_array_equal(file.graph.fixed, [False, False, True])
    assert file.has_start


@given(seeds)
def test_missing_vertices_are_composed_from_edges(folder: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 8)
    order = rng.permutation(7)
    lines = []
    for k in order.tolist():
        i, j = (k, k + 1) if rng.random() < 0.5 else (k + 1, k)
        mean = ' '.join(map(repr, se2.between(truth[i], truth[j]).tolist()))
        lines.append(f'EDGE_SE2 {10 * i} {10 * j} {mean} {IDENTITY}')
    known = int(rng.integers(8))
    start = ' '.join(map(repr, truth[known].tolist()))
    file = read(folder, '\n'.join([*lines, f'VERTEX_SE2 {10 * known} {start}']))
    assert not file.has_start
    np.testing.assert_allclose(file.graph.poses[:, :2], truth[:, :2], atol=1e-12)
    np.testing.assert_allclose(se2.wrap(file.graph.poses[:, 2] - truth[:, 2]), 0.0, atol=1e-12)
    # without any vertex the first node is at the origin
    file = read(folder, '\n'.join(lines))
    np.testing.assert_array_equal(file.graph.poses[0], 0.0)
    expected = se2.between(truth[0], truth)
    np.testing.assert_allclose(file.graph.poses[:, :2], expected[:, :2], atol=1e-12)


def test_the_numbers_behind_every_tag_land_where_they_belong(folder: Path) -> None:
    numbers = '11 0.12 0.13 22 0.23 33'
    matrix = np.array([[11.0, 0.12, 0.13], [0.12, 22.0, 0.23], [0.13, 0.23, 33.0]])
    graph = read(folder, f"""
        EDGE_SE2 0 1 1 2 4 {numbers}
        EDGE_PRIOR_SE2 1 5 6 7 {numbers}
        EDGE_PRIOR_SE2_XY 0 8 9 11 0.12 22
        OBSERVED_SE2_OFFSET 1 0.1 0.2 0.3 1 2 3 {numbers}
    """).graph
    np.testing.assert_array_equal(graph.factors.edges.information[0], matrix)
    np.testing.assert_allclose(graph.factors.edges.mean[0], [1.0, 2.0, 4.0 - 2.0 * np.pi])
    unary = graph.factors.observed
    np.testing.assert_array_equal(unary.i, [1, 0, 1])
    np.testing.assert_array_equal(unary.offset, [[0.0] * 3, [0.0] * 3, [0.1, 0.2, 0.3]])
    np.testing.assert_allclose(
        unary.mean, [[5.0, 6.0, 7.0 - 2.0 * np.pi], [8.0, 9.0, 0.0], [1.0, 2.0, 3.0]])
    position = matrix.copy()
    position[2, :] = position[:, 2] = 0.0
    np.testing.assert_array_equal(unary.information, [matrix, position, matrix])
    np.testing.assert_array_equal(unary.kind, [
        FactorKind.GLOBAL_POSE, FactorKind.POSITION, FactorKind.GLOBAL_POSE])


@given(seeds)
def test_edge2_means_what_it_is_said_to_mean(folder: Path, seed: int) -> None:
    information = random_information(np.random.default_rng(seed), 1)[0]
    root = np.linalg.cholesky(information).T     # upper triangular, root^T root = information
    i = information
    toro = [i[0, 0], i[0, 1], i[1, 1], i[2, 2], i[0, 2], i[1, 2]]
    isam = root[np.triu_indices(3)]
    for order, numbers in (('toro', toro), ('isam', isam)):
        text = ' '.join(repr(float(number)) for number in numbers)
        graph = read(folder, f'VERTEX2 0 1 2 3\nEDGE2 0 1 1 0 0 {text}', order).graph
        np.testing.assert_allclose(graph.factors.information[0], information, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(graph.poses[0], [1.0, 2.0, 3.0])


def test_the_other_tags_of_toro_and_isam_are_read(folder: Path) -> None:
    six = '11 0.12 22 33 0.13 0.23'
    first = read(folder, f'VERTEX2 0 1 2 3\nEDGE2 0 1 1 0 0 {six}', 'toro').graph
    old = read(folder, f'VERTEX 0 1 2 3\nEDGE 0 1 1 0 0 {six}').graph
    assert snapshot(old) == snapshot(first)
    root = '3 0.1 0.2 4 0.3 5'
    first = read(folder, f'EDGE2 0 1 1 0 0 {root}', 'isam').graph
    assert snapshot(read(folder, f'ODOMETRY 0 1 1 0 0 {root}', 'isam').graph) == snapshot(first)
    assert snapshot(read(folder, f'ODOMETRY 0 1 1 0 0 {root}').graph) == snapshot(first)


def test_lines_with_other_tags_are_skipped_and_counted(folder: Path) -> None:
    foreign = ('EQUIV 0 1', 'EQUIV 1 0', 'VERTEX_TAG 77 1 2', 'EDGE_SE2_TAG 0 77 1 2 1 0 1',
               'PARAMS_SE2OFFSET 0 0 0 0', 'FIX 77', 'VERTEX_SE3 5 0 0 0', 'edge_se2 x')
    plain, file = read(folder, GOOD), read(folder, '\n'.join((*foreign, GOOD)))
    assert plain.skipped == {}
    assert file.skipped == {'EQUIV': 2, 'VERTEX_TAG': 1, 'EDGE_SE2_TAG': 1, 'PARAMS_SE2OFFSET': 1,
                            'VERTEX_SE3': 1, 'edge_se2': 1}
    assert snapshot(file.graph) == snapshot(plain.graph)


# --- invalid files ---------------------------------------------------------------------------

GOOD = f'VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 {IDENTITY}\n'
HUGE_ID = 10**30
# The text of line 4, and the message.
MISTAKES = {
    'few': ('VERTEX_SE2 2 0 0', r'VERTEX_SE2 is followed by 4 numbers, got 3'),
    'word': ('VERTEX_SE2 2 0 zero 0', 'got 4: 2 0 zero 0'),
    'large_fix': (f'FIX {HUGE_ID}', 'FIX is'),
    'nan': ('VERTEX_SE2 2 0 nan 0', '2 0 nan 0; .*finite'),
    'inf': (f'EDGE_SE2 0 1 1e999 0 0 {IDENTITY}', '0 1 1e999 .*finite'),
    'twice': ('VERTEX_SE2 1 0 0 0', 'vertex 1 is in the file twice'),
    'fix': ('FIX 2', 'FIX 2: there is no such vertex'),
    'negative': ('EDGE_SE2 0 1 1 0 0 -1 0 0 1 0 1', 'not positive semidefinite'),
    'zero': ('EDGE_SE2 0 1 1 0 0 0 0 0 0 0 0', 'not positive semidefinite, or zero'),
    'offset': ('OBSERVED_SE2_OFFSET 0 0 0 0 0 0 0 1 2 0 1 0 1', 'not positive semidefinite'),
}


@pytest.mark.parametrize('name', MISTAKES)
def test_every_mistake_is_named_with_file_and_line(folder: Path, name: str) -> None:
    line, message = MISTAKES[name]
    where = re.escape(str(folder / 'graph.g2o'))
    with pytest.raises(FileFormatError, match=f'^{where}:4: .*{message}'):
        read(folder, f'{GOOD}{line}\nEDGE_SE2 1 0 1 0 0 {IDENTITY}\n')


@pytest.mark.parametrize('text', ['', '\n\n', '# nothing\n', 'FIX 3\n'])
def test_a_file_without_a_graph_is_refused(folder: Path, text: str) -> None:
    with pytest.raises(FileFormatError, match=r'graph\.g2o: holds no vertex and no edge'):
        read(folder, text)


def test_what_is_no_text_or_no_file_is_refused(folder: Path) -> None:
    binary = folder / 'binary.g2o'
    binary.write_bytes(bytes(range(256)))
    for path in (binary, folder / 'missing.g2o', folder):
        with pytest.raises(FileFormatError, match=re.escape(str(path))):
            read_g2o(path)


words = st.one_of(
    st.sampled_from(['VERTEX_SE2', 'EDGE_SE2', 'EDGE2', 'VERTEX2', 'FIX', 'EDGE_PRIOR_SE2',
                     'EDGE_PRIOR_SE2_XY', 'OBSERVED_SE2_OFFSET', '#', '0', '1', '2', '-1', '1e308',
                     'nan', 'inf', '1e-320', '99999999999999999999', '9223372036854775807']),
    st.integers(-3, 5).map(str), st.floats().map(repr), st.text(max_size=5))
COUNTS = {'VERTEX_SE2': (1, 3), 'EDGE_SE2': (2, 9), 'EDGE2': (2, 9), 'EDGE_PRIOR_SE2': (1, 9),
          'EDGE_PRIOR_SE2_XY': (1, 5), 'OBSERVED_SE2_OFFSET': (1, 12)}


@st.composite
def plausible_lines(draw: st.DrawFn) -> str:
    tag = draw(st.sampled_from(sorted(COUNTS)))
    n_ids, n_numbers = COUNTS[tag]
    ids = draw(st.lists(st.integers(-2, 5), min_size=n_ids, max_size=n_ids))
    numbers = draw(st.lists(st.floats(allow_nan=False), min_size=n_numbers, max_size=n_numbers))
    return ' '.join([tag, *map(str, ids), *map(repr, numbers)])


@example(text='EDGE 0 0 0 0 0 0 0 0 0 0 0', edge2_order=None)
@given(st.one_of(
    st.text(), st.lists(st.lists(words).map(' '.join)).map('\n'.join),
    st.lists(st.one_of(plausible_lines(), st.lists(words).map(' '.join))).map('\n'.join)),
    st.sampled_from((None, 'toro', 'isam')))
def test_any_text_is_read_or_refused(folder: Path, text: str, edge2_order: str | None) -> None:
    path = folder / 'fuzz.g2o'
    path.write_bytes(text.encode('utf-8', 'surrogatepass'))
    try:
        with np.errstate(over='ignore', invalid='ignore'):
            file = read_g2o(path, edge2_order)
    except FileFormatError as error:
        problem = str(error)
    else:
        problem = str(path)
        assert len(file.ids) == file.graph.n_nodes > 0
        assert np.all(np.isfinite(file.graph.poses))
    assert str(path) in problem


def test_landmarks_are_read_solved_and_written_again(tmp_path: Path) -> None:
    truth = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.5], [3.5, 1.0, 1.2]])
    point, far = np.array([2.0, 3.0]), np.array([5.0, -1.0])
    lines = ['VERTEX_SE2 0 0 0 0', 'VERTEX_SE2 2 2.3 0.2 0.4', 'VERTEX_SE2 5 3.2 1.1 1.3',
             'VERTEX_XY 4 4.6 -0.7', 'FIX 0']
    for k, name in enumerate((0, 2, 5)):
        if k > 0:
            motion = ' '.join(map(repr, se2.between(truth[k - 1], truth[k]).tolist()))
            lines.append(f'EDGE_SE2 {(0, 2)[k - 1]} {name} {motion} 50 0 0 50 0 200')
        x, y = se2.transform(se2.inverse(truth[k]), point).tolist()
        lines.append(f'EDGE_SE2_XY {name} 3 {x!r} {y!r} 20 1 30')
        distance = float(np.hypot(*(far - truth[k, :2])))
        lines.append(f'EDGE_RANGE_SE2_XY {name} 4 {distance!r} 100')
    path, again = tmp_path / 'landmarks.g2o', tmp_path / 'again.g2o'
    path.write_text('\n'.join(lines))
    file = read_g2o(path)
    graph = file.graph
    assert (file.skipped, file.has_start) == ({}, False)
    assert graph.node_kind.tolist() == [0, 0, 2, 2, 0]
    for optimize in (optimizer.optimize, optimizer.optimize_from_linear_start):
        result = optimize(graph, SolverConfig())
        assert result.chi2 == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(graph.poses[graph.is_pose], truth, atol=1e-6)
        np.testing.assert_allclose(graph.poses[~graph.is_pose, :2], [point, far], atol=1e-6)
    write_g2o(graph, again, file.ids)
    copy = read_g2o(again)
    np.testing.assert_array_equal(copy.graph.poses, graph.poses)
    assert again.read_text().count('_XY') == 8
    assert copy.graph.energies().chi2 == graph.energies().chi2


# --- the order of EDGE2 ------------------------------------------------------------------------

PAIRS = [(k, k + 1) for k in range(7)] + [(0, 3), (2, 6), (1, 7), (0, 7)]


def six(root: FloatArray, order: str) -> list[float]:
    """Return the numbers of the information `root^T root` in a file."""
    full = root.T @ root
    if order == 'isam':
        return list(root[np.triu_indices(3)].tolist())
    return [float(full[i, j]) for i, j in ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))]


def written(path: Path, order: str, correlation: float, tag: str = 'EDGE2') -> Path:
    """Write a noisy graph whose information has correlations."""
    rng = np.random.default_rng(3)
    truth = rng.uniform(-3.0, 3.0, (8, 3))
    lines = []
    for i, j in PAIRS:
        root = np.diag(rng.uniform((5.0, 2.0, 30.0), (9.0, 4.0, 60.0)))
        root[np.triu_indices(3, 1)] = correlation * rng.uniform(0.5, 1.0, 3)
        noise = np.linalg.solve(root, rng.normal(size=3))
        mean = se2.compose(se2.between(truth[i], truth[j]), noise)
        numbers = ' '.join(map(repr, [*mean.tolist(), *six(root, order)]))
        lines.append(f'{tag} {i} {j} {numbers}')
    path.write_text('\n'.join(lines), encoding='ascii')
    return path


@pytest.mark.parametrize('tag', ['EDGE2', 'ODOMETRY'])
@pytest.mark.parametrize('correlation', [0.0, 0.1, 1.5])
@pytest.mark.parametrize('order', ['toro', 'isam'])
def test_the_order_is_found_out(order: str, correlation: float, tag: str, tmp_path: Path) -> None:
    path = written(tmp_path / 'graph.graph', order, correlation, tag)
    file = read_g2o(path)
    assert file.edge2_order == order
    assert ('positive definite' in file.found_by) or ('the median' in file.found_by)
    np.testing.assert_array_equal(
        file.graph.factors.information, read_g2o(path, order).graph.factors.information)


def test_a_file_that_neither_order_can_be_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / 'graph.graph'
    path.write_text('EDGE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE2 1 2 1 0 0 1 0\n', encoding='ascii')
    with pytest.raises(FileFormatError, match=r'graph\.graph:2: EDGE2 is followed by'):
        read_g2o(path)
    with pytest.raises(FileFormatError, match='cannot be read'):
        read_g2o(tmp_path / 'missing')
