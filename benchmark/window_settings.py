# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Windows by the names that the tables have."""

from typing import Any

from pose_graph_ros.core.config import ThinningConfig, WindowConfig, WindowPrior

UNITS = {'s': 'seconds', 'm': 'metres', 'nodes': 'nodes'}
UNLIMITED = 'unlimited'


def settings_of(window: str) -> dict[str, Any]:
    """
    Return the arguments of `BackendConfig` for a window.

    Names are `unlimited`, `90 s`, `90 s sparse`, `500 nodes`, and `thinning 2 m` for cells of that
    size.
    """
    if window == UNLIMITED:
        return {}
    size, unit, *rest = window.removeprefix('thinning ').split()
    if window.startswith('thinning'):
        return {'thinning': ThinningConfig(cell=float(size))}
    return {'window': WindowConfig(
        **{UNITS[unit]: int(size)}, prior=(
            WindowPrior.SPARSE if rest == ['sparse'] else WindowPrior.DENSE))}
