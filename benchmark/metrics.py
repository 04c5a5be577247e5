# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Figures with a direction: what is asked for, and how much worse than before is still no fault.

The baseline is a committed file of the figures that do not depend on the machine: optima, excess,
accuracy, and ratios of times. The gate compares whatever was measured with it. Plain times are
reported, not gated.
"""

from dataclasses import dataclass
import json
from pathlib import Path

BASELINE = Path(__file__).with_name('baseline.json')


@dataclass(frozen=True, slots=True)
class Slack:
    """How much worse than the baseline a figure may get: the larger of the two."""

    relative: float
    absolute: float


OPTIMUM = Slack(1e-6, 1e-7)
"""chi2 of optima: the same minimum, but for rounding."""
ACCURACY = Slack(0.25, 1e-4)
"""Excess and distances: they follow rounding through thresholds."""
RATIO = Slack(0.25, 0.0)
"""Ratios of times vary from run to run, and with the machine."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure."""

    key: str
    """Row of the requirements, world and quantity: `loops/ring/ratio mean`."""
    value: float
    unit: str = ''
    slack: Slack | None = None
    """None: not gated."""
    target: float | None = None
    """What the requirement asks for."""
    higher_is_better: bool = False

    @property
    def reached(self) -> bool:
        """Whether the target is reached; true without one."""
        if self.target is None:
            return True
        return self.value >= self.target if self.higher_is_better else self.value <= self.target

    def status(self) -> str:
        """Return what was asked for, and whether it is reached."""
        if self.target is None:
            return ''
        sign = 'at least' if self.higher_is_better else 'at most'
        return f'{sign} {self.target:.4g}: {"reached" if self.reached else "NOT reached"}'

    def worse_than(self, before: float) -> bool:
        """Tell whether the figure is worse than it was, beyond its slack."""
        if self.slack is None:
            return False
        allowed = max(self.slack.relative * abs(before), self.slack.absolute)
        loss = before - self.value if self.higher_is_better else self.value - before
        return not loss <= allowed


def gate(metrics: list[Metric], mode: str, path: Path = BASELINE) -> list[str]:
    """
    Compare figures with the baseline.

    Parameters
    ----------
    metrics : list of Metric
    mode : {'quick', 'full'}
        The worlds and sampling differ, so each has its own baseline.
    path : Path

    Returns
    -------
    list of str
        One sentence for each figure that got worse; figures without a baseline are passed over.

    """
    before = _read(path).get(mode, {})
    if len(before) == 0:
        return [f'{path.name} holds nothing for {mode} runs: make it with --write-baseline']
    return [f'{metric.key}: {metric.value:.6g}{metric.unit}, was '
            f'{before[metric.key]:.6g}{metric.unit}'
            for metric in metrics
            if metric.key in before and metric.worse_than(before[metric.key])]


def write_baseline(metrics: list[Metric], mode: str, path: Path = BASELINE) -> None:
    """Write the gated figures; those of the baseline that were not measured stay."""
    content = _read(path)
    figures = content.setdefault(mode, {})
    figures.update({metric.key: float(f'{metric.value:.9g}') for metric in metrics
                    if metric.slack is not None})
    content[mode] = dict(sorted(figures.items()))
    path.write_text(json.dumps(content, indent=1) + '\n', encoding='ascii')


def _read(path: Path) -> dict[str, dict[str, float]]:
    if not path.exists():
        return {}
    content: dict[str, dict[str, float]] = json.loads(path.read_text(encoding='ascii'))
    return content
