# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Make one HTML page of a run: map, errors, residuals by source, what is doubted and why.

The data of the run, style and script are in it, and it asks no network for anything. In `page/`,
the end of `sections.js` lists the sections, colours are in `report.css`, and `vendor/` has uPlot
and Leaflet as they are published, with their licences.

Titles, ids and reasons come from files and topics, so none of them is trusted: in the page they
are JSON in which no tag can begin, and the script shows them as text only. The policy of the page
(Content-Security-Policy) allows these scripts and this style by their hashes, and nothing from
anywhere.
"""

import argparse
import base64
from collections.abc import Mapping
from contextlib import redirect_stdout
import hashlib
import html
from importlib.resources import files
import io
import json
from pathlib import Path
import re
from typing import Any
import webbrowser

from pose_graph_ros.adapters import bags
from pose_graph_ros.cli import arguments, replay
from pose_graph_ros.cli.run.document import FILE, read_document
from pose_graph_ros.core.exceptions import ConfigError, FileFormatError

SUMMARY = ('title', 'subtitle', 'start', 'duration', 'facts', 'findings', 'error_table', 'sources',
           'springs')  # keys of run.json that --json prints
OF_REPLAY = ('begin', 'until', 'edge2', 'params_file', 'truth', 'align', *bags.OPTIONS,
             'param', 'hold_out', 'stretch')  # of bags alone
PAGES = ('.html', '.htm')
BAG_SUFFIXES = (*bags.BAG_FILE_SUFFIXES, '.g2o', '.graph')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.out is not None and options.out.suffix not in PAGES:
        raise ConfigError(f'--out {options.out}: the name must end in {" or ".join(PAGES)}')
    code, file = 0, _file(options)
    if file is None:
        if (options.folder / 'metadata.yaml').is_file():
            raise bags.BagError(f'--run {options.folder}: this is a bag; name another folder')
        file, words = options.folder / FILE, argparse.Namespace(
            **vars(options) | {'bags': options.runs, 'out': options.folder, 'json': False,
                               'export': arguments.Exports(), 'new_bag': None, 'live': False})
        with redirect_stdout(io.StringIO()):
            code = replay.execute(words)
    data = read_document(file)
    page = options.out or file.parent / 'report.html'
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(render(data), encoding='utf-8')
    # without its large tables
    print(json.dumps({key: data[key] for key in SUMMARY} | {'sources': [
        {key: value for key, value in source.items() if key not in ('series', 'histogram')}
        for source in data['sources']], 'page': str(page), 'bytes': page.stat().st_size}, indent=2)
        if options.json else '\n'.join([
            *(f'{each["level"]:8} {each["text"]}' for each in data['findings']),
            f'written: {page} ({1e-6 * page.stat().st_size:.1f} MB)']))
    if options.open:
        webbrowser.open(page.resolve().as_uri())
    return code


def _file(options: argparse.Namespace) -> Path | None:
    """Return the run.json that is asked for; None if something is to be replayed."""
    first: Path = options.runs[0]
    for path in options.runs if len(options.runs) > 1 else ():
        if (path / FILE).is_file() or path.suffix == '.json':
            raise FileFormatError(f'{path}: expected one run, or several bags')
    file = first / FILE if (first / FILE).is_file() else first
    if file.suffix != '.json':
        if first.is_dir() and not (first / 'metadata.yaml').is_file():
            raise FileFormatError(f'{first}: expected the folder of a replay or a demo with '
                                  f'{FILE}, or a rosbag2 with metadata.yaml')
        if first.is_file() and first.suffix not in BAG_SUFFIXES:
            raise FileFormatError(f'{first}: expected {FILE}, or a file with the suffix '
                                  f'{", ".join(BAG_SUFFIXES)}')
        return None
    if len(given := [name for name in OF_REPLAY if (
            value := getattr(options, name)) or value is False]) > 0:
        option = {'begin': 'from'}.get(given[0], given[0]).replace('_', '-')
        raise ConfigError(f'--{option}: {first} has been run already; the option is for a bag')
    return file


SCRIPTS = ('base', 'chart', 'paint', 'map', 'sections')
"""Parts of the script, in order; they share one scope."""
LIBRARIES = {'uPlot': ('uPlot.iife.min.js', 'uPlot.min.css'),
             'leaflet': ('leaflet.js', 'leaflet.css')}
"""Script and style of the libraries of others in vendor/, with their licences beside them."""
# Paper has more pixels than most screens; the libraries ask once, as they are loaded.
SHARP = ("Object.defineProperty(window, 'devicePixelRatio', "
         '{value: Math.max(2, devicePixelRatio), configurable: true});')
ESCAPES = {ord(sign): f'\\u{ord(sign):04x}' for sign in '<>&'}
"""Signs that begin a tag, a comment or an entity, as JSON may spell them in texts."""


def render(data: Mapping[str, Any]) -> str:
    """Return the page for the data of a report as HTML; ValueError if a number is not finite."""
    parts = {
        'library': '\n'.join((SHARP, *(_vendored(name, 0) for name in LIBRARIES))),
        'script': '\n'.join(("\n'use strict';", *(_asset(f'{name}.js') for name in SCRIPTS))),
        'style': '\n'.join((*(_vendored(name, 1) for name in LIBRARIES), _asset('report.css'))),
        'data': json.dumps(data, allow_nan=False, separators=(',', ':')).translate(ESCAPES),
        # half a surrogate pair, which no file can hold, becomes a question mark
        'title': html.escape(str(data.get('title') or 'report').encode(
            'utf-8', 'replace').decode('utf-8')),
    }
    parts['policy'] = (
        f"default-src 'none'; script-src {_hash(parts['library'])} {_hash(parts['script'])}; "
        f"style-src {_hash(parts['style'])}; img-src data:; base-uri 'none'; form-action 'none'")
    # one pass, so that what is put in is not looked at again
    return re.sub(r'{{(\w+)}}', lambda found: parts[found[1]], _asset('report.html'))


def _asset(name: str) -> str:
    return (files(__package__) / 'page' / name).read_text(encoding='utf-8')


def _vendored(library: str, which: int) -> str:
    """Return the script (0) or the style (1) of a library after its licence."""
    text = _asset(f'vendor/{LIBRARIES[library][which]}')
    # of the map of its source only the developer's tools of a browser would ask
    text = text.partition('//# sourceMappingURL')[0]
    return text if which == 1 else f'/*\n{_asset(f"vendor/LICENSE.{library}")}*/\n{text}'


def _hash(text: str) -> str:
    """Return how a policy names a script or a style."""
    digest = hashlib.sha256(text.encode('utf-8')).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
