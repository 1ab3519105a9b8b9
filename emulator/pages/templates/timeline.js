{
const root = document.querySelector("#timeline"), data = JSON.parse(document.querySelector("#timeline-data").textContent);
const pick = selector => root.querySelector(selector);
const axis = pick(".axis"), lanes = pick(".lanes"), scroll = pick(".scroll"), tip = pick(".tip"), filter = pick("input[type=search]");
const GUTTER = 74, AXIS_PX = 26, BAR_PX = 15, MOST_ARROWS = 1000, LEAST_US = 20, NEAR_PX = 7;
const MARKS = {failure: "rust", process: "quiet", warning: "orange", event: "blue"};
const ORDER = ["event", "warning", "process", "failure"];

// Frames with their receptions, by the time at which they were sent.
const frames = [], off = new Set();
let sent = 0, next = 0, longest = 0;
const arrived = data.delay.filter(delay => delay >= 0).sort((a, b) => a - b);
const usual = arrived.length ? arrived[arrived.length >> 1] : 0;
data.heard.forEach((count, i) => {
  sent += data.time[i];
  frames.push({time: sent, wait: data.wait[i], sender: data.sender[i], seq: data.seq[i], copy: data.copy[i], bytes: data.bytes[i], from: next, to: next += count});
});
for (const delay of arrived.slice(-1)) longest = delay;
longest = Math.max(longest, usual);
const endOf = (frame, i) => frame.time + (data.delay[i] >= 0 ? data.delay[i] : usual);
const firstAfter = time => {
  let low = 0, high = frames.length;
  while (low < high) { const middle = (low + high) >> 1; frames[middle].time < time ? low = middle + 1 : high = middle; }
  return low;
};

// Rows of the faults' bars above the lanes: those that overlap are one below the other.
const rowEnds = [];
const bars = data.bars.map(([label, start, end, nodes]) => {
  let row = rowEnds.findIndex(until => until <= start);
  if (row < 0) row = rowEnds.length;
  rowEnds[row] = end;
  return {label, start, end, nodes: new Set(nodes), row};
});
const barRows = Math.min(rowEnds.length, 8);

const opening = [data.view[0] - .02 * (data.view[1] - data.view[0]), data.view[1]];
let [start, end] = opening, shown = [], lanePx = 24, hover = null, colours = {}, width = 600;
const whole = Math.max(data.end, 1);
const x = time => GUTTER + (time - start) / (end - start) * (width - GUTTER);
const timeAt = px => start + (px - GUTTER) / (width - GUTTER) * (end - start);
const colour = name => colours[name] ??= getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
const seconds = time => (time / 1e6).toFixed(end - start < 2000 ? 6 : end - start < 2e6 ? 4 : 2) + " s";
const middle = lane => (lane + .5) * lanePx;

function choose() {
  const words = filter.value.toLowerCase().split(/[\s,]+/).filter(Boolean);
  const named = i => words.some(word => data.nodes[i].toLowerCase().includes(word));
  const all = words.length ? [...data.nodes.keys()].filter(named) : data.first;
  shown = all.slice(0, data.lanes);
  lanePx = shown.length > 30 ? 18 : shown.length > 14 ? 22 : shown.length > 5 ? 28 : 44;
  pick(".count").textContent = shown.length < data.nodes.length ? `${shown.length} of ${data.nodes.length} vehicles` : "";
  draw();
}

function fit(canvas, height) {
  const ratio = window.devicePixelRatio || 1;
  canvas.style.height = height + "px";
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "12px system-ui, sans-serif";
  pen.textBaseline = "middle";
  return pen;
}

let waiting = false;
function draw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; paint(); });
}

function paint() {
  width = Math.max(scroll.clientWidth, 260);
  drawAxis();
  drawLanes();
}

