// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// The section with the map: the picture, its controls, the layers, the time and the panel.

/** Put the map on the page; returns what other sections do with it. */
function showMap() {
  const lines = DATA.lines || {};
  const host = section('map', 'Map');
  if (!lines.corrected || lines.corrected.x.length === 0) {
    host.append(nothing('No path: the run made no hidden nodes.'));
    return {choose: () => {}};
  }
  const layers = makeLayers();
  const stage = make('div', {class: 'stage'});
  const side = make('div', {class: 'side'});
  host.append(make('div', {class: 'map-grid'}, make('div', {class: 'map-main'}, stage), side));

  const frame = {view: null, width: 0, height: 0, points: 0,
    picture: {canvas: document.createElement('canvas'), seen: null, painted: 0,
      oldest: OLDEST}};
  const surface = canvasIn(stage, {
    id: 'map-canvas', class: 'map', tabindex: '0', role: 'application',
    'aria-roledescription': 'map',
    'aria-label': 'Map of the drive. Arrow keys pan, plus and minus zoom, 0 shows all, Enter '
      + 'chooses what is nearest to the middle, Escape chooses nothing.',
  }, ({width, height}) => {
    if (width !== frame.width || height !== frame.height) {
      // as much is seen as before, and all if all was seen
      const change = Math.min(width / frame.width, height / frame.height);
      if (frame.width === 0 || view.fits(box, frame)) view.fit(box, false);
      else view.set(view.x, view.y, view.scale * change);
      Object.assign(frame, {width, height});
    }
    paintMap(layers, surface, frame);
  });
  surface.reset = () => { frame.picture.seen = null; };
  const view = makeView(surface, () => {
    surface.canvas.dataset.view = `${view.x} ${view.y} ${view.scale}`;
    surface.later();
  });
  frame.view = view;
  const box = boxOf(layers);
  const fit = () => view.fit(box);

  const choose = (item) => {
    const layer = layers.find((each) => (item.spring ? each.id === 'springs'
      : each.table === item.table));
    if (layer) {
      layer.shown = true;
      if (layer.states) layer.states.add(item.state);
    }
    for (const update of updates) update();
    surface.reset();
    lookAtItem(item);
    if (item.times.length > 0) lookAtTime(item.times[item.times.length - 1]);
    centreOn(item, view, surface, box);
  };
  const label = make('div', {class: 'readout', hidden: true});
  stage.append(label);
  addGestures(surface, view, {
    onFit: fit,
    onPick: (u, v, within) => {
      const item = pick(layers, view, u, v, within);
      lookAtItem(item);
      if (!item) return;
      lookAtTime(item.times[item.times.length - 1]);
      bringIntoView(document.getElementById('panel'));
    },
    onHover: (u, v) => hover(layers, view, surface, lines.corrected, label, u, v),
  });
  stage.append(mapButtons(view, fit));
  const updates = showLayers(side, layers, surface);
  makePanel(side, {onCentre: choose});
  showTime(host.querySelector('.map-main'), lines.corrected);
  for (const [kind, tables] of [['fixes', DATA.fixes || []], ['closures', DATA.closures || []]]) {
    for (const {source, left_out: leftOut} of tables.filter((table) => table.left_out > 0)) {
      host.append(make('p', {class: 'note'}, `${source}: ${number(leftOut, 9)} more ${
        kind} are not shown, nearly all of which are believed.`));
    }
  }
  const lists = make('div', {class: 'lists'});
  host.append(lists);
  listRejected(lists, 'closure', DATA.closures || [],
    {title: 'Doubted and refused closures', onChoose: choose, open: true});
  listRejected(lists, 'fix', DATA.fixes || [],
    {title: 'Doubted and refused fixes', onChoose: choose, open: false});
  followers.time.push(surface.later);
  followers.item.push(surface.later);
  return {choose};
}

/** The box that shows the path and the truth as a whole, and other marks if they are near. */
function boxOf(layers) {
  const near = layers.filter((layer) => layer.id === 'corrected' || layer.id === 'truth');
  const others = layers.filter((layer) => layer.id === 'odometry' || layer.kind);
  const columns = (of, name) => of.flatMap((layer) => [
    (layer.line || layer.table)[name] || (layer.table || {})[`${name}0`]]);
  const [[left, right], [bottom, top]] = ['x', 'y'].map(
    (name) => extent(...columns(near, name)) || [0, 1]);
  const room = 0.15 * Math.max(right - left, top - bottom, 10);
  const clipTo = (name, low, high) => {
    const [least, most] = extent(...columns(others, name)) || [low, high];
    return [Math.max(Math.min(least, low), low - room), Math.min(Math.max(most, high), high + room)];
  };
  const [x, y] = [clipTo('x', left, right), clipTo('y', bottom, top)];
  return {left: x[0], right: x[1], bottom: y[0], top: y[1]};
}

