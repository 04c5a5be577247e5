# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the vertices of a diagram stand, in radii of a hidden node, and which way its arcs take.

Hidden nodes stand where they are in the map, to scale, but for those too close to each other:
these are pushed apart. What is attached to them is put where there is room beside or between them.
`time_slices.py` has the rows of a dynamic Bayesian network instead.
"""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.offline.drawing import time_slices
from pose_graph_ros.offline.drawing.diagram import Arc, Diagram, Vertex, View
from pose_graph_ros.offline.drawing.structure import Structure

# In radii: usual distance of neighbours, least distance of centres, distance of what is attached.
SPACING, APART, ATTACHED = 6.0, 3.0, 3.7
# Largest extent of a diagram for its number of nodes n: what is asked for is a * sqrt(n) + b.
_EXTENT = 22.0, 16.0
_ROUNDS = 200
# Bends that are tried, as parts of the distance of both ends, and how near a vertex may be.
_BENDS = (0.0, 0.12, -0.12, 0.22, -0.22, 0.34, -0.34, 0.48, -0.48, 0.65, -0.65)
_CLEAR = 1.5
_ALONG = np.linspace(0.0, 1.0, 21)[1:-1]
_DIRECTIONS = np.arange(32) * (2.0 * np.pi / 32)


@dataclass(frozen=True, slots=True)
class Layout:
    """Places of a diagram, y upwards."""

    at: FloatArray
    """Of the vertices, shape (V, 2) [radii]."""
    corners: tuple[FloatArray, ...]
    """
    Of each arc, shape (P, 2) [radii]: none if it is straight, the control point of a quadratic
    Bezier curve, or several corners.
    """
    headings: FloatArray
    """Of the hidden nodes, shape (N,) [rad]."""
    n_moved: int = 0
    """How many hidden nodes are not to scale, as others are where they are."""


def place(drawing: Diagram, graph: Structure) -> Layout:
    """Return the places of a diagram of a graph."""
    if drawing.view is View.DBN:
        rows = time_slices.place(drawing)
        return Layout(rows, time_slices.corners(drawing, rows), graph.poses[:, 2])
    hidden, n_moved = _hidden(graph)
    at = np.full((len(drawing.vertices), 2), np.nan)
    at[:len(hidden)] = hidden
    between = [n for n, each in enumerate(drawing.vertices)
               if n >= len(hidden) and len(set(each.nodes)) > 1]
    beside = [n for n, each in enumerate(drawing.vertices)
              if n >= len(hidden) and len(set(each.nodes)) == 1]
    for n in between:
        at[n] = _between(at, drawing.vertices[n])
    bends = _bends(at, drawing.arcs, len(hidden))
    lines = _lines(at, drawing.arcs, bends)
    for n in beside:
        at[n] = _beside(at, lines, drawing.vertices[n].nodes[0], hidden)
        lines = np.concatenate((lines, _points(at[drawing.vertices[n].nodes[0]], at[n], 0.0)))
    # what stands beside nodes may be in the way now
    corners = tuple(
        np.empty((0, 2)) if bend == 0.0 else _control_point(at[arc.start], at[arc.end], bend)[None]
        for arc, bend in zip(
            drawing.arcs, _bends(at, drawing.arcs, len(hidden)).tolist(), strict=True))
    return Layout(at, corners, graph.poses[:, 2], n_moved)


def _control_point(start: FloatArray, end: FloatArray, bend: float) -> FloatArray:
    """Return the control point of an arc, shape (2,)."""
    chord = end - start
    return np.asarray(0.5 * (start + end) + 2.0 * bend * np.array((-chord[1], chord[0])))


def _hidden(graph: Structure) -> tuple[FloatArray, int]:
    """Return the places of the hidden nodes, and how many are not to scale."""
    at, n = graph.poses[:, :2].copy(), graph.n_nodes
    near = graph.neighbours()
    placed = np.array([name[0] != 'b' for name in graph.names])
    for row in np.flatnonzero(~placed).tolist():    # a bias is nowhere in the map
        others = [other for other in near[row] if placed[other]]
        at[row] = np.mean(at[others or np.flatnonzero(placed)], axis=0) if np.any(placed) else row
    at -= np.mean(at, axis=0)
    lengths = np.array([np.hypot(*(at[i] - at[j])) for i in range(n) for j in near[i] if i < j])
    lengths = lengths[lengths > 1e-9]
    if len(lengths) == 0:
        spread = np.max(np.ptp(at, axis=0), initial=0.0)
        lengths = np.array([spread / max(n - 1, 1) if spread > 0.0 else 1.0])
    largest = _EXTENT[0] * np.sqrt(n) + _EXTENT[1]
    at *= min(SPACING / float(np.median(lengths)),
              largest / max(float(np.max(np.ptp(at, axis=0))), 1e-9))
    return _apart(at, placed)


def _apart(at: FloatArray, placed: np.ndarray) -> tuple[FloatArray, int]:
    """Push apart what is too close; return the places, and how many of the placed have moved."""
    first, n = at.copy(), len(at)
    # there is a measurement between a bias and a pose
    least = np.where(placed[:, None] == placed, APART, 2.1 * APART)
    for _ in range(_ROUNDS):
        apart = at[:, None] - at[None]
        distance = np.hypot(apart[..., 0], apart[..., 1])
        np.fill_diagonal(distance, np.inf)
        if np.all(distance >= least - 0.01):
            break
        # nodes at the same place leave in different directions
        i, j = np.nonzero(distance < 1e-6)
        turn = 2.4 * (i + j)
        apart[i, j] = np.where(i < j, 1.0, -1.0)[:, None] * np.column_stack(
            (np.cos(turn), np.sin(turn)))
        length = np.hypot(apart[..., 0], apart[..., 1])
        np.fill_diagonal(length, 1.0)
        push = 0.5 * (least - np.minimum(distance, least))
        at += np.sum(apart / length[..., None] * push[..., None], axis=1)
    moved = np.hypot(*(at - first).T) > 1.0
    return at, int(np.count_nonzero(moved[:n] & placed))


def _between(at: FloatArray, vertex: Vertex) -> FloatArray:
    """Return a clear place between the nodes of a vertex."""
    ends = at[sorted(set(vertex.nodes))]
    middle = np.mean(ends, axis=0)
    there = at[~np.isnan(at[:, 0])]
    chord = ends[-1] - ends[0]
    across = np.array((-chord[1], chord[0])) / max(float(np.hypot(*chord)), 1e-9)
    best, most = middle, -np.inf
    for bend in (0.0, 1.4, -1.4, 2.8, -2.8, 4.2, -4.2, 5.6, -5.6, 7.0, -7.0):
        point = middle + bend * across
        score = _distance(there, point[None]) - 0.5
        for end in ends:
            others = there[np.hypot(*(there - end).T) > 1e-9]
            score = min(score, _distance(others, _points(point, end, 0.0)))
        if score > _CLEAR:
            return np.asarray(point)
        if score > most:
            best, most = point, score
    return np.asarray(best)


def _beside(
    at: FloatArray, lines: FloatArray, node: int, hidden: FloatArray,
) -> FloatArray:
    """Return the clearest place beside a hidden node; of several one farther out, or above."""
    there = at[~np.isnan(at[:, 0])]
    others = there[np.hypot(*(there - at[node]).T) > 1e-9]
    out = at[node] - np.mean(hidden, axis=0)
    best, most = at[node], -np.inf
    for distance in (ATTACHED, 1.5 * ATTACHED):
        for turn in _DIRECTIONS:
            way = np.array((np.cos(turn), np.sin(turn)))
            point = at[node] + distance * way
            score = min(_distance(others, point[None]), 3.0) + 0.06 * float(
                way @ out) / max(float(np.hypot(*out)), 1.0) + 0.08 * way[1] - 0.1 * distance
            score += min(_distance(lines, point[None]), 1.8)
            score += min(_distance(others, _points(at[node], point, 0.0)), 1.5)
            if score > most + 1e-9:
                best, most = point, score
    return np.asarray(best)


def _bends(at: FloatArray, arcs: tuple[Arc, ...], n_hidden: int) -> FloatArray:
    """Return bends with which arcs keep clear of vertices and of arcs between the same ends."""
    bends, taken = np.zeros(len(arcs)), set()
    placed = ~np.isnan(at[:, 0])
    for n, arc in enumerate(arcs):
        # what stands between nodes was put where straight arcs are clear
        if not (placed[arc.start] and placed[arc.end]) or max(arc.start, arc.end) >= n_hidden:
            continue
        others = placed.copy()
        others[[arc.start, arc.end]] = False
        low, high = min(arc.start, arc.end), max(arc.start, arc.end)
        side = 1.0 if arc.start == low else -1.0
        most = -np.inf
        for bend in _BENDS:
            if (low, high, bend * side) in taken:
                continue
            clear = min(_distance(at[others], _points(at[arc.start], at[arc.end], bend)), _CLEAR)
            if clear > most + 1e-6:
                bends[n], most = bend, clear
            if clear >= _CLEAR:
                break
        taken.add((low, high, bends[n] * side))
    return bends


def _lines(at: FloatArray, arcs: tuple[Arc, ...], bends: FloatArray) -> FloatArray:
    """Return points on all arcs whose ends are placed."""
    parts = [_points(at[arc.start], at[arc.end], bend) for arc, bend in zip(
        arcs, bends.tolist(), strict=True)]
    points = np.concatenate([np.empty((0, 2)), *parts])
    return np.asarray(points[~np.isnan(points[:, 0])])


def _points(start: FloatArray, end: FloatArray, bend: float) -> FloatArray:
    """Return points on an arc, without its ends, shape (P, 2)."""
    t = _ALONG[:, None]
    middle = _control_point(start, end, bend)
    return np.asarray((1.0 - t)**2 * start + 2.0 * t * (1.0 - t) * middle + t**2 * end)


def _distance(points: FloatArray, others: FloatArray) -> float:
    """Return the least distance of two sets of points; infinite if one is empty."""
    if len(points) == 0 or len(others) == 0:
        return np.inf
    apart = points[:, None] - others[None]
    return float(np.min(np.hypot(apart[..., 0], apart[..., 1])))