function ticks() {
  const raw = (end - start) / Math.max(2, (width - GUTTER) / 110), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(factor => factor * power).find(each => each >= raw);
  const found = [];
  for (let time = Math.ceil(start / step) * step; time <= end; time += step) found.push(time);
  const digits = Math.max(0, 6 - Math.floor(Math.log10(step)));
  return found.map(time => [time, (time / 1e6).toFixed(Math.min(6, digits))]);
}

function drawAxis() {
  const pen = fit(axis, AXIS_PX + barRows * BAR_PX);
  pen.fillStyle = colour("quiet");
  pen.textAlign = "center";
  for (const [time, label] of ticks()) {
    const at = x(time), half = pen.measureText(label).width / 2;
    if (at - half > GUTTER - 8 && at + half < width) pen.fillText(label, at, 10);
    pen.fillRect(at, AXIS_PX - 6, 1, 4);
  }
  pen.textAlign = "left";
  pen.fillText("time (s)", 0, 10);
  pen.save();
  pen.beginPath(); pen.rect(GUTTER, 0, width, 1e4); pen.clip();
  for (const bar of bars) {
    if (bar.end < start || bar.start > end || bar.row >= barRows) continue;
    const left = Math.max(x(bar.start), GUTTER), right = Math.max(left + 2, Math.min(x(bar.end), width)), top = AXIS_PX + bar.row * BAR_PX;
    pen.globalAlpha = hover?.bar === bar ? .55 : .3;
    pen.fillStyle = colour("purple");
    pen.fillRect(left, top, right - left, BAR_PX - 2);
    pen.globalAlpha = 1;
    if (bar.start >= start) pen.fillRect(left, top, 2, BAR_PX - 2);
    pen.fillStyle = colour("ink");
    pen.save();
    pen.beginPath(); pen.rect(left, top, right - left, BAR_PX); pen.clip();
    pen.fillText(bar.label, left + 6, top + BAR_PX / 2 - .5);
    pen.restore();
  }
  pen.restore();
}

function drawLanes() {
  const height = Math.max(1, shown.length) * lanePx + 4, pen = fit(lanes, height);
  const laneOf = new Map(shown.map((node, lane) => [node, lane]));
  shown.forEach((node, lane) => {
    pen.fillStyle = colour("line");
    pen.fillRect(GUTTER, middle(lane), width - GUTTER, 1);
  });
  pen.fillStyle = colour("grid");
  for (const [time] of ticks()) pen.fillRect(x(time), 0, 1, height);
  pen.save();
  pen.beginPath(); pen.rect(GUTTER, 0, width, height); pen.clip();
  for (const bar of bars) {
    if (bar.end < start || bar.start > end) continue;
    const left = Math.max(x(bar.start), GUTTER), right = Math.max(left + 2, Math.min(x(bar.end), width));
    pen.fillStyle = colour("purple");
    for (const node of bar.nodes) {
      if (!laneOf.has(node)) continue;
      pen.globalAlpha = hover?.bar === bar ? .3 : .13;
      pen.fillRect(left, laneOf.get(node) * lanePx + 1, right - left, lanePx - 2);
    }
  }
  pen.globalAlpha = 1;
  for (const [node, from, to] of data.down) {
    if (!laneOf.has(node) || to < start || from > end) continue;
    const left = Math.max(x(from), GUTTER), right = Math.min(x(to), width), top = middle(laneOf.get(node));
    pen.fillStyle = colour("grey");
    pen.globalAlpha = .45;
    pen.fillRect(left, top - lanePx * .3, Math.max(1, right - left), lanePx * .6);
    pen.globalAlpha = 1;
  }
  const first = firstAfter(start - longest), last = firstAfter(end);
  let arrows = 0;
  for (let n = first; n < last && arrows <= MOST_ARROWS; n++) {
    if (laneOf.has(frames[n].sender)) for (let i = frames[n].from; i < frames[n].to; i++) arrows += laneOf.has(data.receiver[i]) && !hidden(i);
  }
  const asArrows = arrows <= MOST_ARROWS;
  (asArrows ? drawArrows : drawTicks)(pen, first, last, laneOf);
  if (!asArrows && hover?.frame) drawArrows(pen, frames.indexOf(hover.frame), frames.indexOf(hover.frame) + 1, laneOf);
  pick(".hint").hidden = asArrows;
  for (const [time, node, kind] of data.marks.filter(mark => ORDER.includes(mark[2])).sort((a, b) => ORDER.indexOf(a[2]) - ORDER.indexOf(b[2]))) {
    if (time < start || time > end || off.has(kind)) continue;
    if (node < 0) {
      pen.fillStyle = colour(MARKS[kind]);
      pen.fillRect(x(time), 0, 1.5, height);
      sign(pen, kind, x(time), 7);
    } else if (laneOf.has(node)) sign(pen, kind, x(time), middle(laneOf.get(node)));
  }
  pen.restore();
  pen.fillStyle = colour("ink");
  shown.forEach((node, lane) => {
    let name = data.nodes[node];
    while (name.length > 2 && pen.measureText(name).width > GUTTER - 10) name = name.slice(0, -2) + "…";
    pen.fillText(name, 0, middle(lane));
  });
}

