'use strict';
// The table of units, the details of one, and the drawings of a fleet's page. Names, findings and
// messages come from recordings: they are set as text, and never as HTML.
(() => {
const BAD = -(2 ** 31), PAGE = 50, MONTH = 30.4375 * 86400e3, MINUTE = 60e3;
const byId = id => document.getElementById(id);

function make(kind, attributes = {}, ...children) {
  const element = document.createElement(kind);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === 'onclick') element.addEventListener('click', value);
    else if (value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.map(c => (c instanceof Node ? c : String(c))));
  return element;
}

// As imu_calib/fleet/page_contents.py packs it.
async function unpack(id) {
  const text = atob(byId(id).textContent);
  const packed = new Uint8Array(text.length);
  for (let k = 0; k < text.length; ++k) packed[k] = text.charCodeAt(k);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(bytes.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  const found = {...head.texts};
  let place = 4 + length;
  const kinds = {Uint8Array, Int8Array, Int32Array, Float32Array};
  for (const [name, kind, count] of head.arrays) {
    const array = new kinds[kind](count), size = array.BYTES_PER_ELEMENT;
    const target = new Uint8Array(array.buffer);
    for (let plane = 0; plane < size; ++plane)
      for (let k = 0; k < count; ++k) target[k * size + plane] = bytes[place++];
    found[name] = array;
  }
  byId(id).remove();
  return found;
}

const once = start => { let begun; return () => (begun ??= start()); };
const minus = text => text.replace('-', '\u2212');
const day = minutes => (minutes === BAD ? '' : new Date(minutes * MINUTE).toISOString().slice(0, 10));
const decimals = std => (std > 0 && isFinite(std) ? Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(std)))) : 4);
const fixed = (value, std) => (isFinite(value) ? minus(value.toFixed(decimals(std)).replace(/^-(?=[0.]*$)/, '')) : '\u2013');

// --- units -------------------------------------------------------------------------------------

let units;
const shown = {order: null, page: 0, column: 'status', down: false};
const collator = new Intl.Collator('en', {numeric: true});

const badge = ([, words, kind, meaning]) => make('span', {class: `badge ${kind}`, title: meaning}, words);
const flagsOf = k => units.flags.filter((_, bit) => units.bits[k] >> bit & 1);
const unitHash = k => `#unit=${[units.imus[units.imu[k]], units.serials[k]].map(encodeURIComponent).join('/')}`;

function columns() {
  const last = 1 << 20;
  const all = {
    unit: ['unit', k => units.serials[k], k => make('a', {href: unitHash(k)}, units.serials[k])],
    imu: ['type', k => units.imus[units.imu[k]]],
    lot: ['lot', k => units.lots[units.lot[k]]],
    stand: ['stand', k => units.stands[units.stand[k]]],
    sessions: ['sessions', k => units.sessions[k]],
    failed: ['failed', k => units.failed[k], k => units.failed[k] || ''],
    newest: ['newest', k => units.last[k], k => day(units.last[k])],
    // What has no date is due last.
    due: ['due', k => (units.due[k] === BAD ? 2 ** 31 : units.due[k]), dueCell],
    verdict: ['verdict', k => units.verdicts[units.verdict[k]]],
    // The worst flag is the lowest bit; beside each other the units that are due first.
    status: ['status', k => (units.bits[k] ? Math.log2(units.bits[k] & -units.bits[k]) : last),
             k => make('span', {class: 'badges'}, ...(units.bits[k] ? flagsOf(k).map(badge)
                   : [make('span', {class: 'badge pass'}, 'fine')]))],
  };
  if (!units.lots.some(Boolean)) delete all.lot;
  return all;
}

function dueCell(k) {
  // On a phone an empty cell is left out, with its heading.
  if (units.due[k] === BAD) return '';
  const because = units.because[k] < 0 ? '' : ` ${units.parameters[units.because[k]][0]}`;
  return make('span', {}, day(units.due[k]), make('small', {}, because));
}

function sorted(order) {
  const key = units.columns[shown.column][1], keys = new Map(order.map(k => [k, key(k)]));
  const sign = shown.down ? -1 : 1;
  const compare = (a, b) => (typeof a === 'number' ? a - b : collator.compare(a, b));
  const due = units.columns.due[1];
  return order.sort((a, b) => sign * compare(keys.get(a), keys.get(b)) || due(a) - due(b) || a - b);
}

