# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which of many verdicts are listed, and which constraints are drawn apart."""

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray

# Of each source, the newest of those that are not simply believed.
MOST_OTHERS = 500


def listed(
    source: IntArray, believed: BoolArray, decided: BoolArray, most_believed: int | None,
) -> IntArray:
    """
    Return the numbers of constraints whose verdicts are listed, shape (K,), increasing.

    All that a person has decided on are among them, of the others the newest of each source.

    Parameters
    ----------
    source : ndarray of int, shape (M,), of all constraints in the order of their addition
    believed : ndarray of bool, shape (M,), whether their state is `State.BELIEVED`
    decided : ndarray of bool, shape (M,), whether a person has decided on them
    most_believed : int, largest number of believed ones of a source; None lists all constraints

    """
    if most_believed is None:
        return np.arange(len(source))
    chosen = decided.copy()
    for each in np.unique(source).tolist():
        for most, those in ((most_believed, believed), (MOST_OTHERS, ~believed)):
            numbers = np.flatnonzero((source == each) & those & ~decided)
            chosen[numbers[max(len(numbers) - most, 0):]] = True
    return np.flatnonzero(chosen)
