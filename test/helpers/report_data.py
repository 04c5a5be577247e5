# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Data of a report, made up: laps of a figure of eight, of any length, with all kinds of marks."""

from typing import Any

import numpy as np

REASONS = [
    'contradicts odometry and 3 other closures over the same part: 14.2 m off, 9.8 sigma',
    'its group of 5 closures agrees with itself, but with nothing else',
    'covariance is not positive definite',
    'waits for a second closure that agrees']
STATES = ['believed', 'believed weakly', 'waiting', 'doubted', 'refused', 'held out']


def example(
    poses: int = 400, fixes: int = 300, closures: int = 24, *, others: int = 400,
    title: str = 'figure of eight',
) -> dict[str, Any]:
    """
    Return the data of a report.

    Parameters
    ----------
    poses, fixes, closures : int
        Numbers of points of each of the three paths, of fixes, and of closures.
    others : int
        Number of errors and of updates, at most `poses`.

    """
    rng = np.random.default_rng(16)
    t = np.linspace(0.0, 0.5 * poses, poses)
    phase = 2.0 * np.pi * t / 180.0
    path = np.stack((90.0 * np.sin(phase), 40.0 * np.sin(2.0 * phase) + 0.01 * t), axis=1)
    theta = np.arctan2(np.gradient(path[:, 1]), np.gradient(path[:, 0]))
    error = 0.6 + 0.5 * np.sin(t / 40.0) ** 2 + rng.normal(0.0, 0.1, poses)
    drift = 12.0 * (t / t[-1]) ** 1.5
    truth = path + 0.4 * np.stack((np.sin(t / 30.0), np.cos(t / 23.0)), axis=1)
    odometry = path + drift[:, None] * np.stack((np.cos(t / 50.0), np.sin(t / 70.0)), axis=1)
    some = np.linspace(0, poses - 1, min(poses, 200)).astype(int)
    told = np.linspace(0, poses - 1, min(poses, others)).astype(int)
    return {
        'version': 1, 'title': title, 'subtitle': 'replay of figure_of_eight',
        'start': '2015-02-26T10:11:12.123Z', 'start_ns': '1424945472123000000',
        'duration': float(t[-1]), 'axes': ['east', 'north'], 'offset': [1200.0, -350.0],
        'facts': [
            {'label': label, 'value': value, 'note': note} for label, value, note in (
                ('hidden nodes', str(poses), ''), ('path', '3.1 km', 'by corrected odometry'),
                ('fixes', str(fixes), '12 doubted'), ('closures', str(closures), '4 not used'),
                ('error, rms', '0.92 m', 'odometry: 6.1 m'), ('chi2', '1 204', '1 180 expected'))],
        'findings': [
            {'level': 'warning', 'anchor': 'source-gps',
             'text': 'gps: errors are 2.1 times what their covariances claim; set '
                     'gps.sigma_scale to 2.1'},
            {'level': 'notice', 'anchor': 'map', 'text': '4 loop closures are not used'},
            {'level': 'good', 'anchor': 'errors',
             'text': '96 % of errors are within the claimed 2 sigma'}],
        'lines': {
            'corrected': columns(t=t, x=path[:, 0], y=path[:, 1], theta=theta),
            'odometry': columns(t=t, x=odometry[:, 0], y=odometry[:, 1]),
            'truth': columns(t=t, x=truth[:, 0], y=truth[:, 1])},
        'ellipses': columns(
            t=t[some], x=path[some, 0], y=path[some, 1], xx=0.3 + 0.2 * np.sin(t[some] / 9) ** 2,
            xy=np.full(len(some), 0.05), yy=np.full(len(some), 0.2)),
        'fixes': [fix_table(rng, t, path, fixes)],
        'closures': [closure_table(rng, t, path, closures)],
        'states': STATES, 'texts': REASONS,
        'errors': {
            'against': 'truth', 't': column(t[told]), 'position': column(np.abs(error)[told]),
            'heading': column(rng.normal(0.0, 0.01, len(told)), 4),
            'sigma': column(np.full(len(told), 0.55)),
            'odometry': column(np.abs(drift[told]) + 0.2)},
        'error_table': [
            {'name': 'corrected path to truth', 'count': 400, 'median': 0.8, 'rms': 0.92,
             'p95': 1.2, 'maximum': 1.6, 'unit': 'm'},
            {'name': 'corrected heading to truth', 'count': 400, 'median': 0.4, 'rms': 0.5,
             'p95': 0.9, 'maximum': 1.6, 'unit': 'deg'}],
        'sources': [source(rng, t, 'gps', kind='fix', count=fixes, ratio=2.1),
                    source(rng, t, 'odom', kind='odometry', count=poses, ratio=0.97),
                    {'name': 'loop_closure', 'kind': 'loop_closure', 'count': closures, 'used': 0,
                     'rows': [], 'energy': None, 'verdict': None, 'histogram': None,
                     'series': None, 'autocorrelation': None, 'ratio': None, 'scale': 1.0}],
        'springs': [spring(rank, t, path) for rank in range(1, 11)],
        'updates': {
            't': column(t[told]), 'nodes': (told + 1).tolist(),
            'ms': column(np.exp(rng.normal(0.0, 0.7, len(told))) * (
                1 + 30 * (rng.random(len(told)) < 0.01))),
            'chi2': column(np.cumsum(rng.chisquare(3, len(told)))), 'count': poses,
            'period': 100.0},
        'sparsity': [sparsity('H, nodes in order of time', poses, 0),
                     sparsity('R, in an order of elimination', poses, 310)]}


