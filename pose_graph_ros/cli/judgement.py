# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What was believed in a run, in the summary and as text."""

from collections.abc import Iterator, Mapping, Sequence

from pose_graph_ros.core.judgement.texts import as_json, is_notable, ORDER, sentence, totals_text
from pose_graph_ros.core.judgement.verdicts import (
    Judged,
    SourceVerdicts,
    State,
    Verdict,
)

NAMED = 10  # number of constraints of a source that the text names


def judgement(
    totals: Mapping[str, SourceVerdicts], verdicts: Sequence[Verdict],
) -> dict[str, object]:
    """
    Return counts and scale of each source, and all closures and all that is not believed.

    Parameters
    ----------
    totals : mapping, what is believed of each source

    """
    return {
        'sources': {source: {
            'states': {state.value: each.counts.get(state, 0) for state in ORDER},
            'scale': each.scale, 'forgotten': each.n_forgotten}
            for source, each in totals.items()},
        'constraints': [as_json(each) for each in verdicts
                        if each.kind is Judged.LOOP_CLOSURE or is_notable(each)]}


def judgement_lines(
    totals: Mapping[str, SourceVerdicts], verdicts: Sequence[Verdict],
) -> Iterator[str]:
    """
    Yield a line for each source, and for the first of its constraints that are doubted.

    Parameters
    ----------
    totals : mapping, what is believed of each source

    """
    for source, each in totals.items():
        yield f'{source}: {totals_text(each)}'
        doubted = [verdict for verdict in verdicts
                   if verdict.source == source and verdict.state is State.DOUBTED]
        for verdict in doubted[:NAMED]:
            yield f'  {verdict.id}: {sentence(verdict)}'
        if len(doubted) > NAMED:
            yield f'  and {len(doubted) - NAMED} more, all of which are in summary.json'