function matching() {
  const words = byId('text').value.toLowerCase().split(/\s+/).filter(Boolean);
  const [imu, stand, flag] = ['imu', 'stand', 'flag'].map(n => byId(`${n}-filter`).value);
  const bit = units.flags.findIndex(f => f[0] === flag);
  const found = [];
  for (let k = 0; k < units.serials.length; ++k) {
    if (imu !== '' && units.imu[k] !== +imu) continue;
    if (stand !== '' && units.stand[k] !== +stand) continue;
    if (flag === 'FINE' ? units.bits[k] : flag && !(units.bits[k] >> bit & 1)) continue;
    if (words.length) {
      const text = [units.serials[k], units.imus[units.imu[k]], units.lots[units.lot[k]],
                    units.stands[units.stand[k]]].join('\n').toLowerCase();
      if (!words.every(w => text.includes(w))) continue;
    }
    found.push(k);
  }
  return found;
}

function refilter() {
  shown.order = sorted(matching());
  shown.page = 0;
  drawHead();
  drawRows();
}

function drawHead() {
  byId('unit-head').replaceChildren(...Object.entries(units.columns).map(([name, [words]]) => {
    const mine = name === shown.column;
    const sort = mine ? (shown.down ? 'descending' : 'ascending') : 'none';
    const press = () => {
      shown.down = mine && !shown.down;
      shown.column = name;
      refilter();
      byId('unit-head').querySelector(`[data-column=${name}] button`).focus();
    };
    const arrow = make('span', {'aria-hidden': 'true', class: 'arrow'}, mine ? (shown.down ? '\u25be' : '\u25b4') : '');
    return make('th', {scope: 'col', 'aria-sort': sort, 'data-column': name},
                make('button', {type: 'button', onclick: press}, words, arrow));
  }));
}

function row(k) {
  const cells = Object.entries(units.columns).map(([name, [words, value, cell]]) => {
    const content = (cell || value)(k);
    return make('td', {class: `of-${name}`, 'data-name': words}, content);
  });
  return make('tr', {}, ...cells);
}

function drawRows(all = false) {
  const total = shown.order.length, pages = Math.max(1, Math.ceil(total / PAGE));
  const first = all ? 0 : shown.page * PAGE, last = all ? total : Math.min(total, first + PAGE);
  byId('unit-rows').replaceChildren(...shown.order.slice(first, last).map(row));
  const filters = ['imu', 'stand', 'flag'].map(n => byId(`${n}-filter`)).filter(f => f.value !== '')
    .map(f => f.selectedOptions[0].textContent);
  const text = byId('text').value.trim();
  if (text) filters.unshift(`"${text}"`);
  const of = filters.length ? ` that match ${filters.join(', ')}` : '';
  const range = total && !all && pages > 1 ? `, ${first + 1} to ${last} shown` : '';
  byId('matching').textContent = `${total} of ${units.serials.length} units${of}${range}`;
  const go = step => () => { shown.page += step; drawRows(); };
  const button = (words, step, off) =>
    make('button', {type: 'button', onclick: go(step), ...(off ? {disabled: ''} : {})}, words);
  const many = pages > 1 ? [button('Previous', -1, shown.page === 0),
    make('span', {}, `page ${shown.page + 1} of ${pages}`), button('Next', 1, shown.page === pages - 1)] : [];
  byId('pages').replaceChildren(...many);
}

function startTable() {
  units.bits = Int32Array.from(units.bitmask);
  units.columns = columns();
  const fill = (name, texts) => byId(`${name}-filter`).append(...texts.map(([value, words]) =>
    make('option', {value}, words)));
  const named = texts => texts.map((t, k) => [k, t || 'not stated']).sort((a, b) => collator.compare(a[1], b[1]));
  fill('imu', named(units.imus));
  fill('stand', named(units.stands));
  const counts = units.flags.map((_, bit) => units.bits.reduce((n, b) => n + (b >> bit & 1), 0));
  const flags = units.flags.map(([name, words], bit) => [name, `${words} (${counts[bit]})`]).filter((_, bit) => counts[bit]);
  fill('flag', [...flags, ['FINE', `fine (${units.bits.reduce((n, b) => n + !b, 0)})`]]);
  byId('filters').addEventListener('input', refilter);
  byId('filters').addEventListener('submit', event => event.preventDefault());
  byId('clear').addEventListener('click', () => { byId('filters').reset(); refilter(); });
  for (const button of document.querySelectorAll('button.show'))
    button.addEventListener('click', () => {
      byId('filters').reset();
      byId('flag-filter').value = button.dataset.flag;
      refilter();
      byId('units').scrollIntoView();
      byId('flag-filter').focus({preventScroll: true});
    });
  addEventListener('beforeprint', () => drawRows(true));
  addEventListener('afterprint', () => drawRows());
  refilter();
}

