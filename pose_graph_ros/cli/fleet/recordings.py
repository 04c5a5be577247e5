# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Find bags, tell whether they have changed, and bring them to where they are replayed.

A bag is named by a path, or by a URL of a file system that fsspec knows.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
import glob
import hashlib
import os
from pathlib import Path
import posixpath
import re
import shutil
import sys
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import fsspec

from pose_graph_ros.adapters.bags import BAG_FILE_SUFFIXES, BagError, JOURNALS, one_line
from pose_graph_ros.cli.fleet.kept import DRIVES, UNFINISHED
from pose_graph_ros.cli.graph_input import GRAPH_SUFFIXES

LISTS = ('.txt', '.list')  # suffixes of files with a bag in each line
METADATA = 'metadata.yaml'
JOURNAL_ENDS = ('-wal', '-journal')  # of files beside a .db3
SCHEME = re.compile(r'[a-z][a-z0-9+.-]*://|[a-z0-9+.-]+::', re.IGNORECASE)
WILD = re.compile(r'[*?[]')
VERSION_OF_FILE = ('size', 'mtime', 'ETag', 'etag', 'LastModified', 'last_modified', 'updated',
                   'md5Hash', 'content_md5', 'created')
"""What file systems tell of a file that is another one if the file has changed."""


class Recording(NamedTuple):
    """A bag."""

    name: str  # for people
    path: str  # or URL
    files: tuple[str, ...] = ()  # URLs of its files, if it has to be fetched
    stamp: str = ''  # another one if the bag may have changed; empty if that is not known

    @property
    def is_remote(self) -> bool:
        """Whether it has to be fetched."""
        return len(self.files) > 0


def find_recordings(words: Iterable[str], out: Path) -> list[Recording]:
    """
    Return the bags that are meant by paths, patterns, folders, lists and URLs, each once.

    Results in the folder `out` are left out. A path where nothing is stands for a bag that only
    workers see; so does a line of a list that names no bag, so that the others are replayed.
    Raises `BagError` for a word that names no bag, or a file system that is not installed.
    """
    found: dict[str, Recording] = {}
    for word in words:
        own = [*_meant(word, out.absolute())]
        if len(own) == 0:
            raise BagError(f'{word}: no bag, expected rosbag2 folders or files ending in '
                           f'{", ".join(BAG_FILE_SUFFIXES)}')
        for each in own:
            # by a link and by its own name it is one bag
            found.setdefault(each.path if each.is_remote else os.path.realpath(each.path), each)
    return [*found.values()]


def _meant(word: str, out: Path) -> Iterator[Recording]:
    path = Path(word)
    if SCHEME.match(word):
        yield from _remote(word)
    elif path.suffix in LISTS and path.is_file():
        # as Windows writes it, it may begin with a mark
        text = path.read_text(encoding='utf-8-sig', errors='surrogateescape')
        for line in map(str.strip, text.splitlines()):
            if Path(line).suffix in LISTS:
                yield _local(line)      # a list may name itself, as that of all files in a folder
            elif line != '' and not line.startswith('#'):
                bag = os.path.expanduser(line)
                yield from [*_meant(bag, out)] or [_local(bag)]
    elif path.is_dir():
        # links last, so that a bag has its own name
        yield from map(_local, sorted(_bags_among(_files_below(path, out)), key=os.path.islink))
    elif WILD.search(word) and not path.exists():
        for each in sorted(glob.glob(os.path.expanduser(word), recursive=True)):
            if Path(each).is_dir() or _is_bag_file(each):
                yield from _meant(each, out)
    else:
        yield _local(word)


def _files_below(root: Path, out: Path) -> Iterator[str]:
    """Yield files at any depth, each once whatever links there are; none of results."""
    seen = {os.path.realpath(out / name) for name in (DRIVES, UNFINISHED)}
    for folder, folders, names in os.walk(root, onerror=_tell_left_out, followlinks=True):
        if (real := os.path.realpath(folder)) in seen:
            folders.clear()
            continue
        seen.add(real)
        folders.sort(key=lambda name: os.path.islink(os.path.join(folder, name)))
        yield from (os.path.join(folder, name) for name in names)


def _tell_left_out(error: OSError) -> None:
    print(f'left out: {error.filename}: {error.strerror}', file=sys.stderr)


def _local(path: str) -> Recording:
    # workers may be elsewhere
    # a name that is no UTF-8 has no place in a table or a message: such a bag is told, and fails
    absolute = Path(os.fsencode(os.path.abspath(path)).decode('utf-8', 'backslashreplace'))
    return Recording(_name(str(absolute)), str(absolute), stamp=stamp_of(files_of(absolute)))


