# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Validation: every covariance is made usable or rejected with a reason."""

from dataclasses import dataclass, replace

from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from pose_graph_ros.core.config import CovariancePolicy, Heading
from pose_graph_ros.core.geometry import covariance
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import (
    Answer,
    AnswerStatus,
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    Measurement,
    Position,
)
from pose_graph_ros.core.sources.kinds import validate
from pose_graph_ros.core.sources.validation import Validated

SECOND = 1_000_000_000
NAN, INF, LARGEST = np.nan, np.inf, np.finfo(float).max     # 1.8e308 itself reads as inf
GOOD = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.01]])
REPAIR, REFUSE = CovariancePolicy(), CovariancePolicy(repair=False)
# Relative; products and quotients of a few numbers.
ROUNDING = 1e-12


def pose(cov: FloatArray) -> GlobalPose:
    return GlobalPose(SECOND, np.array([1.0, 2.0, 3.0]), cov)


def position(cov: FloatArray) -> Position:
    return Position(SECOND, np.array([1.0, 2.0]), cov[:2, :2], np.array([0.3, 0.1]))


def closure(cov: FloatArray) -> LoopClosure:
    return LoopClosure(SECOND, np.array([1.0, 2.0, 3.0]), cov, reference_node=0)


KINDS = (pose, position, closure)


def put(*entries: tuple[int, int, float], into: FloatArray = GOOD) -> FloatArray:
    result = into.copy()
    for i, j, value in entries:
        result[i, j] = value
    return result


def both(i: int, j: int, value: float) -> FloatArray:
    return put((i, j, value), (j, i, value))


@dataclass(frozen=True)
class Case:
    """Expected answers to a pose, a position and a closure with one covariance."""

    cov: FloatArray
    pose: str
    """Type of the result with repairs allowed, then the repair; the reason if rejected."""
    position: str
    closure: str
    strict: tuple[str, str, str]
    """Reasons of all three without repairs; empty if accepted."""


def all_alike(cov: FloatArray, word: str, *, position_only: bool = False) -> Case:
    repaired = f'repaired_covariance_{word}'
    left = 'Position' if position_only else 'GlobalPose'
    return Case(cov, f'{left} {repaired}', f'Position {repaired}', f'LoopClosure {repaired}',
                3 * (f'covariance_{word}',))


def heading_alone(value: float, word: str) -> Case:
    """Return a case whose heading has an unknown or uninformative variance."""
    return Case(put((2, 2, value)), 'Position', 'Position',
                f'LoopClosure repaired_covariance_{word}', ('', '', f'covariance_{word}'))


