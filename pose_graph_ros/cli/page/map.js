// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// The map: Leaflet moves and zooms it, in metres (latitude is y, longitude is x). What is on it is
// painted on two canvases: the layers, when the map has come to rest, and above them what follows
// the reader. Measurements and springs are items: what a click finds and the panel shows.

/** Put the map on the page; returns how to choose an item, and how to zoom to parts of the drive. */
function showMap() {
  const host = section('map', 'Map');
  const path = DATA.lines.corrected;
  const stage = make('div', {class: 'stage', id: 'stage', role: 'application',
    'aria-roledescription': 'map',
    'aria-label': 'Map of the drive. Arrow keys pan, plus and minus zoom, 0 shows all, Enter '
      + 'chooses what is nearest to the middle, Escape chooses nothing.'});
  const main = make('div', {}, stage);
  const side = make('div', {class: 'side'});
  host.append(make('div', {class: 'map-grid'}, main, side));
  const layers = makeLayers();
  const items = layers.flatMap((layer) => layer.items || []);
  const map = L.map(stage, {crs: L.CRS.Simple, zoomSnap: 0, minZoom: -14, maxZoom: 8,
    attributionControl: false, keyboardPanDelta: 60, bounceAtZoomLimits: false,
    wheelPxPerZoomLevel: 120, inertia: !CALM.matches, zoomAnimation: !CALM.matches});
  if (CALM.matches) {
    map.panBy = (offset) => L.Map.prototype.panBy.call(map, offset, {animate: false});
  }
  const box = boxOf(layers);
  let fitted = null;
  const fit = () => {
    map.fitBounds(boxOf(layers), {padding: [30, 35], animate: false});
    fitted = map.getZoom();
  };
  fit();
  const below = new Painted({padding: 0.25, paint: (...of) => {
    paintLayers(layers, ...of);
    // of two canvases the upper one hides the other on paper
    if (isPaper()) paintFocus(path, ...of);
  }}).addTo(map);
  const above = new Painted({padding: 0, paint: (...of) => paintFocus(path, ...of)}).addTo(map);
  L.control.scale({imperial: false, position: 'bottomright'}).addTo(map);
  stage.append(make('p', {class: 'axes'}, `↑ ${DATA.axes[1]} [m] → ${DATA.axes[0]} [m]`));
  stage.querySelector('.leaflet-control-zoom').append(make('a', {href: '#', role: 'button',
    title: 'Show all', 'aria-label': 'Show all', onclick: (event) => {
      event.preventDefault();
      fit();
    }}, 'all'));
  const tell = () => {
    const {lng, lat} = map.getCenter();
    stage.dataset.view = `${lng} ${lat} ${2 ** map.getZoom()}`;
    above._update();
  };
  map.on('move zoom', tell);
  tell();
  repaints.push(() => {
    map.invalidateSize({animate: false});
    below._update();
    above._update();
  });
  // what was shown as a whole stays so; as long as a page is changed for paper, see `printWhole`
  map.on('resize', ({newSize}) => {
    if (map.getZoom() === fitted && newSize.x > 100 && !isPaper()) fit();
  });

  const tick = showLayers(side, layers, () => below._update());
  const choose = (item) => {
    const layer = layers.find((each) => (each.items || []).includes(item));
    layer.shown = true;
    if (layer.states) layer.states.add(item.state);
    tick();
    below._update();
    lookAtItem(item);
    if (!item.times.some(isShownTime)) showSpan(-Infinity, Infinity);
    lookAtTime(item.times[item.times.length - 1]);
    const [x, y] = middleOf(item.ends);
    const apart = Math.max(...item.ends.map((end) => Math.hypot(end[0] - x, end[1] - y)));
    lookNear([x, y], 1.4 * apart);
  };
  /** Show a place and what is around it. */
  const lookNear = ([x, y], radius) => {
    const half = Math.max(radius, Math.min(0.06 * (box.getEast() - box.getWest()), 60), 2);
    map.fitBounds([[y - half, x - half], [y + half, x + half]], {animate: !CALM.matches});
    stage.scrollIntoView({block: 'nearest'});
  };
  /** Mark parts of the drive, each from a time to another, and show them. */
  const zoomTo = (spans) => {
    showSpan(-Infinity, Infinity);
    lookAtItem(null);
    focus.spans = spans;
    lookAtTime(spans[0][0]);
    const places = [path, DATA.lines.other || path].flatMap(
      (line) => spans.flatMap((part) => alongPath(line, part)));
    const [[left, right], [low, high]] = [0, 1].map((axis) => extent(places.map((at) => at[axis])));
    lookNear([(left + right) / 2, (low + high) / 2], 0.6 * Math.max(right - left, high - low));
    above._update();
  };
  const shown = () => layers.filter((layer) => layer.shown);
  const pick = ({lng, lat}, pixels) => {
    const item = nearestItem(shown(), lng, lat, 2 ** map.getZoom(), pixels);
    lookAtItem(item);
    if (!item) return;
    lookAtTime(item.times[item.times.length - 1]);
    const panel = document.getElementById('panel');
    if (panel.getBoundingClientRect().top > window.innerHeight - 120) panel.scrollIntoView({block: 'nearest'});
  };
  map.on('click', ({latlng, originalEvent: {pointerType}}) => pick(
    latlng, pointerType === 'touch' || pointerType === 'pen' ? 18 : 9));
  stage.addEventListener('keydown', (event) => {
    const action = {0: fit, Escape: () => lookAtItem(null),
      Enter: () => pick(map.getCenter(), Infinity)}[event.key];
    if (action && event.target === stage) action();
  });
  const label = L.tooltip({direction: 'auto', offset: [12, 0]});
  map.on('mousemove', ({latlng}) => {
    const scale = 2 ** map.getZoom();
    const item = nearestItem(shown(), latlng.lng, latlng.lat, scale, 9);
    stage.classList.toggle('on-item', item !== null);
    if (!item) label.remove();
    else label.setLatLng(latlng).setContent(make('span', {}, make('b', {}, item.id || item.source),
      make('br'), item.spring ? 'spring' : STATES[item.state])).addTo(map);
    lookAtTime(timeAt(path, latlng, 14 / scale));
  });
  map.on('mouseout', () => label.remove());
  scrollBeforeZoom(map, stage);
  printWhole(map);
  followers.time.push(() => above._update());
  followers.item.push(() => above._update());
  showTime(main, path);
  const showSpan = makeSpan(main, path, () => {
    below._update();
    above._update();
  });
  makePanel(side, choose);
  const tables = [...(DATA.fixes || []), ...(DATA.closures || [])];
  for (const {source, left_out: leftOut} of tables.filter((each) => each.left_out > 0)) {
    host.append(make('p', {class: 'note'}, `${source}: ${number(leftOut, 9)} more measurements are `
      + 'not shown, nearly all of which are believed.'));
  }
  host.append(make('div', {class: 'lists'}, listRejected('closure', items, choose),
    listRejected('fix', items, choose)));
  if (DATA.kind === 'comparison' && items.every(({kind}) => kind === 'spring')) {
    host.append(nothing('No fix and no closure is used in one of the runs and not in the other.'));
  }
  return {choose, zoomTo};
}

