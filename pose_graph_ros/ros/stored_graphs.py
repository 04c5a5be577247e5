# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The graph that a node starts with: from its journal, or from a file. It imports no ROS."""

from collections.abc import Mapping
import logging
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
from pose_graph_ros.core.recovery import Over, recovered
from pose_graph_ros.ros.graph_folder import graph_path

logger = logging.getLogger(__name__)


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
