# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The order of the test files: those that wait for other processes are spread over the others."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """
    Let two files follow each one that waits for other processes.

    So the processors have something to do meanwhile, and none of those that wait is the last. They
    run from the last name to the first, as those of the first names are short: all workers end
    at about the same time.
    """
    waiting, others = ({path: None for path in (item.path for item in reversed(items))
                        if (path.parent.name in ('ros', 'test')) is waits}
                       for waits in (True, False))
    turns = {path: 2 * turn for turn, path in enumerate(waiting)}
    turns |= {path: turn | 1 for turn, path in enumerate(others)}
    items.sort(key=lambda item: turns[item.path])
