# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Robust losses, and iteratively reweighted least squares over the factors that have one.

With E = e^T information e the energy, k the threshold of the loss [sigma] and z = E / k^2, the
cost of a factor is k^2 rho(z) instead of E, and its weight in H and b is w(z) = rho'(z):

    none                     rho = z                               w = 1
    Huber                    rho = z up to 1, 2 sqrt(z) - 1        w = 1, then 1 / sqrt(z)
    Cauchy                   rho = log(1 + z)                      w = 1 / (1 + z)
    Geman-McClure            rho = z / (1 + z)                     w = 1 / (1 + z)^2
    DCS                      rho = z up to 1, (3 z - 1) / (1 + z)  w = 1, then 4 / (1 + z)^2
    Tukey                    rho = (1 - (1 - z)^3) / 3, 1 / 3      w = (1 - z)^2, then 0
    truncated least squares  rho = z up to 1, 1                    w = 1, then 0

All are concave in z, so each reweighted solution lowers the cost. The last four are bounded: a
wrong factor has the same cost however wrong it is, but the result depends on the start.

DCS (dynamic covariance scaling, P. Agarwal et al., ICRA 2013) multiplies the information by s^2,
s = min(1, 2 k^2 / (k^2 + E)). Its cost is the integral of that weight; the cost of switchable
constraints, s^2 E + k^2 (1 - s)^2, is constant beyond k for this s.

The weights depend on the estimate and the estimate on the weights, so both are computed in turn.
At each update the weights of the newest factors and of some older ones in turn are computed
anew, so that the work does not grow with the graph. The final optimisation computes all of them
repeatedly, starting from weights that do not depend on earlier updates. The *base weight* of a
factor is its weight without the loss: 1, or less where the errors of several measurements are
correlated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, assert_never, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.saved_columns import Column

_LOSSES = tuple(Loss)


class _Tuning(NamedTuple):
    """How much work reweighting is."""

    window: int = 200           # the newest factors, and as many older, at a time
    least_change: float = 0.005     # smallest relative change of a weight that an update applies
    part: int = 2000            # factors that a refinement looks at at a time
    least_refined: float = 1e-4     # smallest relative change of a weight that it applies


TUNING: Final = _Tuning()


def costs_and_weights(loss: Loss, energy: FloatArray,
                      threshold: float) -> tuple[FloatArray, FloatArray]:
    """Return costs [sigma^2] and weights for unweighted energies; negative ones count as 0."""
    square = threshold**2
    rho, weight = _normalized(loss, np.maximum(energy, 0.0) / square)
    return square * rho, weight