// --- sessions ----------------------------------------------------------------------------------

// Differences become values, and each unit knows where its own begin.
const sessions = once(async () => {
  const s = await unpack('sessions-data');
  const count = s.calibrated, number = units.parameters.length;
  s.values = Array.from({length: number}, (_, p) => {
    const of = new Float64Array(count);
    let sum = 0;
    for (let k = 0; k < count; ++k) {
      sum = (sum + s.value[p * count + k]) | 0;
      of[k] = s.known[p * count + k] ? sum * s.valueSteps[p] : NaN;
    }
    return of;
  });
  s.stdOf = (p, k) => {
    const code = s.std[p * count + k], [low, ratio] = s.stdScales[p];
    return code ? low * Math.exp(ratio * (code - 1)) : NaN;
  };
  s.scoreOf = (array, p, k) => (array[p * count + k] === -128 ? NaN : array[p * count + k] * s.scoreStep);
  s.first = [];
  s.firstRow = [];
  let value = 0, any = 0;
  units.serials.forEach((_, u) => {
    s.first.push(value);
    s.firstRow.push(any);
    value += units.sessions[u];
    any += units.rows[u];
  });
  return s;
});

const perUnit = (array, p, u) => array[p * units.serials.length + u];

// --- drawings ----------------------------------------------------------------------------------

const library = once(async () => {
  // Held as text until now; the page's policy knows it by its hash.
  const script = make('script');
  script.textContent = byId('library').textContent;
  document.head.append(script);
  byId('library').remove();
  return window.Bokeh;
});

const colour = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const STANDS = ['x', 'y', 'z', 'stand-4', 'stand-5', 'stand-6', 'stand-7', 'stand-8'];
const views = new Map();
const again = new Map();

// Headings and names of stands stand in the document: there they wrap, and are read aloud.
function figure(title, yWords, options = {}) {
  const plotting = window.Bokeh.Plotting;
  const plot = plotting.figure({
    height: 230, sizing_mode: 'stretch_width', tools: 'box_zoom,reset,save',
    toolbar_location: 'above', output_backend: 'svg', ...options,
  });
  const names = [];
  plot.setv({
    background_fill_color: colour('paper'), border_fill_color: colour('paper'),
    outline_line_color: colour('frame'), min_border_right: 12, min_border_left: 64,
  });
  // A finger that scrolls the page is not to move the drawing.
  plot.toolbar.setv({logo: null, active_drag: null, autohide: false});
  for (const axis of [...plot.left, ...plot.below])
    axis.setv({axis_line_color: colour('frame'), major_tick_line_color: colour('frame'),
               minor_tick_line_color: null, major_label_text_color: colour('soft'),
               major_label_text_font_size: '11px', major_label_text_font: 'system-ui, sans-serif',
               axis_label_text_color: colour('soft'), axis_label_text_font_size: '11px',
               axis_label_text_font_style: 'normal', axis_label_text_font: 'system-ui, sans-serif'});
  for (const axis of plot.left) axis.setv({axis_label: yWords});
  // Dates beside each other need 70 px.
  for (const axis of plot.below)
    if (axis.ticker && innerWidth < 600) axis.ticker.setv({desired_num_ticks: 3});
  for (const grid of plot.center.filter(g => g.type === 'Grid')) grid.setv({grid_line_color: colour('grid')});
  return {plot, title, names};
}

// The library loads its formulae from elsewhere where a text holds $$: names that do are not drawn so.
const plain = text => String(text).replaceAll('$$', '$\u200b$');