/** The box that shows the path and the truth as a whole. */
function boxOf(layers) {
  const lines = layers.filter(({id}) => ['corrected', 'truth', 'other'].includes(id));
  const places = lines.flatMap(({line: {t, x, y}}) => x.map((each, k) => [y[k], each]).filter(
    (_, k) => !t || isShownTime(t[k])));
  return L.latLngBounds(places).pad(0.03);
}

/** The wheel zooms, unless it has begun to scroll the page before the map came under it. */
function scrollBeforeZoom({scrollWheelZoom}, stage) {
  let last = -Infinity;
  window.addEventListener('wheel', ({target, timeStamp}) => {
    const scrolls = !scrollWheelZoom.enabled() && timeStamp - last < 200;
    scrollWheelZoom[!stage.contains(target) || scrolls ? 'disable' : 'enable']();
    last = timeStamp;
  }, {passive: true, capture: true});
}

/** On paper there is the same part of the map, whatever the size of the paper. */
function printWhole(map) {
  let seen = null;
  followers.print.push((begins) => {
    const bounds = map.getBounds();
    if (begins) seen = [map.getCenter(), map.getZoom()];
    map.invalidateSize({animate: false});
    if (begins) map.fitBounds(bounds, {animate: false});
    else map.setView(...seen, {animate: false});
  });
}

// --- items and layers ---------------------------------------------------------------------------

