# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is believed, doubted or waits, in words that need no knowledge of the solver."""

from collections.abc import Mapping, Sequence
import math
import re

from pose_graph_ros.core.judgement import verdicts as vd
from pose_graph_ros.core.measurements import Answer, rejected
from pose_graph_ros.core.quantities import NANOSECONDS

PLAUSIBLE = 3.37  # distance up to which a pose may be right: 99 % of right ones are nearer [sigma]
NOUNS = {vd.Judged.LOOP_CLOSURE: ('closure', 'closures'), vd.Judged.FIX: ('fix', 'fixes'),
         vd.Judged.ODOMETRY: ('odometry edge', 'odometry edges')}
# states in the order in which people want to read of them
ORDER = (vd.State.DOUBTED, vd.State.WAITING, vd.State.WEAKLY_BELIEVED, vd.State.BELIEVED)
Key = tuple[str, int, int | None]  # source, stamp and stamp of the other end of a measurement [ns]


def seconds(stamp_ns: int, digits: int = 3) -> str:
    """Return a stamp in seconds, rounded down."""
    whole, rest = divmod(stamp_ns, NANOSECONDS)
    return f'{whole}.{f"{rest:09d}"[:digits]}'


def short(value: float, digits: int = 2) -> str:
    """
    Return a number for people: with so many significant digits, but all those before the point.
    """
    rounded = float(f'{value:.{digits}g}')
    if not 1e-4 <= abs(rounded) < 1e9:
        return f'{value:.{digits}g}'
    text = f'{value:.{max(digits - 1 - math.floor(math.log10(abs(rounded))), 0)}f}'
    return text.rstrip('0').rstrip('.') if '.' in text else text


def shortened(text: str, most: int = 80) -> str:
    """Return a text of others for people: of one that is too long the begin and its length."""
    return text if len(text) <= most else f'{text[:most // 2]}... ({len(text)} characters)'


def number_of(n: int, kind: vd.Judged) -> str:
    """Return `1 closure` or `2 closures`."""
    return f'{n} {NOUNS[kind][n != 1]}'


def joined(names: Sequence[str]) -> str:
    """Return names separated by commas, and how many there are above `MOST_NAMED`."""
    more = len(names) - vd.MOST_NAMED
    return ', '.join(names[:vd.MOST_NAMED]) + (f' and {more} more' if more > 0 else '')


def sentence(verdict: vd.Verdict, start_ns: int | None = None) -> str:
    """
    Return state and reason of a verdict as a sentence.

    Of a drive that is over, its start [ns] is given: times are since then, `12.3 s`, else stamps.
    """
    since, far = _time(verdict.since_ns, start_ns), _far(verdict.distance)
    reason, n_supporting = _doubt(verdict, start_ns), len(verdict.supported_by)
    supported = '' if n_supporting == 0 else (
        f'; {joined(verdict.supported_by)} {"agrees" if n_supporting == 1 else "agree"} with it')
    # that odometry contradicts it is what its distance tells
    others = [name for name in verdict.contradicted_by if name != vd.ODOMETRY]
    contradicted = '' if len(others) == 0 else f'; it contradicts {joined(others)}'
    if verdict.left:
        how = 'doubted' if verdict.kind is vd.Judged.ODOMETRY else 'unused'
        return f'Left the window {how} at {since}: {reason}{contradicted}{supported}.'
    if verdict.decision is not vd.Decision.AUTO:
        used = 'Used' if verdict.decision is vd.Decision.IN else 'Not used'
        return f'{used} since {since}, as a person has decided: {far}{contradicted}{supported}.'
    match verdict.state:
        case vd.State.BELIEVED:
            # of a drive that is over, the path is that with it
            when = f' since {since}' if start_ns is None else ''
            return f'Believed and used{when}: {far}{supported}{contradicted}.'
        case vd.State.WEAKLY_BELIEVED:
            return (f'Believed weakly, but used since {since}: {far}, and little else speaks for '
                    f'it{supported}{contradicted}.')
        case vd.State.WAITING:
            return (f'Waits since {since} and is not used: too little is known yet to believe or '
                    f'to doubt it; {far}{supported}{contradicted}.')
        case vd.State.DOUBTED:
            return f'Doubted and not used since {since}: {reason}{contradicted}{supported}.'


def _time(stamp_ns: int, start_ns: int | None) -> str:
    return seconds(stamp_ns) if start_ns is None else f'{(stamp_ns - start_ns) * 1e-9:.1f} s'


