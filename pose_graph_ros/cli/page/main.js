// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// What is on the page, from top to bottom.

showHead();
showContents();
const map = showMap();
showErrors();
showSources();
showSprings(map);
showUpdates();
showSparsity();
document.getElementById('foot').append(make('p', {},
  'Made by pose-graph report. This file holds all its data, and loads nothing.'));

// on paper the page is light and has all findings, whatever it is on the screen
let onScreen = null;
let folded = [];
window.addEventListener('beforeprint', () => {
  onScreen = document.documentElement.dataset.scheme;
  folded = [...document.querySelectorAll('details.good:not([open])')];
  for (const each of folded) each.open = true;
  document.documentElement.classList.add('paper');
  setScheme('light');
  // nothing is painted any more while it is printed
  for (const surface of surfaces) surface.paint(2);
});
window.addEventListener('afterprint', () => {
  document.documentElement.classList.remove('paper');
  for (const each of folded) each.open = false;
  setScheme(onScreen || 'light');
});
