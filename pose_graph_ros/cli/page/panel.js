// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// What is known of one fix, closure or spring, and the lists of those that are not believed.

const KINDS = {fix: 'Fix', closure: 'Loop closure', spring: 'Spring'};
const MOST_ENTRIES = 100;

/** The panel beside the map; it shows the item that the reader has chosen. */
function makePanel(host, {onCentre}) {
  const panel = make('div', {class: 'panel', id: 'panel', 'aria-live': 'polite'});
  host.append(panel);
  const show = (item) => {
    if (!item) {
      panel.replaceChildren(make('p', {class: 'hint'},
        'Click or tap a fix, a closure or a spring on the map to see what is known of it.'));
      return;
    }
    panel.replaceChildren(
      make('div', {class: 'panel-head'},
        make('h3', {}, KINDS[item.kind], ' ', make('span', {class: 'id'}, item.id || item.source)),
        make('button', {type: 'button', class: 'plain', 'aria-label': 'Close',
          onclick: () => lookAtItem(null)}, '×')),
      item.state === null || item.state === undefined ? null
        : make('p', {class: 'badges'}, stateTag(item.state),
          item.heldOut && item.state !== HELD_OUT ? stateTag(HELD_OUT) : null),
      item.reason ? make('p', {class: 'reason'}, item.reason) : null,
      make('dl', {}, factsOf(item).flatMap(
        ([name, value]) => [make('dt', {}, name), make('dd', {}, value)])),
      make('button', {type: 'button', onclick: () => onCentre(item)}, 'Centre the map on it'));
  };
  // children that are null become texts, so they are dropped
  const replace = panel.replaceChildren.bind(panel);
  panel.replaceChildren = (...nodes) => replace(...nodes.filter((node) => node !== null));
  followers.item.push(show);
  show(null);
  return panel;
}

function factsOf(item) {
  const offset = DATA.offset || [0, 0];
  const place = ([x, y]) => `${(x + offset[0]).toFixed(2)}, ${(y + offset[1]).toFixed(2)} m`;
  const time = (t) => [clock(t), timeOfDay(t)].filter((text) => text).join(' · ');
  const rows = [['source', item.source]];
  if (item.ends.length === 2) {
    rows.push(['from', `${time(item.times[0])} at ${place(item.ends[0])}`],
      ['to', `${time(item.times[1])} at ${place(item.ends[1])}`],
      ['apart', length(Math.hypot(item.ends[1][0] - item.ends[0][0],
        item.ends[1][1] - item.ends[0][1]))]);
  } else if (item.ends.length === 1) {
    rows.push(['time', time(item.times[0])], ['place', place(item.ends[0])]);
  }
  if (item.tie) {
    rows.push(['off the path', length(Math.hypot(item.tie[0] - item.ends[0][0],
      item.tie[1] - item.ends[0][1]))]);
  }
  if (known(item.distance)) rows.push(['distance', `${number(item.distance)} sigma`]);
  if (item.spring) {
    const {rank, kind, energy, expected, residual, sigma} = item.spring;
    rows.push(['rank', `${rank} of ${DATA.springs.length}`], ['kind', kind],
      ['energy', `${number(energy)}, where ${number(expected)} is expected`]);
    if (residual && sigma) rows.push(...residualRows(kind, residual, sigma));
  }
  return rows.filter(([, value]) => value !== null && value !== undefined);
}

/** Residuals of a spring with their units and in sigma; coordinates without a sigma say nothing. */
function residualRows(kind, residual, sigma) {
  const names = ['position', 'fix', 'global_pose'].includes(kind) ? ['x', 'y', 'heading']
    : ['along', 'across', 'heading'];
  return names.flatMap((name, k) => {
    if (!known(residual[k]) || !known(sigma[k]) || sigma[k] <= 0) return [];
    const value = name === 'heading' ? `${number(degrees(residual[k]))}°` : length(residual[k]);
    return [[name, `${value}, ${number(residual[k] / sigma[k], 2)} sigma`]];
  });
}

/** A list of the measurements of a kind that are doubted or refused, the farthest off first. */
function listRejected(host, kind, tables, {title, onChoose, open}) {
  const found = tables.flatMap((table) => table.state.flatMap((state, k) => (
    state === DOUBTED || state === REFUSED ? [{table, k, state, d: (table.d || [])[k]}] : [])));
  if (tables.length === 0) return;
  const far = (entry) => (known(entry.d) ? entry.d : -1);
  found.sort((one, other) => one.state - other.state || far(other) - far(one));
  const list = make('ol', {class: 'entries'});
  const head = make('summary', {}, title, ' ', make('span', {class: 'count'}, found.length));
  host.append(make('details', {class: 'rejected', 'data-kind': kind, open: open && found.length > 0},
    head, found.length > 0 ? list : nothing('None: all were used.')));
  const show = (entries) => list.append(...entries.map(({table, k}) => entryOf(
    itemOf(kind, table, k), onChoose)));
  show(found.slice(0, MOST_ENTRIES));
  if (found.length > MOST_ENTRIES) {
    const more = make('button', {type: 'button', class: 'more', onclick: () => {
      more.remove();
      show(found.slice(MOST_ENTRIES));
    }}, `Show the other ${found.length - MOST_ENTRIES}`);
    list.after(more);
  }
}

function entryOf(item, onChoose) {
  const button = make('button', {
    type: 'button', class: 'entry', onclick: () => onChoose(item)},
  swatch({...lookOf(item.state), dash: null}),
  make('span', {class: 'entry-name'}, item.id || `${item.source} at ${clock(item.times[0])}`),
  make('span', {class: 'entry-far'}, known(item.distance) ? `${number(item.distance)} σ` : ''),
  make('span', {class: 'entry-why'}, item.reason
    ? [make('span', {class: 'unseen'}, `${STATES[item.state]}: `), item.reason]
    : STATES[item.state]));
  followers.item.push((chosen) => {
    if (sameItem(chosen, item)) button.setAttribute('aria-current', 'true');
    else button.removeAttribute('aria-current');
  });
  return make('li', {}, button);
}
