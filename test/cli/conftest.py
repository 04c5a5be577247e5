# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The browser of the tests of pages."""

from collections.abc import Iterator
import os
from typing import Any

from browser_pages import executable, missing
import pytest


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
    try:
        from playwright.sync_api import sync_playwright  # noqa: PLC0415
    except ImportError:
        missing('no playwright: pip install playwright')
    with sync_playwright() as tool:
        options = ['--no-sandbox'] if os.geteuid() == 0 else []
        chromium = tool.chromium.launch(executable_path=executable(), args=options)
        yield chromium
        chromium.close()
