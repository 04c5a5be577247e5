# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps seen so far, compared with plain sets."""


from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.measurements import (
    HeadingOnly,
    LoopClosure,
    Measurement,
)
from pose_graph_ros.core.sources.pipeline import SeenStamps


def heading(stamp: int) -> HeadingOnly:
    return HeadingOnly(stamp, 1.0, 0.1)


def closure(stamp: int, **reference: int) -> LoopClosure:
    return LoopClosure(stamp, np.zeros(3), np.eye(3), **reference)


@given(st.lists(st.tuples(
    st.sampled_from('ab'), st.integers(1, 6), st.sampled_from((None, 'ns', 'node', 'none')),
    st.integers(0, 3), st.booleans()), max_size=60))
def test_what_has_come_before_is_known(
    steps: list[tuple[str, int, str | None, int, bool]],
) -> None:
    seen, plain = SeenStamps(), set()
    for source, stamp, kind, number, add in steps:
        one: Measurement = heading(stamp)
        if kind is not None:
            one = closure(stamp, **({} if kind == 'none' else {f'reference_{kind}': number + 1}))
        key = source, stamp, kind, number if kind in ('ns', 'node') else 0
        assert seen.has(source, one) == (key in plain)
        if add and key not in plain:
            seen.add(source, one)
            plain.add(key)
        elif not add:
            seen.remove(source, one)
            plain.discard(key)