async function show(id, plots, redraw) {
  const place = typeof id === 'string' ? byId(id) : id;
  for (const view of views.get(place) || []) view.remove();
  place.replaceChildren();
  const made = [];
  for (const {plot, title, names} of plots) {
    const box = make('div');
    if (title) place.append(make('h4', {}, title));
    if (names.length) place.append(legend(names));
    place.append(box);
    made.push(await window.Bokeh.Plotting.show(plot, box));
  }
  views.set(place, made);
  again.set(place, redraw);
}

const level = (plot, x, y, name, dash = []) =>
  plot.line(x, [y, y], {line_color: colour(name), line_dash: dash, line_width: 1.2});

const legend = names => make('p', {class: 'legend'}, ...names.map(([tone, words]) =>
  make('span', {style: `--tone: ${tone}`}, words)));

// --- details of a unit -------------------------------------------------------------------------

async function openUnit() {
  const match = /^#unit=([^/]*)\/(.*)$/.exec(location.hash);
  if (!match) return;
  let imu, serial;
  try { [imu, serial] = match.slice(1).map(decodeURIComponent); } catch { return; }
  const u = units.serials.findIndex((s, k) => s === serial && units.imus[units.imu[k]] === imu);
  if (u < 0) return;
  const s = await sessions();
  byId('unit-name').replaceChildren(serial, ' ', make('small', {}, imu));
  byId('unit-body').replaceChildren(...details(u, s));
  byId('unit').hidden = false;
  byId('unit').dataset.unit = serial;
  byId('unit').scrollIntoView();
  byId('unit').focus({preventScroll: true});
  if (units.sessions[u]) await course(u, s, worst(u, s));
  byId('unit').dataset.drawn = serial;
}

function closeUnit() {
  byId('unit').hidden = true;
  delete byId('unit').dataset.unit;
  delete byId('unit').dataset.drawn;
  const from = [...document.querySelectorAll('a')].find(a => a.getAttribute('href') === location.hash);
  history.replaceState(null, '', location.pathname + location.search);
  if (from) from.focus();
}

// Name, words, unit and its size of each parameter, as a unit of this grade is shown.
const parametersOf = u => (units.by_hand[u] ? units.parameters_by_hand : units.parameters);

// The parameter that says most: that stepped last, that drifts or signals most, by which the unit is
// due, or that is nearest to its limit.
function worst(u, s) {
  const last = s.first[u] + units.sessions[u] - 1;
  const most = value => {
    const found = units.parameters.map((_, p) => value(p)), best = Math.max(...found.filter(isFinite), 0);
    return best > 0 ? found.indexOf(best) : -1;
  };
  const step = s.steps[u].find(([index, , sizes]) => index === units.sessions[u] - 1 && sizes.length);
  const candidates = [
    () => (step ? units.parameters.findIndex(([name]) => name === step[2][0][0]) : -1),
    () => most(p => (perUnit(s.significant, p, u) ? Math.abs(perUnit(s.slope, p, u)) / perUnit(s.slope_reach, p, u) : 0)),
    () => most(p => Math.max(0, Math.abs(s.scoreOf(s.score, p, last)) - s.individualsLimit)),
    () => units.because[u],
    () => most(p => Math.abs(s.values[p][last]) / perUnit(s.limit, p, u)),
  ];
  for (const candidate of candidates) {
    const p = candidate();
    if (p >= 0) return p;
  }
  return 0;
}

function details(u, s) {
  const parts = [make('p', {class: 'badges'}, ...(units.bits[u] ? flagsOf(u).map(badge) : [make('span', {class: 'badge pass'}, 'fine')]))];
  const due = day(units.due[u]);
  const because = units.because[u] < 0 ? '' : `, because of ${units.parameters[units.because[u]][0]}`;
  const lot = units.lots[units.lot[u]] ? ` Lot ${units.lots[units.lot[u]]}.` : '';
  const lost = units.failed[u] ? ` ${units.failed[u]} failed.` : '';
  const said = [`${units.sessions[u]} calibrated session${units.sessions[u] === 1 ? '' : 's'}.${lost}${lot}`,
                due ? `Recalibration is due on ${due}${because}.` : s.findings[u].includes(s.reasons[u]) ? '' : s.reasons[u]];
  parts.push(make('p', {}, said.filter(Boolean).join(' ')));
  if (s.findings[u].length) parts.push(make('ul', {}, ...s.findings[u].map(f => make('li', {}, f))));
  if (units.sessions[u])
    parts.push(make('div', {id: 'course', class: 'plot'}),
               make('p', {class: 'note', id: 'course-note'}),
               make('h3', {}, 'Parameters at the newest session'), parameterTable(u, s));
  parts.push(make('h3', {}, 'Recordings'), recordingTable(u, s));
  return parts;
}

