# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Make one HTML page of a run: map, errors, residuals by source, what is doubted and why.

So it does of a graph that it solves, and of what differs between two runs.

How such a page is put together is in `html_page.py`; the end of `page/sections.js` lists its
sections.
"""

import argparse
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
import io
import json
from pathlib import Path
from typing import Any
import webbrowser

from pose_graph_ros.adapters import bags
from pose_graph_ros.cli import arguments, html_page, replay
from pose_graph_ros.cli.graph_input import GRAPH_SUFFIXES
from pose_graph_ros.cli.run.comparison import compared
from pose_graph_ros.cli.run.document import FILE, read_document
from pose_graph_ros.core.exceptions import ConfigError, FileFormatError

SUMMARY = ('title', 'subtitle', 'start', 'duration', 'facts', 'findings', 'error_table', 'sources',
           'springs', 'figures')  # keys of run.json that --json prints
OF_REPLAY = ('begin', 'until', 'params_file', 'truth', 'align', *bags.OPTIONS,
             'param', 'hold_out', 'stretch')  # of bags alone
PAGES = ('.html', '.htm')
BAG_SUFFIXES = (*bags.BAG_FILE_SUFFIXES, '.g2o', '.graph')
SCRIPTS = ('base', 'chart', 'paint', 'map', 'sections')
LIBRARIES = ('uPlot', 'leaflet')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.out is not None and options.out.suffix not in PAGES:
        raise ConfigError(f'--out {options.out}: the name must end in {" or ".join(PAGES)}')
    if (options.folder / 'metadata.yaml').is_file():
        raise bags.BagError(f'--run {options.folder}: this is a bag; name another folder')
    code, files = 0, [_file(path) for path in options.runs]
    n_runs = sum(file is not None for file in files)
    if n_runs not in (0, len(files)) or n_runs > 2:
        raise FileFormatError('expected one run, two runs to compare, or bags')
    _refuse_options(options, files)
    if len(files) == 2 and files[0] is not None and files[1] is not None:
        data, folder = compared((files[0], files[1])), options.folder
    else:
        file = files[0]
        if file is None:
            file, code = options.folder / FILE, _run(options)
        data, folder = read_document(file), file.parent
    page = options.out or folder / 'report.html'
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(render(data), encoding='utf-8')
    print(json.dumps(_summary(data) | {'page': str(page), 'bytes': page.stat().st_size}, indent=2)
          if options.json else '\n'.join([
              *(f'{each["level"]:8} {each["text"]}' for each in data['findings']),
              f'written: {page} ({1e-6 * page.stat().st_size:.1f} MB)']))
    if options.open:
        webbrowser.open(page.resolve().as_uri())
    return code


def _summary(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of a page without its large tables."""
    return {key: data[key] for key in SUMMARY if key in data} | {'sources': [
        {key: value for key, value in source.items() if key not in ('series', 'histogram')}
        for source in data['sources']]}


def _run(options: argparse.Namespace) -> int:
    """Replay bags, or solve a graph, into the folder of `--run`; return the exit code."""
    if options.runs[0].suffix not in GRAPH_SUFFIXES:
        words = argparse.Namespace(**vars(options) | {
            'bags': options.runs, 'out': options.folder, 'json': False,
            'export': arguments.Exports(), 'new_bag': None, 'live': False})
        with redirect_stdout(io.StringIO()):
            return replay.execute(words)
    # what solves graphs is not needed for others
    from pose_graph_ros.cli.run.graph_document import solved_document  # noqa: PLC0415

    if len(options.runs) > 1:
        raise FileFormatError(f'{options.runs[0]}: expected one graph alone')
    data = solved_document(options.runs[0], options.edge2, options.robust)
    options.folder.mkdir(parents=True, exist_ok=True)
    (options.folder / FILE).write_text(json.dumps(
        data, allow_nan=False, separators=(',', ':'), ensure_ascii=False) + '\n', encoding='utf-8')
    return 0 if any(each['value'] == 'converged' for each in data['facts']) else 1


def _file(path: Path) -> Path | None:
    """Return the run.json of what is asked for; None if it is to be replayed or solved."""
    file = path / FILE if (path / FILE).is_file() else path
    if file.suffix == '.json':
        return file
    # a recording that was cut off has no metadata.yaml
    if path.is_dir() and not any(each.suffix in ('.yaml', '.zstd', *bags.BAG_FILE_SUFFIXES)
                                 for each in path.iterdir()):
        raise FileFormatError(f'{path}: expected the folder of a replay or a demo with '
                              f'{FILE}, or a rosbag2')
    if path.is_file() and path.suffix not in BAG_SUFFIXES:
        raise FileFormatError(f'{path}: expected {FILE}, or a file with the suffix '
                              f'{", ".join(BAG_SUFFIXES)}')
    return None


def _refuse_options(options: argparse.Namespace, files: Sequence[Path | None]) -> None:
    """Raise `ConfigError` for an option of bags with a run or a graph, and so on."""
    first, is_run = options.runs[0], files[0] is not None
    is_graph = first.suffix in GRAPH_SUFFIXES and not is_run
    names = (*(() if is_graph else ('robust',)), *(OF_REPLAY if is_graph or is_run else ()),
             *(('edge2',) if is_run else ()))
    if len(given := [name for name in names if (
            value := getattr(options, name)) or value is False]) > 0:
        option = {'begin': 'from'}.get(given[0], given[0]).replace('_', '-')
        raise ConfigError(f'--{option}: ' + (
            f'{first} has been run already; the option is for a bag' if is_run else
            'the option is for a graph' if given[0] == 'robust' else
            f'{first} is solved as it is; replay it first to use the option'))


def render(data: Mapping[str, Any]) -> str:
    """Return the page for the data of a report as HTML; ValueError if a number is not finite."""
    return html_page.page(data, f'{data.get("title") or "report"} - pose-graph report', SCRIPTS,
                          LIBRARIES)
