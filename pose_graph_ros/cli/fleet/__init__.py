# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Replay many bags on Dask, with one table and one overview, and nothing done twice.

Paths of bags come in (`recordings`), with what is done to each (`settings`). Workers of a
`cluster` do one task for each bag, whose files are `kept` under a key of all that they depend on.
Rows come back for the `table`, the `overview` and the scores of a `sweep`. Read first `call`, then
`worker`. Dask, pyarrow and fsspec are imported here alone.
"""

import argparse
from importlib.util import find_spec

from pose_graph_ros.core.exceptions import ConfigError

NEEDED = ('dask', 'distributed', 'fsspec', 'pyarrow')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if len(missing) > 0:
        raise ConfigError(f'pose-graph fleet needs {", ".join(missing)}: '
                          "pip install 'dask[distributed]' pyarrow bokeh")
    from pose_graph_ros.cli.fleet.call import run  # noqa: PLC0415  (needs these)

    return run(options)
