# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Rows of a dynamic Bayesian network: one slice for each pose, in the order of the graph.

From top to bottom there are measurements of several poses, controls, states, measurements of one
pose (those that a bias or a landmark has a part in too), biases, and landmarks.
"""

from collections import Counter

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.offline.drawing.diagram import Diagram, Role
from pose_graph_ros.offline.drawing.structure import Sort

WIDTH, NARROW = 5.6, 2.7
"""Distance of slices, and of measurements in one [radii]."""
CONTROLS, MEASURED, BIASES, LANDMARKS, LOOSE = 3.6, -4.2, -8.4, -12.6, -16.8
ABOVE, TRACK = 7.2, 3.0
"""Lowest row of measurements of several poses, and distance of two such rows [radii]."""


def place(drawing: Diagram) -> FloatArray:
    """Return the places of the vertices of a dynamic Bayesian network, shape (V, 2) [radii]."""
    vertices = drawing.vertices
    at = np.zeros((len(vertices), 2))
    poses = [n for n, each in enumerate(vertices) if each.role is Role.POSE]
    measured: dict[int, list[int]] = {node: [] for node in poses}
    above, loose = [], []
    for n, each in enumerate(vertices):
        if each.role is Role.MEASUREMENT:
            of_poses = sorted(set(each.nodes) & set(poses))
            if len(of_poses) == 1 or (len(of_poses) == 2 and each.sort is Sort.TURN):
                measured[of_poses[-1]].append(n)
            elif len(of_poses) > 1:
                above.append((of_poses[0], of_poses[-1], n))
            else:
                loose.append(n)
    x = 0.0
    for node in poses:
        room = max(WIDTH, NARROW * len(measured[node]) + 0.8)
        at[node] = x + 0.5 * room, 0.0
        for k, n in enumerate(measured[node]):
            at[n] = x + 0.5 * room + NARROW * (k - 0.5 * (len(measured[node]) - 1)), MEASURED
        x += room
    for n, each in enumerate(vertices):
        if each.role is Role.CONTROL:
            at[n] = at[max(each.nodes)] + (0.0, CONTROLS)
    _set_aside_controls(drawing, at)
    _put_above(above, at)
    for role, level in ((Role.BIAS, BIASES), (Role.LANDMARK, LANDMARKS)):
        _put_below(drawing, [n for n, each in enumerate(vertices) if each.role is role], at, level)
    has_landmarks = any(each.role is Role.LANDMARK for each in vertices)
    last = -np.inf
    for x, n in sorted((float(at[vertices[n].nodes[0], 0]), n) for n in loose):
        last = max(x, last + NARROW)    # of biases or landmarks alone
        at[n] = last, LOOSE if has_landmarks else LANDMARKS
    return at


def corners(drawing: Diagram, at: FloatArray) -> tuple[FloatArray, ...]:
    """
    Return the corners of all arcs: those to the rows above pass beside the controls.

    Parameters
    ----------
    drawing : Diagram
    at : ndarray, shape (V, 2), from `place`

    """
    found, used = [], Counter[tuple[int, bool]]()
    for arc in drawing.arcs:
        (x, y), (top_x, top) = at[arc.start].tolist(), at[arc.end].tolist()
        if top < ABOVE or y != 0.0 or drawing.vertices[arc.start].role is not Role.POSE:
            found.append(np.empty((0, 2)))
            continue
        right = top_x >= x
        aside = (1.0 if right else -1.0) * (1.25 + 0.2 * min(used[arc.start, right], 2))
        used[arc.start, right] += 1
        found.append(np.array(((x + aside, abs(aside)), (x + aside, top))))
    return tuple(found)


def _set_aside_controls(drawing: Diagram, at: FloatArray) -> None:
    """Put several controls of one state beside each other."""
    of_state: dict[int, list[int]] = {}
    for n, each in enumerate(drawing.vertices):
        if each.role is Role.CONTROL:
            of_state.setdefault(max(each.nodes), []).append(n)
    for controls in of_state.values():
        for k, n in enumerate(controls):
            at[n, 0] += NARROW * (k - 0.5 * (len(controls) - 1))


def _put_above(above: list[tuple[int, int, int]], at: FloatArray) -> None:
    """Put measurements of several poses on the lowest row where nothing of another is."""
    rows: list[list[tuple[float, float]]] = []
    for first, last, n in sorted(above, key=lambda each: (each[1] - each[0], each[0])):
        begin, end = at[first, 0], at[last, 0]
        track = 0
        while track < len(rows) and any(
                begin < high - 1.0 and low < end - 1.0 for low, high in rows[track]):
            track += 1
        if track == len(rows):
            rows.append([])
        rows[track].append((begin, end))
        at[n] = 0.5 * (begin + end), ABOVE + TRACK * track


def _put_below(drawing: Diagram, nodes: list[int], at: FloatArray, level: float) -> None:
    """Put hidden nodes below what was measured of them, at some distance of each other."""
    wanted = {}
    for node in nodes:
        xs = [at[n, 0] for n, each in enumerate(drawing.vertices)
              if each.role is Role.MEASUREMENT and node in each.nodes and len(each.nodes) > 1]
        wanted[node] = float(np.mean(xs)) if xs else 0.0
    last = -np.inf
    for node in sorted(nodes, key=lambda each: (wanted[each], each)):
        last = max(wanted[node], last + NARROW + 0.6)
        at[node] = last, level
