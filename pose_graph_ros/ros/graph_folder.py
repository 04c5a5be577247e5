# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The folder that files of graphs are written to and read from, and which file there is meant.

Anybody on the network can name a file, so no name and no link leads out of the folder.
"""

from collections.abc import Mapping
import os
from pathlib import Path
from typing import Any

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.io.graph_files import graph_paths
from pose_graph_ros.core.judgement.texts import shortened

MOST_BYTES = 4000  # of a name with its folders: Linux takes 4095 of a path


def graph_path(values: Mapping[str, Any]) -> Path:
    """Return the file that graph_file names below file_folder; raises `ConfigError` for none."""
    name, folder = values['graph_file'], Path(values['file_folder'])
    expected = f'expected the name of a file below {folder}, the file_folder, such as map.g2o'
    try:
        # before anything that takes longer with each part of it
        is_short = '\0' not in name and len(os.fsencode(name)) <= MOST_BYTES
        path = folder / Path(name if is_short else '').expanduser()
        files = graph_paths(path)
        if not is_short or any(len(os.fsencode(each)) > 255 for each in files[1].parts):
            expected = f'expected names of at most 255 bytes without NUL, {MOST_BYTES} in all'
        # a link may lead anywhere
        elif name != '' and all(each.resolve().is_relative_to(folder) for each in files):
            return path.parent.resolve() / path.name
    except (OSError, RuntimeError, ValueError) as error:
        expected += f' ({shortened(str(error))})'
    raise ConfigError(f'parameter graph_file: {expected}, got {shortened(name)!r}')


def with_folder(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters of the start, with the folder that `graph_path` stays in as a path."""
    name, folder = values.get('graph_file', ''), values.get('file_folder', '')
    try:
        if folder == '' and name != '':     # relative to where the node is started, this once
            path = Path(name).expanduser().absolute()
            name, folder = str(path), path.parent
        return {**values, 'graph_file': name, 'file_folder': str(
            Path(folder).expanduser().resolve())}
    except (OSError, RuntimeError, ValueError) as error:
        raise ConfigError(f'parameter graph_file or file_folder: {error}, got '
                          f'{shortened(name)!r}') from error
