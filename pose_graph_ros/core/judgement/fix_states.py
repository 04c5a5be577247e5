# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is decided on each position and pose in the map: one record each, and its verdict."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import (
    Change,
    Decision,
    Judged,
    Judgements,
    listed,
    MOST_NAMED,
    Records,
    SourceVerdicts,
    State,
    Verdict,
)
from pose_graph_ros.core.saved_columns import Choices, Integers, Numbers, Pairs
from pose_graph_ros.core.sources.source_constraints import Held, NewConstraint

DECISIONS = tuple(Decision)
AUTO, IN = DECISIONS.index(Decision.AUTO), DECISIONS.index(Decision.IN)
RECORD = np.dtype([
    ('held', np.int64),  # id of what holds it, an edge to a bias or an observed node
    ('edge', np.bool_),  # whether that is an edge
    ('source', np.int64),  # index of its source
    ('number', np.int64),  # in its name
    ('stamp_ns', np.int64),
    ('run', np.int64),  # number of the run that it belongs to
    ('believed', np.bool_),
    ('since_ns', np.int64),  # newest odometry when it came, or its use began or ended
    ('decision', np.int64),  # index of what a person has decided
    ('observed', np.int64),  # id of the observed node that it was added as; -1 for an edge
    ('distance', np.float64),  # Mahalanobis distance when it was judged first [sigma]
])
# Run of a measurement that is in none.
LONE = -1


@dataclass(frozen=True, slots=True)
class SavedFixes:
    sources: tuple[str, ...]
    rows: Integers  # ids of what holds them
    edges: Integers  # 1 for those of edges, to a bias; 0 for those of observed nodes
    source: Integers  # index into `sources`
    stamps_ns: Integers
    believed: Integers
    since_ns: Integers
    decision: Annotated[IntArray, Choices(Decision)]
    # ids of the observed nodes that they were added as; -1 for those added as edges
    observed: Integers
    distance: Numbers  # Mahalanobis distance when it was judged first [sigma]
    loosened: Integers  # ids of odometry edges that are believed less than claimed
    weights: Numbers  # their weights
    # those in their names; empty if they are counted from 0 in each source
    numbers: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    # of each source, how many have left the graph, and how many of these unused
    left: Pairs = field(default_factory=lambda: np.empty((0, 2), dtype=np.int64))


