# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on a constraint, and why, as values; `judgements` is the table of them."""

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray

# Number of ids that a verdict has as a reason, or a sentence names.
MOST_NAMED = 5
# Among what contradicts a constraint it stands for the estimate without it.
ODOMETRY = 'odometry'


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


# In tables they are numbers.
STATES, DECISIONS = tuple(State), tuple(Decision)
WAITING, BELIEVED, WEAK, DOUBTED = (STATES.index(state) for state in (
    State.WAITING, State.BELIEVED, State.WEAKLY_BELIEVED, State.DOUBTED))
AUTO, OUT = DECISIONS.index(Decision.AUTO), DECISIONS.index(Decision.OUT)
USED = np.array([state.in_graph for state in STATES])


class Judged(Enum):
    """Kind of a constraint that is judged."""

    LOOP_CLOSURE = 'loop_closure'
    FIX = 'fix'  # A position or a pose in the map
    ODOMETRY = 'odometry'


class Verdict(NamedTuple):
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
    # ids of what contradicts it, at most five, see `ODOMETRY`
    contradicted_by: tuple[str, ...]
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
    # whether its newest measurements are doubted or wait, while the estimate goes on
    doubting: bool
    n_forgotten: int = 0  # number of hopeless loop closures that are not judged again
    # number of its constraints that have left the window of the graph; `counts` is without
    n_left: int = 0
    n_left_unused: int = 0  # how many of these were not believed then
