# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Put one HTML page together: its data, style and scripts are in it, and it asks no network.

In `page/`, `page.html` is what all pages begin as, `base.js` what their scripts share, and
`page.css` has the colours; `vendor/` has uPlot and Leaflet as they are published, with their
licences.

Titles, ids and reasons come from files and topics, so none of them is trusted: in the page they
are JSON in which no tag can begin, and the script shows them as text only. The policy of the page
(Content-Security-Policy) allows these scripts and this style by their hashes, and nothing from
anywhere.
"""

import base64
from collections.abc import Mapping, Sequence
import hashlib
import html
from importlib.resources import files
import json
import re
from typing import Any

from pose_graph_ros.core.quantities import Metres, Seconds

LIBRARIES = {'uPlot': ('uPlot.iife.min.js', 'uPlot.min.css'),
             'leaflet': ('leaflet.js', 'leaflet.css')}
"""Script and style of the libraries of others in vendor/, with their licences beside them."""
# Paper has more pixels than most screens; the libraries ask once, as they are loaded.
SHARP = ("Object.defineProperty(window, 'devicePixelRatio', "
         '{value: Math.max(2, devicePixelRatio), configurable: true});')
ESCAPES = {ord(sign): f'\\u{ord(sign):04x}' for sign in '<>&'}
"""Signs that begin a tag, a comment or an entity, as JSON may spell them in texts."""


def page(data: Mapping[str, Any], title: str, scripts: Sequence[str],
         libraries: Sequence[str] = ()) -> str:
    """
    Return the HTML that the scripts make of data; ValueError if a number is not finite.

    Scripts are parts of one, in their order, and share one scope.
    """
    parts = {
        'library': '\n'.join((SHARP, *(_vendored(name, 0) for name in libraries))),
        'script': '\n'.join(("\n'use strict';", *(_asset(f'{name}.js') for name in scripts))),
        'style': '\n'.join((*(_vendored(name, 1) for name in libraries), _asset('page.css'))),
        'data': json.dumps(data, allow_nan=False, separators=(',', ':')).translate(ESCAPES),
        # half a surrogate pair, which no file can hold, becomes a question mark
        'title': html.escape(title.encode('utf-8', 'replace').decode('utf-8')),
    }
    parts['policy'] = (
        f"default-src 'none'; script-src {_hash(parts['library'])} {_hash(parts['script'])}; "
        f"style-src {_hash(parts['style'])}; img-src data:; base-uri 'none'; form-action 'none'")
    # one pass, so that what is put in is not looked at again
    return re.sub(r'{{(\w+)}}', lambda found: parts[found[1]], _asset('page.html'))


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


def duration_text(duration: Seconds) -> str:
    """Return a duration for people."""
    minutes, seconds = divmod(round(duration), 60)
    return f'{duration:.1f} s' if duration < 120.0 else f'{minutes} min {seconds:02d} s' if (
        minutes < 60) else f'{minutes // 60} h {minutes % 60:02d} min'


def length_text(length: Metres) -> str:
    """Return a length for people."""
    return f'{length:.1f} m' if length < 1000.0 else f'{1e-3 * length:.2f} km'