/** A fix or a closure. */
function itemOf(kind, source, k) {
  const column = (name) => (source[name] ? source[name][k] : null);
  const [why, at] = [column('why'), column('at')];
  const {x, y} = DATA.lines.corrected;
  return {
    kind, source: source.source, state: column('state'), id: column('id'), distance: column('d'),
    reason: why < 0 ? null : DATA.texts[why], ...(kind === 'closure' ? {
      times: [column('t0'), column('t1')],
      ends: [[column('x0'), column('y0')], [column('x1'), column('y1')]]} : {
      times: [column('t')], ends: [[column('x'), column('y')]], tie: at >= 0 ? [x[at], y[at]] : null})};
}

function springItem(spring) {
  const ends = [spring.from, spring.to].filter((end) => end && known(end.x));
  const id = spring.kind === 'difference' ? `at ${clock(spring.from.t)}` : spring.name;
  return {kind: 'spring', spring, source: spring.source, id, reason: spring.text,
    times: ends.map((end) => end.t), ends: ends.map((end) => [end.x, end.y])};
}

const springItems = (DATA.springs || []).map(springItem);

/** All layers in the order in which they are painted; those without marks are left out. */
function makeLayers() {
  const lines = DATA.lines || {};
  const [ours, before] = {graph: ['optimised poses', 'poses as read, moved to fit'],
    comparison: ['A']}[DATA.kind] || ['corrected path', 'odometry, aligned'];
  const looks = {
    odometry: {name: before, colour: 'odometry', width: 1.5, dash: [6, 4]},
    truth: {name: 'truth', colour: 'truth', width: 1.2, dash: [2, 3]},
    corrected: {name: ours, colour: 'path', width: 2.2, dash: []},
    other: {name: 'B', colour: 'odometry', width: 2, dash: [7, 4]}};
  const ellipses = DATA.ellipses || {x: []};
  const measurements = (kind, sources) => (sources || []).map((source) => {
    const items = source.state.map((_, k) => itemOf(kind, source, k));
    const counts = STATES.map((_, state) => items.filter((item) => item.state === state).length);
    const byError = kind === 'closure' && source.state.some((state) => state <= WEAK)
      && rampOf(source.d.filter((_, k) => source.state[k] <= WEAK), (value) => `${number(value)} sigma`);
    return {id: `${kind}/${source.source}`, kind, items,
      ramps: byError ? {'by error': byError} : null, ramp: DATA.by_node ? byError || null : null, counts, count: items.length,
      name: `${kind === 'fix' ? 'fixes' : 'closures'}${sources.length > 1 ? ` ${source.source}` : ''}`,
      states: new Set(STATES.keys()), swatch: {...LOOKS[BELIEVED], dash: kind === 'fix' ? null : []}};
  });
  const springs = springItems.filter((item) => item.ends.length > 0);
  return [
    {id: 'ellipses', name: 'covariances, 2 sigma', count: ellipses.x.length, ellipses, factor: 1,
      swatch: {colour: 'path', area: 0.25}},
    ...Object.entries(looks).filter(([id]) => lines[id]).map(([id, look]) => ({
      id, name: look.name, count: lines[id].x.length, swatch: look, line: lines[id], look,
      ramps: id === 'corrected' ? pathRamps() : null})),
    ...measurements('closure', DATA.closures), ...measurements('fix', DATA.fixes),
    {id: 'springs', kind: 'spring', name: DATA.kind === 'comparison' ? 'where they differ most' : 'springs under most tension', count: springs.length,
      items: springs, swatch: {colour: 'spring', dash: [], width: 4}, shown: false},
  ].filter((layer) => layer.count > 0).map((layer) => ({shown: true, ...layer}));
}

/** What the colour of the path can tell. */
function pathRamps() {
  const {errors, ellipses, lines: {corrected: {t}}} = DATA;
  const metres = (value) => `${number(value)} m`;
  const at = (times, column) => (times ? t.map((time) => valueAt(times, column, time)) : null);
  const sigma = ellipses && ellipses.xx.map((xx, k) => (known(xx) ? Math.sqrt(xx + ellipses.yy[k]) : null));
  const found = {
    [DATA.kind === 'comparison' ? 'by distance to B' : 'by error']: errors && rampOf(
      at(errors.t, errors.position), metres),
    'by sigma': ellipses && rampOf(at(ellipses.t, sigma), metres),
    [DATA.by_node ? 'by node' : 'by time']: rampOf(t, (value) => clock(value))};
  return Object.fromEntries(Object.entries(found).filter(([, ramp]) => ramp));
}