function sign(pen, kind, at, y) {
  const size = kind === "failure" ? 6 : 5;
  pen.fillStyle = pen.strokeStyle = colour(MARKS[kind]);
  pen.lineWidth = 2.5;
  pen.beginPath();
  if (kind === "failure") {
    pen.fillStyle = colour("paper");
    pen.arc(at, y, size + 3, 0, 7); pen.fill(); pen.beginPath();
    pen.moveTo(at - size, y - size); pen.lineTo(at + size, y + size); pen.moveTo(at + size, y - size); pen.lineTo(at - size, y + size);
    pen.stroke();
    return;
  }
  if (kind === "event") { pen.moveTo(at, y - size); pen.lineTo(at + size, y); pen.lineTo(at, y + size); pen.lineTo(at - size, y); }
  else if (kind === "warning") { pen.moveTo(at, y - size); pen.lineTo(at + size, y + size); pen.lineTo(at - size, y + size); }
  else { pen.moveTo(at - size + 1, y - size); pen.lineTo(at + size, y); pen.lineTo(at - size + 1, y + size); }
  pen.closePath();
  pen.fill();
  pen.lineWidth = 1.5; pen.strokeStyle = colour("paper"); pen.stroke();
}

function hidden(i) { return off.has(data.outcomes[data.outcome[i]][0]); }

// One path for all arrows of a colour and kind.
function drawArrows(pen, first, last, laneOf) {
  const strong = hover?.frame, dots = new Path2D(), faint = new Map(), bold = new Map();
  let at = null;
  for (let n = first; n < last; n++) {
    const frame = frames[n], from = laneOf.get(frame.sender);
    if (from === undefined) continue;
    for (let i = frame.from; i < frame.to; i++) {
      const to = laneOf.get(data.receiver[i]), [, name, stays] = data.outcomes[data.outcome[i]];
      if (to === undefined || hidden(i)) continue;
      const paths = frame === strong ? bold : faint, arrives = data.delay[i] >= 0, key = name + (arrives ? "" : " lost");
      if (!paths.has(key)) paths.set(key, {name, arrives, lines: new Path2D(), ends: new Path2D()});
      arrow(paths.get(key), x(frame.time), middle(from), x(endOf(frame, i)), middle(to), stays);
    }
    if (frame === strong) at = [x(frame.time), middle(from)];
    else if (frame.time >= start) { dots.moveTo(x(frame.time) + 2.6, middle(from)); dots.arc(x(frame.time), middle(from), 2.6, 0, 7); }
  }
  stroke(pen, faint, 1.1, strong ? .18 : 0);
  pen.fillStyle = colour("ink");
  pen.fill(dots);
  stroke(pen, bold, 2.2, 0);
  if (at) { pen.fillStyle = colour("ink"); pen.beginPath(); pen.arc(...at, 4, 0, 7); pen.fill(); }
}