/** Show an item with what is around it. */
function centreOn(item, view, surface, box) {
  surface.canvas.scrollIntoView({
    behavior: CALM.matches ? 'auto' : 'smooth', block: 'nearest'});
  const [x, y] = middleOf(item.ends);
  const apart = Math.max(...item.ends.map((end) => Math.hypot(end[0] - x, end[1] - y)), 0);
  const whole = Math.max(box.right - box.left, box.top - box.bottom);
  const half = Math.max(1.4 * apart, Math.min(0.06 * whole, 60), 2);
  const size = Math.min(surface.canvas.clientWidth, surface.canvas.clientHeight);
  view.flyTo(x, y, size / 2 / half);
}

/** Scroll as little as needed, if nearly nothing of an element can be seen. */
function bringIntoView(node) {
  if (node.getBoundingClientRect().top > window.innerHeight - 120) {
    node.scrollIntoView({behavior: CALM.matches ? 'auto' : 'smooth', block: 'nearest'});
  }
}

/** The pointer on the map marks the time at which the robot was there. */
function hover(layers, view, surface, path, label, u, v) {
  const item = u === null ? null : pick(layers, view, u, v, 9);
  label.hidden = item === null;
  if (u === null) return;
  surface.canvas.style.cursor = item ? 'pointer' : 'grab';
  if (item) {
    label.replaceChildren(make('b', {}, item.id || item.source),
      make('span', {}, item.spring ? 'spring' : STATES[item.state]));
    const left = u > surface.canvas.clientWidth / 2;
    Object.assign(label.style, {
      left: left ? 'auto' : `${u + 14}px`,
      right: left ? `${surface.canvas.clientWidth - u + 14}px` : 'auto', top: `${v + 12}px`});
  }
  const [x, y] = view.toMap(u, v);
  let [best, found] = [14 / view.scale, null];
  for (let k = 0; k < path.x.length; k += 1) {
    const apart = Math.abs(path.x[k] - x) + Math.abs(path.y[k] - y);
    if (apart < best) [best, found] = [apart, path.t[k]];
  }
  if (found !== null) lookAtTime(found);
}

// --- controls -----------------------------------------------------------------------------------

function mapButtons(view, fit) {
  const button = (label, sign, onclick) => make(
    'button', {type: 'button', 'aria-label': label, title: label, onclick}, sign);
  return make('div', {class: 'map-buttons'},
    button('Zoom in', '+', () => view.zoom(1.6)),
    button('Zoom out', '−', () => view.zoom(1 / 1.6)),
    button('Show all', draw('svg', {viewBox: '0 0 16 16', 'aria-hidden': 'true'},
      draw('path', {d: 'M2,6V2H6M10,2H14V6M14,10V14H10M6,14H2V10', fill: 'none',
        stroke: 'currentColor', 'stroke-width': 1.8})), fit));
}

/** A box to tick for each layer, and for each state of measurements; returns how to show them. */
function showLayers(host, layers, surface) {
  const updates = [];
  const tick = (text, mark, count, read, write) => {
    const input = make('input', {type: 'checkbox', onchange: () => {
      write(input.checked);
      surface.reset();
      surface.later();
    }});
    updates.push(() => { input.checked = read(); });
    return make('label', {}, input, swatch(mark), make('span', {class: 'label'}, text),
      make('span', {class: 'count'}, number(count, 6)));
  };
  const list = make('ul', {class: 'layers', 'aria-label': 'Layers of the map'});
  for (const layer of [...layers].reverse()) {
    const row = make('li', {'data-layer': layer.id}, tick(layer.name, layer.swatch, layer.count,
      () => layer.shown, (on) => { layer.shown = on; }));
    if (layer.counts) {
      row.append(make('ul', {class: 'states'}, layer.counts.flatMap((count, state) => (
        count === 0 ? [] : [make('li', {'data-state': state}, tick(STATES[state],
          {...lookOf(state), dash: layer.kind === 'fix' ? null : lookOf(state).dash}, count,
          () => layer.states.has(state),
          (on) => (on ? layer.states.add(state) : layer.states.delete(state))))]))));
    }
    if (layer.id === 'ellipses') row.append(sizeOfEllipses(layer, surface));
    list.append(row);
  }
  host.append(make('details', {class: 'layer-box', open: true},
    make('summary', {}, 'Layers'), list));
  for (const update of updates) update();
  return updates;
}

function sizeOfEllipses(layer, surface) {
  const choice = make('select', {'aria-label': 'Size of the covariance ellipses',
    onchange: () => {
      layer.factor = Number(choice.value);
      surface.reset();
      surface.later();
    }}, [1, 3, 10, 30, 100].map((factor) => make('option', {value: factor},
    factor === 1 ? 'true to scale' : `${factor} times as large`)));
  return make('div', {class: 'choice'}, choice);
}

