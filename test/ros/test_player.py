# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the player of bags says."""

import pytest

from pose_graph_ros.ros.player import Progress


@pytest.mark.parametrize('total', [10, 37, 12345])
def test_progress_in_a_log_is_a_line_every_ten_percent(
    total: int, capsys: pytest.CaptureFixture[str],
) -> None:
    progress = Progress(total)
    for done in range(1, total + 1):
        progress.show(done)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[-1] == f'  played {total} of {total} messages (100 %)'
