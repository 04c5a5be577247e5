# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on a constraint, and why; and which of many verdicts are listed."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray

# Number of ids that a verdict has as a reason, or a sentence names.
MOST_NAMED = 5


class State(Enum):
    """Whether a constraint takes part in the estimate."""

    WAITING = 'waiting'
    """Weight 0: not enough is known yet to believe or to doubt it."""
    BELIEVED = 'believed'
    WEAKLY_BELIEVED = 'believed weakly'
    """In the estimate, though little supports it: only the record of its source speaks for it."""
    DOUBTED = 'doubted'
    """Weight 0: it contradicts the estimate."""

    @property
    def in_graph(self) -> bool:
        """Whether a constraint in this state has a weight above 0."""
        return self in (State.BELIEVED, State.WEAKLY_BELIEVED)


class Decision(Enum):
    """What a person decides on a constraint."""

    IN = 'in'
    """It is believed, whatever contradicts it."""
    OUT = 'out'
    """It is doubted, whatever supports it."""
    AUTO = 'auto'
    """It is judged like all others; takes the other two back."""


class Judged(Enum):
    """Kind of a constraint that is judged."""

    LOOP_CLOSURE = 'loop_closure'
    FIX = 'fix'
    """A position or a pose in the map."""
    ODOMETRY = 'odometry'


@dataclass(frozen=True, slots=True)
class Verdict:
    """The state of one constraint, with the reasons."""

    id: str
    """
    `SOURCE/NUMBER`, such as `loop_closure/17`: the constraints of a source are counted from 0 in
    the order of their addition. It never changes.
    """
    kind: Judged
    source: str
    stamp_ns: int
    """Of the measurement [ns]; of an odometry edge, that of its end."""
    reference_ns: int | None
    """Of the other end of a loop closure or an odometry edge [ns]."""
    state: State
    since_ns: int
    """Stamp of the newest odometry when it came, or when its use began or ended last [ns]."""
    decision: Decision
    residual: FloatArray
    """Error at the present estimate, shape (3,) [m, m, rad]; nan where nothing is measured."""
    distance: float
    """Mahalanobis distance when it was last judged, before it took part [sigma]."""
    supported_by: tuple[str, ...]
    """Ids of what agrees with it, at most five."""
    contradicted_by: tuple[str, ...]
    """Ids of what contradicts it, at most five; `odometry` stands for the estimate without it."""
    edge: bool
    """Whether `number` is that of an edge; else of an observed node."""
    number: int
    """Its id in the graph."""
    left: bool = False
    """Whether it has left the window of the graph, so that nothing of this changes any more."""


class Change(NamedTuple):
    """A change of the state of one constraint, to be announced once."""

    id: str
    kind: Judged
    source: str
    stamp_ns: int
    """Of the measurement [ns]."""
    before: State | None
    """None for a new constraint; one that is believed at once is no change."""
    after: State


class SourceVerdicts(NamedTuple):
    """What is believed of a source, as a whole."""

    counts: Mapping[State, int]
    """Number of its constraints by state; states without any may be missing."""
    scale: float
    """Factor on its sigmas in the graph; 1 where too little is known."""
    doubting: bool
    """Whether its newest measurements are doubted or wait, while the estimate goes on."""
    n_forgotten: int = 0
    """Number of hopeless loop closures that are not judged again."""
    n_left: int = 0
    """Number of its constraints that have left the window of the graph; `counts` is without."""
    n_left_unused: int = 0
    """How many of these were not believed then."""


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