class FixStates(Judgements):
    """Records of what is decided, and the changes that are to be announced."""

    def __init__(self) -> None:
        super().__init__(RECORD, n_left=2)  # of these the second were unused
        # numbers of records that were changed, and what they were, for `undo`
        self._before: list[tuple[IntArray, Records]] = []
        # records that an update believes or doubts anew, and whether they were believed
        self.changed: dict[int, bool] = {}

    @property
    def believed(self) -> BoolArray:
        return np.asarray(self.records['believed'].copy())

    @property
    def unused(self) -> Held:
        unused = self.records[~self.believed]
        return Held(unused['held'], unused['edge'])

    def append(
        self, one: NewConstraint, *, run: int, believed: bool, distance: float, now_ns: int,
    ) -> None:
        index = self.index_of(one.source)
        held = (one.held_by, True) if one.held_by >= 0 else (one.number, one.is_edge)
        self._records.append_one(np.array((
            *held, index, self.next_number(index), one.stamp_ns, run, believed, now_ns, AUTO,
            -1 if one.is_edge else one.number, distance), dtype=RECORD))

    def leaving(self, edges: IntArray, observed: IntArray) -> BoolArray:
        """Return which records leave with constraints, shape (M,)."""
        held, edge, first = self.records['held'], self.records['edge'], self.records['observed']
        return np.asarray(np.where(edge, np.isin(held, edges), np.isin(held, observed))
                          | np.isin(first, observed))

    def leave(self, gone: BoolArray) -> None:
        """Remove records of measurements that have left the graph; only their number is kept."""
        if not np.any(gone):
            return
        for source, believed in self.records[gone][['source', 'believed']].tolist():
            self._left[source][0] += 1
            self._left[source][1] += 1 - believed
        kept = np.flatnonzero(~gone)
        self._records.select(kept)

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

    def by_stamp(self) -> IntArray:
        """Return the numbers of all records, by stamp, then by the name of the source."""
        names = np.argsort(np.argsort(np.array(self.sources)))
        return np.lexsort((names[self.records['source']], self.records['stamp_ns']))

    def believe(self, which: IntArray, *, believed: bool, now_ns: int) -> None:
        """Believe or doubt some records, but not those that a person has decided on."""
        records = self.records
        which = which[(records['decision'][which] == AUTO)
                      & (records['believed'][which] != believed)]
        self.keep(which)
        for number in which.tolist():
            self.changed.setdefault(number, not believed)
        records['believed'][which], records['since_ns'][which] = believed, now_ns

    def weights(
        self, first: int, reweighting: Reweighting,
    ) -> tuple[dict[int, float], dict[int, float]]:
        """Return weights that change, of edges and of observed nodes by id."""
        weights: tuple[dict[int, float], dict[int, float]] = {}, {}
        doubted = np.flatnonzero(~self.records['believed'][first:]) + first
        for number in (*doubted.tolist(), *self._after_return(), *self.changed):
            held, edge, believed = self.records[number][['held', 'edge', 'believed']].tolist()
            weights[0 if edge else 1][held] = (
                self._base_weight(number, reweighting) if believed else 0.0)
        return weights

    def set_base_weights(self, first: int, reweighting: Reweighting) -> None:
        """Tell what is not believed any more, or again."""
        for number in (*range(first, len(self)), *self.changed):
            held, edge, believed = self.records[number][['held', 'edge', 'believed']].tolist()
            if not believed:
                reweighting.set_base_weight(held, 0.0, edge=edge)
            elif number < first:
                base = self._base_weight(number, reweighting)
                reweighting.set_base_weight(held, base, edge=edge)

    def _after_return(self) -> list[int]:
        """Return the believed ones since one that returns: losses have lowered their weights."""
        again = [number for number, believed in self.changed.items() if not believed]
        if len(again) == 0:
            return []
        since = np.min(self.records['stamp_ns'][again])
        return np.flatnonzero((self.records['stamp_ns'] >= since) & self.believed).tolist()

    def _base_weight(self, number: int, reweighting: Reweighting) -> float:
        """Return the base weight of a believed record, or else that of one next to it."""
        held, edge, source = self.records[number][['held', 'edge', 'source']].tolist()
        if edge:
            return 1.0
        own = reweighting.base_weight(held)
        if own:
            return own
        first = max(number - BELIEF.records_near, 0)
        near = self.records[first:number + BELIEF.records_near]
        alike = first + np.flatnonzero(
            near['believed'] & ~near['edge'] & (near['source'] == source))
        for other in alike[np.argsort(np.abs(alike - number), kind='stable')].tolist():
            if other not in self.changed:
                return reweighting.base_weight(int(self.records['held'][other])) or 1.0
        return 1.0

    def moved(self, before: Held, after: Held) -> None:
        """Have records follow measurements that others hold now."""
        held = 2 * self.records['held'] + self.records['edge']
        wanted = 2 * before.ids + before.is_edge
        numbers = np.flatnonzero(np.isin(held, wanted))
        order = np.argsort(wanted)
        at = order[np.searchsorted(wanted, held[numbers], sorter=order)]
        self.records['held'][numbers] = after.ids[at]
        self.records['edge'][numbers] = after.is_edge[at]

    def announce(self, number: int, before: State | None) -> None:
        record = self.records[number]
        after = State.BELIEVED if record['believed'] else State.DOUBTED
        self._changes.append(Change(
            self.name(number), Judged.FIX, self.sources[record['source']], int(record['stamp_ns']),
            before, after))

    def totals(self) -> dict[str, SourceVerdicts]:
        totals = {}
        for index, source in enumerate(self.sources):
            own, (n_left, n_unused) = self.believed[self.source == index], self._left[index]
            n = int(np.count_nonzero(own))
            totals[source] = SourceVerdicts(
                {State.BELIEVED: n, State.DOUBTED: len(own) - n}, 1.0,
                len(own) > 0 and not bool(np.any(own[-BELIEF.newest:])),
                n_left=n_left, n_left_unused=n_unused)
        return totals

    def saved(self, loosened: dict[int, float]) -> SavedFixes:
        records = self.records.copy()
        return SavedFixes(
            tuple(self.sources), records['held'], records['edge'].astype(np.int64),
            records['source'], records['stamp_ns'], records['believed'].astype(np.int64),
            records['since_ns'], records['decision'], records['observed'], records['distance'],
            np.array(list(loosened), dtype=np.int64),
            np.array(list(loosened.values()), dtype=np.float64), records['number'],
            np.array(self._left, dtype=np.int64).reshape(-1, 2))

    def restore(self, saved: SavedFixes) -> None:
        """Fill empty records with saved ones; they belong to no run."""
        self.fill(saved.sources, saved.left, saved.numbers, {
            'held': saved.rows, 'edge': saved.edges, 'source': saved.source,
            'stamp_ns': saved.stamps_ns, 'run': LONE, 'believed': saved.believed,
            'since_ns': saved.since_ns, 'decision': saved.decision, 'observed': saved.observed,
            'distance': saved.distance})


