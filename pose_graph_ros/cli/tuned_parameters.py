# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From estimated noise to parameters of the node, and their file with a reason for each."""

from collections.abc import Iterable, Iterator, Sequence
import math
from typing import Any, NamedTuple

from pose_graph_ros.adapters.parameters import yaml_text_of
from pose_graph_ros.adapters.sources import Values
from pose_graph_ros.core.quantities import Metres, Radians
from pose_graph_ros.offline.noise import Found

# Sigmas of odometry, and whether they are of its turns.
ODOMETRY = {'sigma_distance': False, 'sigma_lateral': False, 'sigma_heading_distance': True,
            'sigma_heading_turn': True}
LARGEST_SIGMA = 10.0  # of odometry, by the range of its parameters


class Tuned(NamedTuple):
    """One parameter of the node, before and after."""

    name: str
    before: Any
    after: Any
    low: float = math.nan  # end of its interval of 95 %, in its unit; NaN if it has none
    high: float = math.nan
    note: str = ''

    @property
    def changes(self) -> bool:
        """Whether it has another value than before."""
        return bool(self.after != self.before)


def odometry_parameters(source: str, way: Found, turn: Found, values: Values) -> Iterator[Tuned]:
    """Yield the parameters of a source of odometry by the noise of the way and of turns."""
    if values[f'{source}.noise'] == 'twist':
        yield _one(f'{source}.covariance_scale', max(way, turn), values, 1.0)
    else:
        for leaf, of_turn in ODOMETRY.items():
            yield _one(f'{source}.{leaf}', turn if of_turn else way, values, 0.5, LARGEST_SIGMA)
    if values[f'{source}.sigma_scale'] not in (0.0, 1.0):
        yield Tuned(f'{source}.sigma_scale', values[f'{source}.sigma_scale'], 1.0,
                    note='the sigmas are those of this odometry')


class Claims(NamedTuple):
    """The covariances that a source claims for what it measures in the map."""

    is_constant: bool  # whether they are always the same
    is_scalable: bool  # whether they are valid and not at a bound, so that a factor helps
    sigma: Metres  # median of a coordinate; 0 without positions
    sigma_heading: Radians  # median; 0 without headings


def source_parameters(source: str, claims: Claims, values: Values, *, size: Found | None,
                      heading: Found | None = None) -> Iterator[Tuned]:
    """Yield the parameters of a source by the size of its errors, of positions and headings."""
    leading = heading if size is None else size
    if leading is None:
        return
    scale, override = f'{source}.covariance_scale', f'{source}.covariance_override'
    # factors of positions and headings that both need a number
    apart = size is not None and heading is not None and claims.is_constant and (
        max(heading.value, size.value) > 1.3**2 * min(heading.value, size.value))
    if claims.is_scalable and not apart:
        one = _one(scale, leading, values, 1.0)
        if claims.is_constant and claims.sigma > 0.0 and one.changes:
            one = one._replace(note=f'{one.note}; sigma {_number(claims.sigma)} m claimed, '
                               f'{_number(claims.sigma * math.sqrt(leading.value))} m found')
        if one.changes and size is not None and heading is not None:
            one = one._replace(note=f'{one.note}; of headings by themselves it would be '
                               f'{_number(values[scale] * heading.value)}')
        yield one
    else:
        sigmas = [claims.sigma * math.sqrt(size.value)] if size is not None else [1.0]
        if claims.sigma_heading > 0.0:
            ratio = 1.0 if heading is None else heading.value
            sigmas.append(claims.sigma_heading * math.sqrt(ratio))
        of = claims.sigma if size is not None else claims.sigma_heading
        kept = leading.kept and (heading is None or heading.kept)
        yield Tuned(override, values[override],
                    values[override] if kept else [float(f'{each:.3g}') for each in sigmas],
                    of * math.sqrt(leading.low), of * math.sqrt(leading.high),
                    _kept_note(leading) if kept else 'of position and heading'
                    if claims.is_scalable else 'instead of covariances that are not valid')
        if not kept and values[scale] != 1.0:
            yield Tuned(scale, values[scale], 1.0, note='part of covariance_override')


def _one(name: str, found: Found, values: Values, power: float,
         largest: float = math.inf) -> Tuned:
    """Return a parameter by the factor on the variances, of which it is a power."""
    before = values[name]
    low, after, high = (min(before * factor**power, largest)
                        for factor in (found.low, found.value, found.high))
    note = _kept_note(found) if found.kept else (
        'the data tell this one only roughly' if found.is_wide else '')
    return Tuned(name, before, before if found.kept else float(f'{after:.3g}'), low, high, note)


def _kept_note(found: Found) -> str:
    return 'kept: the data do not tell' if found.is_wide else 'kept: as good as any'


def changed(tuned: Iterable[Tuned]) -> dict[str, Any]:
    """Return the new values by name."""
    return {each.name: each.after for each in tuned if each.changes}


def yaml_text(tuned: Sequence[Tuned], headline: Sequence[str]) -> str:
    """Return a parameter file with what changes, and comments."""
    lines = [*(f'# {line}'.rstrip() for line in headline), '/**:', '  ros__parameters:']
    for source in dict.fromkeys(each.name.partition('.')[0] for each in tuned):
        own = [each for each in tuned if each.name.startswith(f'{source}.')]
        some_change = any(each.changes for each in own)
        lines += [f'    {source}:'] if some_change else []
        for each in own:
            leaf = each.name.partition('.')[2]
            if each.changes:
                lines += [f'      # {yaml_text_of(each.before)} before; {_why(each)}',
                          f'      {leaf}: {yaml_text_of(each.after)}']
            else:
                name = f'      # {leaf}' if some_change else f'    # {each.name}'
                lines.append(f'{name}: {yaml_text_of(each.before)}, {_why(each)}')
    return '\n'.join(lines) + '\n'


def interval(tuned: Tuned) -> str:
    """Return the interval of a parameter; empty if it has none."""
    return '' if math.isnan(tuned.low) else f'{_number(tuned.low)} to {_number(tuned.high)}'


def _why(tuned: Tuned) -> str:
    shown = interval(tuned)
    return '; '.join(filter(None, (shown and f'95 %: {shown}', tuned.note.strip('; '))))


def _number(value: float) -> str:
    return 'no bound' if math.isinf(value) else f'{value:.3g}'
