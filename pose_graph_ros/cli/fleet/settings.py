# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is done with a bag, and under which key its result is kept.

The settings of a run are a file in the folder of the results, which all workers can read, so that
a task is a few names. A result is kept by the content of the bag, the settings, and the version of
this package with its code, so none is taken for that of another bag or of older code.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
import functools
import hashlib
import json
from pathlib import Path
from typing import Any

import pose_graph_ros
from pose_graph_ros.adapters.bags import OPTIONS
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.cli import finite
from pose_graph_ros.cli.arguments import Exports
from pose_graph_ros.cli.fleet.recordings import without_suffix
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.io.atomic_files import write_files

FOLDER = 'settings'
OF_BAGS = ('begin', 'until', 'edge2', 'hold_out', 'stretch', 'align', 'truth', *OPTIONS)
"""Options of `pose-graph replay` that are the same for all bags."""
BESIDE = '{}'  # at the begin of the path of a truth: the path of the bag without its suffix


@functools.cache
def code_digest() -> str:
    """Return a digest of the Python code of this package."""
    digest, root = hashlib.sha256(), Path(pose_graph_ros.__file__).parent
    for path in sorted(root.rglob('*.py')):
        digest.update(f'{path.relative_to(root)}\0'.encode() + path.read_bytes() + b'\0')
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class Settings:
    """What is done with each bag."""

    given: Mapping[str, Any]  # parameters that are set
    options: Mapping[str, Any]  # `OF_BAGS`
    version: str = pose_graph_ros.__version__
    code: str = field(default_factory=code_digest)

    @functools.cached_property
    def id(self) -> str:
        """The same for the same results."""
        values = checked(self.given)
        return hashlib.sha256(json.dumps(
            [finite(values), *_plain(self.options), self.version, self.code],
            sort_keys=True, default=str).encode()).hexdigest()[:16]

    def write(self, out: Path) -> None:
        """Write the file that workers read."""
        write_files({out / FOLDER / f'{self.id}.json': json.dumps(
            asdict(self) | {'options': dict(_plain(self.options))}, indent=1).encode()})

    def replay_options(self, bag: Path, truth: Path | str | None) -> argparse.Namespace:
        """Return the options with which `replay` runs a bag."""
        return argparse.Namespace(**{
            **self.options, 'truth': truth, 'bags': [bag], 'export': Exports(), 'new_bag': None,
            'live': False})

    def truth_of(self, bag: str) -> Path | str | None:
        """Return the topic or the file of the truth of a bag, if there is one."""
        truth = self.options['truth']
        if isinstance(truth, Path):
            return Path(str(truth).replace(BESIDE, without_suffix(bag)))
        return truth if truth is None else str(truth)


def _plain(options: Mapping[str, Any]) -> Sequence[tuple[str, Any]]:
    return [(name, {'file': str(value)} if isinstance(value, Path) else value)
            for name, value in options.items()]


@functools.lru_cache(maxsize=64)
def read_settings(out: Path, id: str) -> Settings:
    """Return the settings of a run; raises `ConfigError` if they are not those of this code."""
    path = out / FOLDER / f'{id}.json'
    try:
        data = json.loads(path.read_text(encoding='utf-8'))
    except FileNotFoundError as error:
        raise ConfigError(f'{path}: not found by this worker; the folder of the results must be '
                          'one that all workers share, under the same path') from error
    data['options'] = {name: Path(value['file']) if isinstance(value, dict) else value
                       for name, value in data['options'].items()}
    settings = Settings(**data)
    if (settings.version, settings.code) != (pose_graph_ros.__version__, code_digest()):
        raise ConfigError(f'this worker has another pose_graph_ros ({pose_graph_ros.__version__}, '
                          f'code {code_digest()}) than the caller ({settings.version}, code '
                          f'{settings.code})')
    return settings