def without_suffix(path: str) -> str:
    """Return the path of a bag without its suffix; a folder may have a dot in its name."""
    stem = path.removesuffix('.zstd')
    return posixpath.splitext(stem)[0] if _is_bag_file(stem) else path


def _name(path: str) -> str:
    return posixpath.basename(without_suffix(path))


def stamp_of(files: Iterable[Path]) -> str:
    """Return another text if one of the files may have changed."""
    facts = {str(each): each.stat() for each in files}
    return _digest({name: (each.st_size, each.st_mtime_ns) for name, each in facts.items()})


def files_of(path: Path) -> list[Path]:
    """Return the files of a bag, in the order of their names; none where there is none."""
    if path.is_dir():
        return sorted(each for each in path.iterdir() if each.is_file() and _belongs(each.name))
    beside = (path.with_name(f'{path.name}{end}') for end in ('', *JOURNAL_ENDS))
    return [each for each in beside if each.is_file()]


def _belongs(name: str) -> bool:
    """Return whether a file in the folder of a bag is a part of it."""
    return name == METADATA or _is_bag_file(name) or name.endswith(JOURNALS)


def _is_bag_file(name: str) -> bool:
    return name.removesuffix('.zstd').endswith((*BAG_FILE_SUFFIXES, *GRAPH_SUFFIXES))


def _bags_among(files: Iterable[str]) -> Iterator[str]:
    """Yield folders that are a bag each, and files that are one by themselves."""
    folders: dict[str, list[str]] = {}
    for file in sorted(files):
        folder, name = posixpath.split(file)
        if name == METADATA or name.removesuffix('.zstd').endswith(BAG_FILE_SUFFIXES):
            folders.setdefault(folder, []).append(name)
    for folder, names in folders.items():
        # the recorder names its files by the folder, and adds the metadata at its end
        own = re.escape(posixpath.basename(folder.rstrip('/')))
        is_cut_off = all(re.fullmatch(rf'{own}_\d+\.[\w.]+', name) for name in names) and any(
            name.startswith(f'{posixpath.basename(folder)}_0.') for name in names)
        if is_cut_off or (METADATA in names and len(names) > 1):
            yield folder
        else:
            yield from (posixpath.join(folder, name) for name in names if name != METADATA)


def _remote(url: str) -> Iterator[Recording]:
    """Yield the bags at a URL, which may be of a file, a folder or a pattern."""
    _, chain, rest = url.partition('::')    # of a file in an archive that is at another URL
    try:
        system, path = fsspec.core.url_to_fs(url)
        for root in sorted(system.glob(path)) if WILD.search(path) else [path]:
            files: dict[str, Any] = system.find(root, detail=True)
            for bag in [root] if {*files} == {root} else _bags_among(files):
                own = {each: told or system.info(each) for each, told in sorted(files.items())
                       if each == bag or (posixpath.dirname(each) == bag
                                          and _belongs(posixpath.basename(each)))}
                facts = {each: [str(told[key]) for key in VERSION_OF_FILE if told.get(key)]
                         for each, told in own.items()}
                is_known = all(len(each) > 1 for each in facts.values())    # not the size alone
                yield Recording(
                    _name(bag), system.unstrip_protocol(bag) + chain + rest,
                    tuple(system.unstrip_protocol(each) + chain + rest for each in own),
                    _digest(facts) if is_known else '')
    except Exception as error:  # of file systems of others, which raise anything
        raise BagError(f'{url}: {one_line(error)}') from error


def _digest(facts: Mapping[str, Any]) -> str:
    return hashlib.sha256(repr(facts).encode()).hexdigest() if len(facts) > 0 else ''


@contextmanager
def local_copy(recording: Recording) -> Iterator[Path]:
    """Yield the path of a bag on this machine, which is fetched first if it is elsewhere."""
    if not recording.is_remote:
        yield Path(recording.path)
        return
    with TemporaryDirectory(prefix='pose_graph_') as folder:
        # of a bag that is a folder, the files are in it
        bag, *files = (each.partition('::')[0] for each in (recording.path, *recording.files))
        path = Path(folder, posixpath.basename(bag))
        for url, file in zip(recording.files, files, strict=True):
            to = path if file == bag else path / posixpath.basename(file)
            to.parent.mkdir(exist_ok=True)
            with fsspec.open(url, 'rb') as source, to.open('wb') as target:
                shutil.copyfileobj(source, target, 1 << 20)
        yield path


def content_of(paths: Iterable[Path]) -> str:
    """Return a digest of the contents of files."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open('rb') as file:
            digest.update(hashlib.file_digest(file, 'sha256').digest())
    return digest.hexdigest()