function stroke(pen, paths, thickness, opacity) {
  for (const {name, arrives, lines, ends} of paths.values()) {
    pen.lineWidth = thickness;
    pen.globalAlpha = opacity || (name === "green" ? .75 : .95);
    pen.strokeStyle = pen.fillStyle = colour(name);
    pen.setLineDash(arrives ? [] : [4, 3]);
    pen.stroke(lines);
    pen.setLineDash([]);
    arrives ? pen.fill(ends) : pen.stroke(ends);
  }
  pen.globalAlpha = 1;
}

function arrow({arrives, lines, ends}, left, top, right, bottom, stays) {
  const apart = Math.hypot(right - left, bottom - top) || 1, along = (right - left) / apart, down = (bottom - top) / apart;
  if (!stays) { lines.moveTo(left, top); lines.lineTo(right, bottom); }
  if (arrives) {
    ends.moveTo(right, bottom);
    ends.lineTo(right - 7 * along + 3 * down, bottom - 7 * down - 3 * along);
    ends.lineTo(right - 7 * along - 3 * down, bottom - 7 * down + 3 * along);
    ends.closePath();
    return;
  }
  const [h, v] = stays ? [left, top] : [right, bottom];
  ends.moveTo(h - 3.5, v - 3.5); ends.lineTo(h + 3.5, v + 3.5); ends.moveTo(h + 3.5, v - 3.5); ends.lineTo(h - 3.5, v + 3.5);
}

// Too many for arrows: what a vehicle sent is above its line, what became of what it was to receive below it.
function drawTicks(pen, first, last, laneOf) {
  const columns = Math.ceil(width), sends = new Map(), found = new Map();
  for (let n = first; n < last; n++) {
    const frame = frames[n], from = laneOf.get(frame.sender);
    if (from !== undefined) count(sends, from * columns + Math.floor(x(frame.time)), 0);
    for (let i = frame.from; i < frame.to; i++) {
      const to = laneOf.get(data.receiver[i]);
      if (to !== undefined && !hidden(i)) count(found, to * columns + Math.floor(x(endOf(frame, i))), data.outcome[i]);
    }
  }
  const half = lanePx / 2 - 2;
  pen.fillStyle = colour("ink");
  for (const key of sends.keys()) pen.fillRect(key % columns, middle(Math.floor(key / columns)) - half, 1, half);
  for (const [key, counts] of found) {
    const total = counts.reduce((sum, each) => sum + (each || 0), 0);
    let top = middle(Math.floor(key / columns)) + 1;
    counts.forEach((each, outcome) => {
      if (!each) return;
      pen.fillStyle = colour(data.outcomes[outcome][1]);
      pen.fillRect(key % columns, top, 1, half * each / total);
      top += half * each / total;
    });
  }
}
function count(counts, key, outcome) {
  const each = counts.get(key) ?? [];
  each[outcome] = (each[outcome] || 0) + 1;
  counts.set(key, each);
}

