# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The graph that a node starts with, from its journal or from a file; it imports no ROS.

Files of graphs are in one folder. Anybody on the network can name a file, so no name and no link
leads out of it.
"""

from collections.abc import Mapping
import logging
import os
from pathlib import Path
from typing import Any

from pose_graph_ros.adapters.conversions import Datum, datum_of
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.exceptions import ConfigError, FileFormatError
from pose_graph_ros.core.geometry import geodesy
from pose_graph_ros.core.io import graph_files
from pose_graph_ros.core.io.graph_files import datum_refusal, SavedGraph, site_refusal
from pose_graph_ros.core.io.journal import Journal
from pose_graph_ros.core.judgement.texts import shortened
from pose_graph_ros.core.recovery import Over, recovered

logger = logging.getLogger(__name__)

MOST_BYTES = 4000  # of a name with its folders: Linux takes 4095 of a path


def journal_of(values: Mapping[str, Any]) -> Journal | None:
    """Return the journal in the file that state_file names; None if it names none."""
    if values['state_file'] == '':
        return None
    try:
        path = Path(values['state_file']).expanduser().absolute()
    except RuntimeError as error:
        raise ConfigError(f'parameter state_file: {error}') from error
    plane = datum_of(values).plane
    return Journal(path, values['state_period'], lambda saved: (
        None if plane is None else site_refusal(saved, plane.origin, None)))


def from_journal(journal: Journal, config: BackendConfig, datum: Datum,
                 over: Over) -> PoseGraphBackend | None:
    """Return an engine that continues what a journal holds, with its datum; None if nothing."""
    found = journal.take()
    state, n = found.state, sum(entry.act == 0 for entry in found.entries)
    if found.last == (0, 0):
        logger.info('the journal is empty: starting with an empty graph')
        return None
    try:
        if state is not None and state.saved.datum is not None:
            datum.keep(state.saved.datum)
        backend = recovered(config, found, datum.place, over)
    except Exception as error:
        logger.exception('nothing can be made of the journal: starting with an empty graph')
        journal.set_aside(f'nothing can be made of it: {error}')
        return None
    logger.info('continuing with %d hidden nodes from the journal: %d of its checkpoint, and %d '
                'measurements after it%s', len(backend.node_stamps_ns),
                0 if state is None else len(state.saved.nodes.ids), n,
                '' if found.trouble == '' else ', as far as they could be read')
    return backend


def initial_graph(values: Mapping[str, Any]) -> tuple[Path | None, geodesy.MapOrigin | None]:
    """
    Return file and datum of the graph that a node starts with; None before one was saved.

    Only the checksums and the datum are read, as whoever configures the node waits for it.
    """
    if not values['load_graph_on_start']:
        return None, None
    path, plane = graph_path(values), datum_of(values).plane
    try:
        if not path.is_dir() and not any(map(Path.exists, graph_files.graph_paths(path))):
            logger.warning('there is no graph in %s yet: starting with an empty one, which '
                           '~/save_graph writes there', path)
            return None, None
        datum = graph_files.read_datum(path, Path(values['file_folder']))
    except (FileFormatError, OSError) as error:
        raise ConfigError(f'parameter load_graph_on_start: {error}') from error
    if datum is not None and plane is not None and (
            refusal := datum_refusal(datum, plane.origin)) is not None:
        raise ConfigError(f'parameter load_graph_on_start: {path}: {refusal}')
    return path, datum


def continued(path: Path, folder: str, config: BackendConfig) -> PoseGraphBackend | None:
    """Return an engine that continues a saved graph; None, which is logged, if that fails."""
    try:
        saved, backend = restored(path, folder, config)
    except Exception:
        logger.exception('%s could not be loaded: a new graph is started', path)
        return None
    logger.info('continuing with %d hidden nodes from %s', len(saved.nodes.ids), path)
    return backend


def restored(
    path: Path, folder: str, config: BackendConfig,
) -> tuple[SavedGraph, PoseGraphBackend]:
    """Return a saved graph in a folder and an engine for it; raises `FileFormatError`."""
    saved = graph_files.read_graph(path, Path(folder))
    backend = PoseGraphBackend.restored(config, saved)
    backend.update()
    return saved, backend


# --- the folder of the files

def graph_path(values: Mapping[str, Any]) -> Path:
    """Return the file that graph_file names below file_folder; raises `ConfigError` for none."""
    name, folder = values['graph_file'], Path(values['file_folder'])
    expected = f'expected the name of a file below {folder}, the file_folder, such as map.g2o'
    try:
        # before anything that takes longer with each part of it
        is_short = '\0' not in name and len(os.fsencode(name)) <= MOST_BYTES
        path = folder / Path(name if is_short else '').expanduser()
        files = graph_files.graph_paths(path)
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