/** The rows before and after a time, and which part of the way from one to the other it is. */
function around(times, time) {
  let [low, high] = [0, times.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle;
    else high = middle;
  }
  const part = (time - times[low]) / (times[high] - times[low] || 1);
  return [low, high, Math.min(1, Math.max(0, part))];
}

/** A value at a time, between those before and after it; null outside. */
function valueAt(times, column, time) {
  if (!(time >= times[0] && time <= times[times.length - 1])) return null;
  const [k, m, part] = around(times, time);
  return known(column[k]) && known(column[m]) ? column[k] + part * (column[m] - column[k]) : null;
}

const middleOf = (ends) => [0, 1].map(
  (axis) => ends.reduce((sum, end) => sum + end[axis], 0) / ends.length);

/** The item nearest to a place, of the layers and states that are shown, within some pixels. */
function nearestItem(layers, x, y, scale, pixels) {
  let [best, found] = [pixels / scale, null];
  for (const {items, states} of layers) {
    for (const item of items || []) {
      if ((states && !states.has(item.state)) || !item.times.some(isShownTime)) continue;
      // what is not believed is wanted more often, and there is less of it
      const bonus = item.state === BELIEVED || item.state === HELD_OUT ? 0 : 3;
      const apart = toSegment(x, y, item.ends[0], item.ends[item.ends.length - 1]) - bonus / scale;
      if (apart < best) [best, found] = [apart, item];
    }
  }
  return found;
}

/** Distance of a point from a line between two others. */
function toSegment(x, y, [p, q], [r, s]) {
  const length2 = (r - p) ** 2 + (s - q) ** 2;
  const part = length2 === 0 ? 0 : ((x - p) * (r - p) + (y - q) * (s - q)) / length2;
  const at = Math.min(1, Math.max(0, part));
  return Math.hypot(x - p - at * (r - p), y - q - at * (s - q));
}

/** When the robot was near a place, if it was. */
function timeAt({t, x, y}, {lng, lat}, within) {
  const apart = x.map((each, k) => Math.hypot(each - lng, y[k] - lat));
  const [nearest] = extent(apart);
  return nearest < within ? t[apart.indexOf(nearest)] : null;
}

// --- controls -----------------------------------------------------------------------------------

/** A box to tick for each layer, and for each state of measurements; returns how to show them. */
function showLayers(host, layers, repaint) {
  const updates = [];
  const tick = (text, mark, count, read, write) => {
    const input = make('input', {type: 'checkbox', onchange: () => {
      write(input.checked);
      repaint();
    }});
    updates.push(() => { input.checked = read(); });
    return make('label', {}, input, swatch(mark), make('span', {class: 'label'}, text),
      make('span', {class: 'count'}, number(count, 6)));
  };
  const statesOf = ({kind, counts, states}) => make('ul', {class: 'states'}, [...counts.entries()]
    .filter(([, count]) => count > 0).map(([state, count]) => make('li', {'data-state': state}, tick(
      STATES[state], {...lookOf(state), dash: kind === 'fix' ? null : lookOf(state).dash}, count,
      () => states.has(state), (on) => (on ? states.add(state) : states.delete(state))))));
  const sizes = (layer) => make('select', {'aria-label': 'Size of the covariance ellipses',
    onchange: (event) => {
      layer.factor = Number(event.target.value);
      repaint();
    }}, [1, 3, 10, 30, 100].map((factor) => make('option', {value: factor},
    factor === 1 ? 'true to scale' : `${factor} times as large`)));
  const ramps = (layer) => {
    const legend = make('div', {class: 'legend'});
    const show = (name) => {
      const ramp = layer.ramps[name] || null;
      layer.ramp = ramp;
      legend.replaceChildren(...(ramp ? [ramp.low, make('span', {class: 'ramp'}), ramp.high] : []));
    };
    const names = Object.keys(layer.ramps);
    const chosen = names.find((name) => layer.ramps[name] === layer.ramp);
    show(chosen);
    return [make('select', {'aria-label': `Colour of ${layer.name}`, onchange: (event) => {
      show(event.target.value);
      repaint();
    }}, [layer.kind ? 'by state' : 'in one colour', ...names].map((name) => make('option', {
      value: name, selected: name === chosen}, name))), legend];
  };
  host.append(make('details', {class: 'layer-box card', open: true}, make('summary', {}, 'Layers'),
    make('ul', {class: 'layers', 'aria-label': 'Layers of the map'}, [...layers].reverse().map(
      (layer) => make('li', {'data-layer': layer.id}, tick(layer.name, layer.swatch, layer.count,
        () => layer.shown, (on) => { layer.shown = on; }),
      layer.counts ? statesOf(layer) : null, layer.ellipses ? sizes(layer) : null,
      layer.ramps ? ramps(layer) : null)))));
  const update = () => updates.forEach((each) => each());
  update();
  return update;
}

