# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a row of the requirements is asked to do, and what it hands back."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
import sys

from benchmark import files
from benchmark.metrics import Metric
from benchmark.runs import Plan, Run
from benchmark.worlds import World
from pose_graph_ros.core.geometry.se2 import FloatArray


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line asks for."""

    quick: bool = False
    repeats: int = 3
    data: Path | None = None
    """Folder with graph files."""
    worlds: tuple[str, ...] = ()
    """Only worlds whose names hold one of these, ignoring case; all if empty."""
    limit: float = 200.0
    """The time after which a run of one tool over one world is cut [s]."""
    gtsam: bool = True
    """Whether to run GTSAM at all."""

    def wants(self, name: str) -> bool:
        """Tell whether a world is to be measured."""
        return not self.worlds or any(part.lower() in name.lower() for part in self.worlds)

    def chosen(self, worlds: Iterable[tuple[str, Callable[[], World]]]) -> list[World]:
        """Make the worlds that are to be measured, and say so."""
        made = []
        for name, make in worlds:
            if self.wants(name):
                made.append(make())
        return made


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the report."""

    caption: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]] = field(default_factory=list)

    def add(self, *cells: str) -> None:
        """Add a row."""
        assert len(cells) == len(self.header)
        self.rows.append(cells)


@dataclass(frozen=True, slots=True)
class Curve:
    """A line of a picture."""

    picture: str
    """`step time` or `excess`."""
    panel: str
    tool: str
    x: FloatArray
    y: FloatArray


@dataclass(slots=True)
class Section:
    """Everything that one row of the requirements has found."""

    title: str
    about: str
    tables: list[Table] = field(default_factory=list)
    metrics: list[Metric] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    failed: bool = False
    """Whether the row could not be measured."""


Tool = Callable[[World, Plan], Run]


def peers(options: Options, *, careful: bool = True) -> dict[str, Tool]:
    """Return the runs of GTSAM that ours are compared with: none without GTSAM."""
    if not options.gtsam:
        return {}
    # the rest of the benchmark can be used without GTSAM
    from benchmark.gtsam_peer import CAREFUL, FAST  # noqa: PLC0415

    return {setting.name: setting for setting in ((FAST, CAREFUL) if careful else (FAST,))}


def file_worlds(options: Options, notes: list[str]) -> list[World]:
    """Return the wanted worlds of the folder with graph files; complaints go to the notes."""
    if options.data is None:
        return []
    worlds, complaints = _folder(options.data)
    notes += [text for text in complaints if text not in notes]
    return [world for world in worlds if options.wants(world.name)]


@cache
def _folder(folder: Path) -> tuple[list[World], list[str]]:
    return files.load_folder(folder)


def say(text: str) -> None:
    """Tell whoever waits what is being done."""
    print(text, file=sys.stderr, flush=True)
