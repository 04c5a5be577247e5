# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Put the data of a report, its style and its script together to one HTML page.

Titles, ids and reasons come from files and topics, so none of them is trusted: in the page they
are JSON in which no tag can begin, and the script shows them as text only. The policy of the page
(Content-Security-Policy) allows this one script and this one style by their hashes, and nothing
from anywhere.
"""

import base64
from collections.abc import Mapping
import hashlib
import html
from importlib.resources import files
import json
import re
from typing import Any

SCRIPTS = ('base', 'marks', 'chart', 'view', 'layers', 'panel', 'map', 'sources', 'sections',
           'main')
"""Parts of the script, in order; they share one scope."""
ESCAPES = {ord(sign): f'\\u{ord(sign):04x}' for sign in '<>&'}
"""Signs that begin a tag, a comment or an entity, as JSON may spell them in texts."""


def render(data: Mapping[str, Any]) -> str:
    """
    Return the page for the data of a report as HTML.

    Raises
    ------
    ValueError
        If a number is not finite.

    """
    script = "'use strict';\n" + '\n'.join(_asset(f'{name}.js') for name in SCRIPTS)
    parts = {
        'script': f'\n{script}',
        'style': f'\n{_asset("report.css")}',
        'data': json.dumps(data, allow_nan=False, separators=(',', ':')).translate(ESCAPES),
        'title': _as_html(str(data.get('title') or 'report')),
    }
    parts['policy'] = (
        f"default-src 'none'; script-src {_hash(parts['script'])}; "
        f"style-src {_hash(parts['style'])}; img-src data:; base-uri 'none'; form-action 'none'")
    # one pass, so that what is put in is not looked at again
    return re.sub(r'{{(\w+)}}', lambda found: parts[found[1]], _asset('report.html'))


def _asset(name: str) -> str:
    return (files(__package__) / name).read_text(encoding='utf-8')


def _as_html(text: str) -> str:
    """Return a text as HTML; half a surrogate pair, which no file can hold, as a question mark."""
    return html.escape(text.encode('utf-8', 'replace').decode('utf-8'))


def _hash(text: str) -> str:
    """Return how a policy names a script or a style."""
    digest = hashlib.sha256(text.encode('utf-8')).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