def column(values: np.ndarray, digits: int = 3) -> list[float]:
    return np.round(values, digits).tolist()


def columns(**arrays: np.ndarray) -> dict[str, list[float]]:
    return {name: column(values, 4 if name in ('theta', 'xx', 'xy', 'yy') else 3)
            for name, values in arrays.items()}


def fix_table(
    rng: np.random.Generator, t: np.ndarray, path: np.ndarray, count: int,
) -> dict[str, Any]:
    at = np.linspace(0, len(t) - 1, count).astype(int)
    draw = rng.random(count)
    state = np.select([draw < 0.04, draw < 0.06, draw < 0.1, draw < 0.3], [3, 4, 1, 5], 0)
    places = path[at] + rng.normal(0.0, 1.0, (count, 2))
    places += np.where(state == 3, 25.0, 0.0)[:, None] * rng.normal(0.0, 1.0, (count, 2))
    return {
        'source': 'gps', **columns(t=t[at], x=places[:, 0], y=places[:, 1]),
        'state': state.tolist(), 'why': np.select([state == 3, state == 4], [0, 2], -1).tolist(),
        'id': [f'gps/{k}' for k in range(count)],
        'd': column(np.abs(rng.normal(0.0, 1.5, count)) + 9.0 * (state == 3), 2),
        'at': at.tolist()}


def closure_table(
    rng: np.random.Generator, t: np.ndarray, path: np.ndarray, count: int,
) -> dict[str, Any]:
    early = rng.integers(0, max(len(t) - 370, 2), count)
    late = np.minimum(early + 360, len(t) - 1)
    state = (np.arange(count) % 12 == 5) * 3        # each twelfth is doubted, and ends elsewhere
    state[np.arange(count) % 12 == 8] = 2
    state[np.arange(count) % 12 == 11] = 4
    late = np.where(state == 3, (early + 120) % len(t), late)
    first, second = np.minimum(early, late), np.maximum(early, late)
    return {
        'source': 'loop_closure', **columns(
            t0=t[first], t1=t[second], x0=path[first, 0], y0=path[first, 1],
            x1=path[second, 0], y1=path[second, 1]),
        'state': state.tolist(), 'why': np.select(
            [state == 3, state == 4, state == 2], [0, 1, 3], -1).tolist(),
        'id': [f'loop_closure/{k}' for k in range(count)],
        'd': column(1.0 + 8.8 * (state == 3) + np.zeros(count), 2)}


def source(
    rng: np.random.Generator, t: np.ndarray, name: str, *, kind: str, count: int, ratio: float,
) -> dict[str, Any]:
    residuals = rng.normal(0.0, ratio, (2, min(count, 2000)))
    counts, edges = np.histogram(np.clip(residuals, -4.99, 4.99), bins=40, range=(-5.0, 5.0))
    lag = np.arange(0.0, 60.0, 2.0)
    return {
        'name': name, 'kind': kind, 'count': count, 'used': count - 12,
        'rows': [{'name': each, 'unit': 'm', 'expected': 1.0, 'found': ratio, 'count': count,
                  'ratio': ratio, 'low': 0.94, 'high': 1.06} for each in ('x', 'y')],
        'energy': {'expected': 2.0, 'found': 2.0 * ratio ** 2, 'quantile95_share': 0.71},
        'verdict': f'found {ratio} times the sigma that is claimed',
        'histogram': {'edges': column(edges), 'count': counts.tolist()},
        'series': {'t': column(np.linspace(t[0], t[-1], residuals.shape[1])),
                   'rows': [column(each) for each in residuals]},
        'autocorrelation': {
            'lag': column(lag), 'value': column(np.exp(-lag / 17.0) + rng.normal(0, 0.03, 30)),
            'band': 0.06, 'time': 17.0, 'fitted': column(np.exp(-lag / 17.0)), 'in_use': 30.0},
        'ratio': ratio, 'scale': ratio}


def spring(rank: int, t: np.ndarray, path: np.ndarray) -> dict[str, Any]:
    ends = [{'t': float(t[k]), 'x': float(path[k, 0]), 'y': float(path[k, 1])}
            for k in ((37 * rank) % len(t), (37 * rank + 5) % len(t))]
    return {
        'rank': rank, 'name': f'loop_closure/{rank}', 'source': 'loop_closure',
        'kind': 'loop closure' if rank % 3 else 'fix', 'energy': 40.0 / rank, 'expected': 3,
        'from': ends[0], 'to': ends[1] if rank % 3 else None,
        'text': 'from 0:37.0 to 2:10.5, pulls 0.41 m'}


def sparsity(title: str, size: int, fill: int) -> dict[str, Any]:
    bins = min(size, 120)
    place = np.arange(bins)
    pairs = {(int(k), int(m)) for k in place for m in (k - 1, k, k + 1, k - bins // 3)
             if 0 <= m < bins}
    if fill:
        pairs |= {(k, bins - 1 - (k % 7)) for k in range(bins)}
        pairs = {(k, m) for k, m in pairs if m >= k}
    return {'title': title, 'size': size, 'nonzeros': 3 * size + fill, 'fill': fill, 'bins': bins,
            'cells': [[k, m, 3 if k == m else 1] for k, m in sorted(pairs)]}
