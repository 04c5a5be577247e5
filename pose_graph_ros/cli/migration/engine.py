# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From the parameters of other nodes to those of this one.

A filter of robot_localization in the map is replaced. One in the odometry frame that uses no GNSS
stays, as it publishes the transform from there to the robot, and the odometry here is its output:
the transform from map to odometry, which this node publishes, must belong to the same odometry.
"""

from collections.abc import Sequence
import re
from typing import Any, NamedTuple

from pose_graph_ros.adapters import parameters
from pose_graph_ros.adapters.sources import KINDS, KNOWN_SOURCES
from pose_graph_ros.cli.migration import inputs as of
from pose_graph_ros.cli.migration.inputs import in_map, Input, place, PLANAR, Section, System
from pose_graph_ros.cli.migration.rules import CONVERSIONS, Fate, Rule, rule_of, TABLES
from pose_graph_ros.core.exceptions import ConfigError

USUAL_NAMES = {kind.name: name for name, (kind, _) in KNOWN_SOURCES.items()}
ANGLES = ('yaw_offset', 'magnetic_declination_radians')  # their sum turns a compass to the east
LOCAL, ALONE, GLOBAL = 'odometry/local', 'odometry/filtered', 'odometry/global'
"""Outputs of filters, as launch files of robot_localization and Nav2 name them."""


class Entry(NamedTuple):
    """What became of one parameter."""

    section: Section
    name: str
    fate: Fate
    sentence: str


class Setting(NamedTuple):
    """One of our parameters."""

    value: Any
    why: str


class Migration:
    """What some files become; all of it is known when it is made."""

    def __init__(self, sections: Sequence[Section], *, replaces_local: bool) -> None:
        self.sections = sections
        self.entries: list[Entry] = []
        self.settings = {'sources': Setting([], '')}  # by name
        self.names: dict[Input, dict[str, str]] = {}  # of the sources of an input by kind
        filters, smoothers = self.of(System.FILTER), self.of(System.FUSE)
        local = [each for each in filters if not in_map(each)]
        with_gnss = [each for each in local if any(one.is_gnss for one in of.of_filter(each))]
        self.replaced = next((each for each in filters if in_map(each)),
                             next(iter(with_gnss or smoothers), None))
        # the one that publishes the transform to the robot, and knows nothing of the map
        self.kept = next((each for each in local if each not in with_gnss and not replaces_local
                          and each.values.get('publish_tf', True) is True), None)
        if self.replaced is None and self.kept is None:
            self.replaced = next(iter(local), None)
        self.heard = [] if self.kept is None else list(of.of_filter(self.kept))
        self._add_sources([] if self.replaced is None else list(
            of.of_smoother(self.replaced) if self.replaced in smoothers
            else of.of_filter(self.replaced)))
        for section in sections:
            self._judge(section)
        for setting in self.settings.values():
            if isinstance(setting.value, str) and '$(' in setting.value:
                raise ConfigError(f'{setting.why}: {setting.value!r} is filled in by a launch '
                                  'file: write what it becomes')
        parameters.checked_together({name: each.value for name, each in self.settings.items()})

    def of(self, *systems: System) -> list[Section]:
        """Return the groups of parameters of some kinds of nodes."""
        return [each for each in self.sections if each.system in systems]

    def hears(self, one: Input) -> bool:
        """Tell whether the filter that stays has the same input."""
        return any(each.topic.lstrip('/') == one.topic.lstrip('/') for each in self.heard)

    # --- sources

    def _add_sources(self, inputs: Sequence[Input]) -> None:
        """Set the sources, and what their inputs tell of them."""
        named = ['odom'] if self.kept is not None else list[str]()
        navsats = self.of(System.NAVSAT)
        own = self._take_output(inputs)
        for one in inputs:
            kinds = [] if one is own else of.kinds_of(
                one, inputs, with_fixes=len(navsats) > 0, in_map=(
                    one.section.system is System.FUSE or in_map(one.section)))
            if self.hears(one):  # an absolute heading is not what the filter's odometry tells
                kinds = [kind for kind in kinds if kind in ('imu', 'fix', 'global_pose')]
            self.names[one] = {'odometry': 'odom'} if one is own else {}
            for kind in kinds:
                # nobody knows the topic of a second receiver
                if kind != 'fix' or 'fix' not in named:
                    name = of.free_name(one, kind, kinds, named, USUAL_NAMES.get(kind, ''))
                    self._add_source(one, kind, name)
                    named.append(name)
                    self.names[one][kind] = name
        moving = [name for name in named if KINDS[self.type_of(name)].is_odometry]
        others = [name for name in named if name not in moving]
        if len(navsats) > 0 and 'fix' not in named:
            others.append('fix')
            self._set('fix.topic', 'gps/fix', f'{place(navsats[0])}: its input')
        if len(moving) == 0:
            moving = ['odom']
            self._set('odom.topic', 'odom', 'no file tells it: write the topic of odometry here')
        moving.sort(key=lambda name: name != 'odom')
        self.settings['sources'] = Setting([*moving, *others], 'the inputs below')

    def _take_output(self, inputs: Sequence[Input]) -> Input | None:
        """Use the output of the filter that stays as odometry; return the input that it is."""
        if self.kept is None:
            return None
        own = next((one for one in inputs if one.message == 'odom' and not self.hears(one)
                    and re.search('local|filtered', one.topic)), None)
        if own is not None:
            self._set('odom.topic', own.topic, place(own.section, own.topic_key))
        else:
            self._set('odom.topic', ALONE if self.replaced is None else LOCAL,
                      f'{place(self.kept)}: its output')
        self._set('outputs.filtered_odometry', GLOBAL,
                  f'not the name of the output of {self.kept.node}')
        return own

    def _add_source(self, one: Input, kind: str, name: str) -> None:
        topic, use = (place(one.section, *keys) for keys in ((one.topic_key,), one.use_keys))
        if name not in KNOWN_SOURCES or KNOWN_SOURCES[name][0].name != kind:
            self._set(f'{name}.type', kind, use)
        if kind == 'fix':
            self._set('fix.topic', 'gps/fix', f'{topic}: what {one.topic} is made of')
        else:
            self._set(f'{name}.topic', one.topic, topic)
        if one.topic.lstrip('/') == ALONE:
            self._set('outputs.filtered_odometry', GLOBAL, f'not the name of the input {name}')
        if kind == 'odometry' and not one.uses & {'x', 'y'}:
            self._set(f'{name}.integrate', 'twist', f'{use}: velocities')
        if kind == 'global_pose' and 'yaw' not in one.uses:
            self._set(f'{name}.heading', 'never', f'{use}: no yaw')
        if kind == 'imu':
            self._set(f'{name}.correlation_time', 60.0, 'what a compass is wrong by lasts, so it '
                      'is estimated and bends no path')
            self._set(f'{name}.sigma_floor', [0.01, 0.1], 'how much that may be [m, rad]')
        for navsat in self.of(System.NAVSAT) if kind == 'imu' else []:
            if (angle := _angle(navsat)) != 0.0:
                self._set(f'{name}.yaw_offset', angle, place(navsat, *ANGLES))

    def type_of(self, source: str) -> str:
        """Return the type of a source, which is given or usual for its name."""
        given = self.settings.get(f'{source}.type')
        return str(given.value) if given is not None else KNOWN_SOURCES[source][0].name

    def _set(self, name: str, value: Any, why: str) -> None:
        self.settings.setdefault(name, Setting(value, why))

    # --- parameters

    def _judge(self, section: Section) -> None:
        """Note what becomes of each parameter of a node."""
        inputs = [one for one in self.names if one.section is section]
        plugins = of.plugins(section)
        told = {key for one in inputs for key in self._judge_input(one)}
        for name, value in section.values.items():
            if name in told:
                continue
            if section.system is None:
                self._note(section, name, Fate.UNKNOWN, 'of a node that is none of these systems')
            elif section.system is System.FILTER and section is not self.replaced and not (
                    self.replaced is None and name in parameters.FRAMES):
                self._note(section, name, Fate.NOT_NEEDED, 'unchanged, in the filter that stays'
                           if section is self.kept else 'of a filter that is not needed any more')
            elif section.system is System.NAVSAT and self._judge_angle(section, name, value):
                pass
            else:
                one = next((each for each in inputs if re.fullmatch(
                    rf'{re.escape(each.name)}[_.].+', name)), None)
                if one is None:
                    rule, source = _rule(section.system, plugins, name, value), ''
                else:
                    names = self.names[one]
                    source = next(iter(names.values()), '')
                    rule = rule_of(
                        'input_of_fuse' if len(plugins) > 0 else 'input',
                        f'{"+".join(names) or "none"}:{name[len(one.name) + 1:]}', value)
                self._apply(section, name, value, rule, source)

    def _judge_input(self, one: Input) -> list[str]:
        """Note what an input became; return the parameters of which that tells."""
        names = self.names[one]
        keys = [key for key in (one.topic_key, f'sensor_models.{one.name}.type', *one.use_keys)
                if key in one.section.values]
        fate, why = Fate.NONE, f'{one.topic} {one.why_unused}'
        if len(names) > 0:
            fate, why = Fate.TAKEN, 'source ' + ' and '.join(names.values())
        elif self.kept is not None and self.hears(one) and one.uses & PLANAR:
            fate, why = Fate.CHANGED, (f'{one.topic} is in the output of {self.kept.node}, which '
                                       'is the odometry here, and must not count twice')
        elif one.is_gnss:
            why = (f'{one.topic} is made of the fixes of another receiver: add a source of type '
                   'fix with their topic')
        for key in keys:
            self._note(one.section, key, fate, why)
        left = [each for each in of.STATE if each in one.uses - PLANAR]
        if len(left) > 0 and len(names) > 0:
            self._note(one.section, f'{", ".join(left)} in {one.use_keys[0]}', Fate.NONE,
                       'this node is in the plane, and takes motion from odometry alone')
        return keys

    def _judge_angle(self, section: Section, name: str, value: Any) -> bool:
        """Note what becomes of origin and angles of the map if no table can tell."""
        if name == 'datum' and section.values.get('wait_for_datum') is not True:
            self._note(section, name, Fate.NOT_NEEDED, 'navsat_transform_node does not use it '
                       'either, as wait_for_datum is false')
        elif name == 'datum' and (angle := _angle(section)) != 0.0:
            # navsat_transform_node adds them to the angle of a datum as to that of an IMU
            rule = rule_of('navsat', name, value)
            self._apply(section, name, value, rule._replace(
                why=f'{rule.why}; {" and ".join(ANGLES)} are added to it, as there'), '')
            taken = [] if '$(' in str(value) or 'datum' not in self.settings else (
                self.settings['datum'].value)
            if len(taken) > 0:
                latitude, longitude, *yaw = taken
                self.settings['datum'] = Setting([latitude, longitude, round(sum(yaw) + angle, 9)],
                                                 place(section, name, *ANGLES))
        elif name in ANGLES and value != 0.0 and len(parts := [
                *(each for each in self.settings if each.endswith('.yaw_offset')),
                *(['datum'] if section.values.get('wait_for_datum') is True
                  and 'datum' in section.values else [])]) > 0:
            self._note(section, name, Fate.TAKEN, f'part of {" and ".join(parts)}')
        else:
            return False
        return True

    def _apply(self, section: Section, name: str, value: Any, rule: Rule, source: str) -> None:
        """Note what a row of a table says of a parameter, and take its value if it says so."""
        fate, sentence = Fate[rule.fate.upper()], rule.why
        if (target := rule.target.replace('*', source, 1)) != '':
            types = {each: own.value for each, own in self.settings.items()
                     if each == 'sources' or each.endswith('.type')}
            own = {each.name: each for each in parameters.all_parameters(types)}.get(target)
            try:
                self._set(target, value if '$(' in str(value) or own is None else
                          parameters.checked_value(own, CONVERSIONS[rule.convert](value)),
                          place(section, name))
                sentence = '; '.join(filter(None, (target if target != name else '', sentence)))
            except (ConfigError, ArithmeticError, LookupError, TypeError, ValueError):
                fate, sentence = Fate.CHANGED, f'{value!r} is nothing that {target} can be'
        self._note(section, name, fate, sentence)

    def _note(self, section: Section, name: str, fate: Fate, sentence: str) -> None:
        self.entries.append(Entry(section, name, fate, sentence))


def _angle(navsat: Section) -> float:
    """Return what turns a compass to the east, of navsat_transform_node [rad]."""
    angles = [navsat.values.get(part, 0.0) for part in ANGLES]
    if any(isinstance(each, bool) or not isinstance(each, int | float) or not abs(each) < 100.0
           for each in angles):
        raise ConfigError(f'{place(navsat, *ANGLES)}: expected angles [rad], got {angles}')
    return round(sum(angles), 9)


def _rule(system: System, plugins: dict[str, str], name: str, value: Any) -> Rule:
    """Return what becomes of a parameter that is of no input."""
    model = re.fullmatch(r'(?:sensor_models|publishers)\.(.+)\.type', name)
    if (owner := model[1] if model else next(
            (each for each in plugins if name.startswith(f'{each}.')), '')) == '':
        return rule_of(system.name.lower(), name, value)
    return rule_of(plugins[owner] if plugins[owner] in TABLES else 'unknown_plugin',
                   'type' if model else name.removeprefix(f'{owner}.'), value)
