# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each position and pose in the map: one record each, as they were added."""

from collections import deque
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.verdicts import (
    Change,
    Decision,
    Judged,
    SourceVerdicts,
    State,
)
from pose_graph_ros.core.saved_columns import Choices, Integers, Numbers, Pairs
from pose_graph_ros.core.sources.constraint_queue import NewConstraint
from pose_graph_ros.core.sources.source_constraints import Held

DECISIONS = tuple(Decision)
AUTO, IN = DECISIONS.index(Decision.AUTO), DECISIONS.index(Decision.IN)
# Columns of the records. `HELD` is the id of what holds it, an edge if `EDGE` is 1; `OBSERVED` is
# that of the observed node that it was added as, -1 if it was added as an edge.
HELD, EDGE, SOURCE, NUMBER, STAMP, RUN, BELIEVED, SINCE, DECISION, OBSERVED = range(10)
# Run of a measurement that is in none.
LONE = -1
# Largest number of changes that are kept for the announcement.
MOST_CHANGES = 1000
# Number of records around one among which another one is looked for.
NEAR = 100
# Number of the newest measurements of a source that tell whether it is doubted.
NEWEST = 3


@dataclass(frozen=True, slots=True)
class SavedFixes:
    """Saved state of the judgement of positions and poses in the map."""

    sources: tuple[str, ...]
    rows: Integers
    """Ids of what holds them."""
    edges: Integers
    """1 for those of edges, to a bias; 0 for those of observed nodes."""
    source: Integers
    """Index into `sources`."""
    stamps_ns: Integers
    believed: Integers
    since_ns: Integers
    decision: Annotated[IntArray, Choices(Decision)]
    observed: Integers
    """Ids of the observed nodes that they were added as; -1 for those added as edges."""
    distance: Numbers
    """Mahalanobis distance when it was judged first [sigma]."""
    loosened: Integers
    """Ids of odometry edges that are believed less than claimed."""
    weights: Numbers
    """Their weights."""
    numbers: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Those in their names; empty if they are counted from 0 in each source."""
    left: Pairs = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))
    """Of each source, how many have left the graph, and how many of these unused."""


class _Tally:
    """What is believed of one source."""

    def __init__(self, n_left: int = 0, n_left_unused: int = 0) -> None:
        self.n = self.n_believed = 0
        """In the graph."""
        self.n_left, self.n_left_unused = n_left, n_left_unused
        """Those that have left it."""
        self.newest: deque[int] = deque(maxlen=NEWEST)
        """Numbers of its newest records."""

    @property
    def next_number(self) -> int:
        """Number of the next one."""
        return self.n + self.n_left


class FixStates:
    """Records of what is decided, and the changes that are to be announced."""

    def __init__(self) -> None:
        self._records = GrowingArray((10,), np.int64)
        self._distances = GrowingArray((), np.float64)
        self.sources: list[str] = []
        self._tallies: list[_Tally] = []
        self._changes: deque[Change] = deque(maxlen=MOST_CHANGES)
        self._before: list[tuple[IntArray, IntArray]] = []
        """Numbers of records that were changed, and what they were, for `undo`."""
        self.changed: dict[int, bool] = {}
        """Records that an update believes or doubts anew, and whether they were believed."""

    def __len__(self) -> int:
        return len(self._records)

    @property
    def records(self) -> IntArray:
        """All records, shape (M, 10), writeable."""
        return self._records.values

    @property
    def distances(self) -> FloatArray:
        """Mahalanobis distances when they were judged first, shape (M,) [sigma]."""
        return self._distances.values

    @property
    def believed(self) -> BoolArray:
        """Whether they have a weight above 0, shape (M,)."""
        return np.asarray(self._records.values[:, BELIEVED] != 0)

    @property
    def unused(self) -> Held:
        """What holds the measurements that are not believed."""
        unused = self.records[~self.believed]
        return Held(unused[:, HELD], unused[:, EDGE] != 0)

    def append(
        self, one: NewConstraint, *, run: int, believed: bool, distance: float, now_ns: int,
    ) -> None:
        """
        Append a record.

        Parameters
        ----------
        run : int, number of its run
        distance : float, Mahalanobis distance [sigma]
        now_ns : int, newest stamp of odometry

        """
        if one.source not in self.sources:
            self.sources.append(one.source)
            self._tallies.append(_Tally())
        index = self.sources.index(one.source)
        held = (one.held_by, True) if one.held_by >= 0 else (one.number, one.is_edge)
        self._append((*held, index, self._tallies[index].next_number, one.stamp_ns, run,
                      believed, now_ns, AUTO, -1 if one.is_edge else one.number), distance)

    def _append(self, record: tuple[int, ...], distance: float) -> None:
        tally = self._tallies[record[SOURCE]]
        tally.n += 1
        tally.n_believed += record[BELIEVED]
        tally.newest.append(len(self))
        self._records.append_one(record)
        self._distances.append_one(distance)

    def _count(self) -> None:
        """Count the records anew."""
        self._tallies = [_Tally(each.n_left, each.n_left_unused) for each in self._tallies]
        for index, tally in enumerate(self._tallies):
            numbers = np.flatnonzero(self.records[:, SOURCE] == index)
            tally.n = len(numbers)
            tally.n_believed = int(np.count_nonzero(self.records[numbers, BELIEVED]))
            tally.newest.extend(numbers[-NEWEST:].tolist())

    def leaving(self, edges: IntArray, observed: IntArray) -> BoolArray:
        """
        Return which records leave with constraints, shape (M,).

        Parameters
        ----------
        edges, observed : ndarray of int, ids

        """
        held, edge, first = self.records[:, HELD], self.records[:, EDGE], self.records[:, OBSERVED]
        return np.asarray(np.where(edge != 0, np.isin(held, edges), np.isin(held, observed))
                          | np.isin(first, observed))

    def leave(self, gone: BoolArray) -> None:
        """Remove records of measurements that have left the graph; only their number is kept."""
        if not np.any(gone):
            return
        for source, believed in self.records[gone][:, (SOURCE, BELIEVED)].tolist():
            self._tallies[source].n_left += 1
            self._tallies[source].n_left_unused += 1 - believed
        kept = np.flatnonzero(~gone)
        self._records.select(kept)
        self._distances.select(kept)
        self._count()

    def has_left(self, name: str) -> bool:
        """Return whether the measurement with an id was in the graph, and is no more."""
        source, _, text = name.rpartition('/')
        return (source in self.sources and text.isdecimal() and self.find(name) < 0
                and int(text) < self._tallies[self.sources.index(source)].next_number)

    def keep(self, numbers: IntArray) -> None:
        """Remember some records that are about to be changed, until `forget` or `undo`."""
        self._before.append((numbers, self.records[numbers]))

    def forget(self) -> None:
        """Forget what records were before."""
        self._before.clear()
        self.changed = {}

    def undo(self, size: int) -> None:
        """Make the records what they were before, and remove the newest, so that some are left."""
        for numbers, records in reversed(self._before):
            self.records[numbers] = records
        self.forget()
        self._records.truncate(size)
        self._distances.truncate(size)
        self._count()

    def by_stamp(self) -> IntArray:
        """Return the numbers of all records, by stamp, then by the name of the source."""
        names = np.argsort(np.argsort(np.array(self.sources)))
        return np.lexsort((names[self.records[:, SOURCE]], self.records[:, STAMP]))

    def believe(self, which: IntArray, *, believed: bool, now_ns: int) -> None:
        """
        Believe or doubt some records, but not those that a person has decided on.

        Parameters
        ----------
        which : ndarray of int
        now_ns : int, newest stamp of odometry

        """
        records = self.records
        which = which[(records[which, DECISION] == AUTO)
                      & (records[which, BELIEVED] != int(believed))]
        self.keep(which)
        for number, source in zip(which.tolist(), records[which, SOURCE].tolist(), strict=True):
            self.changed.setdefault(number, not believed)
            self._tallies[source].n_believed += 1 if believed else -1
        records[which, BELIEVED], records[which, SINCE] = int(believed), now_ns

    def weights(
        self, first: int, reweighting: Reweighting,
    ) -> tuple[dict[int, float], dict[int, float]]:
        """
        Return weights that change, of edges and of observed nodes by id.

        Parameters
        ----------
        first : int, number of the first new record

        """
        weights: tuple[dict[int, float], dict[int, float]] = {}, {}
        doubted = np.flatnonzero(self.records[first:, BELIEVED] == 0) + first
        for number in (*doubted.tolist(), *self._after_return(), *self.changed):
            held, edge, believed = self.records[number, (HELD, EDGE, BELIEVED)].tolist()
            weights[0 if edge else 1][held] = (
                self._base_weight(number, reweighting) if believed else 0.0)
        return weights

    def set_base_weights(self, first: int, reweighting: Reweighting) -> None:
        """
        Tell what is not believed any more, or again.

        Parameters
        ----------
        first : int, number of the first new record
        reweighting : Reweighting, is changed

        """
        for number in (*range(first, len(self)), *self.changed):
            held, edge, believed = self.records[number, (HELD, EDGE, BELIEVED)].tolist()
            if not believed:
                reweighting.set_base_weight(held, 0.0, edge=bool(edge))
            elif number < first:
                base = self._base_weight(number, reweighting)
                reweighting.set_base_weight(held, base, edge=bool(edge))

    def _after_return(self) -> list[int]:
        """
        Return the believed records from the first one on that is believed again.

        With what a loss has left of their weights they might hold the path where it was.
        """
        again = [number for number, believed in self.changed.items() if not believed]
        if len(again) == 0:
            return []
        since = np.min(self.records[again, STAMP])
        return np.flatnonzero((self.records[:, STAMP] >= since) & self.believed).tolist()

    def _base_weight(self, number: int, reweighting: Reweighting) -> float:
        """Return the base weight of a believed record, or else that of one next to it."""
        held, edge, source = self.records[number, (HELD, EDGE, SOURCE)].tolist()
        if edge:
            return 1.0
        own = reweighting.base_weight(held)
        if own:
            return own
        first = max(number - NEAR, 0)
        near = self.records[first:number + NEAR]
        alike = first + np.flatnonzero((near[:, BELIEVED] != 0) & (near[:, EDGE] == 0)
                                       & (near[:, SOURCE] == source))
        for other in alike[np.argsort(np.abs(alike - number), kind='stable')].tolist():
            if other not in self.changed:
                return reweighting.base_weight(int(self.records[other, HELD])) or 1.0
        return 1.0

    def name(self, number: int) -> str:
        """Return the id of a measurement."""
        return f'{self.sources[self.records[number, SOURCE]]}/{self.records[number, NUMBER]}'

    def find(self, name: str) -> int:
        """Return the index of the record with an id, -1 if there is none."""
        source, _, text = name.rpartition('/')
        if source not in self.sources or not text.isdecimal():
            return -1
        found = np.flatnonzero((self.records[:, SOURCE] == self.sources.index(source))
                               & (self.records[:, NUMBER] == int(text)))
        return int(found[0]) if len(found) > 0 else -1

    def moved(self, before: Held, after: Held) -> None:
        """
        Have records follow measurements that others hold now.

        Parameters
        ----------
        before, after : Held, of the same measurements

        """
        held = 2 * self.records[:, HELD] + self.records[:, EDGE]
        wanted = 2 * before.ids + before.is_edge
        numbers = np.flatnonzero(np.isin(held, wanted))
        order = np.argsort(wanted)
        at = order[np.searchsorted(wanted, held[numbers], sorter=order)]
        self.records[numbers, HELD], self.records[numbers, EDGE] = after.ids[at], after.is_edge[at]

    def announce(self, number: int, before: State | None) -> None:
        """
        Note a change of the state of a measurement.

        Parameters
        ----------
        number : int
        before : State, or None for a new one

        """
        record = self.records[number]
        after = State.BELIEVED if record[BELIEVED] else State.DOUBTED
        self._changes.append(Change(
            self.name(number), Judged.FIX, self.sources[record[SOURCE]], int(record[STAMP]),
            before, after))

    def take_changes(self) -> list[Change]:
        """Return the changes since the last call."""
        changes = list(self._changes)
        self._changes.clear()
        return changes

    def totals(self) -> dict[str, SourceVerdicts]:
        """Return what is believed of each source."""
        return {source: SourceVerdicts(
            {State.BELIEVED: tally.n_believed, State.DOUBTED: tally.n - tally.n_believed}, 1.0,
            tally.n > 0 and not any(self.records[number, BELIEVED] for number in tally.newest),
            n_left=tally.n_left, n_left_unused=tally.n_left_unused)
            for source, tally in zip(self.sources, self._tallies, strict=True)}

    def state(self) -> tuple[IntArray, list[Change]]:
        """Return copies of all records and of the changes that are to be announced."""
        return self.records.copy(), list(self._changes)

    def set_state(self, records: IntArray, changes: list[Change]) -> None:
        """
        Set what `state` has returned; there are as many records.

        Parameters
        ----------
        records : ndarray of int, shape (M, 10)

        """
        self.records[:] = records
        self._count()
        self._changes.clear()
        self._changes.extend(changes)

    def saved(self, loosened: dict[int, float]) -> SavedFixes:
        """Return all records, and the weights of odometry edges by id."""
        records = self.records.copy().T
        return SavedFixes(
            tuple(self.sources), records[HELD], records[EDGE], records[SOURCE], records[STAMP],
            records[BELIEVED], records[SINCE], records[DECISION], records[OBSERVED],
            self.distances.copy(),
            np.array(list(loosened), dtype=np.int64),
            np.array(list(loosened.values()), dtype=np.float64), records[NUMBER],
            np.array([(tally.n_left, tally.n_left_unused) for tally in self._tallies],
                     dtype=np.int64).reshape(-1, 2))

    def restore(self, saved: SavedFixes) -> None:
        """Fill empty records with saved ones; they belong to no run."""
        self.sources = list(saved.sources)
        left = saved.left.tolist() or [(0, 0)] * len(self.sources)
        self._tallies = [_Tally(*each) for each in left]
        columns = (saved.rows, saved.edges, saved.source, saved.stamps_ns, saved.believed,
                   saved.since_ns, saved.decision, saved.observed, saved.distance)
        for held, edge, source, stamp_ns, believed, since_ns, decision, observed, distance in zip(
                *(column.tolist() for column in columns), strict=True):
            self._append((held, edge, source, self._tallies[source].next_number, stamp_ns, LONE,
                          believed, since_ns, decision, observed), distance)
        if len(saved.numbers) > 0:
            self.records[:, NUMBER] = saved.numbers
