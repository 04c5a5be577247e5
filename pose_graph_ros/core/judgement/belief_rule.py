# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which of the loop closures that have passed the gate are believed.

One is believed if a clique of closures that agree along the path supports it, or if a random one
of its source would hardly pass: q p is small against 1 - q, with p the chance to pass and q the
share of its source that is doubted. If p is large, only the record q of the source speaks for it:
it is believed weakly.
"""

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.judgement.closure_states import ClosureStates, OUT
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.retests import Retests
from pose_graph_ros.core.judgement.verdicts import State

# A clique supports a closure if it has so many members, over so long a way [m].
CLIQUE, CLIQUE_TRAVEL = 3, 1.0
# Largest odds that a closure is wrong which is believed alone.
WRONG_ODDS = 0.02
# Chance of a random closure to pass, above which a lone one is only believed weakly.
WEAK = 0.02
# The same, below which several are believed at once, as none changes the gates of others much.
NARROW = 1e-3


class BeliefRule:
    """Chooses what is believed; it changes nothing."""

    def __init__(self, states: ClosureStates, table: ClosureTable, retests: Retests) -> None:
        self._states, self._table, self._retests = states, table, retests

    def choose(self, passed: IntArray, chance: FloatArray) -> dict[int, State]:
        """
        Return which closures that have passed are believed now.

        Of wide gates only one is, and of those that have failed before.

        Parameters
        ----------
        passed : ndarray of int, shape (M,)
        chance : ndarray, shape (M,)

        """
        chosen: dict[int, State] = {}
        failures = self._retests.failures(passed)
        for k in np.lexsort((chance, failures)).tolist():
            if (chance[k] > NARROW or failures[k] > 0) and len(chosen) > 0:
                break
            state = self._belief(int(passed[k]), float(chance[k]))
            if state.in_graph:
                chosen[int(passed[k])] = state
        return chosen

    def _belief(self, number: int, chance: float) -> State:
        """Return the state of a closure that has passed the gate."""
        good, bad = self._states.record(int(self._states.source[number]))
        alone = (bad + 1.0) * chance < WRONG_ODDS * (good + 1.0)
        if (alone and chance <= WEAK) or self.is_corroborated(
                number, self._states.decision != OUT):
            return State.BELIEVED
        return State.WEAKLY_BELIEVED if alone else State.WAITING

    def is_corroborated(self, number: int, usable: BoolArray) -> bool:
        """
        Tell whether a clique of closures that agree along the path supports one.

        Parameters
        ----------
        number : int
        usable : ndarray of bool, shape (M,), which closures may be in the clique

        """
        support = self._table.support(number, usable)
        return len(support.clique) >= CLIQUE and support.travel >= CLIQUE_TRAVEL