/** The slider that tells where the robot was at a time. */
function showTime(host, path) {
  const [first, last] = [path.t[0], path.t[path.t.length - 1]];
  const slider = make('input', {
    type: 'range', id: 'time', min: first, max: last, step: 'any', value: first,
    'aria-label': 'Time of the drive', oninput: () => lookAtTime(Number(slider.value))});
  slider.addEventListener('keydown', (event) => {
    const step = {ArrowLeft: -0.005, ArrowRight: 0.005, PageDown: -0.05, PageUp: 0.05}[event.key];
    if (step === undefined) return;
    event.preventDefault();
    lookAtTime(Math.min(last, Math.max(first, Number(slider.value) + step * (last - first))));
  });
  const text = make('output', {for: 'time', id: 'where'});
  host.append(make('div', {class: 'time'}, slider, text));
  const say = (time) => {
    if (time === null) {
      text.textContent = 'Move the slider, or point at the path or at a chart, to see where the '
        + 'robot was.';
      return;
    }
    slider.value = time;
    const pose = poseAt(path, time);
    const offset = DATA.offset || [0, 0];
    const day = timeOfDay(time);
    slider.setAttribute('aria-valuetext', clock(time));
    text.replaceChildren(make('b', {}, clock(time)), day ? ` · ${day}` : '',
      ` · ${(pose.x + offset[0]).toFixed(2)}, ${(pose.y + offset[1]).toFixed(2)} m`,
      known(pose.theta) ? ` · ${number(degrees(pose.theta))}°` : '');
  };
  followers.time.push(say);
  say(null);
}

/** Where the robot was at a time, between two poses of the path. */
function poseAt({t, x, y, theta}, time) {
  const k = nearest(t, time);
  const before = Math.max(0, t[k] <= time ? k : k - 1);
  const after = Math.min(t.length - 1, before + 1);
  const span = t[after] - t[before];
  const part = span > 0 ? Math.min(1, Math.max(0, (time - t[before]) / span)) : 0;
  const between = (column) => column[before] + part * (column[after] - column[before]);
  return {x: between(x), y: between(y), theta: theta ? theta[part < 0.5 ? before : after] : null};
}

// --- the picture --------------------------------------------------------------------------------

/** Above so many points a picture of the layers is moved with the map, and seldom painted anew. */
const HEAVY = 6000;
/** How old it may become meanwhile: at least so much [ms], and so many times what it takes. */
const [OLDEST, TIMES] = [250, 8];

function paintMap(layers, surface, frame) {
  const {context, canvas} = surface;
  const {view, picture} = frame;
  const now = performance.now();
  const seen = [view.x, view.y, view.scale, canvas.width, canvas.height];
  const same = picture.seen && seen.every((value, k) => value === picture.seen[k]);
  const resized = !picture.seen || seen[3] !== picture.seen[3] || seen[4] !== picture.seen[4];
  if (!same && (resized || frame.points < HEAVY || now - picture.painted >= picture.oldest)) {
    paintLayers(layers, canvas, frame);
    Object.assign(picture, {seen, painted: now});
    requestAnimationFrame(() => {
      picture.oldest = Math.max(OLDEST, TIMES * (performance.now() - now));
    });
  } else if (!same) {
    clearTimeout(picture.again);
    picture.again = setTimeout(() => {
      picture.painted = -Infinity;
      surface.later();
    }, OLDEST);
  }
  const [x, y, scale] = picture.seen;
  const [left, top] = view.toScreen(x, y);
  const [width, height] = [frame.width, frame.height].map((size) => (size * view.scale) / scale);
  context.drawImage(picture.canvas, left - width / 2, top - height / 2, width, height);
  if (focus.item) paintChosen(focus.item, context, frame);
  if (focus.time !== null) paintRobot(DATA.lines.corrected, context, frame);
  paintScaleBar(context, frame);
  paintNorth(context, frame);
}

/** Paint the layers on a canvas of their own. */
function paintLayers(layers, {width, height}, frame) {
  const {canvas} = frame.picture;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
  const context = canvas.getContext('2d');
  context.setTransform(width / frame.width, 0, 0, height / frame.height, 0, 0);
  context.clearRect(0, 0, frame.width, frame.height);
  frame.points = 0;
  paintGrid(context, frame);
  const shown = layers.filter((layer) => layer.shown);
  const later = shown.filter((layer) => layer.id === 'corrected' || layer.id === 'springs');
  for (const layer of shown) {
    if (!later.includes(layer)) layer.paint(layer, context, frame, BELOW);
  }
  for (const layer of later) layer.paint(layer, context, frame);
  for (const layer of shown) if (layer.kind) layer.paint(layer, context, frame, ABOVE);
}

