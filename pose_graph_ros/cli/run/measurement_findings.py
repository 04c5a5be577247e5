# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Findings on measurements: what is doubted or refused, where and why, and what is missing."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.cli.run.content import Run
from pose_graph_ros.cli.run.recorder import Recorder
from pose_graph_ros.core.judgement.closures import NEAR
from pose_graph_ros.core.judgement.texts import number_of, sentence, short
from pose_graph_ros.core.judgement.verdicts import Judged, State, Verdict

Texts = tuple[str, str, str]
"""Level, text and anchor of a finding."""

# Number of stretches, groups and gaps that are told one by one.
MOST_TOLD = 3
# Doubted fixes belong to one stretch if at most so many others are between them.
MOST_BETWEEN = 2
# Stretches and groups of at least so many measurements are more than bad luck.
MANY = 3
# A silence of odometry, or of fixes, is a gap if it is this long [s], and this many periods.
GAPS = {True: (0.5, 8.0), False: (4.0, 8.0)}
# A gap from which it is a warning [s].
LONG_GAP = 20.0
# Share of the messages of a source that are refused, from which it is a warning.
MANY_REFUSED = 0.05
# Answers that are no refusals; those that begin with `repaired` are none either.
HARMLESS = ('accepted', 'pending', 'sorted', 'thinned', 'rotations', 'default_covariance',
            'done_over')


def found(run: Run) -> Iterator[Texts]:
    """Yield all of them."""
    for source in sorted({each.source for each in run.verdicts}):
        own = [each for each in run.verdicts if each.source == source]
        yield from _stretches(run, source, own)
        yield from _groups(run, source, own)
        yield from _odometry(run, source, own)
    yield from silences(run.recorder, run.kinds, run.start_ns)
    yield from _refusals(run)


def _seconds(run: Run, stamp_ns: int) -> float:
    return (stamp_ns - run.start_ns) * 1e-9


def _stretches(run: Run, source: str, verdicts: Sequence[Verdict]) -> Iterator[Texts]:
    """Yield the stretches of fixes that are doubted."""
    every = sorted((each for each in verdicts if each.kind is Judged.FIX),
                   key=lambda each: each.stamp_ns)
    places = np.flatnonzero([each.state is State.DOUBTED for each in every])
    doubted = [every[place] for place in places.tolist()]
    if len(doubted) == 0:
        return
    ends = np.flatnonzero(np.diff(places) > 1 + MOST_BETWEEN) + 1
    parts = [part.tolist() for part in np.split(np.arange(len(places)), ends)]
    parts.sort(key=len, reverse=True)
    long = [part for part in parts if len(part) >= MANY]
    for part in long[:MOST_TOLD]:
        begin, end = (_seconds(run, doubted[at].stamp_ns) for at in (part[0], part[-1]))
        far = [float(np.hypot(*doubted[at].residual[:2])) for at in part]
        size = f', {short(np.nanmedian(far))} m from the path' if np.any(np.isfinite(far)) else ''
        yield ('warning', f'{source}: {number_of(len(part), Judged.FIX)} from {begin:.1f} s to '
               f'{end:.1f} s contradict the path and are not used{size}: look for reflections, '
               f'or a jump of the receiver', 'map')
    rest = sum(map(len, parts)) - sum(map(len, long[:MOST_TOLD]))
    if rest > 0:
        more = ' more' if len(long) > 0 else ''
        yield ('notice', f'{source}: {rest}{more} of {number_of(len(every), Judged.FIX)} '
               f'contradict the path, alone or in other stretches, and are not used', 'map')


def _groups(run: Run, source: str, verdicts: Sequence[Verdict]) -> Iterator[Texts]:
    """Yield the groups of loop closures that are doubted, and how many wait."""
    every = [each for each in verdicts if each.kind is Judged.LOOP_CLOSURE]
    doubted = sorted((each for each in every if each.state is State.DOUBTED),
                     key=lambda each: each.stamp_ns)
    anchor = 'map'
    if len(doubted) > 0:
        groups = _closure_groups(run, doubted)
        large = [group for group in groups if len(group) >= MANY]
        largest = ''
        if len(large) > 0:
            first = large[0]
            ends = [[_seconds(run, stamp) for stamp in stamps] for stamps in (
                [each.reference_ns or 0 for each in first], [each.stamp_ns for each in first])]
            here, there = (f'{min(each):.0f} to {max(each):.0f} s' for each in ends)
            largest = (f'; {len(large)} group{"s" if len(large) > 1 else ""} of {MANY} or more, '
                       f'the largest takes the place at {there} for that at {here} '
                       f'({len(first)} closures)')
        level = 'warning' if len(doubted) >= MANY else 'notice'
        yield (level, f'{source}: {len(doubted)} of {number_of(len(every), Judged.LOOP_CLOSURE)} '
               f'contradict the others and are not used{largest}; the strongest: '
               f'{_strongest(doubted)}', anchor)
    waiting = sum(each.state is State.WAITING for each in every)
    if waiting > 0:
        yield ('notice', f'{source}: {waiting} of {number_of(len(every), Judged.LOOP_CLOSURE)} '
               'are not used, as too little speaks for or against them', anchor)
    weakly = sum(each.state is State.WEAKLY_BELIEVED for each in every)
    if weakly > 0:
        yield ('notice', f'{source}: {weakly} of {number_of(len(every), Judged.LOOP_CLOSURE)} '
               'are used, though little but the record of the source speaks for them', anchor)
    refused = [reason for (name, _, _), reason in run.refused.items() if name == source]
    if len(refused) > 0:
        yield ('notice', f'{source}: {number_of(len(refused), Judged.LOOP_CLOSURE)} could not be '
               f'added; the first: {refused[0]}', anchor)


