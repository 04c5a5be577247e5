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


def merged(folder: Path, made: Mapping[str, Section], order: Sequence[str]) -> list[Section]:
    """
    Keep sections, and return them with those that were kept before.

    Parameters
    ----------
    folder : Path
    made : mapping, sections without curves by name
    order : sequence of str, names of all sections

    """
    file = folder / FILE
    kept: dict[str, Section] = {}
    if file.exists():
        kept = {name: _section(values) for name, values in json.loads(
            file.read_text(encoding='utf-8')).items()}
    kept |= made
    kept = {name: kept[name] for name in order if name in kept}
    folder.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(
        {name: asdict(section) for name, section in kept.items()}, indent=1) + '\n',
        encoding='utf-8')
    return list(kept.values())


def _section(values: dict[str, object]) -> Section:
    section = Section(**values)     # type: ignore[arg-type]
    section.tables = [Table(**table) for table in section.tables]   # type: ignore[arg-type]
    section.metrics = [Metric(**metric) for metric in section.metrics]  # type: ignore[arg-type]
    return section