def verdicts(states: FixStates, graph: Graph, most_believed: int | None) -> list[Verdict]:
    numbers = listed(states.records['source'], states.believed,
                     states.records['decision'] != AUTO, most_believed)
    return verdicts_on(states, graph, numbers)


def believed_after(states: FixStates, stamp_ns: int) -> tuple[str, ...]:
    """Return the ids of the first believed measurements from a stamp on."""
    after = np.flatnonzero(states.believed & (states.records['stamp_ns'] >= stamp_ns))
    first = after[np.argsort(states.records['stamp_ns'][after], kind='stable')][:MOST_NAMED]
    return tuple(map(states.name, first.tolist()))


def verdicts_on(states: FixStates, graph: Graph, numbers: IntArray) -> list[Verdict]:
    residuals = _residuals(graph, states.records['held'][numbers], states.records['edge'][numbers])
    return [_verdict(states, number, residual)
            for number, residual in zip(numbers.tolist(), residuals, strict=True)]


def _verdict(states: FixStates, number: int, residual: FloatArray) -> Verdict:
    record = states.records[number]
    believed = bool(record['believed'])
    # members of a run follow one another
    first, records = max(number - 50, 0), states.records
    alike = first + np.flatnonzero(records['run'][first:number + 50] == record['run'])
    alike = alike[alike != number] if record['run'] != LONE else alike[:0]
    # a person may force out what fits, and force in what does not
    contradicted = (not believed if record['decision'] == AUTO
                    else bool(record['distance']**2 > BELIEF.event))
    near = alike[np.argsort(np.abs(alike - number), kind='stable')][:MOST_NAMED]
    return Verdict(
        id=states.name(number), kind=Judged.FIX, source=states.sources[record['source']],
        stamp_ns=int(record['stamp_ns']), reference_ns=None,
        state=State.BELIEVED if believed else State.DOUBTED, since_ns=int(record['since_ns']),
        decision=DECISIONS[record['decision']], residual=residual,
        distance=float(record['distance']),
        supported_by=tuple(states.name(other) for other in near.tolist()),
        contradicted_by=('odometry',) if contradicted else (), edge=bool(record['edge']),
        number=int(record['held']))


def _residuals(graph: Graph, held: IntArray, some: BoolArray) -> FloatArray:
    """Return the errors at the estimate, shape (K, 3), nan where nothing is measured."""
    residuals = np.empty((len(held), 3))
    biased, observed = graph.edges_at(held[some]), graph.observed_at(held[~some])
    for which, error, information in (
            (some, graph.edge_errors(biased), biased.information),
            (~some, graph.observed_errors(observed), observed.information)):
        measured = np.diagonal(information, axis1=1, axis2=2) > 0.0
        residuals[which] = np.where(measured, error, np.nan)
    return residuals