def _strongest(doubted: Sequence[Verdict]) -> str:
    """Return the name and the distance of the closure that contradicts most."""
    known = [each for each in doubted if np.isfinite(each.distance)]
    if len(known) == 0:
        return doubted[0].id
    worst = max(known, key=lambda each: each.distance)
    return f'{worst.id}, {worst.distance:.1f} sigma'


def _closure_groups(run: Run, closures: Sequence[Verdict]) -> list[list[Verdict]]:
    """Return closures in groups with both ends near each other, the largest first."""
    path = run.drive.corrected
    stamps = np.array([(each.stamp_ns, each.reference_ns or 0) for each in closures])
    ends = path.at(np.clip(stamps, *path.stamps_ns[[0, -1]]))[:, :, :2]
    groups: list[list[int]] = []
    for k, here in enumerate(ends):
        for group in groups:
            # as near as those are that can agree with one another
            if np.all(np.hypot(*(here - ends[group[-1]]).T) <= NEAR):
                group.append(k)
                break
        else:
            groups.append([k])
    return [[closures[k] for k in group] for group in sorted(groups, key=len, reverse=True)]


def _odometry(run: Run, source: str, verdicts: Sequence[Verdict]) -> Iterator[Texts]:
    """Yield where odometry is doubted."""
    doubted = [each for each in verdicts
               if each.kind is Judged.ODOMETRY and not each.state.in_graph]
    for each in doubted[:MOST_TOLD]:
        at = _seconds(run, each.stamp_ns)
        yield ('warning', f'{source}: odometry is wrong before {at:.1f} s: '
               f'{sentence(each, run.start_ns)}', 'map')
    if len(doubted) > MOST_TOLD:
        yield ('warning', f'{source}: odometry is doubted in {len(doubted) - MOST_TOLD} more '
               'places', 'map')
    jumps = run.counts.get((source, 'jump'), 0)
    if jumps > 0:
        yield ('warning', f'{source}: odometry jumped {jumps} times by more than '
               f'{source}.maximum_speed allows; the motion there is taken as unknown', 'map')


def silences(
    recorder: Recorder, kinds: Mapping[str, Kind], start_ns: int,
) -> Iterator[Texts]:
    """
    Yield silences of odometry, and of fixes and global poses.

    Parameters
    ----------
    recorder : Recorder
    kinds : mapping, of the sources
    start_ns : int, from which times count [ns]

    """
    for source, arrivals in recorder.arrivals.items():
        kind = kinds.get(source)
        if kind not in (Kind.ODOMETRY, Kind.TWIST, Kind.GYRO, Kind.FIX, Kind.GLOBAL_POSE):
            continue
        moves = kind in (Kind.ODOMETRY, Kind.TWIST, Kind.GYRO)
        gaps = arrivals.gaps(*GAPS[moves]) - start_ns * 1e-9
        if len(gaps) == 0:
            continue
        lengths = gaps[:, 1] - gaps[:, 0]
        told = gaps[np.sort(np.argsort(-lengths, kind='stable')[:MOST_TOLD])]
        where = ', '.join(f'{begin:.1f} to {end:.1f} s' for begin, end in told.tolist())
        more = f' and {len(gaps) - len(told)} more' if len(gaps) > len(told) else ''
        others = any(each.is_odometry and name != source and name in recorder.arrivals
                     for name, each in kinds.items())
        what = ('the path follows odometry there, and its covariance grows' if not moves else
                'the heading there is that of other sources' if kind is Kind.GYRO else
                'the motion there is that of other odometry, as far as it goes on' if others else
                'the motion there is not known')
        longest = float(np.max(lengths))
        level = 'warning' if longest > LONG_GAP else 'notice'
        yield (level, f'{source}: no messages from {where}{more} ({short(longest, 3)} s at '
               f'most); {what}', f'source-{source}')


def _refusals(run: Run) -> Iterator[Texts]:
    """Yield how many messages were refused, by source and reason."""
    totals: dict[str, int] = {}
    for (source, _), count in run.counts.items():
        totals[source] = totals.get(source, 0) + count
    for (source, reason), count in sorted(run.counts.items()):
        if reason in HARMLESS or reason.startswith('repaired') or reason == 'jump' or (
                source in ('solver', 'alignment')):
            continue
        level = 'warning' if count > MANY_REFUSED * totals[source] else 'notice'
        detail = run.backend.refusals.get((source, reason), '')
        yield (level, f'{source}: {count} of {totals[source]} messages are not used: {reason}'
               + (f', the last: {detail}' if detail else ''), f'source-{source}')
    for (source, reason), count in sorted(run.counts.items()):
        if reason == 'default_covariance' or reason.startswith('repaired'):
            yield ('notice', f'{source}: {count} messages with a covariance that is not valid '
                   f'({reason}); set {source}.covariance_override to its sigma',
                   f'source-{source}')
