// One volume, or two with their difference: slices across z, y, x with one zoom each, grey window, profile, histogram.
// Of a series in time: a slider for the time, and a player. Of a scan: its views as a stack, see scan.js.
import { PLANES, Picture, debounce, fetchTile, namesOf, position, usualWindow, windowButtons, windowSliders } from "./picture.js";
import { showScan } from "./scan.js";

const $ = (name) => document.getElementById(name);
const COLOURS = ["#1f6feb", "#d29922"];
const json = async (url) => { const answer = await fetch(url), body = await answer.json(); if (!answer.ok) throw new Error(body.message); return body; };

let volumes = [], rows = [], profiled = null, plots = {}, crossed = true;

/** A row of slices: `url(axis, index)` of its tiles, `shape` and facts of its volume. */
function addRow(title, facts, url) {
  const heading = document.createElement("h2"), box = document.createElement("div");
  heading.textContent = title; box.className = "slices";
  const row = { title, facts, url, window: facts.window, pictures: [] };
  for (let axis = 0; axis < 3; axis++) {
    const canvas = document.createElement("canvas");
    canvas.id = `slice${rows.length}${axis}`; canvas.tabIndex = 0;
    canvas.setAttribute("aria-label", `${title}, slice across ${namesOf(facts)[axis]}`);
    box.append(canvas);
    row.pictures.push(new Picture(canvas, {
      point: (r, c) => { $("value").textContent = r === null ? "" : `${place(row, axis, r, c)}: ${valuesAt(row, axis, r, c)} ${facts.unit}`; },
      pick: (r, c) => PLANES[axis].forEach((side, i) => { $(`at${side}`).value = Math.floor([r, c][i] * volumes[0].shape[side] / facts.shape[side]); showAxis(side); }),
      choosing: () => $("measure").checked,
      stretch: axis > 0 && facts.angles.length > 0,  // an angle has no length
      line: (line) => { profiled = { axis, line, row }; showProfile(); },
      moved: () => follow(row, axis),
      draw: (context, at) => { drawCross(context, canvas, at, row, axis); drawScale(context, canvas, at.x, row, axis); },
    }));
    canvas.addEventListener("keydown", (event) => {
      const step = { PageUp: 1, PageDown: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      $(`at${axis}`).value = Number($(`at${axis}`).value) + step; showAxis(axis);
    });
  }
  $("slices").append(heading, box);
  rows.push(row);
  return row;
}

/** Index in another volume at the same height of its field. */
const indexIn = (facts, axis) => Math.min(facts.shape[axis] - 1, Math.floor((Number($(`at${axis}`).value) + 0.5) * facts.shape[axis] / volumes[0].shape[axis]));

function place({ facts }, axis, row, col) {
  const at = [0, 0, 0];
  at[axis] = indexIn(facts, axis); at[PLANES[axis][0]] = row; at[PLANES[axis][1]] = col;
  return at.map((index, i) => `${namesOf(facts)[i]} ${position(facts, i, index)}`).join(", ");
}

/** What every row shows at a place of one of them: values are compared, not remembered. */
function valuesAt(row, axis, r, c) {
  const values = rows.map((other) => other.pictures[axis].at(...[r, c].map((at, i) => (at + 0.5) * other.facts.shape[PLANES[axis][i]] / row.facts.shape[PLANES[axis][i]])));
  return values.map((value, i) => value === undefined ? "" : `${rows.length > 1 ? `${rows[i].title} ` : ""}${value.toPrecision(5)}`).filter(Boolean).join(", ");
}

/** Where the other two slices cut this one, with a gap about the point. */
function drawCross(context, canvas, { x, y }, { facts }, axis) {
  if (!crossed) return;
  const { width, height } = canvas.getBoundingClientRect(), [down, across] = PLANES[axis].map((side) => indexIn(facts, side) + 0.5);
  const [px, py] = [x(across), y(down)];
  context.strokeStyle = "#d2992299"; context.lineWidth = 1; context.beginPath();
  for (const [from, to] of [[0, px - 14], [px + 14, width]]) { context.moveTo(from, py); context.lineTo(to, py); }
  for (const [from, to] of [[0, py - 14], [py + 14, height]]) { context.moveTo(px, from); context.lineTo(px, to); }
  context.stroke();
}

/** Names of the two axes, and a bar of a round length in the lower left corner. */
function drawScale(context, canvas, x, { facts }, axis) {
  context.fillStyle = "#fff"; context.strokeStyle = "#000"; context.lineWidth = 3; context.font = "12px system-ui";
  const [down, across] = PLANES[axis].map((side) => namesOf(facts)[side]), named = `${across} →  ${down} ↓`;
  context.strokeText(named, 10, 16); context.fillText(named, 10, 16);
  const pixel = facts.voxel[PLANES[axis][1]], perScreen = pixel / (x(1) - x(0)), wanted = 90 * perScreen;
  const ten = 10 ** Math.floor(Math.log10(wanted)), round = [5, 2, 1].find((n) => n * ten <= wanted) * ten, wide = round / perScreen;
  const height = canvas.getBoundingClientRect().height;
  context.strokeRect(10, height - 14, wide, 4); context.fillRect(10, height - 14, wide, 4);
  const text = `${Number(round.toPrecision(1))} ${facts.length_unit}`;
  context.strokeText(text, 10, height - 20); context.fillText(text, 10, height - 20);
}

/** Other rows show the part that this one shows; what is seen is fetched at its own resolution. */
function follow(row, axis) {
  for (const other of rows) {
    const [from, to] = [row.pictures[axis], other.pictures[axis]];
    if (other !== row) { to.zoom = from.zoom; to.centre = [...from.centre]; to.redraw(); }
    other.refine = other.refine || [0, 1, 2].map((each) => debounce(() => showSlice(other, each), 150));
    other.refine[axis]();
  }
}

/** Number of the time that is shown, in a volume that may not change. */
const timeIn = (facts) => Math.round(Number($("time").value) * Math.max(0, facts.seconds.length - 1) / Math.max(1, Number($("time").max)));

async function showSlice(row, axis) {
  const index = indexIn(row.facts, axis), time = timeIn(row.facts), extent = PLANES[axis].map((i) => row.facts.shape[i]), picture = row.pictures[axis];
  const [r0, r1, c0, c1] = picture.tile ? picture.seen() : [0, extent[0], 0, extent[1]];
  try {
    const tile = await fetchTile(`${row.url(axis, index)}?region=${r0},${r1},${c0},${c1}&time=${time}`);
    if (index !== indexIn(row.facts, axis) || time !== timeIn(row.facts)) return;
    if (!row.window) { const high = Math.max(...usualWindow(tile).map(Math.abs)); setWindow(row, [-high, high]); }
    picture.window = row.window;
    picture.show(tile, extent, tile.region);
    if (tile.ready < 1) again(row, axis, tile.ready);
    else if (reading.size && reading.delete(picture) && !reading.size) { $("reading").textContent = ""; showHistogram(); }
  } catch (error) { $("value").textContent = error.message; }
}

/** Pictures of a volume that the server still reads are fetched until it has read all. */
const reading = new Set();
function again(row, axis, ready) {
  const picture = row.pictures[axis];
  $("reading").textContent = ` ${(100 * ready).toFixed(0)} % read`;
  reading.add(picture);
  clearTimeout(picture.again); picture.again = setTimeout(() => showSlice(row, axis), 800);
}

async function showAxis(axis) {
  $(`where${axis}`).textContent = position(volumes[0], axis, Number($(`at${axis}`).value));
  rows.forEach((row) => row.pictures.forEach((picture) => picture.redraw()));  // the cross-hair moves
  await Promise.all(rows.map((row) => showSlice(row, axis)));
  if (profiled && profiled.axis === axis) showProfile();
}

async function showTime() {
  const { seconds } = volumes.find((each) => each.seconds.length > Number($("time").max));
  $("when").textContent = `${Number(seconds[Number($("time").value)].toPrecision(4))} s`;
  await Promise.all([0, 1, 2].map(showAxis));
}

let player = 0;  // number of the player that runs, 0: none
function play() {
  const own = player ? 0 : Date.now();
  player = own;
  $("play").textContent = own ? "Pause" : "Play";
  if (own) playOn(own); else showHistogram();
}

async function playOn(own) {
  while (player === own) {
    $("time").value = (Number($("time").value) + 1) % (Number($("time").max) + 1);
    await Promise.all([showTime(), new Promise((done) => setTimeout(done, 400))]);
  }
}

function startTimes() {
  const last = Math.max(...volumes.map((each) => each.seconds.length)) - 1;
  if (last < 1) return;
  $("times").hidden = false;
  $("time").max = last;
  const show = debounce(async () => { await showTime(); showHistogram(); }, 40), step = (by) => { $("time").value = Number($("time").value) + by; show(); };
  $("time").addEventListener("input", show);
  $("play").addEventListener("click", play);
  document.addEventListener("keydown", (event) => {
    const act = { " ": play, ",": () => step(-1), ".": () => step(1) }[event.key];
    if (!act || event.target.matches("button, input:not([type=range])")) return;
    event.preventDefault(); act();
  });
}

let setDifference = null;
function setWindow(row, window) {
  row.window = window;
  setDifference([2 * window[0], 2 * window[1]], window);
  row.pictures.forEach((picture) => picture.setWindow(window));
}

function draw(name, title, unit, x, lines, scales) {
  plots[name]?.destroy();
  const colour = getComputedStyle(document.body).color, axis = { stroke: colour, grid: { stroke: "#8884" }, ticks: { stroke: "#8884" } };
  plots[name] = new uPlot({
    width: $(name).clientWidth || 600, height: 260, scales, axes: [{ ...axis, label: title }, { ...axis, label: unit, size: 70 }],
    series: [{ label: title }, ...lines.map((line, i) => ({ label: line.name, stroke: COLOURS[i], width: 1.5 }))],
    legend: { show: name !== "angles" && name !== "light" }, hooks: name === "histogram" ? { draw: [drawWindow] } : {},
  }, [x, ...lines.map((line) => line.values)], $(name));
}

function drawWindow(plot) {
  const { ctx, bbox } = plot;
  ctx.strokeStyle = "#3fb950"; ctx.lineWidth = 2;
  for (const edge of rows[0].window) {
    const at = plot.valToPos(edge, "x", true);
    if (at < bbox.left || at > bbox.left + bbox.width) continue;
    ctx.beginPath(); ctx.moveTo(at, bbox.top); ctx.lineTo(at, bbox.top + bbox.height); ctx.stroke();
  }
}

/** Width of the one body that a profile crosses at half of its height over the profile's ends; why there is none. */
function widthOf({ distance, values }) {
  const base = (values[0] + values.at(-1)) / 2, spread = values.map((value) => value - base), top = spread.reduce((a, b) => Math.abs(b) > Math.abs(a) ? b : a, 0);
  const height = spread.map((value) => value / top), edges = [];  // 1 at the top of the body
  let inside = false, from = 0;
  height.forEach((value, i) => {  // an edge goes from below a quarter to above three quarters, or back
    if (inside ? value < 0.25 : value > 0.75) { edges.push([from, i]); inside = !inside; }
    if (inside ? value > 0.75 : value < 0.25) from = i;
  });
  if (!(Math.abs(height[0]) < 0.25) || edges.length !== 2 || inside || Math.min(...height) < -0.5) return null;
  const [rise, fall] = edges.map(([a, b]) => {
    let i = a;
    while (i + 1 < b && (height[i + 1] - 0.5) * (height[a] - 0.5) > 0) i++;
    return distance[i] + (0.5 - height[i]) / (height[i + 1] - height[i]) * (distance[i + 1] - distance[i]);
  });
  const sharp = edges.every(([a, b]) => distance[b - 1] - distance[a] <= 0.6 * (fall - rise));  // else there is a step on the way
  return sharp ? fall - rise : null;
}

async function showProfile() {
  const { axis, line, row } = profiled;
  const found = await Promise.all(volumes.map((facts, which) => {
    const scaled = line.map((value, i) => { const side = PLANES[axis][i % 2]; return value * facts.shape[side] / row.facts.shape[side]; });
    return json(`api/profile/${which}/${axis}/${indexIn(facts, axis)}?line=${scaled.join(",")}&time=${timeIn(facts)}`);
  }));
  const distance = found[0].distance;  // of the same line in steps of the first volume's voxels
  const lines = found.map((each, i) => ({ name: volumes[i].name, values: distance.map((d, k) => each.values[Math.round(k * (each.values.length - 1) / Math.max(distance.length - 1, 1))]) }));
  const unit = volumes[0].length_unit, widths = found.map(widthOf).map((width, i) => width === null ? (i ? "" : "; no width: it does not cross one body") : `; ${volumes.length > 1 ? `${volumes[i].name}: ` : ""}${width.toPrecision(3)} ${unit} wide at half height`);
  $("profile-name").textContent = `${distance.at(-1).toPrecision(4)} ${unit} in a slice across ${namesOf(volumes[0])[axis]}${widths.join("")}`;
  draw("profile", volumes[0].length_unit, volumes[0].unit, distance, lines, { x: { time: false } });
}

async function showHistogram() {
  const found = await Promise.all(volumes.map((facts, which) => json(`api/histogram/${which}?time=${timeIn(facts)}`)));
  const x = [...new Set(found.flatMap((each) => each.values))].sort((a, b) => a - b);
  const lines = found.map((each, i) => { const at = new Map(each.values.map((value, k) => [value, each.voxels[k] || null])); return { name: volumes[i].name, values: x.map((value) => at.has(value) ? at.get(value) : undefined) }; });
  $("counted").textContent = countedIn(volumes[0]);
  draw("histogram", volumes[0].unit || "value", countedIn(volumes[0]), x, lines, { x: { time: false }, y: { distr: 3 } });
}

/** What the values of a volume, or of a scan's views, are of. */
function countedIn({ angles }) { return angles.length ? "pixels" : "voxels"; }

async function start() {
  volumes = await json("api/volumes");
  const [first, second] = volumes;
  $("names").textContent = volumes.map((each) => `${each.name}: ${each.method ? `${each.method}, ` : ""}${each.seconds.length ? `${each.seconds.length} times ` : ""}${each.shape.join(" x ")} ${countedIn(each)}${each.coarse_bin > 1 ? ` (slices across y and x binned by ${each.coarse_bin})` : ""}`).join("; ");
  document.title = volumes.map((each) => each.name).join(", ");
  volumes.forEach((facts, which) => addRow(facts.name, facts, (axis, index) => `api/slice/${which}/${axis}/${index}`));
  const showWindow = (window) => { for (const row of rows.slice(0, volumes.length)) { row.window = window; row.pictures.forEach((picture) => picture.setWindow(window)); } plots.histogram?.redraw(); };
  const setRange = windowSliders($("window"), showWindow);
  const ends = Object.values(first.windows).flat(), low = Math.min(...ends), high = Math.max(...ends);
  const range = [low - (high - low), high + (high - low)];
  for (const row of rows) row.window = first.window;
  setRange(range, first.window);
  windowButtons($("window"), first.windows, (window) => { setRange(range, window); showWindow(window); });
  const several = volumes.map((each) => each.seconds).filter((each) => each.length);
  if (second && first.shape.join() === second.shape.join() && several.every((each) => each.length === several[0].length)) {
    $("difference-window").hidden = false;
    const row = addRow(`${second.name} less ${first.name}`, { ...first, window: null, seconds: several[0] || [] }, (axis, index) => `api/difference/${axis}/${index}`);
    setDifference = windowSliders($("difference-window"), (window) => { row.window = window; row.pictures.forEach((picture) => picture.setWindow(window)); });
  }
  for (let axis = 0; axis < 3; axis++) {
    $(`name${axis}`).textContent = namesOf(first)[axis];
    Object.assign($(`at${axis}`), { max: first.shape[axis] - 1, value: Math.floor(first.shape[axis] / 2) });
    $(`at${axis}`).addEventListener("input", debounce(() => showAxis(axis), 40));
  }
  startTimes();
  await ($("times").hidden ? Promise.all([0, 1, 2].map(showAxis)) : showTime());
  await showHistogram();
  if (first.angles.length) await showScan(first, draw);
}

document.addEventListener("keydown", (event) => {
  if (event.key !== "x" && event.key !== "X") return;
  crossed = !crossed;
  rows.forEach((row) => row.pictures.forEach((picture) => picture.redraw()));
});
start().catch((error) => { $("names").textContent = error.message; });
