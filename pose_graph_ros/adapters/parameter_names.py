# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of parameters that are not known: gone, or misspelt; no ROS."""

from collections.abc import Collection
from difflib import get_close_matches

LIKENESS = 0.7  # from which on one name may be meant by another, as difflib measures it

_FIXED = 'it is {} now, remove it'
_LOSS = 'the threshold of a robust_loss is 3 sigma, of tukey 5; remove it, or scale covariances'
# What to do about parameters that older versions had, by their names without that of a source.
REMOVED = {
    'graph_period': 'markers come half as often as paths: set path_period',
    'clock_jump_threshold': _FIXED.format('1 s'),
    'minimum_node_interval': _FIXED.format('0.2 s'),
    'moving_node_interval': _FIXED.format('1 s'),
    'node_heartbeat': _FIXED.format('10 s'),
    'odometry_patience': _FIXED.format('2 s'),
    'transform_slew_linear': 'set transform_slew: [m/s, rad/s]',
    'transform_slew_angular': 'set transform_slew: [m/s, rad/s]',
    'thinning.angle': _FIXED.format('90 degrees'),
    'thinning.poses': _FIXED.format('1'),
    'thinning.newest': _FIXED.format('50'),
    'alignment.sigma_heading': _FIXED.format('0.15 rad'),
    'alignment.minimum_baseline': _FIXED.format('1 m'),
    'alignment.baseline_in_sigmas': _FIXED.format('5'),
    'reorder_window': _FIXED.format('0.25 s'),
    'rejection_threshold': _LOSS,
    'covariance_policy': 'invalid covariances are repaired, of loop closures refused; remove it, '
                         'or set covariance_override',
    'sigma_ceiling': _FIXED.format('1000 m'),
    'default_sigma': 'for unknown covariances it is 5 m and 0.3 rad; set covariance_override for '
                     'others',
    'minimum_period': 'all measurements are used, of an imu one in 0.5 s; remove it, or throttle '
                      'the topic',
    'correlation_model': 'correlated errors are estimated as a bias; remove it',
    'white_share': _FIXED.format('0.05'),
}
# Those that only some types of sources still have.
REMOVED_OF_SOME = {
    'sigma_floor': 'odometry and loop closures have none; remove it, or set covariance_scale',
    'sigma_scale': 'it is learnt; remove it, or set covariance_scale to its square',
    'robust_loss': 'odometry has none any more; remove it',
}


def removed(name: str) -> str:
    """Return what to do about a parameter that older versions had; empty for other names."""
    own = name.rpartition('.')[2]
    return REMOVED.get(name) or (
        '' if name == own else {**REMOVED, **REMOVED_OF_SOME}.get(own, ''))


def explanation(name: str, known: Collection[str], of_sources: Collection[str]) -> str:
    """
    Return what may be wrong with a name that is not known; empty if no other is like it.

    Parameters
    ----------
    known : collection of str, names of all parameters
    of_sources : collection of str
        Names of the parameters that sources can have, without the name of a source.

    """
    source, _, own = name.rpartition('.')
    if source == '' or own not in of_sources:
        return _question(get_close_matches(name, known, 1, LIKENESS))
    if f'{source}.type' in known:
        return f'a source of the type of {source} has none'
    others = [each.removesuffix(f'.{own}') for each in known if each.endswith(f'.{own}')]
    question = _question(
        [f'{other}.{own}' for other in get_close_matches(source, others, 1, LIKENESS)])
    return f'{source} is not in sources' + (question and f'; {question}')


def is_own(name: str, known: Collection[str], of_sources: Collection[str]) -> bool:
    """
    Tell whether a name that is not known is probably meant for this node.

    A file may have parameters for several nodes: those in a group that this node does not have
    are for others, unless they resemble one of its own.

    Parameters
    ----------
    known, of_sources : collection of str, as for `explanation`

    """
    group, dot, _ = name.partition('.')
    return (dot == '' or name in REMOVED or any(each.startswith(f'{group}.') for each in known)
            or explanation(name, known, of_sources) != '')


def _question(nearest: list[str]) -> str:
    return '' if len(nearest) == 0 else f'did you mean {nearest[0]}?'
