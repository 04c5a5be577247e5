# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a section of a page is asked to do, what it hands back, and where it is kept."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
import inspect
import json
from pathlib import Path
import sys
from typing import Any

import numpy as np

from benchmark import worlds
from benchmark.files import DATA, load_folder
from benchmark.metrics import Metric, RATIO, Slack
from benchmark.worlds import World
from pose_graph_ros.core.geometry.se2 import FloatArray

KEPT = 'sections.json'
QUICK_SIZE = 1300
"""Sets with more nodes are left out of quick runs."""
LABELS = 2
"""Cells at the begin of a row that name it."""


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line asks for."""

    quick: bool = False
    repeats: int = 3
    """Runs of each tool that is timed."""
    runs: int | None = None
    """Seeded drives of each kind."""
    data: Path = DATA
    """Folder with public data."""
    cases: Sequence[str] = ()
    """Only what has one of these in its name, ignoring case; all if empty."""
    limit: float = 60.0
    """The time after which a run of one tool is cut [s]."""
    gtsam: bool = True
    """Whether to run GTSAM at all."""
    sizes: Sequence[int] = ()
    hours: float | None = None
    rates: Sequence[float] = (50.0, 200.0, 500.0, 1000.0)
    seconds: float = 20.0
    out: Path = Path()
    """Folder of the page."""

    def wants(self, name: str) -> bool:
        """Tell whether a world, a drive or a graph is to be measured."""
        return not self.cases or any(part.lower() in name.lower() for part in self.cases)

    def chosen(self, made: Iterable[tuple[str, Callable[[], World]]]) -> list[World]:
        """Make the worlds that are to be measured."""
        return [make() for name, make in made if self.wants(name)]

    def closing(self, notes: list[str]) -> list[World]:
        """Return the wanted worlds that are no chains, generated ones and those from files."""
        made = {'laps': worlds.laps, 'campus': worlds.campus, 'grid': worlds.grid}
        made |= {'grid': lambda: worlds.grid(1200)} if self.quick else {
            'drive': worlds.drive, 'city GPS': worlds.city}
        return self.chosen(made.items()) + self.file_worlds(
            notes, QUICK_SIZE if self.quick else np.inf)

    def file_worlds(self, notes: list[str], most: float = np.inf) -> list[World]:
        """Return the wanted worlds from graph files up to a size; complaints go to the notes."""
        read, complaints = load_folder(self.data / 'graphs')
        notes += complaints
        return [world for world in read if self.wants(world.name) and world.n_nodes <= most]


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the report."""

    caption: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]] = field(default_factory=list)

    def add(self, *cells: str) -> None:
        """Add a row, and tell it whoever waits."""
        assert len(cells) == len(self.header)
        self.rows.append(cells)
        say('  ' + ' | '.join(cells))


@dataclass(frozen=True, slots=True)
class Curve:
    """Time of a step of a tool [us] against the size of the graph."""

    tool: str
    x: FloatArray
    y: FloatArray


@dataclass(slots=True)
class Section:
    """Everything that one section has found."""

    title: str
    about: str
    tables: list[Table] = field(default_factory=list)
    metrics: list[Metric] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    failed: bool = False
    """Whether it could not be measured."""

    def table(self, caption: str, *header: str) -> Table:
        """Add a table."""
        self.tables.append(Table(caption, header))
        return self.tables[-1]

    def ask(
        self, key: str, value: float, unit: str = '', slack: Slack | None = None, *,
        most: float | None = None, least: float | None = None,
    ) -> None:
        """Add a figure, what is asked of it, and by how much it may get worse, if it is gated."""
        self.metrics.append(Metric(
            key, float(value), unit, slack, most if least is None else least,
            higher_is_better=least is not None or slack is RATIO))


def about(what: Any, **further: object) -> str:
    """
    Return the last paragraph of a docstring, for the page.

    What stands in braces is a constant of the module, or one of `further`.
    """
    text = (inspect.getdoc(what) or '').split('\n\n')[-1].replace('\n', ' ')
    return text.format(**getattr(what, '__globals__', {}), **further)


def kept_with(
    folder: Path, name: str, made: Section, order: Sequence[str], *, rows: bool,
) -> list[Section]:
    """Keep a section, perhaps with `rows` of before; return it with those that were kept."""
    file = folder / KEPT
    kept: dict[str, Section] = {}
    if file.exists():
        kept = {key: _section(values) for key, values in json.loads(
            file.read_text(encoding='utf-8')).items()}
    merges = rows and name in kept and not (made.failed or kept[name].failed)
    kept[name] = _with_rows(kept[name], made) if merges else made
    kept = {key: kept[key] for key in order if key in kept}
    file.write_text(json.dumps(
        {key: asdict(replace(section, curves=[])) for key, section in kept.items()}, indent=1)
        + '\n', encoding='utf-8')
    return list(kept.values())


def _with_rows(old: Section, new: Section) -> Section:
    """Return a section with the rows, figures and notes of an older one that it does not have."""
    for table, before in zip(new.tables, old.tables, strict=True):
        again = {tuple(row[:LABELS]) for row in table.rows}
        table.rows[:0] = [row for row in before.rows if tuple(row[:LABELS]) not in again]
    made = {metric.key for metric in new.metrics}
    new.metrics[:0] = [metric for metric in old.metrics if metric.key not in made]
    new.notes[:0] = [note for note in old.notes if note not in new.notes]
    return new


def _section(values: dict[str, Any]) -> Section:
    tables = [Table(**table) for table in values['tables']]
    metrics = [Metric(**metric) for metric in values['metrics']]
    return Section(**values | {'tables': tables, 'metrics': metrics})


def say(text: str) -> None:
    """Tell whoever waits what is being done."""
    print(text, file=sys.stderr, flush=True)