CASES = {
    'good': Case(GOOD, 'GlobalPose', 'Position', 'LoopClosure', ('', '', '')),
    'tiny': Case(np.diag([1e-300] * 3), 'GlobalPose', 'Position', 'LoopClosure', ('', '', '')),
    'zeros': Case(np.zeros((3, 3)), 'Position default_covariance', 'Position default_covariance',
                  'LoopClosure default_covariance', 3 * ('covariance_not_positive',)),
    'all nan': all_alike(np.full((3, 3), NAN), 'not_finite', position_only=True),
    'all minus one': all_alike(np.full((3, 3), -1.0), 'not_positive', position_only=True),
    'x nan': all_alike(put((0, 0, NAN)), 'not_finite'),
    'x inf': all_alike(put((0, 0, INF)), 'not_finite'),
    'x largest': all_alike(put((0, 0, LARGEST)), 'too_large'),
    'x zero': all_alike(put((0, 0, 0.0)), 'not_positive'),
    'y minus one': all_alike(put((1, 1, -1.0)), 'not_positive'),
    'y minus inf': all_alike(put((1, 1, -INF)), 'not_finite'),
    'asymmetric': all_alike(put((0, 1, 0.03)), 'not_symmetric'),
    'skew': all_alike(put((0, 1, 0.03), (1, 0, -0.03)), 'not_symmetric'),
    'correlated beyond one': all_alike(both(0, 1, 0.07), 'not_positive_definite'),
    'correlated by one': all_alike(both(0, 1, 0.06), 'not_positive_definite'),
    'off-diagonal nan': all_alike(both(0, 1, NAN), 'not_finite'),
    'one off-diagonal nan': all_alike(put((0, 1, NAN)), 'not_finite'),
    'off-diagonal largest': all_alike(both(0, 1, LARGEST), 'not_positive_definite'),
    'off-diagonal inf': all_alike(both(0, 1, -INF), 'not_finite'),
    'heading nan': heading_alone(NAN, 'not_finite'),
    'heading inf': heading_alone(INF, 'not_finite'),
    'heading largest': heading_alone(LARGEST, 'too_large'),
    'heading zero': heading_alone(0.0, 'not_positive'),
    'heading minus one': heading_alone(-1.0, 'not_positive'),
    'heading flat': Case(put((2, 2, np.pi**2 / 3.0)), 'Position', 'Position', 'LoopClosure',
                         ('', '', '')),
    'cross nan': Case(both(0, 2, NAN), 'GlobalPose repaired_covariance_not_finite', 'Position',
                      'LoopClosure repaired_covariance_not_finite',
                      ('covariance_not_finite', '', 'covariance_not_finite')),
    'only the position zero': Case(
        np.diag([0.0, 0.0, 0.01]), 'GlobalPose repaired_covariance_not_positive',
        'Position default_covariance', 'LoopClosure repaired_covariance_not_positive',
        3 * ('covariance_not_positive',)),
    'only the heading': Case(
        np.diag([INF, INF, 0.01]), 'HeadingOnly', 'Position repaired_covariance_not_finite',
        'LoopClosure', ('', 'covariance_not_finite', '')),
    'only the heading, by large numbers': Case(
        np.diag([LARGEST, 1e16, 0.01]), 'HeadingOnly', 'Position repaired_covariance_too_large',
        'LoopClosure', ('', 'covariance_too_large', '')),
    'nothing at all': Case(
        np.diag([INF] * 3), 'no_information', 'Position repaired_covariance_not_finite',
        'no_information', ('no_information', 'covariance_not_finite', 'no_information')),
    'nothing at all, by large numbers': Case(
        np.diag([LARGEST] * 3), 'no_information', 'Position repaired_covariance_too_large',
        'no_information', ('no_information', 'covariance_too_large', 'no_information')),
}


def assert_usable(validated: Validated, policy: CovariancePolicy) -> None:
    left = validated.measurement
    flat = covariance.UNKNOWN_HEADING_VARIANCE
    if isinstance(left, HeadingOnly):
        assert policy.heading_floor**2 * (1 - ROUNDING) <= left.variance <= flat
        return
    cov = left.covariance
    if isinstance(left, LoopClosure) and np.isinf(cov[0, 0]):
        np.testing.assert_array_equal(cov, np.diag([INF, INF, cov[2, 2]]))
        assert policy.heading_floor**2 * (1 - ROUNDING) <= cov[2, 2] <= flat
        return
    assert cov.shape == ((2, 2) if isinstance(left, Position) else (3, 3))
    np.testing.assert_array_equal(cov, cov.T)
    assert covariance.defect(cov) is None
    variances = np.diagonal(cov)
    assert np.all(variances[:2] >= policy.position_floor**2 * (1 - ROUNDING))
    assert np.all(variances[:2] <= policy.position_ceiling**2 * (1 + ROUNDING))
    assert np.all(variances[2:] >= policy.heading_floor**2 * (1 - ROUNDING))
    assert np.all(variances[2:] <= flat * (1 + ROUNDING))
    assert np.all(np.isfinite(covariance.information(cov)))


@pytest.mark.parametrize('name', CASES)
def test_every_covariance_gets_its_answer(name: str) -> None:
    case = CASES[name]
    for kind, said, strict in zip(
            KINDS, (case.pose, case.position, case.closure), case.strict, strict=True):
        with np.errstate(all='raise', under='ignore'):
            repaired, refused = validate(kind(case.cov), REPAIR), validate(kind(case.cov), REFUSE)
        what, *repairs = said.split()
        if what == 'no_information':
            assert isinstance(repaired, Answer)
            assert (repaired.status, repaired.reason) == (AnswerStatus.REJECTED, what)
        else:
            assert isinstance(repaired, Validated)
            assert type(repaired.measurement).__name__ == what
            assert list(repaired.repairs) == repairs
            assert_usable(repaired, REPAIR)
        if strict == '':
            assert isinstance(refused, Validated)
            assert refused.repairs == ()
            assert_usable(refused, REFUSE)
        else:
            assert isinstance(refused, Answer)
            assert (refused.status, refused.reason) == (AnswerStatus.REJECTED, strict)
            assert refused.detail != ''


