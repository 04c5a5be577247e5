# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which of two formats the tag EDGE2 means in a file."""

from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.io.edge2_order import read_guessed
from pose_graph_ros.core.io.g2o import read_g2o

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
    guess = read_guessed(path)
    assert guess.order == order
    assert ('positive definite' in guess.reason) or ('the median' in guess.reason)
    np.testing.assert_array_equal(
        guess.file.graph.edges.information, read_g2o(path, order).graph.edges.information)


def test_a_file_that_neither_order_can_be_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / 'graph.graph'
    path.write_text('EDGE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE2 1 2 1 0 0 1 0\n', encoding='ascii')
    with pytest.raises(FileFormatError, match=r'graph\.graph:2: EDGE2 is followed by'):
        read_guessed(path)
    with pytest.raises(FileFormatError, match='cannot be read'):
        read_guessed(tmp_path / 'missing')
