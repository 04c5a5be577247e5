# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph solve --picture`: what is drawn of a graph before and after."""

from contextlib import suppress
from pathlib import Path
import re

from false_loops import laps
import pytest

from pose_graph_ros.cli import picture
from pose_graph_ros.cli.main import main
from pose_graph_ros.core.io.g2o import write_g2o

DATA = Path(__file__).resolve().parents[1] / 'data'


def lines_in(svg: str) -> list[set[str]]:
    """Return the styles of the lines of each collection."""
    groups = re.findall(r'<g id="LineCollection_\d+">(.*?)</g>', svg, re.S)
    return [set(re.findall(r'<path [^>]*style="([^"]*)"', each)) for each in groups]


def test_doubted_closures_are_dashed_and_others_have_the_colours_of_their_errors(
    tmp_path,
) -> None:
    drive, file = laps(4, n_wrong=3), tmp_path / 'laps.g2o'
    write_g2o(drive.graph, file)
    assert main(['solve', str(file), '--robust', '--picture', str(tmp_path / 'laps.svg')]) == 0
    svg = (tmp_path / 'laps.svg').read_text(encoding='utf-8')
    doubted, odometry, closures = lines_in(svg)[:3]
    assert len(odometry) == 1
    assert all('stroke-dasharray' in style and '#666666' in style for style in doubted)
    assert len(closures) > 5
    assert not any('stroke-dasharray' in style for style in closures)
    # all of it once as read and once optimised, and each doubted closure
    assert len(lines_in(svg)) >= 6
    assert len(re.findall(r'<path [^>]*stroke-dasharray', svg)) >= 2 * int((~drive.right).sum())


def test_a_graph_of_any_size_is_drawn_and_many_lines_are_pixels(tmp_path, monkeypatch) -> None:
    files = [tmp_path / 'lines.svg', tmp_path / 'pixels.svg', tmp_path / 'graph.png']
    for most, file in zip((picture.MOST_LINES, 10, 10), files, strict=True):
        monkeypatch.setattr(picture, 'MOST_LINES', most)
        assert main(['solve', str(DATA / 'manhattan.g2o'), '--picture', str(file)]) == 0
    with_lines, with_pixels = (file.read_text(encoding='utf-8') for file in files[:2])
    assert with_lines.count('<image') + 2 <= with_pixels.count('<image')
    assert len(lines_in(with_lines)) > len(lines_in(with_pixels))
    assert files[2].read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize(('name', 'said'), [
    ('missing/graph.png', 'error: --picture: there is no folder'),
    ('graph.pdf', 'expected a name that ends with .svg, .png')])
def test_where_no_picture_can_be_is_said_before_anything_is_solved(
    name, said, tmp_path, capsys,
) -> None:
    with suppress(SystemExit):
        main(['solve', str(DATA / 'ring.g2o'), '--picture', str(tmp_path / name)])
    out, err = capsys.readouterr()
    assert out == ''
    assert said in err
