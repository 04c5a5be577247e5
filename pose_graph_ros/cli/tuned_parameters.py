# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From estimated noise to parameters of the node, and their file with a reason for each."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from pose_graph_ros.offline.tuning import likelihood as lk
from pose_graph_ros.offline.tuning.drive_rows import SourceOfPoses
from pose_graph_ros.offline.tuning.fit import Fit, Found
from pose_graph_ros.offline.tuning.likelihood import Role

ODOMETRY = ('sigma_distance', 'sigma_lateral', 'sigma_heading_distance', 'sigma_heading_turn')
LARGEST_SIGMA = 10.0  # of odometry, by the range of its parameters


@dataclass(frozen=True, slots=True)
class Tuned:
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

    @property
    def source(self) -> str:
        """Name of the source."""
        return self.name.partition('.')[0]


def odometry_parameters(source: str, found: Fit, values: Mapping[str, Any]) -> Iterator[Tuned]:
    """Yield the parameters of a source of odometry by a fit."""
    own = [each for each in found.found if each.parameter.role is Role.ODOMETRY]
    scale = math.sqrt(values[f'{source}.covariance_scale'])
    before, changed = values[f'{source}.sigma_scale'], any(not each.kept for each in own)
    for each in sorted(own, key=lambda one: one.parameter.index):
        if each.parameter.index == lk.GIVEN:
            yield _one(f'{source}.covariance_scale', each, values, lambda sigma: sigma**2)
            continue
        one = _one(f'{source}.{ODOMETRY[each.parameter.index]}', each, values,
                   lambda sigma: min(sigma / scale, LARGEST_SIGMA))
        if each.kept and changed and before not in (0.0, 1.0):
            # the sigma stays, and sigma_scale becomes 1
            one = replace(one, after=_rounded(min(before * one.before, LARGEST_SIGMA)),
                          note=f'times sigma_scale; {one.note}')
        yield one
    if changed:
        yield Tuned(f'{source}.sigma_scale', before, 1.0,
                    note='the sigmas are those of this odometry')


def closure_parameters(
    odometry: str, closures: Sequence[str], found: Fit, values: Mapping[str, Any],
) -> Iterator[Tuned]:
    """Yield the parameters of odometry and of loop closures by factors on their sigmas."""
    by_role = {each.parameter.role: each for each in found.found}
    own, of_closures = by_role[Role.ODOMETRY], by_role[Role.CLOSURE]
    scale = values[f'{odometry}.sigma_scale'] or 1.0
    if values[f'{odometry}.noise'] == 'model':
        for leaf in ODOMETRY:
            at = scale * values[f'{odometry}.{leaf}']
            one = _one(f'{odometry}.{leaf}', own, values,
                       lambda factor, at=at: min(at * factor, LARGEST_SIGMA))
            yield replace(one, note=f'all four by one factor; {one.note}')
    else:
        at = scale**2 * values[f'{odometry}.covariance_scale']
        yield _one(f'{odometry}.covariance_scale', own, values, lambda factor: at * factor**2)
    if not own.kept:
        yield Tuned(f'{odometry}.sigma_scale', values[f'{odometry}.sigma_scale'], 1.0,
                    note='the sigmas are those of this odometry')
    for source in closures:
        at = values[f'{source}.covariance_scale']
        yield _one(f'{source}.covariance_scale', of_closures, values,
                   lambda factor, at=at: at * factor**2)


def source_parameters(
    source: SourceOfPoses, index: int, found: Fit, values: Mapping[str, Any],
) -> Iterator[Tuned]:
    """Yield the parameters of a source of measurements in the map by a fit."""
    of = {each.parameter.role: each for each in found.found
          if each.parameter.index == index and each.parameter.role is not Role.ODOMETRY}
    size, heading = of.get(Role.CORRELATED) or of.get(Role.WHITE), of.get(Role.HEADING)
    share, more = 0.0, ''
    if Role.TAU in of:
        share = of[Role.SHARE].value
        if share > 1.0:     # parameters cannot say it
            more = '; errors are correlated as well, which the node finds'
    if size is not None:
        factor = 1.0 + share if share > 1.0 else 1.0
        size = size._replace(value=size.value * factor, low=size.low * factor,
                             high=size.high * factor)
    yield from _sizes(source, size, heading, values, more)
    if Role.TAU in of and share <= 1.0:
        yield _one(f'{source.name}.correlation_time', of[Role.TAU], values, float)


