# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pages of HTML that are opened in a real browser, and whether they had troubles."""

from dataclasses import dataclass, field
import os
import shutil
import subprocess
from typing import Any

import pytest

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
WIDE, NARROW = 1400, 400


@dataclass
class Opened:
    """A page, and what went wrong or left the machine while it was open."""

    page: Any
    troubles: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def until(self, expression: str) -> None:
        """Wait until an expression is true; what playwright has for this needs eval()."""
        for _ in range(200):
            if self.page.evaluate(expression):
                return
            self.page.wait_for_timeout(20)
        pytest.fail(f'never: {expression}')

    def settle(self) -> None:
        """Wait until what was asked for has been painted."""
        self.page.evaluate('new Promise((done) => requestAnimationFrame('
                           '() => requestAnimationFrame(done)))')

    def overflow(self) -> int:
        return int(self.page.evaluate('document.scrollingElement.scrollWidth - innerWidth'))


def executable() -> str:
    # (Ubuntu's chromium-browser only says that there is a snap)
    found = next((path for path in filter(None, map(shutil.which, BROWSERS)) if subprocess.run(
        [path, '--version'], capture_output=True, check=False).returncode == 0), None)
    if found is None:
        missing('no browser; do: apt install chromium (on Ubuntu, google-chrome from its maker)')
    return str(found)


def missing(reason: str) -> None:
    """Skip, or fail where continuous integration should have installed it."""
    if os.environ.get('CI'):
        pytest.fail(reason)
    pytest.skip(reason)


class Opener:
    """Opens pages, and looks at the end whether they had troubles."""

    def __init__(self, browser: Any, kind: type[Opened] = Opened) -> None:
        self.browser, self.kind = browser, kind
        self.opened: list[Opened] = []

    def __call__(self, address: str, width: int = WIDE, **options: Any) -> Opened:
        touch = {'has_touch': True, 'is_mobile': True} if width == NARROW else {}
        context = self.browser.new_context(
            viewport={'width': width, 'height': 900}, reduced_motion='reduce', **touch, **options)
        opened = self.kind(context.new_page())
        opened.page.set_default_timeout(10_000)
        opened.page.on('pageerror', lambda error: opened.troubles.append(str(error)))
        opened.page.on('console', lambda message: opened.troubles.append(message.text))
        opened.page.on('request', lambda request: opened.requests.append(request.url))
        opened.page.goto(address)
        opened.settle()
        self.opened.append(opened)
        return opened

    def close(self) -> None:
        for opened in self.opened:
            opened.page.context.close()
            assert opened.troubles == []
            assert [url for url in opened.requests if not url.startswith(('file:', 'data:'))] == []
            assert len(opened.requests) <= 2        # itself, and its icon, which is empty
