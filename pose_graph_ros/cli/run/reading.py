# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read run.json, and check that it is one."""

import json
from pathlib import Path
from typing import Any

from pose_graph_ros.core.exceptions import FileFormatError

VERSION = 1
FILE = 'run.json'
KEYS = {
    'title': str, 'subtitle': str, 'start_ns': str, 'axes': list, 'offset': list, 'facts': list,
    'findings': list, 'lines': dict, 'ellipses': dict, 'fixes': list, 'closures': list,
    'states': list, 'texts': list, 'error_table': list, 'sources': list, 'springs': list,
    'sparsity': list}
"""Keys of run.json that are never null, with their types."""
ENTRIES = {'facts': ('label', 'value'), 'findings': ('level', 'text'), 'sources': ('name', 'rows'),
           'springs': ('name', 'energy'), 'fixes': ('t', 'x', 'y', 'state'),
           'closures': ('t0', 't1', 'state'), 'sparsity': ('size', 'cells')}
"""What the entries of these lists have at least."""
OTHERS = ('start', 'duration', 'datum', 'errors', 'updates')


def read_document(path: Path) -> dict[str, Any]:
    """
    Return the JSON object of a run.

    Raises
    ------
    FileFormatError
        If the file is not one of this version.

    """
    def refused(text: str) -> None:
        raise FileFormatError(f'{path}: expected finite numbers, got {text}')

    try:
        data = json.loads(path.read_text(encoding='utf-8'), parse_constant=refused)
    except json.JSONDecodeError as error:
        raise FileFormatError(f'{path}:{error.lineno}: not JSON: {error.msg}') from error
    except (UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(f'{path}: not JSON') from error
    if not isinstance(data, dict) or 'version' not in data:
        raise FileFormatError(f'{path}: not the {FILE} of a replay or a demo')
    if data['version'] != VERSION:
        raise FileFormatError(f'{path}: expected version {VERSION}, got {data["version"]}: '
                              'replay the bag again')
    for key, kind in KEYS.items():
        if not isinstance(data.get(key), kind):
            raise FileFormatError(f'{path}: {key}: expected {kind.__name__}, got '
                                  f'{type(data.get(key)).__name__}')
    for key, names in ENTRIES.items():
        for at, entry in enumerate(data[key]):
            missing = [name for name in names if not isinstance(entry, dict) or name not in entry]
            if len(missing) > 0:
                raise FileFormatError(f'{path}: {key}[{at}]: no {missing[0]}')
    for key in OTHERS:
        if key not in data:
            raise FileFormatError(f'{path}: no {key}')
    return data
