// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// How each state and each line looks, on the map as in lists and legends. States differ by colour,
// by the shape of their marks and by the dashes of their lines, so that no one needs the colours.

/** Shapes as paths of SVG around (0, 0), in pixels; `open` ones are not filled. */
const SHAPES = {
  disc: {path: 'M-3.6,0a3.6,3.6 0 1,0 7.2,0a3.6,3.6 0 1,0 -7.2,0Z', open: false},
  ring: {path: 'M-3.6,0a3.6,3.6 0 1,0 7.2,0a3.6,3.6 0 1,0 -7.2,0Z', open: true},
  triangle: {path: 'M0,-4.6L4.3,3.2H-4.3Z', open: true},
  cross: {path: 'M-3.8,-3.8L3.8,3.8M-3.8,3.8L3.8,-3.8', open: true},
  square: {path: 'M-3.6,-3.6H3.6V3.6H-3.6Z', open: true},
  diamond: {path: 'M0,-5L4.2,0L0,5L-4.2,0Z', open: false},
};
for (const shape of Object.values(SHAPES)) shape.drawn = new Path2D(shape.path);

/** Looks of the states, in the order of STATES. */
const LOOKS = [
  {colour: 'believed', shape: SHAPES.disc, dash: []},
  {colour: 'believed', shape: SHAPES.ring, dash: [9, 4]},
  {colour: 'waiting', shape: SHAPES.triangle, dash: [2, 4]},
  {colour: 'doubted', shape: SHAPES.cross, dash: [7, 3, 2, 3]},
  {colour: 'refused', shape: SHAPES.square, dash: [3, 3]},
  {colour: 'held-out', shape: SHAPES.diamond, dash: [12, 3]},
];
const [BELIEVED, WEAK, WAITING, DOUBTED, REFUSED, HELD_OUT] = LOOKS.keys();
const lookOf = (state) => LOOKS[state] || LOOKS[0];

/** Looks of the lines of the map. */
const LINES = {
  corrected: {name: 'corrected path', colour: 'path', width: 2.2, dash: []},
  odometry: {name: 'odometry, aligned', colour: 'odometry', width: 1.5, dash: [6, 4]},
  truth: {name: 'truth', colour: 'truth', width: 1.2, dash: [2, 3]},
};

/** A small picture of a mark or of a line, for lists and legends. */
function swatch({colour: name, shape, dash, width, fill: filled, solid}) {
  const paint = `var(--${name})`;
  const picture = draw('svg', {class: 'swatch', viewBox: '-13 -7 26 14', 'aria-hidden': 'true'});
  if (filled) {
    picture.append(draw('rect', {
      x: -11, y: -5, width: 22, height: 10, rx: 2, fill: paint, 'fill-opacity': filled}));
  }
  if (dash) {
    picture.append(draw('line', {
      x1: -12, x2: 12, y1: 0, y2: 0, stroke: paint, 'stroke-width': width || 1.6,
      'stroke-dasharray': dash.join(' ')}));
  }
  if (shape) {
    picture.append(draw('path', {
      d: shape.path, stroke: paint, 'stroke-width': 1.7,
      fill: shape.open && !solid ? 'var(--surface)' : paint}));
  }
  return picture;
}

/** A state as a mark with its name. */
function stateTag(state) {
  return make('span', {class: 'state'}, swatch({...lookOf(state), dash: null}),
    STATES[state] || 'unknown');
}
