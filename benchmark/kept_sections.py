# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sections of a report, kept in its folder, so that one can be made again without the others."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
import json
from pathlib import Path

from benchmark.metrics import Metric
from benchmark.section import Section, Table

FILE = 'sections.json'
LABELS = 2
"""Cells at the begin of a row that name it."""


def merged(
    folder: Path, made: Mapping[str, Section], order: Sequence[str], *, rows: bool = False,
) -> list[Section]:
    """
    Keep sections, and return them with those that were kept before.

    Parameters
    ----------
    folder : Path
    made : mapping, sections without curves by name
    order : sequence of str, names of all sections
    rows : bool, whether rows of the sections that are not made again are kept as well

    """
    file = folder / FILE
    kept: dict[str, Section] = {}
    if file.exists():
        kept = {name: _section(values) for name, values in json.loads(
            file.read_text(encoding='utf-8')).items()}
    kept |= {name: _with_rows(kept[name], section) if rows and name in kept else section
             for name, section in made.items()}
    kept = {name: kept[name] for name in order if name in kept}
    folder.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(
        {name: asdict(section) for name, section in kept.items()}, indent=1) + '\n',
        encoding='utf-8')
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


def _section(values: dict[str, object]) -> Section:
    section = Section(**values)     # type: ignore[arg-type]
    section.tables = [Table(**table) for table in section.tables]   # type: ignore[arg-type]
    section.metrics = [Metric(**metric) for metric in section.metrics]  # type: ignore[arg-type]
    return section
