# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on a constraint, and why; and which of many verdicts are listed."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.judgement.settings import BELIEF

# Number of ids that a verdict has as a reason, or a sentence names.
MOST_NAMED = 5


class State(Enum):
    """Whether a constraint takes part in the estimate."""

    WAITING = 'waiting'  # weight 0: not enough is known yet to believe or to doubt it
    BELIEVED = 'believed'
    # in the estimate, though little supports it: only the record of its source speaks for it
    WEAKLY_BELIEVED = 'believed weakly'
    DOUBTED = 'doubted'  # weight 0: it contradicts the estimate

    @property
    def in_graph(self) -> bool:
        return self in (State.BELIEVED, State.WEAKLY_BELIEVED)


class Decision(Enum):
    """What a person decides on a constraint."""

    IN = 'in'  # it is believed, whatever contradicts it
    OUT = 'out'  # it is doubted, whatever supports it
    AUTO = 'auto'  # it is judged like all others; takes the other two back


class Judged(Enum):
    """Kind of a constraint that is judged."""

    LOOP_CLOSURE = 'loop_closure'
    FIX = 'fix'  # A position or a pose in the map
    ODOMETRY = 'odometry'


@dataclass(frozen=True, slots=True)
class Verdict:
    # `SOURCE/NUMBER`, such as `loop_closure/17`: the constraints of a source are counted from 0 in
    # the order of their addition. It never changes.
    id: str
    kind: Judged
    source: str
    stamp_ns: int  # of the measurement [ns]; of an odometry edge, that of its end
    reference_ns: int | None  # of the other end of a loop closure or an odometry edge [ns]
    state: State
    # stamp of the newest odometry when it came, or when its use began or ended last [ns]
    since_ns: int
    decision: Decision
    # error at the present estimate, shape (3,) [m, m, rad]; nan where nothing is measured
    residual: FloatArray
    distance: float  # Mahalanobis distance when it was last judged, before it took part [sigma]
    supported_by: tuple[str, ...]  # ids of what agrees with it, at most five
    # ids of what contradicts it, at most five; `odometry` stands for the estimate without it
    contradicted_by: tuple[str, ...]
    edge: bool  # whether `number` is that of an edge; else of an observed node
    number: int  # its id in the graph
    # whether it has left the window of the graph, so that nothing of this changes any more
    left: bool = False


class Change(NamedTuple):
    id: str
    kind: Judged
    source: str
    stamp_ns: int  # of the measurement [ns]
    before: State | None  # none for a new constraint; one that is believed at once is no change
    after: State


class SourceVerdicts(NamedTuple):
    # number of its constraints by state; states without any may be missing
    counts: Mapping[State, int]
    scale: float  # factor on its sigmas in the graph; 1 where too little is known
    # whether its newest measurements are doubted or wait, while the estimate goes on
    doubting: bool
    n_forgotten: int = 0  # number of hopeless loop closures that are not judged again
    # number of its constraints that have left the window of the graph; `counts` is without
    n_left: int = 0
    n_left_unused: int = 0  # how many of these were not believed then


Records = npt.NDArray[Any]


class Column:
    """A column of the records of `Judgements`, writeable, by its name."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, owner: 'Judgements', kind: type) -> npt.NDArray[Any]:
        return np.asarray(owner.records[self._name])


class Judgements:
    """
    Judged constraints, one record each, and changes that are to be announced.

    They are named by their source and a number, which are columns of the records.
    """

    source = Column()  # indices of their sources, shape (M,)

    def __init__(self, record: np.dtype[Any], n_left: int) -> None:
        self.sources: list[str] = []
        self._records = GrowingArray((), record)
        # of each source, how many have left the graph, and how many of these in which state
        self._left: list[list[int]] = []
        self._no_left = n_left * [0]
        self._changes: deque[Change] = deque(maxlen=BELIEF.most_changes)

    def __len__(self) -> int:
        return len(self._records)

    @property
    def records(self) -> Records:
        """All records, writeable, shape (M,)."""
        return self._records.values

    def next_number(self, source: int) -> int:
        """Return the number of the next one of a source, by its index."""
        return self._left[source][0] + int(np.count_nonzero(self.source == source))

    def index_of(self, source: str) -> int:
        """Return the index of a source, which may be new."""
        if source not in self.sources:
            self.sources.append(source)
            self._left.append([*self._no_left])
        return self.sources.index(source)

    def name(self, row: int) -> str:
        record = self.records[row]
        return f'{self.sources[record["source"]]}/{record["number"]}'

    def find(self, name: str) -> int:
        """Return the row of the constraint with a name, -1 if there is none in the graph."""
        source, _, text = name.rpartition('/')
        if source not in self.sources or not text.isdecimal():
            return -1
        found = np.flatnonzero((self.source == self.sources.index(source))
                               & (self.records['number'] == int(text)))
        return int(found[0]) if len(found) > 0 else -1

    def has_left(self, name: str) -> bool:
        """Return whether the constraint with a name was in the graph, and is no more."""
        source, _, text = name.rpartition('/')
        return (source in self.sources and text.isdecimal() and self.find(name) < 0
                and int(text) < self.next_number(self.sources.index(source)))

    def take_changes(self) -> list[Change]:
        """Return the changes since the last call."""
        changes = list(self._changes)
        self._changes.clear()
        return changes

    def snapshot(self) -> Callable[[], None]:
        """Return what brings the present records and changes back, as long as none is added."""
        records, changes = self.records.copy(), list(self._changes)

        def bring_back() -> None:
            self.records[:] = records
            self._changes.clear()
            self._changes.extend(changes)
        return bring_back

    def fill(
        self, sources: Sequence[str], left: IntArray, numbers: IntArray,
        columns: Mapping[str, npt.ArrayLike],
    ) -> None:
        """Fill the empty table with saved columns; without numbers they are counted from 0."""
        for source in sources:
            self.index_of(source)
        for index, counts in enumerate(left.tolist()):
            self._left[index] = counts
        own = np.asarray(columns['source'])
        records = np.zeros(len(own), dtype=self.records.dtype)
        for name, column in columns.items():
            records[name] = column
        if len(numbers) == 0:
            for index in range(len(sources)):
                records['number'][own == index] = np.arange(np.count_nonzero(own == index))
        else:
            records['number'] = numbers
        self._records.append(records)


# Of each source, the newest of those that are not simply believed.
MOST_OTHERS = 500


def listed(
    source: IntArray, believed: BoolArray, decided: BoolArray, most_believed: int | None,
) -> IntArray:
    """Return which are listed: all that a person has decided on, and the newest of a source."""
    if most_believed is None:
        return np.arange(len(source))
    chosen = decided.copy()
    for each in np.unique(source).tolist():
        for most, those in ((most_believed, believed), (MOST_OTHERS, ~believed)):
            numbers = np.flatnonzero((source == each) & those & ~decided)
            chosen[numbers[max(len(numbers) - most, 0):]] = True
    return np.flatnonzero(chosen)
