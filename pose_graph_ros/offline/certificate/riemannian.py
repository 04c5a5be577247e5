# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Minimisation of the quadratic form over headings of length 1: a Riemannian trust region.

A heading is a row of r complex numbers with length 1. With r = 1 it is an angle; with more there
is room to leave a local minimum. Steps are those of a truncated Newton method (P.-A. Absil,
C. Baker, K. Gallivan, "Trust-region methods on Riemannian manifolds", 2007): conjugate gradients
in the tangent space, preconditioned by the form without the constraint of length 1.

With g = Q Y - L Y, L the real diagonal of `Re <Y_i, (Q Y)_i>`, half the gradient, half the Hessian
is the projection of Q - L. All rows may be turned by one unitary matrix, so row 0 stays.
"""

from collections.abc import Callable

import numpy as np

from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray
from pose_graph_ros.offline.certificate.objective import QuadraticForm

Operator = Callable[[ComplexArray], ComplexArray]
Inverse = Callable[[FloatArray], FloatArray]


def inner(a: ComplexArray, b: ComplexArray) -> float:
    """Return the real inner product of two arrays."""
    return float(np.vdot(a, b).real)


def unit_rows(y: ComplexArray) -> ComplexArray:
    """Return rows, shape (n, r), scaled to length 1; a row of zeros becomes (1, 0, ...)."""
    length = np.linalg.norm(y, axis=1)
    y = y / np.where(length > 0.0, length, 1.0)[:, None]
    y[length == 0.0, 0] = 1.0
    return y


def multipliers(y: ComplexArray, product: ComplexArray) -> FloatArray:
    """Return the diagonal L, shape (n,), given Y and Q Y, shape (n, r)."""
    return np.asarray(np.sum(y.real * product.real + y.imag * product.imag, axis=1))


def minimized(
    form: QuadraticForm, y: ComplexArray, inverse: Inverse | None = None,
) -> ComplexArray:
    """
    Return headings at a minimum of f near the given ones, or where steps no longer lower it.

    `inverse` goes from derivatives by headings that are angles, (n,), to changes of them near the
    minimum.
    """
    cost, radius = form.cost(y), np.inf
    product = form.product(y)
    solve = None if inverse is not None else _preconditioner(form, multipliers(y, product))
    for _ in range(300):
        diagonal = multipliers(y, product)[:, None]
        tangent = _projection(y)
        gradient = tangent(product - diagonal * y)

        def hessian(v: ComplexArray, diagonal: FloatArray = diagonal,
                    tangent: Operator = tangent) -> ComplexArray:
            return tangent(form.product(v) - diagonal * v)

        def precondition(
            v: ComplexArray, tangent: Operator = tangent, y: ComplexArray = y,
        ) -> ComplexArray:
            if solve is not None:
                return tangent(solve(v))
            assert inverse is not None
            # a change of the angle turns a heading at a right angle
            return tangent(1j * y * inverse((y.conj() * v).imag[:, 0])[:, None])

        decrease = inner(gradient, precondition(gradient))
        if not decrease > 1e-11 * cost:
            break
        radius = min(radius, 100.0 * np.sqrt(decrease))
        step, predicted, at_limit = _step(hessian, precondition, gradient, radius)
        candidate = unit_rows(y + step)
        after = form.cost(candidate)
        slack = 1e-14 * cost   # may be rounding
        ratio = (cost - after + slack) / (predicted + slack)
        if ratio < 0.25:
            radius = min(radius, np.sqrt(decrease)) * 0.25
        elif ratio > 0.75 and at_limit:
            radius *= 4.0
        if ratio > 0.05:
            y, cost = candidate, after
            product = form.product(y)
        if predicted < slack:
            break
    return y


def _projection(y: ComplexArray) -> Operator:
    """Return the projection to the tangent space at Y, with row 0 at rest."""
    def tangent(v: ComplexArray) -> ComplexArray:
        v = v - multipliers(y, v)[:, None] * y
        v[0] = 0.0
        return v
    return tangent


def _preconditioner(form: QuadraticForm, diagonal: FloatArray) -> Operator:
    """Return v -> (Q - L)^-1 v with row 0 held, or with Q alone if that is not definite."""
    damping = 1e-12 * form.diagonal   # makes it definite
    factors = form.factors(damping - diagonal, turned=False)
    if not factors.is_positive:
        factors = form.factors(damping, turned=False)

    def solve(v: ComplexArray) -> ComplexArray:
        out = form.inverse(factors, v)
        out[0] = 0.0
        return out
    return solve


def _step(
    hessian: Operator, precondition: Operator, gradient: ComplexArray, radius: float,
) -> tuple[ComplexArray, float, bool]:
    """
    Return a step, the decrease of f that it should bring, and whether the radius limits it.

    Conjugate gradients of Steihaug and Toint, with lengths as the preconditioner measures them.
    """
    step, residual = np.zeros_like(gradient), gradient.copy()
    applied = np.zeros_like(gradient)  # the Hessian times the step
    scaled = precondition(residual)
    square = first = inner(residual, scaled)
    direction = -scaled
    length, cross, own = 0.0, 0.0, square
    at_limit = False
    for _ in range(300):
        image = hessian(direction)
        curvature = inner(direction, image)
        alpha = square / curvature if curvature > 0.0 else np.inf
        if not length + 2.0 * alpha * cross + alpha**2 * own < radius**2:
            alpha = (np.sqrt(cross**2 + own * (radius**2 - length)) - cross) / own
            at_limit = True
        step += alpha * direction
        applied += alpha * image
        if at_limit:
            break
        residual += alpha * image
        length += 2.0 * alpha * cross + alpha**2 * own
        scaled = precondition(residual)
        before, square = square, inner(residual, scaled)
        if square <= 1e-6 * first:
            break
        beta = square / before
        cross = beta * (cross + alpha * own)
        own = square + beta**2 * own
        direction = beta * direction - scaled
    return step, -2.0 * inner(gradient, step) - inner(step, applied), at_limit
