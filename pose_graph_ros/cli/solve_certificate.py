# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The certificate of global optimality of `pose-graph solve`: made, used as a start, and told."""

from dataclasses import dataclass
import time
from typing import Any

from pose_graph_ros.cli.solve_starts import Problem, resumed, Solution, solve
from pose_graph_ros.core.batch.outcome import SAME_MINIMUM, Status
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.offline.certificate.certify import Certificate, certify, NearHessian, Verdict
from pose_graph_ros.offline.certificate.formulation import formulate, NotCoveredError


@dataclass(frozen=True, slots=True)
class Report:
    """What the certificate says of a solution."""

    certificate: Certificate | None
    reason: str
    """Why there is none; else empty."""
    seconds: float
    chi2: float
    """chi2 of the solution, with the error (3.48)."""
    bounds_chi2: bool = False
    """Whether the lower bound is one of chi2 as well."""
    chi2_from_it: float | None = None
    """chi2 at the minimum that was reached from the one that the certificate found, if tried."""

    @property
    def bound(self) -> float | None:
        """Lower bound of chi2, if one was proved."""
        if self.certificate is None or not self.bounds_chi2:
            return None
        return max(self.certificate.bound, 0.0)

    def values(self) -> dict[str, Any]:
        """Return the keys of `certificate` in the JSON output, as in docs/tools.md."""
        made = self.certificate
        verdict = Verdict.NOT_ATTEMPTED if made is None else made.verdict
        return {
            'verdict': verdict.value, 'reason': self.reason, 'seconds': self.seconds,
            'chi2': None if made is None else made.chi2,
            'gap': None if made is None else made.gap,
            'relative_gap': None if made is None else made.relative_gap,
            'lambda_min': None if made is None else made.smallest,
            'rank': None if made is None else made.rank,
            'lower_minimum': made is not None and made.is_lower,
            'chi2_from_it': self.chi2_from_it,
            'chi2_bound': self.bound,
            'chi2_gap': None if self.bound is None else max(self.chi2 - self.bound, 0.0)}

    def lines(self) -> list[str]:
        """Return what is printed."""
        made = self.certificate
        if made is None:
            return [f'certificate: not attempted, because {self.reason}']
        took = f'{self.seconds:.3f} s'
        if made.verdict is Verdict.CERTIFIED:
            lines = [f'certificate: certified, {took}: the chordal objective, {made.chi2:.9g} at '
                     f'its minimum, is nowhere lower by more than {made.gap:.2g}']
        else:
            lines = [f'certificate: not certified, gap {made.gap:.4g} ({made.relative_gap:.2%}), '
                     f'{took}: the chordal objective is {made.chi2:.9g} at the lowest minimum '
                     f'found']
        if made.is_lower:
            lines.append(f'  near the poses found first, its minimum is {made.near:.9g}')
        if self.chi2_from_it is not None:
            lines.append(f'  from there, chi2 becomes {self.chi2_from_it:.9g}')
        if self.bound is None:
            lines.append('  this bounds no chi2, whose information depends on the direction; it '
                         'only speaks for the headings')
        else:
            above = max(self.chi2 - self.bound, 0.0)
            lines.append(f'  so no poses have a chi2 below {self.bound:.9g}; that found is '
                         f'{above:.2g} above this')
        return lines


def with_certificate(
    problem: Problem, solution: Solution, *, eigenvalue: bool,
) -> tuple[Solution, Report]:
    """
    Return the certificate of a solution, and a better solution if it leads to one.

    Parameters
    ----------
    problem : Problem
    solution : Solution
    eigenvalue : bool, whether to compute the smallest eigenvalue if there is a proof without it

    """
    begin, graph = time.monotonic(), problem.graph

    def none(reason: str) -> tuple[Solution, Report]:
        return solution, Report(
            None, reason, time.monotonic() - begin, solution.result.chi2)

    if not solution.determined:
        return none('the constraints do not determine the poses')
    if solution.result.status is Status.FAILED:
        return none(f'the optimisation failed: {solution.result.reason}')
    try:
        formulation = formulate(graph)
        by = solution.optimizer
        made = certify(formulation, graph.poses, eigenvalue=eigenvalue, hessian=(
            None if by is None else NearHessian(by.places, by.heading_steps)))
    except (NotCoveredError, LinearSolveError) as error:
        return none(str(error))
    found = None
    if made.is_lower:
        poses = graph.poses.copy()
        graph.set_poses(made.poses)
        other = solve(problem, 'present')
        found = other.result.chi2
        if (other.result.status is not Status.FAILED
                and found < solution.result.chi2 * (1.0 - SAME_MINIMUM)):
            solution = Solution(other.result, 'minimum of the chordal objective',
                                other.determined, solution.tried)
        else:
            solution = resumed(problem, solution, poses)
    return solution, Report(made, '', time.monotonic() - begin, solution.result.chi2,
                            formulation.below_chi2, found)
