# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation names only what there is: files, links, modules, classes and functions."""

import ast
import functools
import importlib
import inspect
from pathlib import Path
import re

import pytest

import pose_graph_ros
from pose_graph_ros import core

PACKAGE = Path(pose_graph_ros.__file__).parent
ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((*ROOT.glob('*.md'), *ROOT.glob('docs/**/*.md')))
README_LINES = 110


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@functools.cache
def definitions() -> set[str]:
    """Return the names of modules, classes, functions and `Class.member`s of the package."""
    names = set()
    for path in PACKAGE.rglob('*.py'):
        names.add(path.stem)
        tree = ast.parse(path.read_text(encoding='utf-8'))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                names.add(node.name)
                names.add(f'{path.stem}.{node.name}')
            if isinstance(node, ast.ClassDef):
                names |= {f'{node.name}.{item.name}' for item in node.body
                          if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef)}
    return names


def without_code(page: Path) -> str:
    return re.sub(r'^```.*?^```', '', page.read_text(encoding='utf-8'), flags=re.M | re.S)


def quoted(page: Path) -> list[str]:
    """Return what stands in backticks outside blocks of code."""
    return re.findall(r'`([^`\n]+)`', without_code(page))


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_files_that_are_named_exist(page: Path) -> None:
    for name in quoted(page):
        if re.fullmatch(r'[\w/{},]+/\w+\.py', name) is None:
            continue
        places = (ROOT, PACKAGE, PACKAGE / 'core')
        assert any((place / name).is_file() for place in places), f'{name_of(page)}: {name}'


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_what_a_page_says_is_in_a_file_is_there(page: Path) -> None:
    text = page.read_text(encoding='utf-8')
    for name, module in re.findall(r'`([\w.]+)`\s(?:in\s|\()`([\w/]+\.py)`', text):
        files = [place / module for place in (ROOT, PACKAGE, PACKAGE / 'core')]
        found = next(file for file in files if file.is_file()).read_text(encoding='utf-8')
        assert re.search(rf'\b{name.rpartition(".")[2]}\b', found), f'{name_of(page)}: {name}'


@functools.cache
def anchors(page: Path) -> set[str]:
    """Return what `#` may lead to: the headings, as GitHub makes anchors of them."""
    names: list[str] = []
    for title in re.findall(r'^#+ (.*)$', without_code(page), flags=re.M):
        text = re.sub(r'\[([^]]*)\]\([^)]*\)', r'\1', title).lower()
        name = re.sub(r'[^\w -]', '', text).replace(' ', '-')
        names.append(f'{name}-{names.count(name)}' if name in names else name)
    return set(names)


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r'`[^`\n]+`', '', without_code(page))
    for file, anchor in re.findall(r'\]\(([^)#\s]*)#?([^)\s]*)\)', text):
        if '://' in file:
            continue
        target = page.parent / file if file else page
        # a link to a folder shows its list of files on GitHub, and nothing in the site
        assert target.is_file(), f'{name_of(page)}: {file}'
        if anchor:
            assert anchor in anchors(target), f'{name_of(page)}: {file}#{anchor}'


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_classes_and_their_members_that_are_named_exist(page: Path) -> None:
    names = definitions()
    for name in (quoted_name.removesuffix('()') for quoted_name in quoted(page)):
        if re.fullmatch(r'[A-Z][a-zA-Z]+\.[a-z_]+', name) and name.partition('.')[0] in names:
            assert name in names, f'{name_of(page)}: {name}'


def test_the_stories_of_the_design_name_only_what_there_is() -> None:
    text = (ROOT / 'docs' / 'design.md').read_text(encoding='utf-8')
    stories = text[text.index('### One odometry message'):text.index('## Saved graphs')]
    for name in re.findall(r'`([A-Za-z_.]+)(?:\(\))?`', stories):
        if not name.endswith('.py') and '/' not in name:
            assert name in definitions(), name


