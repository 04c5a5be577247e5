# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Models of the errors of sources that are correlated in time.

`GaussMarkovBias` estimates them as biases in the graph; see `gauss_markov`.

`InflatedWeights` is a cheap approximation: each of n measurements within 2 tau has the weight
1 / n, because together they are worth about one measurement with an independent error. A new
measurement changes the weights of all others. To bound the work, each one sets those of `RENEWED`
others, in turn, so that no weight is off by more than about 1 / `RENEWED`; `settle` sets the rest.
"""

from dataclasses import dataclass, field
import itertools

import numpy as np

from pose_graph_ros.core.config import Correlation
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import ObservedNodes
from pose_graph_ros.core.sources.gauss_markov import (
    Additions,
    CorrelatedErrors,
    GaussMarkovBias,
)

# Number of older weights in its bin that a measurement renews, and of such weights in other bins.
RENEWED = 32


@dataclass(slots=True)
class _WeightBin:
    """The measurements within 2 tau."""

    ids: list[int] = field(default_factory=list)
    """Of their observed nodes that are in the graph."""
    n_gone: int = 0
    """Number of those that have left it, with the weights that they had."""
    next: int = 0
    """Index of the weight that is renewed next."""
    n_waiting: int = 0
    """Number of weights, from there on and in a circle, that are not yet 1 / n."""

    @property
    def weight(self) -> float:
        """1 / n."""
        return 1.0 / (len(self.ids) + self.n_gone)


class InflatedWeights:
    """Weights of the measurements of one source, lower the more of them lie within 2 tau."""

    def __init__(self, errors: CorrelatedErrors) -> None:
        self.errors = errors
        self._width_ns = max(round(2e9 * errors.tau), 1)
        self._bins: dict[int, _WeightBin] = {}
        self._waiting: dict[int, None] = {}
        """Numbers of the bins with weights that wait to be renewed, the first one first."""
        self._log: list[tuple[int, int, int, int]] = []
        """Number of each bin that has changed since `begin`, and what it was like."""

    def begin(self) -> None:
        """Begin an update that `rollback` can revert."""
        self._log.clear()

    def rollback(self) -> None:
        """Remove what was added since `begin`."""
        for number, size, at, n_waiting in reversed(self._log):
            made = self._bins[number]
            del made.ids[size:]
            made.next, made.n_waiting = at, n_waiting
            self._note(number)
        self._log.clear()

    def forget(self, gone: IntArray) -> None:
        """Forget measurements that have left the graph: stamps [ns] and ids, shape (K, 2)."""
        numbers = gone[:, 0] // self._width_ns
        for number in np.unique(numbers).tolist():
            made, left = self._bins[number], set(gone[numbers == number, 1].tolist())
            made.ids = [each for each in made.ids if each not in left]
            made.n_gone += len(left)
            made.next, made.n_waiting = 0, len(made.ids) if made.n_waiting > 0 else 0
            if len(made.ids) == 0:
                self._waiting.pop(number, None)
                del self._bins[number]

    def restore(self, measurements: IntArray) -> None:
        """Restore the measurements of a loaded graph: stamps [ns] and ids, shape (K, 2)."""
        for stamp_ns, each in measurements.tolist():
            number = stamp_ns // self._width_ns
            made = self._bins.setdefault(number, _WeightBin())
            made.ids.append(each)
            made.n_waiting += 1     # which of them waited is not saved
            self._note(number)

    def add(self, stamp_ns: int, observed: ObservedNodes, additions: Additions) -> int:
        """
        Return the id of the observed node that is added.

        Parameters
        ----------
        observed : ObservedNodes, one row
        additions : Additions, receives the node, its weight and some weights of older measurements

        """
        added = additions.add_observed(observed)
        number = stamp_ns // self._width_ns
        made = self._bins.setdefault(number, _WeightBin())
        self._log.append((number, len(made.ids), made.next, made.n_waiting))
        made.ids.append(added)
        made.n_waiting = len(made.ids)
        additions.weigh_observed[added] = made.weight
        self._renew(number, RENEWED, additions)
        left = RENEWED
        for other in list(itertools.islice(self._waiting, RENEWED)):
            if other != number and left > 0:
                left -= self._renew(other, left, additions)
        return added

    def settle(self, additions: Additions) -> None:
        """Add the weights of all measurements, as other ones may be believed than before."""
        for number, made in self._bins.items():
            if len(made.ids) == 0:
                continue    # all of it was rolled back
            self._log.append((number, len(made.ids), made.next, made.n_waiting))
            made.n_waiting = len(made.ids)
            self._renew(number, len(made.ids), additions)

    def _renew(self, number: int, most: int, additions: Additions) -> int:
        """Add some weights of a bin that wait to be renewed, and return how many."""
        made = self._bins[number]
        self._log.append((number, len(made.ids), made.next, made.n_waiting))
        count = min(most, made.n_waiting)
        for k in range(made.next, made.next + count):
            additions.weigh_observed[made.ids[k % len(made.ids)]] = made.weight
        made.next = (made.next + count) % len(made.ids)
        made.n_waiting -= count
        self._note(number)
        return count

    def _note(self, number: int) -> None:
        """Keep the list of bins with weights that wait up to date."""
        if self._bins[number].n_waiting > 0:
            self._waiting[number] = None
        else:
            self._waiting.pop(number, None)


ErrorModel = GaussMarkovBias | InflatedWeights


def new_error_model(errors: CorrelatedErrors, correlation: Correlation) -> ErrorModel:
    """Return a model of correlated errors, without measurements."""
    inflates = correlation is Correlation.INFLATE
    return InflatedWeights(errors) if inflates else GaussMarkovBias(errors)