/** The slider that tells where the robot was at a time. */
function showTime(host, path) {
  const [first, last] = [path.t[0], path.t[path.t.length - 1]];
  const slider = make('input', {
    type: 'range', id: 'time', min: first, max: last, step: (last - first) / 200 || 1, value: first,
    'aria-label': 'Time of the drive', oninput: () => lookAtTime(Number(slider.value))});
  const text = make('output', {for: 'time', id: 'where'}, 'Move the slider, or point at the path '
    + 'or at a chart, to see where the robot was.');
  host.append(make('div', {class: 'time'}, slider, text));
  followers.time.push((time) => {
    slider.value = time;
    slider.setAttribute('aria-valuetext', clock(time));
    const {x, y, theta} = poseAt(path, time);
    const words = [timeOfDay(time), placeText([x, y]), known(theta) ? `${number(degrees(theta))}°` : null];
    text.replaceChildren(make('b', {}, clock(time)), ...words.map((word) => (word ? ` · ${word}` : '')));
  });
}

/** Two sliders for the part of the drive that the map shows; returns how to set it. */
function makeSpan(host, {t}, repaint) {
  const [first, last] = [t[0], t[t.length - 1]];
  const text = make('output', {id: 'span'});
  const slider = (id, label, value) => make('input', {type: 'range', id, min: first, max: last,
    step: 'any', value, 'aria-label': label, oninput: () => show(Number(from.value), Number(to.value))});
  const [from, to] = [slider('from', 'Show the map from this time on', first),
    slider('to', 'Show the map up to this time', last)];
  const show = (begin, end) => {
    const [low, high] = begin <= end ? [begin, end] : [end, begin];
    shownTime.from = low > first ? low : -Infinity;
    shownTime.to = high < last ? high : Infinity;
    const isWhole = shownTime.from === -Infinity && shownTime.to === Infinity;
    if (isWhole) [from.value, to.value] = [first, last];
    for (const each of [from, to]) each.setAttribute('aria-valuetext', clock(Number(each.value)));
    text.textContent = isWhole ? 'Map: the whole path'
      : `Map: ${clock(Math.max(low, first))} to ${clock(Math.min(high, last))}`;
    repaint();
  };
  host.append(make('div', {class: 'time span'}, text, from, to));
  show(-Infinity, Infinity);
  return show;
}

function placeText([x, y]) {
  const [right, up] = DATA.offset || [0, 0];
  return `${(x + right).toFixed(2)}, ${(y + up).toFixed(2)} m`;
}

/** Where the robot was at a time, between two poses of the path. */
function poseAt({t, x, y, theta}, time) {
  const [k, m, part] = around(t, time);
  const between = (column) => column[k] + part * (column[m] - column[k]);
  return {x: between(x), y: between(y), theta: theta ? theta[part < 0.5 ? k : m] : null};
}

/** Places of the path from a time to another, shape [[x, y], ...]. */
function alongPath(path, [from, to]) {
  const [begin, end] = [from, to].map((time) => poseAt(path, time)).map(({x, y}) => [x, y]);
  const within = path.t.flatMap((time, k) => (time > from && time < to ? [[path.x[k], path.y[k]]] : []));
  return [begin, ...within, end];
}

// --- the panel and the lists --------------------------------------------------------------------

const KINDS = {fix: 'Fix', closure: 'Loop closure', spring: 'Spring'};
const MOST_ENTRIES = 100;