// Pointing at something.
function near(px, py) {
  let best = null, least = NEAR_PX + 3;
  const laneOf = new Map(shown.map((node, lane) => [node, lane]));
  for (const mark of data.marks) {
    const [time, node, kind] = mark;
    if (off.has(kind) || time < start || time > end || (node >= 0 && !laneOf.has(node))) continue;
    const apart = Math.hypot(x(time) - px, (node < 0 ? Math.max(7, Math.min(py, 1e6)) : middle(laneOf.get(node))) - py);
    if (apart < least) { least = apart; best = {mark}; }
  }
  if (best) return best;
  least = NEAR_PX;
  const first = firstAfter(start - longest), last = firstAfter(end);
  const asArrows = pick(".hint").hidden, lane = shown[Math.floor(py / lanePx)], above = py % lanePx < lanePx / 2;
  for (let n = first; n < last; n++) {
    const frame = frames[n], from = laneOf.get(frame.sender);
    if (!asArrows) {
      const atSender = Math.abs(x(frame.time) - px);
      if (above && frame.sender === lane && atSender < least) { least = atSender; best = {frame}; }
      if (!above) for (let i = frame.from; i < frame.to; i++) {
        const apart = Math.abs(x(endOf(frame, i)) - px);
        if (data.receiver[i] === lane && !hidden(i) && apart < least) { least = apart; best = {frame, i}; }
      }
      continue;
    }
    if (from === undefined) continue;
    const left = x(frame.time), top = middle(from);
    const atSender = Math.hypot(left - px, top - py);
    if (atSender < Math.min(least, 5)) { least = atSender; best = {frame}; }
    for (let i = frame.from; i < frame.to; i++) {
      const to = laneOf.get(data.receiver[i]);
      if (to === undefined || hidden(i) || data.outcomes[data.outcome[i]][2]) continue;
      const right = x(endOf(frame, i)), bottom = middle(to), long = (right - left) ** 2 + (bottom - top) ** 2 || 1;
      const share = Math.max(0, Math.min(1, ((px - left) * (right - left) + (py - top) * (bottom - top)) / long));
      const apart = Math.hypot(left + share * (right - left) - px, top + share * (bottom - top) - py) + .5;
      if (apart < least) { least = apart; best = {frame, i}; }
    }
  }
  if (best) return best;
  const node = shown[Math.floor(py / lanePx)], time = timeAt(px);
  const down = data.down.find(([which, from, to]) => which === node && from <= time && time < to);
  const bar = bars.find(each => each.nodes.has(node) && each.start <= time && time < each.end);
  return bar || down ? {bar, down} : null;
}

function told({mark, frame, i, bar, down}) {
  if (mark) return [`${seconds(mark[0])}  ${mark[1] < 0 ? "" : data.nodes[mark[1]]}`, mark[3]];
  if (frame) {
    const name = `frame ${frame.seq}${frame.copy ? "." + frame.copy : ""} of ${data.nodes[frame.sender]}, ${frame.bytes} bytes`;
    const lines = [name, `sent at ${seconds(frame.time)}${frame.wait ? `, after ${(frame.wait / 1000).toFixed(3)} ms in the queue` : ""}`];
    if (i === undefined) {
      const counts = {};
      for (let k = frame.from; k < frame.to; k++) counts[data.outcomes[data.outcome[k]][0]] = (counts[data.outcomes[data.outcome[k]][0]] || 0) + 1;
      return [...lines, ...Object.entries(counts).map(([outcome, number]) => `${number} ${outcome}`)];
    }
    const cause = data.causes[data.cause[i]], delay = data.delay[i];
    const when = delay >= 0 ? ` after ${(delay / 1000).toFixed(3)} ms` : "";
    return [...lines, `at ${data.nodes[data.receiver[i]]}: ${data.outcomes[data.outcome[i]][0]}${when}${cause ? ` (${cause})` : ""}`];
  }
  const lines = down ? [`${data.nodes[down[0]]} is down`, `${seconds(down[1])} – ${seconds(down[2])}`] : [];
  return bar ? [...lines, `fault ${bar.label}`, `${seconds(bar.start)} – ${seconds(bar.end)}`, `on ${bar.nodes.size} of ${data.nodes.length} vehicles`] : lines;
}

function point(event, found) {
  const same = JSON.stringify([hover?.frame?.from, hover?.i, hover?.bar?.label, hover?.mark]) === JSON.stringify([found?.frame?.from, found?.i, found?.bar?.label, found?.mark]);
  hover = found;
  tip.hidden = !found;
  if (found) {
    tip.textContent = told(found).join("\n");
    const box = root.getBoundingClientRect();
    const left = Math.min(event.clientX - box.left + 14, box.width - tip.offsetWidth - 4);
    tip.style.left = Math.max(0, left) + "px";
    tip.style.top = event.clientY - box.top + 16 + "px";
  }
  if (!same) draw();
}