function grid(headings, rows, kind) {
  return make('div', {class: 'wide'}, make('table', {class: kind},
    make('thead', {}, make('tr', {}, ...headings.map(h => make('th', {scope: 'col'}, h)))),
    make('tbody', {}, ...rows.map(cells => make('tr', {}, ...cells.map(c => make('td', {}, c)))))));
}

function parameterTable(u, s) {
  const last = s.first[u] + units.sessions[u] - 1;
  const rows = parametersOf(u).map(([name, , unit, scale], p) => {
    const std = s.stdOf(p, last) / scale, limit = perUnit(s.limit, p, u) / scale;
    const slope = perUnit(s.slope, p, u) / scale, reach = perUnit(s.slope_reach, p, u) / scale;
    const scatter = perUnit(s.scatter, p, u) / scale;
    const trend = isFinite(slope) ? `${fixed(slope, reach)} \u00b1 ${fixed(reach, reach)}` : '\u2013';
    const marked = perUnit(s.significant, p, u) ? make('b', {}, trend) : trend;
    const choose = make('button', {type: 'button', class: 'choose', onclick: () => course(u, s, p)}, name);
    return [choose, fixed(s.values[p][last] / scale, std), fixed(2 * std, std), unit,
            isFinite(limit) ? `\u00b1${+limit.toPrecision(3)}` : '', marked, scatter === 0 ? '0' : fixed(scatter, scatter),
            day(perUnit(s.leaves, p, u))];
    // What the choice of the axes makes zero has no deviation.
  }).filter((_, p) => s.values[p][last] !== 0 || s.stdOf(p, last) > 0);
  return grid(['', 'value', '\u00b1 2 std', 'unit', 'limit', `trend per month (${s.confidence})`, 'turn-on std', 'leaves limit'],
              rows, 'plain of-unit');
}

function recordingTable(u, s) {
  const from = s.firstRow[u], total = units.rows[u];
  const rows = Array.from({length: total}, (_, k) => from + k);
  rows.sort((a, b) => s.date[b] - s.date[a] || b - a);
  return grid(['date', 'stand', 'verdict', 'recording', 'files', 'to be known'], rows.map(k => {
    const files = make('span', {class: 'files'});
    for (const [words, href] of [['calibration', s.calibrations[k]], ['report', s.reports[k]]])
      if (href) files.append(make('a', {href}, words), ' ');
    const failed = !s.fine[k], replaced = k - from >= units.sessions[u] + units.failed[u];
    const verdict = failed ? 'failed' : replaced ? 'replaced' : s.verdicts[s.verdict[k]];
    const kind = failed ? 'fail' : replaced ? 'plain' : verdict;
    return [day(s.date[k]) || 'no date', s.stands[s.stand[k]],
            verdict ? make('span', {class: `badge ${kind}`}, verdict) : '', s.recordings[k], files,
            failed ? s.errors[s.error[k]] : s.remarks[s.remark[k]]];
  }), 'plain recordings');
}

