# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the public recordings and graphs are that some tests and golden drives use.

They are not part of the project. POSE_GRAPH_DATA names their folder, which has the folders
`robot`, `graphs` and `false_loops`; else it is looked for in shared/data beside the project's.
"""

import os
from pathlib import Path

import pytest

PUBLIC = Path(os.environ.get('POSE_GRAPH_DATA') or (
    Path(__file__).resolve().parents[3] / 'shared' / 'data'))


def missing(*names: str) -> str:
    """Return which of these files or folders are not there, and what to do; '' if none is."""
    absent = [name for name in names if not (PUBLIC / name).exists()]
    return '' if len(absent) == 0 else (
        f'no {", ".join(absent)} in {PUBLIC}: POSE_GRAPH_DATA names the folder of public data')


def needs(*names: str) -> pytest.MarkDecorator:
    """Return what skips a test where one of these files or folders is not there."""
    return pytest.mark.skipif(missing(*names) != '', reason=missing(*names))
