# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The table of the drives: what its columns mean, and the Parquet file.

The columns with their units are also in docs/fleet.md and in the metadata of the file.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

FILE = 'drives.parquet'
AT_ONCE = 10_000  # rows that become columns at a time
FAILED, CONVERGED, NOT_CONVERGED = 'failed', 'converged', 'not converged'
"""Status of a drive."""


class Column(NamedTuple):
    """A column of the table; its values may be unknown."""

    name: str
    type: str  # as pyarrow names it
    unit: str  # empty if it has none
    text: str


def _errors(name: str, of: str) -> list[Column]:
    return [Column(f'{name}_{leaf}_m', 'double', 'm', f'{text} distance of the path from {of}')
            for leaf, text in (('rms', 'root mean square of the'), ('median', 'median'),
                               ('p95', '95 % quantile of the'), ('max', 'largest'))]


COLUMNS = (
    Column('name', 'string', '', 'name of the bag'),
    Column('bag', 'string', '', 'path or URL of the bag'),
    Column('folder', 'string', '', 'where the files of the drive are, in the folder of the '
           'results; empty if it failed'),
    Column('status', 'string', '', f'{CONVERGED}, {NOT_CONVERGED} or {FAILED}'),
    Column('reason', 'string', '', 'why it failed, else empty'),
    Column('level', 'string', '', 'level of the worst finding: warning, notice or good'),
    Column('finding', 'string', '', 'the worst finding of the report of the drive'),
    Column('warnings', 'int32', '', 'number of findings that are warnings'),
    Column('notices', 'int32', '', 'number of findings that are notices'),
    Column('start_ns', 'int64', 'ns', 'stamp of the first pose of the path'),
    Column('duration_s', 'double', 's', 'from the first to the last pose of the path'),
    Column('length_m', 'double', 'm', 'length of the path in the plane'),
    Column('hidden_nodes', 'int64', '', 'hidden nodes of the graph'),
    Column('edges', 'int64', '', 'constraints between hidden nodes'),
    *(Column(f'{what}{end}', 'int64', '', f'{text}{state}')
      for what, text in (('fixes', 'fixes and global poses'), ('closures', 'loop closures'))
      for end, state in (('', ' that were read'), ('_believed', ' that are believed, also weakly'),
                         ('_doubted', ' that are doubted or waiting'),
                         ('_refused', ' that are not in the graph'))),
    Column('fixes_held_out', 'int64', '', 'fixes and global poses kept out for comparison'),
    Column('chi2', 'double', '', 'twice the cost of the graph at its minimum'),
    Column('degrees_of_freedom', 'int64', '', 'measured coordinates less unknowns'),
    Column('chi2_per_degree', 'double', '', 'chi2 divided by the degrees of freedom; 1 if '
           'covariances are right'),
    Column('nees_position', 'double', '', 'mean NEES of positions to the truth; expected 2'),
    Column('nees_pose', 'double', '', 'mean NEES of poses to the truth; expected 3'),
    *_errors('truth', 'the truth'),
    Column('truth_heading_rms_deg', 'double', 'deg', 'root mean square of the error of headings '
           'to the truth'),
    *_errors('held_out', 'fixes that were held out'),
    Column('run_s', 'double', 's', 'time in the engine'),
    Column('total_s', 'double', 's', 'time of the task on its worker, with reading and writing'),
    Column('peak_memory_mb', 'double', 'MB', 'largest memory of the worker during the task'),
    Column('is_new', 'bool', '', 'whether this call has run the drive; else it was kept'),
    Column('parameters', 'string', '', 'parameters that a sweep set, as JSON; else empty'),
    Column('key', 'string', '', 'key of the result: content of the bag, settings and version'),
    Column('version', 'string', '', 'version of this package'),
)


def failed_row(reason: str) -> dict[str, Any]:
    """Return what the table says of a drive without a result."""
    return {'status': FAILED, 'reason': reason, 'folder': '', 'level': '', 'finding': '',
            'warnings': 0, 'notices': 0}


def write_table(rows: Sequence[Mapping[str, Any]], out: Path) -> None:
    """Write the Parquet file, so that nobody ever sees a part of it."""
    import pyarrow as pa  # noqa: PLC0415  (workers need none of it)
    from pyarrow import parquet  # noqa: PLC0415

    schema = pa.schema([pa.field(each.name, pa.type_for_alias(each.type), metadata={
        'unit': each.unit, 'description': each.text}) for each in COLUMNS])
    aside = out / f'.{FILE}.part'
    with parquet.ParquetWriter(aside, schema) as writer:
        for begin in range(0, max(len(rows), 1), AT_ONCE):
            writer.write_table(pa.Table.from_pylist(
                [*map(dict, rows[begin:begin + AT_ONCE])], schema))
    aside.replace(out / FILE)


def markdown(columns: Iterable[Column] = COLUMNS) -> str:
    """Return the table of the columns in docs/fleet.md."""
    return '\n'.join(['| column | type | unit | meaning |', '|---|---|---|---|', *(
        f'| `{each.name}` | {each.type} | {each.unit} | {each.text} |' for each in columns)])