/** The panel beside the map; it shows the item that the reader has chosen. */
function makePanel(host, centreOn) {
  const panel = make('div', {class: 'panel card', id: 'panel', 'aria-live': 'polite'});
  host.append(panel);
  const show = (item) => panel.replaceChildren(...(!item ? [make('p', {class: 'hint'},
    'Click or tap a mark on the map to see what is known of it.')] : [
    make('div', {class: 'panel-head'},
      make('h3', {}, item.spring && item.spring.kind === 'difference' ? 'Difference' : KINDS[item.kind], ' ', make('span', {class: 'id'}, item.id || item.source)),
      make('button', {type: 'button', class: 'plain', 'aria-label': 'Close',
        onclick: () => lookAtItem(null)}, '×')),
    make('p', {}, known(item.state) ? make('span', {class: 'state'},
      swatch({...lookOf(item.state), dash: null}), STATES[item.state]) : null),
    make('p', {class: 'reason'}, item.reason || ''),
    make('dl', {}, factsOf(item).flatMap(
      ([name, value]) => [make('dt', {}, name), make('dd', {}, value)])),
    make('button', {type: 'button', onclick: () => centreOn(item)}, 'Centre the map on it')]));
  followers.item.push(show);
  show(null);
}

function factsOf({source, ends, times, tie, distance, spring}) {
  const time = (t) => [clock(t), timeOfDay(t)].filter((text) => text).join(' · ');
  const apart = ([x, y], [p, q]) => length(Math.hypot(x - p, y - q));
  const rows = [['source', source]];
  if (ends.length === 2 && spring && spring.kind === 'difference') {
    rows.push(['A', placeText(ends[0])], ['B', placeText(ends[1])], ['apart', apart(...ends)]);
  } else if (ends.length === 2) {
    rows.push(['from', `${time(times[0])} at ${placeText(ends[0])}`],
      ['to', `${time(times[1])} at ${placeText(ends[1])}`], ['apart', apart(...ends)]);
  } else if (ends.length === 1) {
    rows.push(['time', time(times[0])], ['place', placeText(ends[0])]);
  }
  if (tie) rows.push(['off the path', apart(tie, ends[0])]);
  if (known(distance)) rows.push(['distance', `${number(distance)} sigma`]);
  if (!spring) return rows;
  const {rank, kind, energy, expected} = spring;
  rows.push(['rank', `${rank} of ${DATA.springs.length}`]);
  if (kind === 'difference') return rows;
  rows.push(['kind', kind],
    ['energy', `${number(energy)}, where ${number(expected)} is expected`]);
  return rows;
}

/** A list of the measurements of a kind that are doubted or refused, the farthest off first. */
function listRejected(kind, items, choose) {
  const far = ({distance}) => (known(distance) ? distance : -1);
  const found = items.filter((item) => item.kind === kind
    && (DATA.kind === 'comparison' || item.state === DOUBTED || item.state === REFUSED));
  found.sort((one, other) => one.state - other.state || far(other) - far(one));
  if (!items.some((item) => item.kind === kind)) return null;
  const list = make('ol', {class: 'entries'});
  const show = (entries) => list.append(...entries.map((item) => entry(item, choose, [
    swatch({...lookOf(item.state), dash: null}),
    make('span', {class: 'entry-name'}, item.id || `${item.source} at ${clock(item.times[0])}`),
    make('span', {class: 'entry-far'}, known(item.distance) ? `${number(item.distance)} σ` : ''),
    make('span', {class: 'entry-why'}, make('span', {class: 'unseen'}, `${STATES[item.state]}: `),
      item.reason || STATES[item.state])])));
  show(found.slice(0, MOST_ENTRIES));
  const more = make('button', {type: 'button', class: 'more', onclick: () => {
    more.remove();
    show(found.slice(MOST_ENTRIES));
  }}, `Show the other ${found.length - MOST_ENTRIES}`);
  return make('details', {class: 'rejected card', 'data-kind': kind,
    open: kind === 'closure' && found.length > 0},
  make('summary', {}, `${DATA.kind === 'comparison' ? 'Judged otherwise in B:' : 'Doubted and refused'} ${
    kind === 'fix' ? 'fixes' : 'closures'} `,
    make('span', {class: 'count'}, found.length)),
  found.length > 0 ? list : nothing('None: all were used.'),
  found.length > MOST_ENTRIES ? more : null);
}

/** A row of a list that shows an item on the map. */
function entry(item, choose, content) {
  const button = make('button', {type: 'button', class: 'entry', disabled: item.ends.length === 0,
    onclick: () => choose(item)}, ...content);
  followers.item.push((chosen) => button.setAttribute('aria-current', chosen === item));
  return make('li', {}, button);
}