async function course(u, s, p) {
  await library();
  const [name, words, unit, scale] = parametersOf(u)[p];
  const first = s.first[u], count = units.sessions[u], row = s.firstRow[u];
  const dated = Array.from({length: count}, (_, k) => s.date[row + k] !== BAD);
  const timed = dated.some(Boolean);
  const chosen = Array.from({length: count}, (_, k) => k).filter(k => (timed ? dated[k] : true) && isFinite(s.values[p][first + k]));
  const at = k => (timed ? s.date[row + k] * MINUTE : k + 1);
  const x = chosen.map(at), value = chosen.map(k => s.values[p][first + k] / scale);
  const std = chosen.map(k => s.stdOf(p, first + k) / scale);
  const shift = chosen.map(k => s.shift[p * s.calibrated + first + k] / scale);
  const ends = x.length > 1 ? [Math.min(...x), Math.max(...x)] : [(x[0] ?? 1) - (timed ? MONTH : 1), (x[0] ?? 1) + (timed ? MONTH : 1)];
  // The same for the course and the charts below it.
  const room = 0.04 * (ends[1] - ends[0]);
  const options = {x_range: [ends[0] - room, ends[1] + room], ...(timed ? {x_axis_type: 'datetime'} : {})};
  const plots = [];

  const drawn = figure(`${name}, ${words}`, unit, {height: 260, ...options}), {plot} = drawn;
  plot.segment({x0: x, x1: x, y0: value.map((v, k) => v - 2 * (std[k] || 0)), y1: value.map((v, k) => v + 2 * (std[k] || 0)),
                line_color: colour('faint')});
  const stands = [...new Set(chosen.map(k => s.stand[row + k]))];
  stands.forEach((stand, n) => {
    const mine = chosen.map((k, j) => [k, j]).filter(([k]) => s.stand[row + k] === stand).map(([, j]) => j);
    const tone = colour(STANDS[n % STANDS.length]);
    if (stands.length > 1 && stands.length <= STANDS.length) drawn.names.push([tone, s.stands[stand] || 'stand not stated']);
    plot.scatter(mine.map(j => x[j]), mine.map(j => value[j]), {size: 7, fill_color: tone, line_color: tone});
    const moved = mine.filter(j => shift[j]);
    if (moved.length)
      plot.scatter(moved.map(j => x[j]), moved.map(j => value[j] - shift[j]), {size: 7, fill_color: null, line_color: tone});
  });
  drawTrend(plot, u, s, p, scale, timed, at, ends);
  const limit = perUnit(s.limit, p, u) / scale;
  const near = Math.max(...value.map(Math.abs), 0) > limit / 2;
  if (isFinite(limit) && near) for (const y of [-limit, limit]) level(plot, ends, y, 'bad', [6, 4]);
  for (const [index, , sizes] of s.steps[u]) {
    const where = timed && dated[index] && dated[index - 1] ? (at(index) + at(index - 1)) / 2 : index + 0.5;
    if (!timed || dated[index])
      plot.add_layout(new window.Bokeh.Span({location: where, dimension: 'height', line_color: colour('mark-doubt'),
        line_dash: sizes.some(([n]) => n === name) ? [] : [2, 4]}));
  }
  plots.push(drawn);
  const beyond = drawCharts(plots, u, s, p, chosen, x, ends, options);
  await show('course', plots, () => course(u, s, p));
  byId('course').dataset.parameter = name;
  const hidden = count - chosen.length;
  byId('course-note').textContent = [
    'Bars are two stated standard deviations.',
    shift.some(Boolean) ? 'Hollow: less what its stand shifts.' : '',
    isFinite(limit) && !near ? `The limit is far off, \u00b1${+limit.toPrecision(3)} ${unit}.` : '',
    beyond ? `Scores beyond ${(127 * s.scoreStep).toFixed(2)} stand there.` : '',
    s.steps[u].length ? 'Upright lines: steps, solid where this parameter changed.' : '',
    hidden ? `${hidden} session${hidden === 1 ? '' : 's'} without a ${timed ? 'date or a value' : 'value'} not drawn.` : '',
  ].filter(Boolean).join(' ');
  for (const button of document.querySelectorAll('table.of-unit .choose'))
    button.setAttribute('aria-pressed', button.textContent === name);
}

// The trend through the sessions, less the steps behind it.
function drawTrend(plot, u, s, p, scale, timed, at, ends) {
  const slope = perUnit(s.slope, p, u) / scale, here = perUnit(s.level, p, u) / scale;
  if (!timed || !isFinite(slope) || !isFinite(here)) return;
  const name = units.parameters[p][0];
  let to = ends[1], height = here;
  const line = x => height + slope * (x - ends[1]) / MONTH;
  for (const [index, , sizes] of [...s.steps[u]].reverse()) {
    const changed = sizes.find(([n]) => n === name);
    if (!changed || index < 1) continue;
    const from = at(index);
    plot.line([from, to], [line(from), line(to)], {line_color: colour('y'), line_dash: [4, 3], line_width: 1.6});
    to = at(index - 1);
    height -= changed[1];
  }
  plot.line([ends[0], to], [line(ends[0]), line(to)], {line_color: colour('y'), line_dash: [4, 3], line_width: 1.6});
}