def _normalized(loss: Loss, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rho and its derivative, for z >= 0."""
    match loss:
        case Loss.NONE:
            return z, np.ones_like(z)
        case Loss.HUBER:
            root = np.sqrt(np.maximum(z, 1.0))
            return np.where(z > 1.0, 2.0 * root - 1.0, z), 1.0 / root
        case Loss.CAUCHY:
            return np.log1p(z), 1.0 / (1.0 + z)
        case Loss.GEMAN_MCCLURE:
            share = 1.0 / (1.0 + z)
            return z * share, share**2
        case Loss.DCS:
            switch = 2.0 / (1.0 + np.maximum(z, 1.0))
            return np.where(z > 1.0, 3.0 - 2.0 * switch, z), switch**2
        case Loss.TUKEY:
            left = 1.0 - np.minimum(z, 1.0)
            return (1.0 - left**3) / 3.0, left**2
        case Loss.TRUNCATED:
            return np.minimum(z, 1.0), np.where(z > 1.0, 0.0, 1.0)
        case _:
            assert_never(loss)


# Id of a factor, index of its loss in `Loss`, its threshold [sigma], and its base weight.
_ROW = np.dtype([('id', 'i8'), ('loss', 'i8'), ('threshold', 'f8'), ('base', 'f8')])


@dataclass(slots=True, eq=False)
class Reweighting:
    """
    Computes the weights of factors with a robust loss, which are in the order of their ids.

    It is saved as it is.
    """

    table: Annotated[GrowingArray, Column(_ROW)] = field(
        default_factory=lambda: GrowingArray((), _ROW))
    cursor: int = 0     # index of the older factor that is reweighted next

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """Return a column of `_ROW`, a view."""
        return self.table[name]

    def restore(self, saved: 'Reweighting') -> None:
        """Copy the state of another one; nothing may have been added before."""
        self.table.append(saved.table.values)
        self.cursor = saved.cursor

    def forget(self, ids: IntArray) -> None:
        """Forget factors that have left the graph."""
        gone = np.isin(self['id'], ids)
        if np.any(gone):
            self.cursor -= int(np.count_nonzero(gone[:self.cursor]))
            self.table.select(np.flatnonzero(~gone))

    def add(self, number: int, loss: Loss, threshold: float) -> None:
        """
        Add a factor with the base weight 1; one without a loss is ignored.

        Its id must be above those that were added before.
        """
        if loss is not Loss.NONE:
            self.table.append_one((number, _LOSSES.index(loss), threshold, 1.0))

    def move(self, number: int, to: int) -> None:
        """
        Give the loss and the base weight of a factor to another one that replaces it.

        The base weight of the old one becomes 0. Nothing happens if it has no loss.
        """
        at, at_new = self._index(number), self._index(to)
        if at < 0:
            return
        if at_new < 0:
            at_new = len(self)
            self.table.append_one((to, self['loss'][at], self['threshold'][at], 0.0))
        self['base'][at_new] = self['base'][at]
        self['base'][at] = 0.0

    def base_weight(self, number: int) -> float | None:
        """Return the base weight of a factor, by its id; None without a loss."""
        at = self._index(number)
        return float(self['base'][at]) if at >= 0 else None

    def set_base_weight(self, number: int, weight: float) -> None:
        """Set the base weight of a factor, if it was added."""
        at = self._index(number)
        if at >= 0:
            self['base'][at] = weight

    def _index(self, number: int) -> int:
        """Return the index of a factor by its id, -1 if it was not added."""
        at = int(np.searchsorted(self['id'], number))
        return at if at < len(self) and self['id'][at] == number else -1

    def changes(self, graph: Graph) -> Mapping[int, float]:
        """
        Return new weights, by id, where they change, for the next update.

        They are those of the newest factors and, in turn, of some older ones.
        """
        size = len(self)
        begin = max(size - TUNING.window, 0)
        some = np.arange(begin, size)
        if begin > 0:
            older = (self.cursor + np.arange(min(TUNING.window, begin))) % begin
            self.cursor = int(older[-1] + 1) % begin
            some = np.concatenate((older, some))
        return self._changes(graph, some, least=TUNING.least_change)

    def changes_of_part(self, graph: Graph, begin: int) -> Mapping[int, float]:
        """Return new weights for a refinement, of the factors from an index on."""
        size = len(self)
        part = (begin + np.arange(min(TUNING.part, size))) % max(size, 1)
        return self._changes(graph, part, least=TUNING.least_refined)

    def all_changes(self, graph: Graph, widened: float = 1.0) -> Mapping[int, float]:
        """Return the new weights of all factors whose weight changes."""
        return self._changes(graph, np.arange(len(self)), widened=widened)

    def _changes(self, graph: Graph, index: IntArray, *, least: float = 0.0,
                 widened: float = 1.0) -> Mapping[int, float]:
        """Return the new weights of indexed factors that change by more than `least`."""
        if len(index) == 0:
            return {}
        ids = self['id'][index]
        energy, weight = _energies_and_weights(graph, ids)
        wanted = np.empty(len(index))
        for loss, threshold, chosen in self._groups(index):
            _, wanted[chosen] = costs_and_weights(loss, energy[chosen], widened * threshold)
        wanted *= self['base'][index]
        changed = np.abs(wanted - weight) > least * np.minimum(wanted, weight)
        return dict(zip(ids[changed].tolist(), wanted[changed].tolist(), strict=True))

    def _groups(self, index: IntArray) -> list[tuple[Loss, float, IntArray]]:
        """Return each pair of loss and threshold with the positions in `index` that have it."""
        losses, thresholds = self['loss'][index], self['threshold'][index]
        groups, left = [], np.arange(len(index))
        while len(left) > 0:
            loss, threshold = int(losses[left[0]]), float(thresholds[left[0]])
            alike = (losses[left] == loss) & (thresholds[left] == threshold)
            groups.append((_LOSSES[loss], threshold, left[alike]))
            left = left[~alike]
        return groups

    def cost(self, graph: Graph) -> float:
        """Return the sum of the robust costs minus the sum of the weighted energies."""
        total, (energy, weight) = 0.0, _energies_and_weights(graph, self['id'])
        for loss, threshold, chosen in self._groups(np.arange(len(self))):
            costs, _ = costs_and_weights(loss, energy[chosen], threshold)
            total += float(np.sum(self['base'][chosen] * costs - weight[chosen] * energy[chosen]))
        return total


def _energies_and_weights(graph: Graph, ids: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the unweighted energies of factors, and their weights."""
    rows = graph.factor_rows(ids)
    return graph.unweighted_energies(rows), graph.factor_records['weight'][rows]
