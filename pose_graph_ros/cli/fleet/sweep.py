# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which parameters are the best for a data set: the points of a sweep, and what they score.

A score is an error of the path of a drive, so that less is better. Points are compared on the
drives that all of them have: an error differs more between drives than between points.
"""

from collections.abc import Iterator, Mapping, Sequence
import csv
import io
import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.parameters import yaml_text_of, yaml_value
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.io.atomic_files import write_files

SCORES = {'held-out': 'held_out_rms_m', 'truth': 'truth_rms_m'}
"""Columns of the table by the name of a score."""
TABLE, BEST = 'sweep.csv', 'best.yaml'
DIGITS = 4  # of a random value
MOST_POINTS = 100_000
IN_METRES = ('mean', 'spread', 'worst', 'worse_by', 'standard_error')

Point = Mapping[str, Any]
"""Values by parameter."""


class Scored(NamedTuple):
    """A point with its score on the drives that all points have [m]."""

    parameters: Point
    drives: int
    failed: int  # drives without a score that another point has
    mean: float
    spread: float  # standard deviation over drives
    worst: float
    worse_by: float  # mean over drives of how much more than that of the best it is
    standard_error: float  # of worse_by


def points_of(texts: Sequence[str], trials: int | None, seed: int) -> list[Point]:
    """
    Return the points of a grid, or random ones between its smallest and largest values.

    Raises `ConfigError` for a text that is not NAME=VALUE,VALUE.
    """
    axes: dict[str, list[Any]] = {}
    for text in texts:
        name, separator, values = text.partition('=')
        try:
            axes[name] = yaml_value(f'[{values}]') if separator and values.strip() else []
        except ValueError:
            axes[name] = []
        if len(axes[name]) == 0 or name == '':
            raise ConfigError(f'--sweep: expected NAME=VALUE,VALUE and so on, got {text!r}')
    if trials is None:
        if (count := math.prod(len(values) for values in axes.values())) > MOST_POINTS:
            raise ConfigError(f'--sweep: {count} points, expected at most {MOST_POINTS}; --trials '
                              'N takes some at random')
        return [dict(zip(axes, each, strict=True)) for each in itertools.product(*axes.values())]
    generator = np.random.default_rng(seed)
    return [{name: _random(values, generator) for name, values in axes.items()}
            for _ in range(trials)]


def _random(values: Sequence[Any], generator: np.random.Generator) -> Any:
    """Return a number between the smallest and the largest, by ratio if they are positive."""
    if not all(isinstance(each, int | float) and not isinstance(each, bool) for each in values):
        return values[int(generator.integers(len(values)))]
    low, high = min(values), max(values)
    number = float(low * (high / low) ** generator.random() if low > 0
                   else low + (high - low) * generator.random())
    return round(number) if all(isinstance(each, int) for each in values) else float(
        f'{number:.{DIGITS}g}')


def scored(points: Sequence[Point], scores: Sequence[Mapping[str, float | None]]) -> list[Scored]:
    """Return points by their scores, the best first; `scores` are those of each point by drive."""
    errors = [{drive: score for drive, score in each.items() if score is not None}
              for each in scores]
    known = set().union(*errors)
    most = max(map(len, errors), default=0)
    whole = [each for each in errors if len(each) == most]
    common = sorted(set(known).intersection(*whole)) if most > 0 else []
    values = [np.array([each[drive] for drive in common if drive in each]) for each in errors]
    order = sorted(range(len(points)), key=lambda k: (
        -len(values[k]), float(np.mean(values[k])) if len(values[k]) > 0 else math.inf))
    best = values[order[0]]
    found = []
    for k in order:
        own = values[k]
        less = own - best if len(own) == len(best) else np.zeros(0)
        found.append(Scored(
            points[k], len(own), len(known) - len(errors[k]), *_statistics(own),
            *(_statistics(less)[0], _spread(less) / math.sqrt(max(len(less), 1)))))
    return found


def _statistics(values: Any) -> tuple[float, float, float]:
    if len(values) == 0:
        return math.nan, math.nan, math.nan
    return float(np.mean(values)), _spread(values), float(np.max(values))


def _spread(values: Any) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def lines(found: Sequence[Scored]) -> Iterator[str]:
    """Yield a table for people."""
    names = [*found[0].parameters]
    head = [*names, 'drives', 'failed', 'mean', 'spread', 'worst', 'worse than the best by']
    rows = [[*(yaml_text_of(each.parameters[name]) for name in names), str(each.drives),
             str(each.failed), *(f'{value:.3f}' for value in (each.mean, each.spread, each.worst)),
             '' if each is found[0] or math.isnan(each.worse_by) else
             f'{each.worse_by:.3f} +- {each.standard_error:.3f}'] for each in found]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        yield '  '.join(f'{cell:>{width}}' for cell, width in zip(
            row, widths, strict=True)).rstrip()


def write(found: Sequence[Scored], given: Mapping[str, Any], score: str, out: Path) -> None:
    """Write the table of the points, and the best one as a parameter file."""
    names = [*found[0].parameters]
    text = io.StringIO(newline='')
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow([*names, *(f'{name}_m' if name in IN_METRES else name
                               for name in Scored._fields[1:])])
    writer.writerows([*(yaml_text_of(each.parameters[name]) for name in names), *each[1:]]
                     for each in found)
    best = found[0]
    write_files({out / TABLE: text.getvalue().encode(), out / BEST: '\n'.join([
        f'# Made by pose-graph fleet --sweep: the best of {len(found)} points by the error '
        f'({score}) of {best.drives} drives:',
        f'# {best.mean:.4g} m in the mean, spread {best.spread:.3g} m, worst {best.worst:.4g} m.',
        '/**:', '  ros__parameters:', *(f'    {name}: {yaml_text_of(value)}' for name, value in {
            # rcl reads no empty list, which stands for unset
            **given, **best.parameters}.items() if value != []), '']).encode()})
