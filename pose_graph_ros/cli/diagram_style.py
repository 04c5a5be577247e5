# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Colours and shapes of diagrams; lines and texts show on light and on dark backgrounds."""

from pose_graph_ros.offline.drawing.diagram import Role
from pose_graph_ros.offline.drawing.structure import Sort

INK, BORDER, TEXT, LINE = '#111111', '#000000', '#7a828c', '#7a828c'
# After Okabe and Ito, but for grey.
SORT_COLOURS = {
    Sort.ODOMETRY: '#7a828c', Sort.LOOP_CLOSURE: '#2F8FD0', Sort.TURN: '#B9A51C',
    Sort.LANDMARK: '#009E73', Sort.OBSERVED: '#E69F00', Sort.BIAS: '#B583A4',
    Sort.PRIOR: '#D55E00'}
FILLS = {Role.POSE: '#ffffff', Role.LANDMARK: '#D9F2E6', Role.BIAS: '#F0E2EC',
         Role.CONTROL: '#C2CAD4', Role.MEASUREMENT: '#C2CAD4', Role.JOINT: '#D55E00'}
"""Of vertices whose colour is not that of their term."""
BLOCK, FILL = '#4C78A8', '#E69F00'  # of the pattern of H, of the fill of its factor
SHAPES = dict.fromkeys(Role, 'circle') | {Role.FACTOR: 'square', Role.JOINT: 'dot'}
