# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Verdicts as a diagnostic_msgs/DiagnosticArray, and decisions from a KeyValue; no rclpy.

The message has one status for each constraint. The first status counts them all, also those that
are not listed, so that the size of a message is bounded.
"""

from collections.abc import Mapping, Sequence

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.adapters.output_cdr import CdrStream
from pose_graph_ros.adapters.sources import NANOSECONDS
from pose_graph_ros.core.judgement.texts import (
    details,
    Key,
    nanoseconds,
    sentence,
    total_values,
    totals_text,
)
from pose_graph_ros.core.judgement.verdicts import Decision, SourceVerdicts, State, Verdict
from pose_graph_ros.core.measurements import Answer, rejected

JUDGE = 'judge'  # name under which decisions are counted
OK, WARN, STALE = 0, 1, 3  # levels of diagnostic_msgs/DiagnosticStatus
LEVELS = {State.BELIEVED: OK, State.WEAKLY_BELIEVED: OK, State.DOUBTED: WARN,
          State.WAITING: STALE}
MOST_BELIEVED = 50  # of each source, the newest


def verdicts_cdr(
    verdicts: Sequence[Verdict], totals: Mapping[str, SourceVerdicts], stamp_ns: int,
    frame_id: str,
) -> bytes:
    """
    Return verdicts as a diagnostic_msgs/DiagnosticArray in little-endian CDR.

    Parameters
    ----------
    verdicts : sequence of Verdict, those that are listed
    totals : mapping, what is believed of each source, as a whole
    stamp_ns : int, [ns]
    frame_id : str, frame of the map

    """
    stream = CdrStream()
    stream.add('<i4', stamp_ns // NANOSECONDS)
    stream.add('<u4', stamp_ns % NANOSECONDS)
    stream.add_text(frame_id)
    stream.add('<u4', 1 + len(verdicts))
    n_all = sum(sum(each.counts.values()) for each in totals.values())
    of_sources = '; '.join(f'{source}: {totals_text(each)}' for source, each in totals.items())
    summary = f'{len(verdicts)} of {n_all} are listed; {of_sources or "nothing is judged yet"}'
    doubting = any(each.doubting for each in totals.values())
    _add_status(stream, WARN if doubting else OK, ('summary', summary, ''), total_values(totals))
    for each in verdicts:
        _add_status(
            stream, LEVELS[each.state], (each.id, sentence(each), each.source), details(each))
    return stream.message()


def _add_status(
    stream: CdrStream, level: int, texts: tuple[str, str, str], values: Mapping[str, str],
) -> None:
    """Add a status, given the level, then name, message and hardware_id, then the values."""
    stream.add('u1', level)
    for text in texts:
        stream.add_text(text)
    stream.add('<u4', len(values))
    for key, value in values.items():
        stream.add_text(key)
        stream.add_text(value)


def states_in(message: Message) -> dict[Key, State]:
    """Return the states of measurements in a message, by their sources and stamps."""
    found: dict[Key, State] = {}
    for status in message.status[1:]:
        values = {item.key: item.value for item in status.values}
        reference = values['reference_stamp']
        found[status.hardware_id, nanoseconds(values['stamp']),
              None if reference == '' else nanoseconds(reference)] = State(values['state'])
    return found


def read_decision(message: Message) -> tuple[str, Decision] | Answer:
    """Return the id of a constraint and what is decided on it; else why it cannot be read."""
    name, text = str(message.key).strip(), str(message.value).strip().lower()
    try:
        return name, Decision(text)
    except ValueError:
        choices = ', '.join(decision.value for decision in Decision)
        return rejected('unknown_decision', f'expected one of {choices} as the value for the key '
                                            f'{name!r}, got {text!r}')
