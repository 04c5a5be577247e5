# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The results of a run, of a replay as of a demo: files in a folder, and lines for people."""

from collections.abc import Mapping, Sequence
import json
import math
from pathlib import Path
from typing import Any

from pose_graph_ros.cli.drive import consistency, consistency_lines, format_table, summary
from pose_graph_ros.cli.run.document import write_document
from pose_graph_ros.cli.run.recorder import Run
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.io.path_files import write_tum
from pose_graph_ros.core.judgement.texts import as_json, is_notable, ORDER, short, totals_text
from pose_graph_ros.core.judgement.verdicts import Judged, SourceVerdicts, Verdict
from pose_graph_ros.core.odometry.motion import AS_CLAIMED


def write_results(run: Run, folder: Path, facts: Mapping[str, Any]) -> list[str]:
    """Return what people want to know, after writing path, picture, summary.json and run.json."""
    # matplotlib takes half a second to load, and wrong input needs none of it
    from pose_graph_ros.cli.picture import draw_drive  # noqa: PLC0415

    drive, estimate, backend, report = run.drive, run.estimate, run.backend, run.report
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(drive.corrected, folder / 'path.tum')
    draw_drive(drive, folder / 'drive.png', run.title)
    totals = backend.verdict_totals()
    counts = {'.'.join(key): count for key, count in sorted(run.counts.items())}
    nees = {} if drive.truth is None or report.status is Status.FAILED else consistency(
        drive, run.covariances)
    text = json.dumps(summary(drive, {
        **facts, **{f'nees_{name}': each for name, each in nees.items()},
        'alignment': estimate.alignment.value,
        'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
        'thinned_nodes': estimate.n_thinned, 'edges': estimate.n_edges,
        'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
        'chi2': estimate.chi2, 'odometry_errors': estimate.odometry_errors._asdict(),
        'status': report.status.value, 'counts': counts,
        'judged': _judgement(totals, run.verdicts)}), indent=2)
    (folder / 'summary.json').write_text(text + '\n', encoding='utf-8')
    told = write_document(run, folder)
    lines = [f'{estimate.n_hidden} hidden nodes, {estimate.n_edges} edges, {estimate.n_observed} '
             f'observed nodes in {run.seconds:.2f} s; {report.status.value}, chi2 '
             f'{report.chi2:.6g}; {estimate.alignment.value}']
    errors = estimate.odometry_errors
    if errors != AS_CLAIMED:
        lines.append(
            f'{estimate.primary}: noise of the way {short(math.sqrt(errors.way), 3)} times, of '
            f'turns {short(math.sqrt(errors.turn), 3)} times what it claims; corrected by '
            f'{short(errors.rate, 3)} rad/s and {short(100.0 * errors.scale, 3)} % of the way')
    lines += [f'{source}: {totals_text(of_source)}' for source, of_source in totals.items()]
    lines += [f'{each["level"]:8} {each["text"]}' for each in told['findings']]
    if 'new_bag' in facts:
        lines.append('new bag: {original} messages copied, {left_out} left out, {corrected} poses '
                     'of odometry corrected'.format(**facts['new_bag']))
    return [*lines, 'counts: ' + ', '.join(f'{name} {count}' for name, count in counts.items()),
            '', format_table(drive.rows), *consistency_lines(nees), '']


def _judgement(
    totals: Mapping[str, SourceVerdicts], verdicts: Sequence[Verdict],
) -> dict[str, object]:
    """Return counts and scale of each source, and all closures and all that is not believed."""
    return {
        'sources': {source: {
            'states': {state.value: each.counts.get(state, 0) for state in ORDER},
            'scale': each.scale, 'forgotten': each.n_forgotten}
            for source, each in totals.items()},
        'constraints': [as_json(each) for each in verdicts
                        if each.kind is Judged.LOOP_CLOSURE or is_notable(each)]}
