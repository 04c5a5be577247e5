# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tool `pose-graph solve`: optima, files that it writes, and what it prints."""

from collections.abc import Sequence
import json
from pathlib import Path
import re

from false_loops import laps
import numpy as np
import pytest

from pose_graph_ros.cli.main import main
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import read_g2o, write_g2o

DATA = Path(__file__).resolve().parents[1] / 'data'
GOLDEN = json.loads((DATA / 'golden.json').read_text(encoding='utf-8'))
NAMES = [name for name in GOLDEN if name.endswith('.g2o')]
# Relative difference of chi2 from that of the other solver.
SAME_CHI2 = 1e-8
IDENTITY = '1 0 0 1 0 1'

# A square with a wrong loop closure between 20 and 22, and a wrong position on 23.
CONFLICT = f"""
VERTEX_SE2 20 0 0 0
EDGE_SE2 20 21 1 0 1.5707963267948966 {IDENTITY}
EDGE_SE2 21 22 1 0 1.5707963267948966 {IDENTITY}
EDGE_SE2 22 23 1 0 1.5707963267948966 {IDENTITY}
EDGE_SE2 23 20 1 0 1.5707963267948966 {IDENTITY}
EDGE_SE2 20 22 2 1 3.141592653589793 {IDENTITY}
EDGE_PRIOR_SE2 20 0 0 0 100 0 0 100 0 100
EDGE_PRIOR_SE2_XY 23 0.6 1 0.3 0 0.3
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding='utf-8')
    return path


def chi2_of(path: Path) -> float:
    return float(read_g2o(path).graph.energies().chi2)


def printed_chi2(lines: Sequence[str]) -> float:
    """Return chi2 after the optimisation."""
    return next(float(line.split()[1].rstrip(',')) for line in lines if line.startswith('chi2'))


@pytest.mark.parametrize('start', ['chordal', 'file'])
@pytest.mark.parametrize('name', NAMES)
def test_a_graph_is_solved_to_its_optimum(name, start, tmp_path, capsys) -> None:
    out = tmp_path / 'optimised.g2o'
    assert main(['solve', str(DATA / name), '-o', str(out), '--start', start]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert printed_chi2(lines) == pytest.approx(GOLDEN[name]['chi2'], rel=SAME_CHI2)
    assert any('converged after' in line for line in lines)
    assert chi2_of(out) == pytest.approx(GOLDEN[name]['chi2'], rel=SAME_CHI2)
    before, after = read_g2o(DATA / name), read_g2o(out)
    assert after.has_start
    np.testing.assert_array_equal(after.ids, before.ids)
    np.testing.assert_array_equal(after.graph.fixed, before.graph.fixed)
    # constraints of the same tag keep their order, and no number of them is changed
    after, before = after.graph.factors, before.graph.factors
    assert after.edges.mean.tobytes() == before.edges.mean.tobytes()
    assert after.edges.information.tobytes() == before.edges.information.tobytes()
    assert len(after) == len(before)


def test_the_start_is_that_of_the_file_only_if_asked_for(tmp_path, capsys) -> None:
    text = (DATA / 'ring.g2o').read_text(encoding='ascii')
    rng = np.random.default_rng(2)

    def scrambled(match: re.Match[str]) -> str:
        x, y = rng.uniform(-20.0, 20.0, 2)
        return f'VERTEX_SE2 {match[1]} {x} {y} {rng.uniform(-3.0, 3.0)}'

    path = write(tmp_path / 'far.g2o', re.sub(
        r'(?m)^VERTEX_SE2 ([1-9]\d*) .*$', scrambled, text))
    assert main(['solve', str(path)]) == 0
    best = printed_chi2(capsys.readouterr().out.splitlines())
    assert best == pytest.approx(GOLDEN['ring.g2o']['chi2'], rel=SAME_CHI2)
    main(['solve', str(path), '--start', 'file', '--no-certificate'])
    assert printed_chi2(capsys.readouterr().out.splitlines()) > 2.0 * best

    # the optimised file is the best start
    out = tmp_path / 'optimised.g2o'
    assert main(['solve', str(path), '-o', str(out)]) == 0
    assert main(['solve', str(out), '--start', 'file']) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith('chi2')]
    assert re.search(r'converged after [12] iterations', lines[-1])
    assert printed_chi2(lines[-1:]) == pytest.approx(best, rel=SAME_CHI2)


# Graphs that nothing, or not enough, holds, with what is said.
LOOSE = {
    'one_node': ('VERTEX_SE2 7 1 2 0.5', r'1 hidden nodes, 0 edges'),
    'no_edges': ('VERTEX_SE2 7 1 2 0.5\nVERTEX_SE2 9 3 2 0', r'nothing held 1 more .*: 9$'),
    'parts': (f"""
        EDGE_SE2 10 11 1 0 0 {IDENTITY}
        EDGE_SE2 12 13 1 0 0 {IDENTITY}
        EDGE_SE2 14 15 1 0 0 {IDENTITY}
    """, 'nothing held 2 more parts of the graph; now their first nodes are fixed: 12, 14$'),
    'half_held': (f"""
        EDGE_PRIOR_SE2 20 1 1 0 {IDENTITY}
        EDGE_SE2 30 31 1 0 0 {IDENTITY}
    """, r'nothing held 1 more .*: 30$'),
    'only_observed': (f'EDGE_PRIOR_SE2 5 1 1 0 {IDENTITY}\nEDGE_PRIOR_SE2 7 2 1 0 {IDENTITY}',
                      r'converged after'),
    'only_positions': ('EDGE_PRIOR_SE2_XY 5 1 1 1 0 1\nEDGE_PRIOR_SE2_XY 7 2 1 1 0 1',
                       r'converged .*: hidden node [57] is not determined; it is held near'),
    'one_position': (f"""
        EDGE_SE2 50 51 1 0 0 {IDENTITY}
        EDGE_SE2 51 52 1 0 1 {IDENTITY}
        EDGE_PRIOR_SE2_XY 51 3 3 1 0 1
    """, r'converged .*: hidden node 5[012] is not determined; it is held near'),
    'all_fixed': (f'EDGE_SE2 1 2 1 0 0 {IDENTITY}\nFIX 1 2', r'converged after 0 iterations'),
}


@pytest.mark.parametrize('start', ['chordal', 'file'])
@pytest.mark.parametrize('name', LOOSE)
def test_there_is_an_answer_wherever_there_is_a_graph(name, start, tmp_path, capsys) -> None:
    text, said = LOOSE[name]
    path, out = write(tmp_path / 'graph.g2o', text), tmp_path / 'out.g2o'
    assert main(['solve', str(path), '-o', str(out), '--start', start]) == 0
    captured = capsys.readouterr()
    assert captured.err == ''
    assert re.search(said, captured.out, re.MULTILINE)
    before, after = read_g2o(path).graph, read_g2o(out).graph
    assert after.factors.j.tolist() == before.factors.j.tolist()
    if name != 'all_fixed':
        assert after.energies().chi2 == pytest.approx(0.0, abs=1e-6)


def test_the_constraints_with_the_largest_energies_are_named(tmp_path, capsys) -> None:
    path, out = write(tmp_path / 'conflict.g2o', CONFLICT), tmp_path / 'out.g2o'
    assert main(['solve', str(path), '-o', str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('4 hidden nodes, 5 edges, 2 observed nodes; chi2 ')
    assert lines[1].startswith('nodes without a pose in the file')
    named = re.findall(r'(?m)^  edge (\d+) -> (\d+): energy (\S+)$', '\n'.join(lines))
    assert len(named) == 5
    assert named[0][:2] == ('20', '22')
    graph = read_g2o(out).graph
    energies, is_edge = graph.energies().factors, graph.factors.j >= 0
    assert [float(energy) for _, _, energy in named] == pytest.approx(
        sorted(energies[is_edge].tolist(), reverse=True), rel=1e-3)
    named = re.findall(r'(?m)^  observed node on (\d+): energy (\S+)$', '\n'.join(lines))
    assert [name for name, _ in named] == ['23', '20']
    assert [float(energy) for _, energy in named] == pytest.approx(
        sorted(energies[~is_edge].tolist(), reverse=True), rel=1e-3)


# --- Wrong loop closures ---------------------------------------------------------------------

def shuffled(path: Path, seed: int) -> None:
    """Write the lines of a file in another order."""
    lines = path.read_text(encoding='ascii').splitlines()
    np.random.default_rng(seed).shuffle(lines)
    path.write_text('\n'.join(lines) + '\n', encoding='ascii')


@pytest.mark.parametrize('order', ['as it was', 'shuffled'])
def test_wrong_closures_are_found_and_left_out(order, tmp_path, capsys) -> None:
    drive = laps(1, n_wrong=5, groups=(6,))
    path, out = tmp_path / 'laps.g2o', tmp_path / 'out.g2o'
    names = 10 * np.arange(drive.graph.n_nodes) + 7
    write_g2o(drive.graph, path, names)
    if order == 'shuffled':
        shuffled(path, 3)
    assert main(['solve', str(path), '--robust', '-o', str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == '31 loop closures: 20 believed, 11 doubted'
    wrong = drive.graph.factors_at(drive.closures[~drive.right])
    ends = {(7 + 10 * i, 7 + 10 * j) for i, j in zip(wrong.i, wrong.j, strict=True)}
    named = re.findall(
        r'(?m)^  doubted edge (\d+) -> (\d+): (\S+) m and (\S+) rad off, (\S+) sigma$',
        '\n'.join(lines))
    assert len(named) == 5
    assert {(int(i), int(j)) for i, j, *_ in named} <= ends
    sigmas = [float(one[-1]) for one in named]
    assert sigmas == sorted(sigmas, reverse=True)
    # other programs read a graph without them
    file = read_g2o(out)
    assert len(file.graph.factors.edges) == len(drive.graph.factors.edges) - 11
    assert drive.error(file.graph.poses) < 0.5
    comments = re.findall(
        r'(?m)^# not used EDGE_SE2 (\d+) (\d+) ', out.read_text(encoding='ascii'))
    assert {(int(i), int(j)) for i, j in comments} == ends
    # the optimum is that of the file's own numbers
    assert main(['solve', str(out)]) == 0
    again = printed_chi2(capsys.readouterr().out.splitlines())
    assert printed_chi2(lines) == pytest.approx(again, rel=1e-6)


def test_closures_join_what_odometry_does_not(tmp_path, capsys) -> None:
    drive = laps(2, n_laps=4, n_wrong=6)
    graph, cut = drive.graph, 60
    gone = (graph.factors.i == cut) & (graph.factors.j == cut + 1)
    path, out = tmp_path / 'parts.g2o', tmp_path / 'out.g2o'
    rows, parts = graph.rows(), Graph()
    parts.fill(rows)
    parts.apply(GraphUpdate(drop=rows.factor_ids[gone].tolist()))
    write_g2o(parts, path)
    assert main(['solve', str(path), '--robust', '-o', str(out)]) == 0
    printed = capsys.readouterr().out
    assert 'leaves 2 parts; loop closures that join them are believed' in printed
    assert '36 loop closures: 30 believed, 6 doubted' in printed
    assert drive.error(read_g2o(out).graph.poses) < 1.0


def test_nothing_is_doubted_where_nothing_contradicts(tmp_path, capsys) -> None:
    for name in ('manhattan.g2o', 'ring.g2o'):
        out = tmp_path / name
        assert main(['solve', str(DATA / name), '--robust', '-o', str(out)]) == 0
        printed = capsys.readouterr().out
        assert re.search(r'(\d+) loop closures: \1 believed, 0 doubted', printed)
        assert printed_chi2(printed.splitlines()) == pytest.approx(
            GOLDEN[name]['chi2'], rel=SAME_CHI2)
        assert '# not used' not in out.read_text(encoding='ascii')


def test_the_least_sigma_of_a_closure_can_be_chosen(tmp_path, capsys) -> None:
    path = tmp_path / 'laps.g2o'
    write_g2o(laps(1, n_wrong=5).graph, path)
    doubted = []
    for option in ([], ['--closure-sigma', '0', '0'], ['--closure-sigma', '50', '3']):
        assert main(['solve', str(path), '--robust', *option]) == 0
        printed = capsys.readouterr().out
        doubted.append(int(re.search(r'(\d+) doubted', printed)[1]))
    assert doubted == [5, 5, 0]


@pytest.mark.parametrize('name', LOOSE)
def test_there_is_a_robust_answer_wherever_there_is_a_graph(name, tmp_path, capsys) -> None:
    path = write(tmp_path / 'graph.g2o', LOOSE[name][0])
    assert main(['solve', str(path), '--robust']) == 0
    told = capsys.readouterr().out
    assert 'converged' in told
    assert main(['solve', '--robust', str(path)]) == 0
    timed = r'[\d.e-]+ s'
    assert re.sub(timed, '', capsys.readouterr().out) == re.sub(timed, '', told)


@pytest.mark.parametrize(('words', 'said'), [
    (['--robust', 'best', 'graph.g2o'],
     "--robust: expected selection, gnc, gnc-gm or nothing, got 'best'"),
    (['--robust', 'gnc'], 'expected the file of a graph'), ([], 'expected the file of a graph')])
def test_a_method_that_is_none_and_a_missing_file_are_told(words, said, capsys) -> None:
    assert main(['solve', *words]) == 2
    assert capsys.readouterr().err == f'error: {said}\n'


def test_a_file_that_cannot_be_written_is_one_line_of_error(tmp_path, capsys) -> None:
    path = write(tmp_path / 'graph.g2o', CONFLICT)
    assert main(['solve', str(path), '-o', str(tmp_path / 'missing' / 'out.g2o')]) == 2
    out, err = capsys.readouterr()
    assert out == ''    # before anything is solved
    assert len(err.splitlines()) == 1
    assert 'out.g2o' in err


@pytest.mark.parametrize('method', ['selection', 'gnc', 'gnc-gm'])
def test_each_method_finds_single_wrong_closures(method, tmp_path, capsys) -> None:
    drive = laps(3, n_wrong=6)
    path, out = tmp_path / 'laps.g2o', tmp_path / 'out.g2o'
    write_g2o(drive.graph, path)
    assert main(['solve', str(path), '--robust', method, '-o', str(out), '--json']) == 0
    values = json.loads(capsys.readouterr().out)
    wrong = drive.graph.factors_at(drive.closures[~drive.right])
    assert set(map(tuple, values['doubted'])) == set(zip(
        wrong.i.tolist(), wrong.j.tolist(), strict=True))
    robust = values['robust']
    assert robust == robust | {
        'method': method, 'closures': len(drive.closures), 'doubted': 6}
    assert set(robust) - {'method', 'closures', 'doubted'} == {
        'scale', 'truncated_cost', 'truncated_cost_of_all'}
    assert robust['truncated_cost'] < robust['truncated_cost_of_all']
    assert values['certificate']['verdict'] == 'certified'
    assert drive.error(read_g2o(out).graph.poses) < 0.5
