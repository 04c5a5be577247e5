# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Make the small graphs beside this file, and the chi2 of their optima, without the package.

Run by hand, `python make_graphs.py`, after a change here. The optima come from
scipy.optimize.least_squares with numeric Jacobians on whitened errors, which are written out
below with homogeneous matrices; it starts at the truth.
"""

import hashlib
import json
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

HERE = Path(__file__).parent
ABOUT = ('chi2 = sum of e^T information e at the optimum, by scipy.optimize.least_squares from '
         'the truth with tolerances of 1e-15 (make_graphs.py); sha256 of the file')
UPPER = np.triu_indices(3)


def matrix(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def vector(m):
    return np.array([m[0, 2], m[1, 2], np.arctan2(m[1, 0], m[0, 0])])


def written(numbers, digits=5):
    return [float(f'{number:.{digits}g}') for number in numbers]


class Maker:
    """A graph with noisy measurements of a truth, ids starting anywhere."""

    def __init__(self, truth, seed, first_id=0, id_step=1):
        self.truth, self.rng = truth, np.random.default_rng(seed)
        self.ids = first_id + id_step * np.arange(len(truth))
        self.edges, self.observed, self.lines = [], [], []

    def noise(self, sigmas):
        """Return noise of a correlated covariance, and its information as it is written."""
        correlation = np.eye(3)
        correlation[1, 2] = correlation[2, 1] = 0.4
        covariance = correlation * np.outer(sigmas, sigmas)
        information = np.zeros((3, 3))
        information[UPPER] = written(np.linalg.inv(covariance)[UPPER])
        information = information + np.triu(information, 1).T
        return np.linalg.cholesky(covariance) @ self.rng.standard_normal(3), information

    def edge(self, i, j, sigmas=(0.1, 0.05, 0.02)):
        noise, information = self.noise(sigmas)
        true = vector(np.linalg.inv(matrix(self.truth[i])) @ matrix(self.truth[j]))
        mean = written(vector(matrix(true) @ matrix(noise)))
        self.edges.append((i, j, mean, information))
        self.line('EDGE_SE2', [self.ids[i], self.ids[j]], [*mean, *information[UPPER]])

    def pose(self, i, offset=None, sigmas=(0.3, 0.2, 0.05)):
        noise, information = self.noise(sigmas)
        through = np.zeros(3) if offset is None else np.array(offset)
        true = matrix(self.truth[i]) @ matrix(through)
        mean = written(vector(true @ matrix(noise)))
        self.observed.append((i, through, mean, information))
        if offset is None:
            self.line('EDGE_PRIOR_SE2', [self.ids[i]], [*mean, *information[UPPER]])
        else:
            self.line('OBSERVED_SE2_OFFSET', [self.ids[i]],
                      [*through, *mean, *information[UPPER]])

    def position(self, i, sigma=0.5):
        _, information = self.noise((sigma, 2.0 * sigma, 1.0))
        information[2, :] = information[:, 2] = 0.0
        mean = [*written(self.truth[i, :2] + sigma * self.rng.standard_normal(2)), 0.0]
        self.observed.append((i, np.zeros(3), mean, information))
        self.line('EDGE_PRIOR_SE2_XY', [self.ids[i]],
                  [*mean[:2], *information[[0, 0, 1], [0, 1, 1]]])

    def line(self, tag, ids, numbers):
        self.lines.append(' '.join([tag, *map(str, ids), *(f'{float(x):g}' for x in numbers)]))

    def start(self):
        """Return the poses that the edges from each node to the next lead to."""
        steps = {(i, j): mean for i, j, mean, _ in self.edges}
        poses = [self.truth[0]]
        for k in range(1, len(self.truth)):
            poses.append(vector(matrix(poses[-1]) @ matrix(steps[k - 1, k])))
        return [written(pose) for pose in poses]

    def optimum(self, start):
        """Return chi2; the first node keeps its start where nothing is observed."""
        fixed = [] if self.observed else list(start[0])

        def errors(x):
            poses = np.concatenate((fixed, x)).reshape(-1, 3)
            whitened = []
            for i, j, mean, information in self.edges:
                e = vector(np.linalg.inv(matrix(mean)) @ np.linalg.inv(matrix(poses[i]))
                           @ matrix(poses[j]))
                whitened.append(root(information) @ e)
            for i, offset, mean, information in self.observed:
                e = vector(np.linalg.inv(matrix(mean)) @ matrix(poses[i]) @ matrix(offset))
                whitened.append(root(information) @ e)
            return np.concatenate(whitened)

        result = least_squares(errors, np.ravel(self.truth)[len(fixed):], jac='3-point',
                               xtol=1e-15, ftol=1e-15, gtol=1e-15)
        return float(np.sum(errors(result.x)**2))

    def write(self, name, *, vertices=True, shuffled=False, fix=False):
        start = self.start()
        if not vertices and not self.observed:
            start[0] = [0.0, 0.0, 0.0]
            self.truth = np.array([
                vector(np.linalg.inv(matrix(self.truth[0])) @ matrix(x)) for x in self.truth])
        lines = list(self.lines)
        if vertices:
            lines = [f'VERTEX_SE2 {self.ids[k]} ' + ' '.join(f'{x:g}' for x in pose)
                     for k, pose in enumerate(start)] + lines
        if fix:
            lines.append(f'FIX {self.ids[0]}')
        if shuffled:
            lines = [lines[k] for k in self.rng.permutation(len(lines))]
        text = '\n'.join(['# made by make_graphs.py', *lines]) + '\n'
        (HERE / name).write_text(text, encoding='ascii')
        return {'chi2': self.optimum(start),
                'sha256': hashlib.sha256(text.encode()).hexdigest()}


def root(information):
    """Return L^T with L L^T = information, also for a position."""
    values, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def ring():
    """30 poses on a circle, closed, with four chords."""
    angle = np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False)
    made = Maker(np.column_stack((10.0 * np.cos(angle), 10.0 * np.sin(angle),
                                  (angle + 1.5 * np.pi) % (2.0 * np.pi) - np.pi)), seed=30)
    for k in range(29):
        made.edge(k, k + 1)
    for i, j in ((0, 29), (0, 15), (22, 7), (4, 20), (27, 2)):
        made.edge(i, j, sigmas=(0.2, 0.2, 0.05))
    return made.write('ring.g2o', fix=True)


def manhattan():
    """A walk through the streets of a grid, with loops wherever it comes near itself again."""
    rng = np.random.default_rng(36)
    x, y, quarter = 0, 0, 0
    truth = []
    for _ in range(45):
        truth.append((2.0 * x, 2.0 * y, (0.5 * np.pi * quarter + np.pi) % (2.0 * np.pi) - np.pi))
        turns = [t for t in (0, 0, 1, -1) if -2 <= x + round(np.cos(0.5 * np.pi * (quarter + t)))
                 <= 2 and -2 <= y + round(np.sin(0.5 * np.pi * (quarter + t))) <= 2] or [2]
        quarter += int(rng.choice(turns))
        x += round(np.cos(0.5 * np.pi * quarter))
        y += round(np.sin(0.5 * np.pi * quarter))
    truth = np.array(truth)
    made = Maker(truth, seed=37, first_id=441, id_step=3)
    for k in range(44):
        made.edge(k, k + 1)
    for i in range(45):
        for j in range(i + 6, 45):
            if np.hypot(*(truth[i] - truth[j])[:2]) < 0.1 and rng.random() < 0.7:
                made.edge(*((j, i) if rng.random() < 0.3 else (i, j)))
    made.edge(3, 4)     # the same pair once more
    return made.write('manhattan.g2o', vertices=False, shuffled=True)


def chain():
    """A chain without a fixed node, held by poses and positions, some of them offset."""
    s = np.linspace(0.0, 20.0, 20)
    made = Maker(np.column_stack((s, 3.0 * np.sin(0.3 * s), np.arctan(0.9 * np.cos(0.3 * s)))),
                 seed=20)
    for k in range(19):
        made.edge(k, k + 1)
    made.pose(0)
    made.pose(9, sigmas=(0.1, 0.4, 0.02))
    for k in (2, 5, 12, 19):
        made.position(k)
    made.pose(7, offset=(0.4, -0.25, 0.1))
    made.pose(16, offset=(0.9, 0.1, -2.5))
    return made.write('chain.g2o')


if __name__ == '__main__':
    golden = {'about': ABOUT, 'ring.g2o': ring(), 'manhattan.g2o': manhattan(),
              'chain.g2o': chain()}
    (HERE / 'golden.json').write_text(json.dumps(golden, indent=2) + '\n', encoding='ascii')
