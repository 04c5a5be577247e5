# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The file that the parameters name for the graph, and the graph that a node starts with."""

from collections.abc import Mapping
from dataclasses import dataclass
import logging
from pathlib import Path
from typing import Any

from pose_graph_ros.adapters.fixes import datum_of
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.exceptions import ConfigError, FileFormatError
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.io.graph_files import graph_paths, read_datum, read_graph
from pose_graph_ros.core.io.saved_graph import datum_refusal, SavedGraph

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class InitialGraph:
    """A saved graph that was found to be whole, and to be of the site of the robot."""

    path: Path
    datum: MapOrigin | None

    def read(self, config: BackendConfig) -> PoseGraphBackend | None:
        """Return an engine that continues it; None, which is logged, if that fails after all."""
        try:
            saved, backend = restored(self.path, config)
        except Exception:
            logger.exception('%s could not be loaded: a new graph is started', self.path)
            return None
        logger.info('continuing with %d hidden nodes from %s', len(saved.nodes.ids), self.path)
        return backend


def graph_path(values: Mapping[str, Any]) -> Path:
    """Return the file that graph_file names; raises `ConfigError` if it names none."""
    name = values['graph_file']
    if name == '':
        raise ConfigError('parameter graph_file: expected the name of a file, such as '
                          "~/map.g2o, got ''")
    try:
        return Path(name).expanduser().absolute()
    except RuntimeError as error:
        raise ConfigError(f'parameter graph_file: {name!r}: {error}') from error


def initial_graph(values: Mapping[str, Any]) -> InitialGraph | None:
    """
    Return the graph that a node starts with; None if it starts with a new one.

    It does, and says so, before a graph was saved: when none of the files is there.
    Only the checksums and the datum are read, as whoever configures the node waits for it.

    Parameters
    ----------
    values : mapping, all checked parameters

    Raises
    ------
    ConfigError
        If one of the files is missing or damaged, or their datum is another one.

    """
    if not values['load_graph_on_start']:
        return None
    path, plane = graph_path(values), datum_of(values).plane
    try:
        if not path.is_dir() and not any(map(Path.exists, graph_paths(path))):
            logger.warning('there is no graph in %s yet: starting with an empty one, which '
                           '~/save_graph writes there', path)
            return None
        datum = read_datum(path)
    except (FileFormatError, OSError) as error:
        raise ConfigError(f'parameter load_graph_on_start: {error}') from error
    if datum is not None and plane is not None:
        refusal = datum_refusal(datum, plane.origin)
        if refusal is not None:
            raise ConfigError(f'parameter load_graph_on_start: {path}: {refusal}')
    return InitialGraph(path, datum)


def restored(path: Path, config: BackendConfig) -> tuple[SavedGraph, PoseGraphBackend]:
    """Return a saved graph and an engine that continues it; raises `FileFormatError`."""
    saved = read_graph(path)
    backend = PoseGraphBackend.restored(config, saved)
    backend.update()
    return saved, backend