/** Lines at round coordinates, with these at the left and at the lower border. */
function paintGrid(context, {view, width, height}) {
  const [left, top] = view.toMap(0, 0);
  const [right, bottom] = view.toMap(width, height);
  const step = niceStep(110 / view.scale);
  const unit = step >= 1000 ? 1000 : 1;
  const labels = [];
  context.strokeStyle = colour('grid');
  context.lineWidth = 1;
  context.beginPath();
  for (const x of multiples(step, left, right)) {
    const u = Math.round(view.toScreen(x, 0)[0]) + 0.5;
    context.moveTo(u, 0);
    context.lineTo(u, height);
    if (u > 70 && u < width - 20) labels.push([number(x / unit, 6), u, height - 6, 'center']);
  }
  for (const y of multiples(step, bottom, top)) {
    const v = Math.round(view.toScreen(0, y)[1]) + 0.5;
    context.moveTo(0, v);
    context.lineTo(width, v);
    if (v > 12 && v < height - 60) labels.push([number(y / unit, 6), 6, v - 3, 'left']);
  }
  context.stroke();
  for (const [text, u, v, align] of labels) halo(context, text, u, v, align);
}

/** A text that can be read on whatever is below it. */
function halo(context, text, u, v, align = 'left', name = 'muted') {
  context.font = FONT;
  context.textBaseline = 'alphabetic';
  context.textAlign = align;
  context.lineJoin = 'round';
  context.strokeStyle = colour('surface');
  context.lineWidth = 3;
  context.strokeText(text, u, v);
  context.fillStyle = colour(name);
  context.fillText(text, u, v);
}

function paintScaleBar(context, {view, width, height}) {
  const metres = niceStep(60 / view.scale);
  const [long, right, v] = [metres * view.scale, width - 16, height - 30];
  for (const [name, thick] of [['surface', 5], ['ink', 2]]) {
    context.strokeStyle = colour(name);
    context.lineWidth = thick;
    context.beginPath();
    context.moveTo(right - long, v - 5);
    context.lineTo(right - long, v);
    context.lineTo(right, v);
    context.lineTo(right, v - 5);
    context.stroke();
  }
  halo(context, length(metres), right - long / 2, v - 5, 'center', 'ink');
}

/** Where the axes of the map lead: north up, or x to the right and y up. */
function paintNorth(context, {height}) {
  const axes = DATA.axes || ['x', 'y'];
  const [u, v, long] = [16, height - 26, 30];
  context.strokeStyle = colour('ink');
  context.lineWidth = 1.6;
  context.beginPath();
  context.moveTo(u, v - long);
  context.lineTo(u, v);
  context.lineTo(u + long, v);
  context.moveTo(u - 4, v - long + 6);
  context.lineTo(u, v - long);
  context.lineTo(u + 4, v - long + 6);
  context.moveTo(u + long - 6, v - 4);
  context.lineTo(u + long, v);
  context.lineTo(u + long - 6, v + 4);
  context.stroke();
  halo(context, `${axes[1]} [m]`, u + 8, v - long + 5, 'left', 'ink');
  halo(context, `${axes[0]} [m]`, u + long + 5, v + 4, 'left', 'ink');
}

/** A frame around what is chosen, and a line from a fix to where the robot was. */
function paintChosen(item, context, {view}) {
  const places = item.ends.map((end) => view.toScreen(...end));
  const line = (from, to, name, thick) => {
    context.strokeStyle = colour(name);
    context.lineWidth = thick;
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.stroke();
  };
  const name = item.spring ? 'spring' : lookOf(item.state).colour;
  if (item.tie) line(places[0], view.toScreen(...item.tie), name, 1.5);
  if (places.length === 2) {
    line(...places, 'surface', 9);
    line(...places, name, 4.5);
  }
  for (const [u, v] of places) {
    for (const [ring, thick] of [['surface', 6], ['ink', 2.4]]) {
      context.strokeStyle = colour(ring);
      context.lineWidth = thick;
      context.beginPath();
      context.arc(u, v, 10, 0, 7);
      context.stroke();
    }
  }
  if (!item.spring) stamp(lookOf(item.state).shape, name, context, ...middleOf(places), 1.3);
}

/** The robot as an arrow where it was at the time that is looked at. */
function paintRobot(path, context, {view}) {
  const pose = poseAt(path, focus.time);
  const [u, v] = view.toScreen(pose.x, pose.y);
  context.save();
  context.translate(u, v);
  context.rotate(-(pose.theta || 0));
  context.beginPath();
  if (known(pose.theta)) context.moveTo(13, 0);
  for (const [x, y] of [[-8, 7.5], [-4.5, 0], [-8, -7.5]]) context.lineTo(x, y);
  context.closePath();
  context.lineJoin = 'round';
  context.strokeStyle = colour('surface');
  context.lineWidth = 5;
  context.stroke();
  context.fillStyle = colour('ink');
  context.fill();
  context.restore();
}
