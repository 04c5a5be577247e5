# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The table of judged constraints: what is decided on each, and changes that are to be announced.

Loop closures have one, positions and poses in the map another.
"""

from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import saved_columns as sc
from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.judgement import verdicts as vd
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.sources.queued import Queued

# State of a constraint before it came.
NEW = -1
# Instead of the row of a constraint: it was in the graph, or never was.
LEFT, UNKNOWN = -1, -2
# Of each source, the newest of those that are not simply believed.
MOST_OTHERS = 500
Records = npt.NDArray[Any]


class Column:
    """A column of the records of `Judgements`, writeable, and what it is for a new one."""

    def __init__(self, kind: Any, *shape: int, new: float = 0) -> None:
        self.kind, self.shape, self.new = kind, shape, new

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, owner: 'Judgements', kind: type) -> npt.NDArray[Any]:
        return np.asarray(owner.records[self._name])


class Judgements:
    KIND: ClassVar[vd.Judged]
    held = Column(np.int64)  # id of what holds it, an edge or an observed node
    added = Column(np.int64)  # id of the factor that it was added as
    source = Column(np.int64)  # index of its source
    number = Column(np.int64)  # in its name
    stamps_ns = Column(np.int64, 2)  # of the measurement, and of the other end of a loop closure
    state = Column(np.int64)  # index of its state
    since_ns = Column(np.int64)  # newest odometry when it came, or its use began or ended
    decision = Column(np.int64, new=vd.AUTO)  # index of what a person has decided
    # Mahalanobis distance when it was judged, of a closure the last time; nan before [sigma]
    distance = Column(np.float64, new=np.nan)

    def __init__(self) -> None:
        self.sources: list[str] = []
        self._columns = {name: each for kind in reversed(type(self).__mro__)
                         for name, each in vars(kind).items() if isinstance(each, Column)}
        self._records = GrowingArray((), np.dtype([
            (name, each.kind, each.shape) for name, each in self._columns.items()], align=True))
        # of each source, how many have left the graph, by their states then, and the next number
        self._left: list[IntArray] = []
        self._next: list[int] = []
        self._changes: deque[vd.Change] = deque(maxlen=BELIEF.most_changes)

    def __len__(self) -> int:
        return len(self._records)

    @property
    def records(self) -> Records:
        """All records, writeable, shape (M,)."""
        return self._records.values

    @property
    def in_graph(self) -> BoolArray:
        return np.asarray(vd.USED[self.state])

    def index_of(self, source: str) -> int:
        """Return the index of a source, which may be new."""
        if source not in self.sources:
            self.sources.append(source)
            self._left.append(np.zeros(len(vd.STATES), dtype=np.int64))
            self._next.append(0)
        return self.sources.index(source)

    def append(self, one: Queued, now_ns: int, state: int, **more: float) -> None:
        record, source = np.zeros((), self.records.dtype), self.index_of(one.source)
        values = {'held': one.held, 'added': one.number, 'source': source, 'since_ns': now_ns,
                  'number': self._next[source], 'stamps_ns': (one.stamp_ns, one.reference_ns),
                  'state': state, **more}
        for name, column in self._columns.items():
            record[name] = values.get(name, column.new)
        self._records.append_one(record)
        self._next[source] += 1

    def truncate(self, size: int) -> None:
        """Remove the newest, so that some are left: they were not added."""
        for source in self.source[size:].tolist():
            self._next[source] -= 1
        self._records.truncate(size)

    def select(self, kept: IntArray) -> None:
        """Keep some; all others have left the graph, and are only counted."""
        gone = np.ones(len(self), dtype=bool)
        gone[kept] = False
        for source, state in self.records[gone][['source', 'state']].tolist():
            self._left[source][state] += 1
        self._records.select(kept)

    def counts(self, source: int) -> IntArray:
        """Return how many of a source are or were in each state, by its index."""
        return self._left[source] + np.bincount(
            self.state[self.source == source], minlength=len(vd.STATES))

    def name(self, row: int) -> str:
        record = self.records[row]
        return f'{self.sources[record["source"]]}/{record["number"]}'

    def find(self, name: str) -> int:
        """Return the row of the constraint with a name, or `LEFT`, or `UNKNOWN`."""
        source, _, text = name.rpartition('/')
        if source not in self.sources or not text.isdecimal() or len(text) > 18:
            return UNKNOWN
        index, number = self.sources.index(source), int(text)
        found = np.flatnonzero((self.source == index) & (self.number == number))
        if len(found) > 0:
            return int(found[0])
        return LEFT if number < self._next[index] else UNKNOWN

    def announce(self, row: int, before: int, now_ns: int) -> None:
        """Note that the state of a constraint is another one than before."""
        record = self.records[row]
        new = vd.STATES[record['state']]
        if before == record['state']:
            return
        # one that has waited is as little used if it is doubted
        if before == NEW or new.in_graph != vd.STATES[before].in_graph:
            record['since_ns'] = now_ns
        if before != NEW or not new.in_graph:
            self._changes.append(vd.Change(
                self.name(row), self.KIND, self.sources[record['source']],
                int(record['stamps_ns'][0]), None if before == NEW else vd.STATES[before], new))

    def take_changes(self) -> list[vd.Change]:
        """Return the changes since the last call."""
        changes = list(self._changes)
        self._changes.clear()
        return changes

    def keep(self, undo: ExitStack[bool]) -> None:
        """Have the present records and changes brought back, as long as none is added."""
        undo.callback(np.copyto, self.records, self.records.copy())
        undo.callback(setattr, self, '_changes', self._changes.copy())

    def verdict(self, row: int, residual: FloatArray, *, supported_by: Sequence[int],
                contradicted_by: Sequence[str]) -> vd.Verdict:
        record = self.records[row]
        stamp, reference = record['stamps_ns'].tolist()
        return vd.Verdict(
            id=self.name(row), kind=self.KIND, source=self.sources[record['source']],
            stamp_ns=stamp, since_ns=int(record['since_ns']), state=vd.STATES[record['state']],
            reference_ns=reference if self.KIND is vd.Judged.LOOP_CLOSURE else None,
            decision=vd.DECISIONS[record['decision']], residual=residual,
            distance=float(record['distance']),
            supported_by=tuple(self.name(other) for other in supported_by[:vd.MOST_NAMED]),
            contradicted_by=tuple(contradicted_by[:vd.MOST_NAMED]), number=int(record['held']))

    def listed(self, most_believed: int | None) -> IntArray:
        """Return which are listed: all that a person has decided on, and the newest of sources."""
        if most_believed is None:
            return np.arange(len(self))
        believed, decided = self.state == vd.BELIEVED, self.decision != vd.AUTO
        chosen = decided.copy()
        for source in range(len(self.sources)):
            for most, those in ((most_believed, believed), (MOST_OTHERS, ~believed)):
                rows = np.flatnonzero((self.source == source) & those & ~decided)
                chosen[rows[max(len(rows) - most, 0):]] = True
        return np.flatnonzero(chosen)

    def totals(self) -> dict[str, vd.SourceVerdicts]:
        totals = {}
        for index, source in enumerate(self.sources):
            left, newest = self._left[index], self.state[self.source == index][-BELIEF.newest:]
            totals[source] = vd.SourceVerdicts(
                dict(zip(vd.STATES, (self.counts(index) - left).tolist(), strict=True)),
                # wrong closures among right ones are what place recognition is like
                doubting=(self.KIND is not vd.Judged.LOOP_CLOSURE and len(newest) > 0
                          and not bool(np.any(vd.USED[newest]))),
                n_left=int(np.sum(left)), n_left_unused=int(np.sum(left[~vd.USED])))
        return totals

    def saved(self) -> 'SavedVerdicts':
        table = self.records[list(SAVED.names or ())].astype(SAVED)
        table['distance'] = np.nan_to_num(table['distance'], nan=-1.0)
        return SavedVerdicts(
            tuple(self.sources), np.array(self._left, dtype=np.int64).reshape(
                -1, len(vd.STATES)), GrowingArray.of(table))

    def restore(self, saved: 'SavedVerdicts') -> None:
        """Fill the empty table with saved columns."""
        for source in saved.sources:
            self.index_of(source)
        records = np.zeros(len(saved.table), dtype=self.records.dtype)
        for name, column in self._columns.items():
            records[name] = saved.table[name] if name in (SAVED.names or ()) else column.new
        records['distance'][records['distance'] < 0.0] = np.nan
        self._records.append(records)
        for index, left in enumerate(saved.left):
            self._left[index] = left.copy()
            self._next[index] = int(np.sum(self.counts(index)))


# What is saved of a record; the columns of special tables follow from these.
SAVED = np.dtype([(name, each.kind, each.shape) for name, each in vars(Judgements).items()
                  if isinstance(each, Column)])


class SavedVerdicts(NamedTuple):
    """The columns of a table, and its sources."""

    sources: tuple[str, ...]
    # of each source, how many have left the graph, by their states then
    left: Annotated[IntArray, sc.Column(int, (len(vd.State),))]
    table: Annotated[GrowingArray, sc.Column(SAVED)]  # the distance is -1 if it was not judged
