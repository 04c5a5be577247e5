# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make one HTML page of a run: map, errors, residuals by source, what is doubted and why."""

import argparse
from contextlib import redirect_stdout
import io
import json
from pathlib import Path
from typing import Any
import webbrowser

from pose_graph_ros.adapters.bags import BagError
from pose_graph_ros.cli import options as shared, replay
from pose_graph_ros.cli.arguments import Exports
from pose_graph_ros.cli.page.render import render
from pose_graph_ros.cli.run.document import FILE, read_document
from pose_graph_ros.core.exceptions import ConfigError, FileFormatError

SUMMARY = ('title', 'subtitle', 'start', 'duration', 'facts', 'findings', 'error_table', 'sources',
           'springs')
"""Keys of run.json that --json prints; sources without their series and histograms."""
OF_SOURCES = ('series', 'histogram')
OF_REPLAY = ('begin', 'until', 'stamps', 'edge2', 'params_file', 'truth')
"""Options that are of use for a bag or a g2o file alone, with inputs and parameters."""
PAGES = ('.html', '.htm')
BAG_SUFFIXES = ('.mcap', '.db3', '.bag', '.g2o', '.graph')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.out is not None and options.out.suffix not in PAGES:
        raise ConfigError(f'--out {options.out}: the name must end in {" or ".join(PAGES)}')
    code, file = 0, _file(options)
    if file is None:
        code, file = _replay(options), options.folder / FILE
    data = read_document(file)
    page = options.out or file.parent / 'report.html'
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(render(data), encoding='utf-8')
    if options.json:
        print(json.dumps(summary(data) | {'page': str(page), 'bytes': page.stat().st_size},
                         indent=2))
    else:
        for each in data['findings']:
            print(f'{each["level"]:8} {each["text"]}')
        print(f'written: {page} ({1e-6 * page.stat().st_size:.1f} MB)')
    if options.open:
        webbrowser.open(page.resolve().as_uri())
    return code


def summary(data: dict[str, Any]) -> dict[str, Any]:
    """Return run.json without its large tables."""
    found = {key: data[key] for key in SUMMARY}
    found['sources'] = [{key: value for key, value in source.items() if key not in OF_SOURCES}
                        for source in data['sources']]
    return found


def _file(options: argparse.Namespace) -> Path | None:
    """Return the run.json that is asked for; None if something is to be replayed."""
    first: Path = options.runs[0]
    for path in options.runs if len(options.runs) > 1 else ():
        if (path / FILE).is_file() or path.suffix == '.json':
            raise FileFormatError(f'{path}: expected one run, or several bags')
    if first.is_dir() and (first / FILE).is_file():
        file = first / FILE
    elif first.suffix == '.json':
        file = first
    elif first.is_dir() and (first / 'summary.json').is_file():
        raise FileFormatError(f'{first}: no {FILE}, so it was made by an earlier version: '
                              'replay the bag again')
    elif first.is_dir() and not (first / 'metadata.yaml').is_file():
        raise FileFormatError(f'{first}: expected the folder of a replay or a demo with {FILE}, '
                              'or a rosbag2 with metadata.yaml')
    elif first.is_file() and first.suffix not in BAG_SUFFIXES:
        raise FileFormatError(f'{first}: expected {FILE}, or a file with the suffix '
                              f'{", ".join(BAG_SUFFIXES)}')
    else:
        return None
    given = [name for name in OF_REPLAY if getattr(options, name) is not None]
    given += [name for name, topic in shared.wanted_topics(options).items() if topic is not None]
    given += ['param'] if options.param else []
    given += ['hold_out'] if options.hold_out else []
    if len(given) > 0:
        option = {'begin': 'from'}.get(given[0], given[0]).replace('_', '-')
        raise ConfigError(f'--{option}: {first} has been run already; the option is for a bag')
    return file


def _replay(options: argparse.Namespace) -> int:
    """Replay bags or a g2o file into the folder of the run; return the exit code."""
    if (options.folder / 'metadata.yaml').is_file():
        raise BagError(f'--run {options.folder}: this is a bag; name another folder')
    words = argparse.Namespace(**vars(options))
    words.bags, words.out, words.json = options.runs, options.folder, False
    words.export, words.new_bag, words.live = Exports(), None, False
    with redirect_stdout(io.StringIO()):
        return replay.execute(words)