def test_the_readme_fits_on_two_screens() -> None:
    assert len((ROOT / 'README.md').read_text(encoding='utf-8').splitlines()) <= README_LINES


@pytest.mark.parametrize('page', ['README.md', 'docker/Dockerfile'])
def test_what_ubuntu_lacks_is_left_out_of_rosdep_and_installed_by_pip(page: str) -> None:
    text = (ROOT / page).read_text(encoding='utf-8')
    (keys,) = re.findall(r"--skip-keys '([^']+)'", text)
    (line,) = re.findall(r"pip install --break-system-packages .*", text)
    package = (ROOT / 'package.xml').read_text(encoding='utf-8')
    requirements = (ROOT / 'setup.py').read_text(encoding='utf-8')
    for key in keys.split():
        assert f'>{key}<' in package, key
        name = key.removeprefix('python3-').removesuffix('-pip')
        (requirement,) = re.findall(rf"'({name}>=[^']+)'", requirements)
        assert f"'{requirement}'" in line, 'rosdep would fail: PEP 668'
    assert re.findall(r'>(python3-\S+-pip)<', package) == [
        key for key in keys.split() if key.endswith('-pip')], 'pip keys'


def test_the_container_copies_what_the_package_is_made_of() -> None:
    ignored = (ROOT / '.dockerignore').read_text(encoding='utf-8').split()
    needed = {'pose_graph_ros', 'launch', 'config', 'resource', 'dev', 'package.xml', 'setup.py',
              'setup.cfg', 'LICENSE'}
    assert not needed & set(ignored)
    assert all((ROOT / name).exists() for name in needed)


def test_what_users_call_has_a_docstring() -> None:
    named = []
    for item in re.findall(r'^- (`.*?):', inspect.getdoc(core) or '', re.M):
        module = ''
        for name in re.findall(r'`([^`]+)`', item):
            # the module of the first name of an item is that of the others, too
            module = name.rpartition('.')[0] or module
            found = importlib.import_module(f'pose_graph_ros.core.{module}')
            named.append(getattr(found, name.rpartition('.')[2]))
    for path in sorted((PACKAGE / 'cli').glob('*.py')):
        tool = importlib.import_module(f'pose_graph_ros.cli.{path.stem}')
        named += [getattr(tool, door) for door in ('add_arguments', 'execute')
                  if hasattr(tool, door)]
    assert len(named) > 30
    # (a dataclass that has none gets its signature)
    assert not [one for one in named
                if not one.__doc__ or one.__doc__.startswith(f'{one.__name__}(')]


@pytest.mark.parametrize('page', PAGES, ids=name_of)
def test_tests_that_a_page_names_exist(page: Path) -> None:
    for file, name in re.findall(r'`(test/[\w/]+\.py)::(\w+)`', page.read_text(encoding='utf-8')):
        assert f'\ndef {name}(' in (ROOT / file).read_text(encoding='utf-8'), f'{file}::{name}'


def test_the_list_beside_the_pages_of_the_site_has_each_of_them() -> None:
    text = (ROOT / 'docs' / 'conf.py').read_text(encoding='utf-8')
    parts = ast.literal_eval(re.search(r'^PARTS = ({.*?})$', text, flags=re.M | re.S)[1])
    listed = [re.sub(r'.*<(.*)>', r'\1', name) for names in parts.values() for name in names]
    pages = {page.relative_to(ROOT).with_suffix('') for page in ROOT.glob('docs/**/*.md')}
    assert not {page for page in pages if not any(page.match(name) for name in listed)}


@pytest.mark.parametrize('folder', ['guides', 'tools'])
def test_the_readme_of_a_folder_lists_its_other_pages(folder: str) -> None:
    pages = {page.name for page in ROOT.glob(f'docs/{folder}/*.md')} - {'README.md'}
    listed = (ROOT / 'docs' / folder / 'README.md').read_text(encoding='utf-8')
    assert not {name for name in pages if f']({name})' not in listed}