// Moving.
function show(from, to) {
  const least = Math.max(LEAST_US, 1), span = Math.min(Math.max(to - from, least), whole * 1.04);
  const centre = (from + to) / 2;
  start = Math.max(-whole * .02, Math.min(centre - span / 2, whole * 1.02 - span));
  end = start + span;
  draw();
}
const instants = () => [...data.marks.filter(mark => !off.has(mark[2])).map(mark => mark[0]), ...bars.flatMap(bar => [bar.start, bar.end])];
function anchor() {
  const centre = (start + end) / 2, seen = instants().filter(time => start <= time && time <= end);
  return seen.length ? seen.reduce((a, b) => Math.abs(a - centre) <= Math.abs(b - centre) ? a : b) : centre;
}
const zoom = (factor, at = anchor()) => show(at - (at - start) * factor, at + (end - at) * factor);
const pan = share => show(start + share * (end - start), end + share * (end - start));
function step(way) {
  const times = [...new Set(instants())].sort((a, b) => a - b);
  const centre = (start + end) / 2, slack = (end - start) / 1000;
  const time = way > 0 ? times.find(each => each > centre + slack) : times.findLast(each => each < centre - slack);
  if (time !== undefined) { start = time - (end - start) / 2; const span = (time - start) * 2; end = start + span; draw(); }
}
const actions = {
  in: () => zoom(.5), out: () => zoom(2), left: () => pan(-.25), right: () => pan(.25), all: () => show(0, whole),
  start: () => show(...opening), before: () => step(-1), after: () => step(1),
};
root.querySelectorAll("button[data-do]").forEach(button => button.onclick = () => actions[button.dataset.do]());
const keys = {"+": "in", "=": "in", "-": "out", ArrowLeft: "left", ArrowRight: "right", Home: "all", "0": "start", p: "before", n: "after"};
const stage = pick(".stage");
stage.onkeydown = event => {
  if (event.key === "Escape") stage.blur();
  else if (keys[event.key] && !event.ctrlKey && !event.metaKey && !event.altKey) { actions[keys[event.key]](); event.preventDefault(); }
};
for (const canvas of [axis, lanes]) {
  canvas.addEventListener("wheel", event => {
    if (document.activeElement !== stage && !event.ctrlKey) return;
    event.preventDefault();
    const step = event.deltaMode ? 30 : 1;
    if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) pan(event.deltaX * step / (width - GUTTER));
    else zoom(Math.exp(Math.max(-120, Math.min(120, event.deltaY * step)) / 300), timeAt(event.offsetX));
  }, {passive: false});
  let held = null;
  canvas.onpointerdown = event => { held = [event.clientX, start, end]; canvas.setPointerCapture(event.pointerId); stage.focus({preventScroll: true}); };
  canvas.onpointermove = event => {
    if (!held) {
      const bar = canvas === axis && bars.find(each => each.row === Math.floor((event.offsetY - AXIS_PX) / BAR_PX) && x(each.start) <= event.offsetX && event.offsetX <= Math.max(x(each.end), x(each.start) + 4));
      point(event, canvas === axis ? bar && {bar} : near(event.offsetX, event.offsetY));
      return;
    }
    const moved = (event.clientX - held[0]) / (width - GUTTER) * (held[2] - held[1]);
    show(held[1] - moved, held[2] - moved);
  };
  canvas.onpointerup = canvas.onpointercancel = () => held = null;
  canvas.onpointerleave = event => point(event, null);
}
root.querySelectorAll(".keys input").forEach(box => box.onchange = () => { box.checked ? off.delete(box.value) : off.add(box.value); draw(); });
filter.oninput = choose;
new ResizeObserver(draw).observe(scroll);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { colours = {}; draw(); });
pick(".board").hidden = false;
choose();
}