BAD = (NAN, INF, -INF, LARGEST, -LARGEST, 0.0, -1.0, 1e-320, 1e200)
POLICIES = (
    REPAIR, REFUSE, CovariancePolicy(heading=Heading.ALWAYS),
    CovariancePolicy(heading=Heading.NEVER), CovariancePolicy(scale=1e6),
    CovariancePolicy(scale=1e-6), CovariancePolicy(override=(0.5,)),
    CovariancePolicy(override=(0.5, 0.1)), CovariancePolicy(override=(1e6, 50.0)),
    CovariancePolicy(repair=False, override=(0.5,), heading=Heading.ALWAYS),
    CovariancePolicy(position_floor=1.0, position_ceiling=1.0, heading_floor=0.5))


def assert_answered(measurement: Measurement, policy: CovariancePolicy) -> None:
    with np.errstate(all='raise', under='ignore'):
        answer = validate(measurement, policy)
    if isinstance(answer, Validated):
        assert_usable(answer, policy)
    else:
        assert answer.reason.startswith('covariance_') or answer.reason == 'no_information'


@given(arrays(np.float64, (3, 3), elements=st.one_of(
    st.floats(), st.sampled_from(BAD), st.floats(-2.0, 2.0))), st.sampled_from(POLICIES))
def test_any_numbers_end_usable_or_refused(cov: FloatArray, policy: CovariancePolicy) -> None:
    for kind in KINDS:
        assert_answered(kind(cov), policy)


@given(st.integers(0, 2**32 - 1))
def test_a_sound_covariance_passes_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.uniform(-1.0, 1.0, (3, 3)) + np.eye(3)
    cov = root @ root.T * 0.02 + 0.001 * np.eye(3)
    cov = 0.5 * (cov + cov.T)
    for kind in KINDS:
        given_ = kind(cov)
        answer = validate(given_, REPAIR)
        assert isinstance(answer, Validated)
        assert answer.repairs == ()
        assert type(answer.measurement) is type(given_)
        np.testing.assert_array_equal(answer.measurement.covariance, given_.covariance)
        scaled = validate(given_, CovariancePolicy(scale=2.0))
        np.testing.assert_array_equal(scaled.measurement.covariance, 2.0 * given_.covariance)
        floor = CovariancePolicy(position_floor=0.3)
        raised = validate(given_, floor).measurement.covariance
        expected = given_.covariance.copy()
        expected[[0, 1], [0, 1]] = np.maximum(expected[[0, 1], [0, 1]], 0.3**2)
        np.testing.assert_allclose(raised, expected, rtol=ROUNDING)


# --- Overrides -------------------------------------------------------------------------------


def test_an_override_of_the_position_alone_leaves_the_heading_to_the_message() -> None:
    policy = CovariancePolicy(override=(0.5,))
    expected = np.diag([0.25, 0.25, 0.01])
    for kind in (pose, closure):
        left = validate(kind(GOOD), policy).measurement
        assert type(left) is type(kind(GOOD))
        np.testing.assert_allclose(left.covariance, expected)
    assert isinstance(validate(pose(put((2, 2, 0.0))), policy).measurement, Position)
    always = replace(policy, heading=Heading.ALWAYS)
    left = validate(pose(put((2, 2, 0.0))), always).measurement
    np.testing.assert_allclose(left.covariance, np.diag([0.25, 0.25, 0.09]))
    # the variance of the heading of a closure is unknown
    strict = replace(policy, repair=False)
    assert validate(closure(put((2, 2, 0.0))), strict).reason == 'covariance_not_positive'
    left = validate(closure(put((2, 2, 0.0))), policy)
    np.testing.assert_allclose(left.measurement.covariance, np.diag([0.25, 0.25, 0.09]))


