# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which nodes edges connect."""

import numpy as np

from pose_graph_ros.core.geometry.se2 import IntArray


def components(i: IntArray, j: IntArray, n: int) -> IntArray:
    """
    Return the smallest node that each node is connected to by edges, shape (n,).

    Labels spread along the edges and, as each label is a node too, along the labels, so that the
    number of rounds grows with the logarithm of the longest path.

    Parameters
    ----------
    i, j : ndarray of int, shape (M,), ends of the edges
    n : int, number of nodes

    """
    label = np.arange(n)
    while True:
        low = np.minimum(label[i], label[j])
        new = label.copy()
        # the labels of both ends, not only the ends, move
        for end in (i, j, label[i], label[j]):
            np.minimum.at(new, end, low)
        while not np.array_equal(new[new], new):
            new = new[new]
        if np.array_equal(new, label):
            return label
        label = new
