# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of short simulated drives, and calls of `pose-graph fleet`."""

from contextlib import redirect_stderr, redirect_stdout
import io
from pathlib import Path
import sys
from typing import Any, NamedTuple

import pyarrow.parquet

from pose_graph_ros.cli.main import main

FLEET = (sys.executable, '-m', 'pose_graph_ros.cli.main', 'fleet')


class Called(NamedTuple):
    """What came of a call."""

    code: int
    out: str
    errors: str

    @property
    def counts(self) -> str:
        """How many drives were replayed, kept and failed."""
        return next(line for line in self.out.splitlines() if ' drives: ' in line)


def write_drives(folder: Path, count: int, *options: str, seconds: int = 15) -> list[Path]:
    """Simulate drives, each another one, into bags in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    bags = [folder / f'day{k:02d}' for k in range(count)]
    for k, bag in enumerate(bags):
        assert call('simulate', bag, '--seed', k, '--duration', seconds, *options).code == 0
        (folder / f'{bag.name}_truth.json').unlink()
    return bags


def call(*words: Any) -> Called:
    """Run a tool in this process."""
    out, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(errors):
        code = main([str(word) for word in words])
    return Called(code, out.getvalue(), errors.getvalue())


def rows_in(out: Path) -> dict[str, dict[str, Any]]:
    """Return the rows of the table by the name of the bag."""
    return {row['name']: row for row in pyarrow.parquet.read_table(
        out / 'drives.parquet').to_pylist()}