# --- Headings --------------------------------------------------------------------------------

@pytest.mark.parametrize(('heading', 'variance', 'left'), [
    (Heading.AUTO, 0.01, 0.01), (Heading.AUTO, 0.0, None), (Heading.AUTO, NAN, None),
    (Heading.AUTO, -1.0, None), (Heading.AUTO, INF, None), (Heading.AUTO, 3.3, None),
    (Heading.AUTO, 3.2, 3.2),
    (Heading.ALWAYS, 0.01, 0.01), (Heading.ALWAYS, 0.0, 0.09), (Heading.ALWAYS, NAN, 0.09),
    (Heading.ALWAYS, INF, 0.09), (Heading.ALWAYS, 99.0, 0.09),
    (Heading.NEVER, 0.01, None), (Heading.NEVER, NAN, None)])
@pytest.mark.parametrize('repair', [True, False])
def test_when_the_heading_of_a_pose_is_used(
    heading: Heading, variance: float, left: float | None, *, repair: bool,
) -> None:
    policy = CovariancePolicy(heading=heading, repair=repair)
    answer = validate(pose(np.diag([0.04, 0.09, variance])), policy)
    assert isinstance(answer, Validated)
    if left is None:
        assert isinstance(answer.measurement, Position)
        np.testing.assert_array_equal(answer.measurement.covariance, np.diag([0.04, 0.09]))
        np.testing.assert_array_equal(answer.measurement.position, [1.0, 2.0])
        np.testing.assert_array_equal(answer.measurement.lever_arm, 0.0)
    else:
        assert isinstance(answer.measurement, GlobalPose)
        np.testing.assert_allclose(answer.measurement.covariance, np.diag([0.04, 0.09, left]))


@pytest.mark.parametrize(('variance', 'said'), [
    (0.01, 0.01), (1e-12, 1e-6), (0.0, 'default'), (-1.0, 'default'), (NAN, 'default'),
    (INF, 'no_information'), (LARGEST, 'no_information'), (3.3, 'no_information')])
def test_the_variance_of_a_heading(variance: float, said: float | str) -> None:
    given_ = HeadingOnly(SECOND, 1.0, variance)
    answer, refused = validate(given_, REPAIR), validate(given_, REFUSE)
    if said == 'no_information':
        assert answer.reason == refused.reason == said
    elif said == 'default':
        assert answer == Validated(HeadingOnly(SECOND, 1.0, 0.3**2), ('default_covariance',))
        assert refused.reason == 'covariance_not_positive'
    else:
        assert answer.measurement.variance == refused.measurement.variance == pytest.approx(said)
    overridden = validate(given_, CovariancePolicy(override=(9.0, 0.2)))
    assert overridden.measurement.variance == pytest.approx(0.04)


# --- Values ----------------------------------------------------------------------------------

def test_values_and_stamps_are_checked_too() -> None:
    bad = [GlobalPose(SECOND, np.array([0.0, 0.0, NAN]), GOOD),
           Position(SECOND, np.array([INF, 0.0]), GOOD[:2, :2], np.zeros(2)),
           Position(SECOND, np.zeros(2), GOOD[:2, :2], np.array([NAN, 0.0])),
           LoopClosure(SECOND, np.array([0.0, -INF, 0.0]), GOOD, reference_node=0),
           HeadingOnly(SECOND, NAN, 0.1)]
    assert [validate(one, REPAIR).reason for one in bad] == 5 * ['not_finite']
    sound = [pose(GOOD), position(GOOD), closure(GOOD), HeadingOnly(SECOND, 1.0, 0.1)]
    for stamp, reason in ((0, 'zero_stamp'), (-3, 'zero_stamp'), (2**63, 'no_stamp')):
        assert [validate(replace(one, stamp_ns=stamp), REPAIR).reason for one in sound] == 4 * [
            reason]
    far = LoopClosure(SECOND, np.zeros(3), GOOD, reference_ns=2**63)
    assert validate(far, REPAIR).reason == 'no_stamp'