def _far(distance: float) -> str:
    return 'it has not been compared with the path yet' if math.isnan(distance) else (
        f'it was {distance:.1f} sigma from the path without it')


def _doubt(verdict: vd.Verdict, start_ns: int | None) -> str:
    """Return why a constraint is doubted."""
    distance, (x, y, theta) = verdict.distance, verdict.residual.tolist()
    if verdict.kind is vd.Judged.ODOMETRY and verdict.reference_ns is not None:
        return (f'it is wrong by {math.hypot(x, y):.2f} m and {abs(theta):.2f} rad, somewhere '
                f'between {_time(verdict.reference_ns, start_ns)} and '
                f'{_time(verdict.stamp_ns, start_ns)}')
    if verdict.kind is vd.Judged.FIX and math.isfinite(x + y):
        # what was expected when it came may have been as wrong
        turned = '' if math.isnan(theta) else f' and {abs(theta):.2f} rad'
        return f'it is {short(math.hypot(x, y))} m{turned} from the path that the others tell'
    if distance > PLAUSIBLE:
        return _far(distance)
    alone = '' if math.isnan(distance) else (
        f'by itself it could be right, {distance:.1f} sigma from the path without it, but ')
    return f'{alone}all others together agree better without it'


def unknown(name: str, *, has_left: bool) -> Answer:
    if has_left:
        return rejected('left_window', f'{name} has left the window of the graph, so nothing can '
                                       'be decided on it any more')
    if re.fullmatch(r'\w+/\d+', name) is not None:
        return rejected('unknown_id', f'there is no verdict {shortened(name)!r}: it is none '
                                      'of those listed')
    return rejected('unknown_id', 'expected the id of a verdict, such as loop_closure/17, '
                                  f'got {shortened(name)!r}')


def details(verdict: vd.Verdict) -> dict[str, str]:
    reference = verdict.reference_ns
    return {
        'kind': verdict.kind.value, 'stamp': seconds(verdict.stamp_ns, 9),
        'reference_stamp': '' if reference is None else seconds(reference, 9),
        'state': verdict.state.value, 'since': seconds(verdict.since_ns),
        'residual': '[' + ', '.join(f'{part:.3f}' for part in verdict.residual.tolist()) + ']',
        'distance': f'{verdict.distance:.2f}', 'supported_by': ', '.join(verdict.supported_by),
        'contradicted_by': ', '.join(verdict.contradicted_by),
        'decision': verdict.decision.value}


def is_notable(verdict: vd.Verdict) -> bool:
    """Return whether a person has decided on a constraint, or it is not in the estimate."""
    return verdict.decision is not vd.Decision.AUTO or not verdict.state.in_graph


def as_json(verdict: vd.Verdict) -> dict[str, object]:
    far = verdict.distance
    return {
        'id': verdict.id, 'source': verdict.source, **details(verdict),
        'residual': [part if math.isfinite(part) else None for part in verdict.residual.tolist()],
        'distance': far if math.isfinite(far) else None,
        'supported_by': list(verdict.supported_by),
        'contradicted_by': list(verdict.contradicted_by), 'sentence': sentence(verdict)}


def totals_text(totals: vd.SourceVerdicts) -> str:
    """Return how many constraints of a source are in each state, such as `3 doubted`."""
    parts = [f'{totals.counts[state]} {state.value}' for state in ORDER
             if totals.counts.get(state, 0) > 0]
    if totals.n_forgotten > 0:
        parts.append(f'{totals.n_forgotten} forgotten')
    if totals.n_left > 0:
        parts.append(f'{totals.n_left} left the window, {totals.n_left_unused} of them unused')
    return ', '.join(parts)


def total_values(totals: Mapping[str, vd.SourceVerdicts]) -> dict[str, str]:
    """Return the counts of all sources by the keys that the diagnostics have for them."""
    values: dict[str, str] = {}
    for source, each in totals.items():
        counts = each.counts
        weakly = counts.get(vd.State.WEAKLY_BELIEVED, 0)
        values |= {
            f'{source}.believed': str(counts.get(vd.State.BELIEVED, 0) + weakly),
            f'{source}.believed_weakly': str(weakly),
            f'{source}.doubted': str(counts.get(vd.State.DOUBTED, 0)),
            f'{source}.waiting': str(counts.get(vd.State.WAITING, 0))}
        if each.n_forgotten > 0:
            values[f'{source}.forgotten'] = str(each.n_forgotten)
        if each.n_left > 0:
            values |= {f'{source}.left': str(each.n_left),
                       f'{source}.left_unused': str(each.n_left_unused)}
    return values
