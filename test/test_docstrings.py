# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What docstrings must say: arguments, what comes back, what is raised."""

import ast
from collections.abc import Iterator
import functools
from pathlib import Path
import re

import pytest

import pose_graph_ros

PACKAGE = Path(pose_graph_ros.__file__).parent
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob('*.py'))
# So many arguments, without self, need a section on them.
DOCUMENTED_FROM = 2
# Annotations that do not tell shape, unit or frame. Classes and texts are told by their names.
NUMBERS = re.compile(r'Array|\b(int|float|tuple|Pose|Matrix|Variances)\b')
# Callbacks of frameworks, whose arguments are theirs.
FRAMEWORK = re.compile(r'on_(configure|activate|deactivate|cleanup|shutdown|error)$')

Function = ast.FunctionDef | ast.AsyncFunctionDef


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse((PACKAGE / path).read_text(encoding='utf-8'))


def public_functions(path: Path) -> Iterator[tuple[str, Function, str | None]]:
    """Yield name, definition and docstring; that of a class stands for its `__init__`."""
    for node in parsed(path).body:
        if isinstance(node, Function) and not node.name.startswith('_'):
            yield node.name, node, ast.get_docstring(node)
        elif isinstance(node, ast.ClassDef) and not node.name.startswith('_'):
            for item in node.body:
                if not isinstance(item, Function) or FRAMEWORK.fullmatch(item.name):
                    continue
                if item.name == '__init__':
                    yield node.name, item, ast.get_docstring(node)
                elif not item.name.startswith('_') and not is_overload(item):
                    yield f'{node.name}.{item.name}', item, ast.get_docstring(item)


def is_overload(function: Function) -> bool:
    return any('overload' in ast.unparse(decorator) for decorator in function.decorator_list)


def arguments(function: Function) -> list[ast.arg]:
    given = function.args
    # the head of the tables is the first argument of every kernel, and said in graph.tables
    return [each for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)
            if each.arg not in ('self', 'cls', 'head') and each.arg[0] != '_']


def says_all(argument: ast.arg) -> bool:
    """Tell whether the name and the annotation of an argument leave nothing to be said."""
    if argument.annotation is None:
        return False
    kind = ast.unparse(argument.annotation)
    return (kind == 'int' and argument.arg.endswith('_ns')) or NUMBERS.search(kind) is None


def section(docstring: str, title: str) -> str:
    """Return the body of a numpydoc section, empty if there is none."""
    found = re.search(rf'^{title}\n-+\n(.*?)(?=^\w+\n-+\n|\Z)', docstring, re.M | re.S)
    return '' if found is None else found[1]


def statements(function: Function) -> Iterator[ast.AST]:
    """Walk a function without the functions inside it."""
    todo: list[ast.AST] = list(function.body)
    while len(todo) > 0:
        node = todo.pop()
        yield node
        if not isinstance(node, Function | ast.Lambda | ast.ClassDef):
            todo += ast.iter_child_nodes(node)


def returns_something(function: Function) -> bool:
    return any(isinstance(node, ast.Return) and node.value is not None
               and not (isinstance(node.value, ast.Constant) and node.value.value is None)
               for node in statements(function))


def missing(function: Function, docstring: str | None) -> Iterator[str]:
    given = arguments(function)
    if docstring is None:
        yield 'a docstring'
        return
    if len(given) >= DOCUMENTED_FROM:
        described = section(docstring, 'Parameters')
        headings = re.findall(r'^(\S.*?)(?: :|$)', described, re.M)
        said = {name.strip().lstrip('*') for line in headings for name in line.split(',')}
        yield from (f'parameter {each.arg}' for each in given
                    if each.arg not in said and not says_all(each))
        first_line = docstring.strip().splitlines()[0]
        if (returns_something(function) and section(docstring, 'Returns') == ''
                and not re.match(r'(Return|Tell|Say|Yield|Evaluate|Make|Iterate)\b', first_line)):
            yield 'section Returns, or a first line that begins with Return'


@pytest.mark.parametrize('path', MODULES, ids=str)
def test_docstrings_say_what_goes_in_and_what_comes_out(path: Path) -> None:
    found = [f'{path}:{function.lineno}: {name}: {what}'
             for name, function, docstring in public_functions(path)
             for what in missing(function, docstring)]
    assert not found, '\n'.join(found)


@pytest.mark.parametrize('path', MODULES, ids=str)
def test_no_docstring_goes_on_in_the_next(path: Path) -> None:
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(
                node.value.value, str):
            text = node.value.value.strip()
            assert not text.startswith('...'), f'{path}:{node.lineno}'
            assert not text.endswith('...'), f'{path}:{node.lineno}'


@pytest.mark.parametrize('path', MODULES, ids=str)
def test_a_package_says_what_happens_in_it(path: Path) -> None:
    if path.name == '__init__.py' and len(path.parts) > 1:
        docstring = ast.get_docstring(parsed(path))
        assert docstring is not None
        assert docstring.count('. ') + docstring.count('.\n') + docstring.endswith('.') >= 3, path