def _sizes(
    source: SourceOfPoses, size: Found | None, heading: Found | None, values: Mapping[str, Any],
    more: str,
) -> Iterator[Tuned]:
    """Yield the factor on the covariances that a source claims, or what replaces these."""
    leading = heading if size is None else size
    if leading is None:
        return
    scale, override = f'{source.name}.covariance_scale', f'{source.name}.covariance_override'
    # factors of positions and headings that both need a number
    apart = size is not None and heading is not None and source.is_constant and (
        max(heading.value, size.value) > 1.3 * min(heading.value, size.value))
    if source.is_scalable and not apart:
        at_scale = values[scale]
        one = _one(scale, leading, values, lambda ratio: at_scale * ratio)
        if source.is_constant and source.sigma > 0.0 and one.changes:
            one = replace(one, note=f'{one.note}; sigma {_number(source.sigma)} m claimed, '
                          f'{_number(source.sigma * math.sqrt(leading.value))} m found')
        if one.changes and size is not None and heading is not None and (
                heading.value != size.value):
            more += (f'; of headings by themselves it would be '
                     f'{_number(at_scale * heading.value)}')
        yield replace(one, note=one.note + more)
        return
    if leading.kept and (heading is None or heading.kept):
        yield Tuned(override, values[override], values[override],
                    source.sigma * math.sqrt(leading.low),
                    source.sigma * math.sqrt(leading.high), note=_kept_note(leading) + more)
        return
    sigmas = [] if size is None else [source.sigma * math.sqrt(size.value)]
    if heading is not None or source.sigma_heading > 0.0:
        ratio = 1.0 if heading is None else heading.value
        sigmas = [*(sigmas or [1.0]), source.sigma_heading * math.sqrt(ratio)]
    of = source.sigma if size is not None else source.sigma_heading
    yield Tuned(override, values[override], [_rounded(each) for each in sigmas],
                of * math.sqrt(leading.low), of * math.sqrt(leading.high),
                note='instead of covariances that are not valid' + more
                if not source.is_scalable else 'of position and heading' + more)
    if values[scale] != 1.0:
        yield Tuned(scale, values[scale], 1.0, note='part of covariance_override')


def _one(name: str, found: Found, values: Mapping[str, Any], value: Any) -> Tuned:
    """Return a parameter by its estimate."""
    before = values[name]
    after = before if found.kept else _rounded(value(found.value))
    note = _kept_note(found) if found.kept else ''
    if not found.kept and found.is_wide:
        note = 'the data tell this one only roughly'
    return Tuned(name, before, after, float(value(found.low)), float(value(found.high)), note)


def _kept_note(found: Found) -> str:
    return 'kept: the data do not tell' if found.is_wide else 'kept: as good as any'


def changed(tuned: Iterable[Tuned]) -> dict[str, Any]:
    """Return the new values by name."""
    return {each.name: each.after for each in tuned if each.changes}


def yaml_text(tuned: Sequence[Tuned], headline: Sequence[str]) -> str:
    """Return a parameter file with what changes, and comments."""
    lines = [*(f'# {line}'.rstrip() for line in headline), '/**:', '  ros__parameters:']
    for source in dict.fromkeys(each.source for each in tuned):
        own = [each for each in tuned if each.source == source]
        if not any(each.changes for each in own):
            lines += [f'    # {each.name}: {_text(each.before)}, {_why(each)}' for each in own]
            continue
        lines.append(f'    {source}:')
        for each in own:
            leaf = each.name.partition('.')[2]
            if each.changes:
                lines += [f'      # {_text(each.before)} before; {_why(each)}',
                          f'      {leaf}: {_text(each.after)}']
            else:
                lines.append(f'      # {leaf}: {_text(each.before)}, {_why(each)}')
    return '\n'.join(lines) + '\n'


def interval(tuned: Tuned) -> str:
    """Return the interval of a parameter; empty if it has none."""
    if math.isnan(tuned.low):
        return ''
    return f'{_number(tuned.low)} to {_number(tuned.high)}'


def _why(tuned: Tuned) -> str:
    parts = [f'95 %: {interval(tuned)}'] if interval(tuned) != '' else []
    return '; '.join([*parts, *([tuned.note.strip('; ')] if tuned.note else [])])


def _rounded(value: float) -> float:
    """Return a value with some digits."""
    return float(f'{value:.3g}')


def _number(value: float) -> str:
    return 'no bound' if math.isinf(value) else f'{value:.3g}'


def _text(value: Any) -> str:
    """Return a value as YAML, numbers as floating-point ones."""
    if isinstance(value, list | tuple):
        return f'[{", ".join(_text(each) for each in value)}]'
    if not isinstance(value, int | float):
        return str(value)
    text = repr(float(value))   # YAML takes 1e-05 for a text
    return text.replace('e', '.0e') if 'e' in text and '.' not in text else text
