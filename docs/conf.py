# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The site of `make docs`, from the same Markdown files, in their places, that GitHub shows."""

from pathlib import Path
from urllib.parse import quote

from sphinx.application import Sphinx
from sphinx.builders.html import StandaloneHTMLBuilder

project = 'pose_graph_ros'
project_copyright = '2026, the pose_graph_ros authors'
extensions = ['myst_parser']
# the source folder is that of the project, so that links of README.md and to other files hold
root_doc = 'README'
include_patterns = ['README.md', 'CONTRIBUTING.md', 'docs/**.md']
exclude_patterns = ['.*', 'build', 'install', 'log']    # not even looked through
myst_heading_anchors = 6            # by GitHub's rule
smartquotes = False                 # a parameter may be ''
html_theme = 'furo'
html_title = project
html_static_path = ['site.css']
html_css_files = ['site.css']
html_use_index = False
html_copy_source = False
html_show_sphinx = False

PARTS = {
    'Guides': ['docs/guides/*'],
    'Tools': ['docs/tools/*'],
    'Reference': ['docs/topics', 'docs/services', 'docs/parameters', 'docs/bad_data',
                  'docs/conventions', 'docs/fleet', 'docs/docker'],
    'Inside': ['docs/design', 'docs/solver', 'docs/scale', 'docs/reliability', 'docs/security',
               'CONTRIBUTING'],
    'Measured': ['docs/benchmarks/README', 'docs/benchmarks/*/README']}
"""What the list beside the pages has; a page that it lacks is an error."""


class SiteBuilder(StandaloneHTMLBuilder):
    """Pages as HTML; a README.md is the index.html of its folder."""

    name = 'html'

    def get_target_uri(self, docname: str, typ: str | None = None) -> str:
        """Return the address of a page."""
        return quote(_address(docname)) + self.link_suffix

    def get_output_path(self, page_name: str, /) -> Path:
        """Return the file of a page."""
        return Path(self.outdir, _address(page_name) + self.out_suffix)


def _address(page: str) -> str:
    return f'{page.removesuffix("README")}index' if page.endswith('README') else page


def _add_list(_: Sphinx, page: str, content: list[str]) -> None:
    """Add the list of all pages to the first one, which on GitHub would be there as code."""
    if page == root_doc:
        for caption, pages in PARTS.items():
            lines = (':hidden:', ':glob:', f':caption: {caption}', *pages)
            content[0] += '\n'.join(('\n```{toctree}', *lines, '```'))


def setup(app: Sphinx) -> None:
    """Register what this site has of its own."""
    app.add_builder(SiteBuilder, override=True)
    app.connect('source-read', _add_list)