// Control charts below the course; returns whether a score is beyond what is kept of it.
function drawCharts(plots, u, s, p, chosen, x, ends, options) {
  const first = s.first[u];
  const score = chosen.map(k => s.scoreOf(s.score, p, first + k));
  const smooth = chosen.map(k => s.scoreOf(s.ewma, p, first + k));
  if (score.some(isFinite)) {
    const drawn = figure('Control charts: normal scores, EWMA as a line', 'std', {height: 190, ...options});
    const {plot: chart} = drawn;
    for (const sign of [-1, 1]) {
      level(chart, ends, sign * s.individualsLimit, 'bad', [6, 4]);
      level(chart, ends, sign * s.ewmaLimit, 'y', [2, 3]);
    }
    chart.line(x, smooth, {line_color: colour('y'), line_width: 1.6});
    const tones = score.map(v => colour(Math.abs(v) > s.individualsLimit ? 'bad' : 'x'));
    chart.scatter(x, score, {size: 6, fill_color: tones, line_color: tones});
    plots.push(drawn);
  }
  const t2 = chosen.map(k => s.t2[first + k]);
  if (t2.some(isFinite)) {
    const drawn = figure('Hotelling\u2019s T\u00b2 of all parameters', '', {height: 170, ...options});
    const {plot: chart} = drawn;
    const limits = chosen.map(k => s.t2_limit[first + k]);
    chart.line(x, limits, {line_color: colour('bad'), line_dash: [6, 4]});
    const tones = t2.map((v, k) => colour(v > limits[k] ? 'bad' : 'x'));
    chart.scatter(x, t2, {size: 6, fill_color: tones, line_color: tones});
    plots.push(drawn);
  }
  return score.some(v => Math.abs(v) > 126.5 * s.scoreStep);
}

// --- types and recordings ----------------------------------------------------------------------

function startTypes() {
  const blocks = [...document.querySelectorAll('div.type')];
  if (!blocks.length) return;
  const choice = byId('type-shown');
  choice.replaceChildren(...blocks.map((b, k) => make('option', {value: k}, b.dataset.imu)));
  choice.addEventListener('change', () => population(0));
  for (const button of document.querySelectorAll('.population .choose'))
    button.addEventListener('click', () => population(+button.dataset.k));
}

async function population(p) {
  const blocks = [...document.querySelectorAll('div.type')];
  if (!blocks.length) return;
  const block = blocks[+byId('type-shown').value];
  blocks.forEach(b => { b.hidden = b !== block; });
  const s = await sessions();
  await library();
  const mine = [...units.serials.keys()].filter(u => units.imus[units.imu[u]] === block.dataset.imu && units.sessions[u]);
  const [name, words, unit, scale] = mine.length ? parametersOf(mine[0])[p] : units.parameters[p];
  const of = mine.map(u => s.values[p][s.first[u] + units.sessions[u] - 1] / scale);
  const known = of.filter(isFinite);
  byId('population-title').textContent = `${name}, ${words}, of ${block.dataset.imu}`;
  for (const button of document.querySelectorAll('.population .choose'))
    button.setAttribute('aria-pressed', +button.dataset.k === p);
  if (!known.length) { await show('population-plot', []); await show('lots-plot', []); return; }
  const limit = mine.length ? perUnit(s.limit, p, mine[0]) / scale : NaN;
  await show('population-plot', [histogram(known, limit, unit)], () => population(p));
  const lots = [...new Set(mine.map(u => units.lot[u]))].sort((a, b) => collator.compare(units.lots[a], units.lots[b]));
  await show('lots-plot', lots.length > 1 ? [byLot(mine, of, lots, unit)] : [], () => population(p));
  byId('population-plot').dataset.parameter = name;
}

