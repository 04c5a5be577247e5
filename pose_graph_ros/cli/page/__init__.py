# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The page of `pose-graph report`: one HTML file that needs nothing but a browser.

The data of a run come in as a JSON object; `docs/tools.md` lists its keys. A text comes out that
holds them with style and script, and that asks no network for anything. Read first `render`, which
puts the parts together, then the end of `sections.js`, which lists the sections. Colours are in
`report.css`; `vendor/` has uPlot and Leaflet as they are published, with their licences.
"""