function histogram(known, limit, unit) {
  known.sort((a, b) => a - b);
  const at = share => known[Math.min(known.length - 1, Math.floor(share * known.length))];
  const low = known[0], high = known[known.length - 1];
  // Freedman and Diaconis 1981: twice the interquartile range over the cube root of the number.
  const width = 2 * (at(0.75) - at(0.25)) / Math.cbrt(known.length);
  const bins = Math.max(1, Math.min(120, width > 0 ? Math.ceil((high - low) / width) : 1));
  const step = (high - low) / bins || 1, counts = new Array(bins).fill(0);
  for (const v of known) counts[Math.min(bins - 1, Math.floor((v - low) / step))] += 1;
  const drawn = figure('', 'units', {height: 240}), {plot} = drawn;
  const left = counts.map((_, k) => low + k * step);
  plot.quad({left, right: left.map(v => v + step), bottom: counts.map(() => 0), top: counts,
             fill_color: colour('static'), line_color: colour('paper')});
  const most = Math.max(...counts);
  if (isFinite(limit) && Math.max(Math.abs(low), Math.abs(high)) > limit / 3)
    for (const x of [-limit, limit]) plot.line([x, x], [0, most], {line_color: colour('bad'), line_dash: [6, 4]});
  for (const axis of plot.below) axis.setv({axis_label: unit});
  return drawn;
}

function byLot(mine, of, lots, unit) {
  const rows = Math.min(lots.length, 40);
  const title = lots.length > rows ? `The first ${rows} of ${lots.length} lots` : 'By lot';
  const names = lots.slice(0, rows).map(l => plain(units.lots[l] || 'no lot')).reverse();
  const drawn = figure(title, '', {height: 90 + 22 * rows, y_range: names}), {plot} = drawn;
  const place = new Map(lots.slice(0, rows).map((l, k) => [l, rows - k - 0.5]));
  const inside = mine.map((u, k) => [u, of[k]]).filter(([u, v]) => isFinite(v) && place.has(units.lot[u]));
  // Spread by the number of the unit, the same each time.
  const y = inside.map(([u]) => place.get(units.lot[u]) + ((u * 0.618034) % 1 - 0.5) * 0.7);
  plot.scatter(inside.map(([, v]) => v), y, {size: 3, fill_color: colour('x'), line_color: null, fill_alpha: 0.6});
  for (const axis of plot.below) axis.setv({axis_label: unit});
  return drawn;
}

async function months() {
  const s = await sessions();
  await library();
  const counts = new Map();
  let row = 0;
  units.serials.forEach((_, u) => {
    for (let k = 0; k < units.rows[u]; ++k, ++row) {
      if (s.date[row] === BAD) continue;
      const date = new Date(s.date[row] * MINUTE);
      const month = Date.UTC(date.getUTCFullYear(), date.getUTCMonth());
      const both = counts.get(month) || [0, 0];
      both[s.fine[row] ? 0 : 1] += 1;
      counts.set(month, both);
    }
  });
  if (!counts.size) return;
  const at = [...counts.keys()].sort((a, b) => a - b), fine = at.map(m => counts.get(m)[0]);
  const all = at.map((m, k) => fine[k] + counts.get(m)[1]);
  const drawn = figure('Recordings a month', '', {height: 210, x_axis_type: 'datetime'}), {plot} = drawn;
  drawn.names.push([colour('good-area'), 'calibrated'], [colour('bad'), 'failed']);
  const right = at.map(m => m + 0.85 * MONTH);
  plot.quad({left: at, right, bottom: at.map(() => 0), top: fine, fill_color: colour('good-area'), line_color: null});
  plot.quad({left: at, right, bottom: fine, top: all, fill_color: colour('bad'), line_color: null});
  await show('months-plot', [drawn], months);
}

// --- start -------------------------------------------------------------------------------------

// Where a person, or a measurement, sees how far it is.
function ready(what) {
  document.documentElement.dataset.ready = what;
  performance.mark(what);
}

async function start() {
  units = await unpack('units-data');
  startTable();
  startTypes();
  ready('table');
  byId('close').addEventListener('click', closeUnit);
  byId('unit').addEventListener('keydown', event => { if (event.key === 'Escape') closeUnit(); });
  addEventListener('hashchange', openUnit);
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', async () => {
    for (const redraw of [...again.values()]) if (redraw) await redraw();
  });
  await openUnit();
  // The drawings of the whole wait until the table stands on the screen.
  requestAnimationFrame(() => setTimeout(async () => {
    await population(0);
    await months();
    ready('drawn');
  }));
}

start();
})();
