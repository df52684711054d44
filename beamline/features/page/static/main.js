// The page of a run: it follows the feed, and fetches pictures as they are needed.
import { PLANES, Picture, debounce, fetchTile, namesOf, packed, position, usualWindow, windowButtons, windowSliders } from "./picture.js";
import { Timeline } from "./flags.js";
import { Passes } from "./passes.js";

const $ = (id) => document.getElementById(id);
const KINDS = { "-1": "alignment", 0: "projection", 1: "flat", 2: "dark", 3: "invalid" };
const COLOURS = { done: "good", complete: "good", paused: "warn", asking: "warn", stopped: "warn", finishing: "busy", acquiring: "busy", darks: "busy", flats: "busy", taxi: "busy", preparing: "busy", aborted: "bad", failed: "bad", died: "bad" };
const columns = { kind: [], angle: [], time: [], mean: [] };
const curves = { trace: { x: [], y: [] }, rate: { x: [], y: [] }, beam: { x: [], y: [], unit: "" }, residual: { x: [], y: [] }, error: { x: [], y: [] } };
let facts = null, frames = 0, planned = 0, current = 0, flags = [], state = "", region = null, volume = null, volumeKey = null, ended = "", rate = null, lastSeen = Date.now(), plot = null, ledger = { exposed: 0 }, fit = null, work = null, pausing = false;

// --- frame -------------------------------------------------------------------------------------------------------
const frameWindows = {};  // of a kind of frame, so that flats and views each keep theirs
let frameBusy = false, frameWanted = null;
const windowKey = () => `${columns.kind[current]} ${$("corrected").checked}`;
const setFrameWindow = windowSliders($("frame-window"), (window) => { frameWindows[windowKey()] = window; frame.setWindow(window); });
const frame = new Picture($("frame"), {
  point: (row, col, value, bin) => { $("frame-value").textContent = row === null ? "" : `row ${row}, column ${col}${lengths(row, col)}: ${value.toPrecision(5)}${bin > 1 ? ` (mean of ${bin} x ${bin} pixels)` : ""}`; },
  region: (chosen) => { region = chosen; curves.trace = { x: [], y: [] }; $("curve").value = "trace"; fetchTrace(); },
  moved: debounce(() => showFrame(current), 150),
  draw: (context, place) => { for (const flag of flags) if (flag.frame === current && flag.region) frame.box(context, place, flag.region, flag.alarm ? "#ff7b72" : "#d29922", flag.check); },
});

function lengths(row, col) {
  if (!facts.pixel_mm) return "";
  return ` (${(row * facts.pixel_mm).toFixed(3)} mm, ${(col * facts.pixel_mm).toFixed(3)} mm)`;
}

async function showFrame(index) {
  frameWanted = index;
  if (frameBusy || !frames) return;
  frameBusy = true;
  while (frameWanted !== null) {
    const wanted = Math.min(frameWanted, frames - 1);
    frameWanted = null;
    frame.extent = facts.shape;
    const part = frame.zoom > 1 ? `&region=${frame.seen().join(",")}` : "";
    try {
      const tile = await fetchTile(`api/frame/${wanted}?corrected=${$("corrected").checked ? 1 : 0}${part}`);
      current = wanted;
      const chosen = frameWindows[windowKey()] ??= usualWindow(tile), spread = chosen[1] - chosen[0];
      if (frame.window !== chosen) { frame.window = chosen; setFrameWindow([chosen[0] - spread / 2, chosen[1] + spread / 2], chosen); }
      frame.show(tile, facts.shape, tile.region);
      nameFrame();
    } catch (error) { $("frame-name").textContent = `${wanted}: ${error.message}`; }
  }
  frameBusy = false;
}

function nameFrame() {
  const angle = columns.angle[current], time = columns.time[current], kind = KINDS[columns.kind[current]] || "";
  $("frame-name").textContent = `${current}, ${kind}${angle === null || angle === undefined ? "" : `, ${angle.toFixed(3)}°`}${time ? `, ${new Date(1000 * time).toLocaleTimeString()}` : ""}`;
  $("frame-slider").value = current;
  $("frame-flags").replaceChildren(...flags.filter((flag) => flag.frame === current).map((flag) => {
    const check = facts.checks.find((each) => each.name === flag.check) || { meaning: "", unit: "" };
    const item = element("li", `${flag.check}${flag.alarm ? " (alarm)" : ""}: ${check.meaning}${flag.score === null ? "" : `; ${flag.score.toPrecision(3)} ${check.unit}`}`, flag.alarm ? "alarm" : "flag");
    const said = advice.filter((each) => each.check === flag.check && each.frame <= current).pop() || advice.find((each) => each.check === flag.check);
    if (said) item.append(element("p", said.frame === current ? said.advice : `Frame ${said.frame}: ${said.advice}`));
    return item;
  }));
  timeline.show(flags, planned || frames, current);
}

$("frame-slider").addEventListener("input", (event) => { $("newest").checked = false; showFrame(Number(event.target.value)); });
$("newest").addEventListener("change", () => { if ($("newest").checked) showFrame(newestFrame()); });
/** The newest view: flats and darks that follow it are of no interest; before the first view, the newest frame. */
function newestFrame() { const view = columns.kind.lastIndexOf(0); return view < 0 ? frames - 1 : view; }
$("corrected").addEventListener("change", () => showFrame(current));

// --- flags -------------------------------------------------------------------------------------------------------
const advice = [];  // flags as the monitor told them; of a series it tells some
function go(index) { $("newest").checked = false; showFrame(index); }
const timeline = new Timeline($("flags"), { go });

async function fetchFlags() {
  flags = await (await fetch("api/flags")).json();
  const marked = new Set(flags.map((flag) => flag.frame)).size;
  $("flag-count").textContent = facts.monitored || marked ? `${marked} of ${frames} frames` : "";
  nameFrame();
  frame.redraw();
}

// --- sinogram ----------------------------------------------------------------------------------------------------
let strip = { row: null, lines: [], views: [], order: [], cols: 0, busy: false };
const sinogram = new Picture($("sinogram"), {
  stretch: true,
  point: (line, col, value) => { const view = strip.order[line]; $("sinogram-value").textContent = view === undefined ? "" : `projection ${view} (frame ${strip.views[view]}, ${(columns.angle[strip.views[view]] ?? NaN).toFixed(2)}°), column ${col * strip.bin}: ${value.toPrecision(5)}`; },
});

async function fetchSinogram() {
  if (!facts || strip.busy) return;
  const row = Number($("sinogram-row").value);
  if (strip.row !== row) strip = { row, lines: [], views: [], order: [], cols: 0, busy: false };
  strip.busy = true;
  const mine = strip;
  try {
    const first = strip.views.length ? strip.views[strip.views.length - 1] + 1 : 0, tile = await fetchTile(`api/sinogram?row=${row}&first=${first}`);
    mine.cols = tile.shape[1]; mine.bin = tile.bin;
    for (let i = 0; i < tile.shape[0]; i++) mine.lines.push(Float32Array.from(tile.numbers.subarray(i * mine.cols, (i + 1) * mine.cols), (number) => tile.offset + tile.scale * number));
    mine.views.push(...tile.views);
    if (mine.views.length) {
      mine.order = byAngle(mine.views);
      const shape = [mine.lines.length, mine.cols], values = new Float32Array(shape[0] * shape[1]);
      mine.order.forEach((view, line) => values.set(mine.lines[view], line * mine.cols));
      const tile = packed(values, shape);
      sinogram.window = usualWindow(tile);
      sinogram.show(tile, shape);
    }
    $("sinogram-name").textContent = `row ${row}, ${mine.views.length} projections${mine.order.some((view, line) => view !== line) ? ", sorted by angle" : ""}`;
  } catch (error) { $("sinogram-name").textContent = error.message; }
  mine.busy = false;
}

/** Numbers of the views by their angle within a turn; as taken, where the stage turned one way. */
function byAngle(frames) {
  const angles = frames.map((frame) => columns.angle[frame]), order = frames.map((_, view) => view);
  const steps = angles.slice(1).map((angle, view) => Math.sign(angle - angles[view]));
  const turned = Math.max(...angles) - Math.min(...angles);
  if (angles.some((angle) => angle === null || angle === undefined) || (new Set(steps).size < 2 && turned <= 360)) return order;
  const within = angles.map((angle) => ((angle % 360) + 360) % 360);
  return order.sort((a, b) => within[a] - within[b]);
}

$("sinogram-row").addEventListener("input", debounce(fetchSinogram, 100));

// --- volume ------------------------------------------------------------------------------------------------------
let chosenWindow = false;  // by hand: it stays when the next snapshot comes
const showWindow = (window) => slices.forEach((slice) => slice.setWindow(window));
const setVolumeWindow = windowSliders($("volume-window"), (window) => { chosenWindow = true; showWindow(window); });
function setWindowOf(window) {
  const ends = Object.values(volume.windows).flat(), [low, high] = [Math.min(...ends), Math.max(...ends)];
  setVolumeWindow([low - (high - low), high + (high - low)], window); showWindow(window);
}
const slices = [0, 1, 2].map((axis) => new Picture($(`slice${axis}`), {
  draw: (context, place) => { if (axis === 0 && volume && volume.unseen_deg.length) dial(context, volume.unseen_deg); },
  point: (row, col, value) => { $("volume-value").textContent = row === null ? "" : `${place(axis, row, col)}: ${value.toPrecision(5)} ${volume.unit}`; },
}));

/** Rays in a slice (y downwards) that no view has taken yet: edges along them are unknown. A ray of θ runs along -sin θ, cos θ. */
function dial(context, [first, last]) {
  const radius = 26, x = context.canvas.clientWidth - radius - 8, y = radius + 8;
  context.fillStyle = context.strokeStyle = "#d29922"; context.font = "12px sans-serif"; context.textAlign = "right";
  context.beginPath(); context.arc(x, y, radius, 0, 2 * Math.PI); context.stroke();
  for (const half of [90, 270]) { context.beginPath(); context.moveTo(x, y); context.arc(x, y, radius, (first + half) * Math.PI / 180, (last + half) * Math.PI / 180); context.fill(); }
  context.fillText(`not measured yet: ${(last - first).toFixed(0)} of 180 degrees`, x - radius - 6, y + 4);
}

function place(axis, row, col) {
  const index = [0, 0, 0];
  index[axis] = Number($(`at${axis}`).value); index[PLANES[axis][0]] = row; index[PLANES[axis][1]] = col;
  return index.map((value, i) => `${namesOf(volume)[i]} ${position(volume, i, value)}`).join(", ");
}


async function fetchVolume() {
  const answer = await fetch("view/api/volumes");
  if (!answer.ok) return;
  const before = volume;
  [volume] = await answer.json();
  $("volume-name").textContent = `${volume.name}: ${volume.method ? `${volume.method}, ` : ""}${volume.views ? `projections 1 to ${volume.views}, ` : ""}${volume.shape.join(" x ")} voxels, ${new Date(1000 * volume.changed).toLocaleTimeString()}${volume.because ? `; ${volume.because}` : ""}`;
  const changed = !before || before.shape.join() !== volume.shape.join();
  for (let axis = 0; axis < 3; axis++) {
    $(`at${axis}`).max = volume.shape[axis] - 1;
    if (changed) $(`at${axis}`).value = Math.floor(volume.shape[axis] / 2);
  }
  $("volume").hidden = $("viewer-link").hidden = false;
  windowButtons($("volume-window"), volume.windows, (window) => { chosenWindow = window !== volume.window; setWindowOf(window); });
  if (!chosenWindow) setWindowOf(volume.window);
  await Promise.all([0, 1, 2].map(showSlice));
  fetchModel();
}

async function showSlice(axis) {
  if (!volume) return;
  const index = Number($(`at${axis}`).value);
  $(`where${axis}`).textContent = position(volume, axis, index);
  try {
    const tile = await fetchTile(`view/api/slice/0/${axis}/${index}`);
    if (Number($(`at${axis}`).value) === index) slices[axis].show(tile, [volume.shape[PLANES[axis][0]], volume.shape[PLANES[axis][1]]]);
    if (tile.ready < 1) { clearTimeout(slices[axis].again); slices[axis].again = setTimeout(() => showSlice(axis), 800); }
  } catch (error) { $("volume-value").textContent = error.message; }
}
for (let axis = 0; axis < 3; axis++) $(`at${axis}`).addEventListener("input", debounce(() => showSlice(axis), 40));

async function fetchModel() {
  const answer = await fetch("api/model.png");
  $("model").hidden = !answer.ok;
  if (!answer.ok) return;
  const before = $("model-picture").src;
  $("model-picture").src = URL.createObjectURL(await answer.blob());
  if (before) URL.revokeObjectURL(before);
}

// --- curves ------------------------------------------------------------------------------------------------------
const LABELS = { light: ["frame", "mean counts"], trace: ["frame", "mean counts of the region"], rate: ["frame", "frames/s"], beam: ["reading, s", "beam"], residual: ["projections", "residual"], error: ["projections", "error in held-out projections"] };

async function fetchTrace() {
  if (!region) return;
  const line = curves.trace, chosen = region;
  const found = await (await fetch(`api/trace?region=${chosen.join(",")}&first=${line.y.length}`)).json();
  if (chosen !== region || found.first !== line.y.length) return;
  found.values.forEach((value) => { line.x.push(line.y.length); line.y.push(value); });
  drawCurve();
}

function drawCurve() {
  const kind = $("curve").value, data = kind === "light" ? { x: columns.mean.map((_, i) => i), y: columns.mean } : curves[kind];
  const style = getComputedStyle(document.body), colour = style.getPropertyValue("--faint"), line = style.getPropertyValue("--line");
  const axis = (label, size) => ({ label, size, stroke: colour, grid: { stroke: line, width: 1 }, ticks: { stroke: line } });
  const unit = kind === "beam" && curves.beam.unit ? `beam, ${curves.beam.unit}` : LABELS[kind][1];
  if (!plot || plot.kind !== kind) {
    if (plot) plot.destroy();
    plot = new uPlot({ width: $("plot").clientWidth, height: 260, scales: { x: { time: false } }, axes: [axis(LABELS[kind][0], 50), axis(unit, 70)], series: [{ label: LABELS[kind][0] }, { label: unit, stroke: style.getPropertyValue("--accent"), width: 1.5, points: { show: data.x.length < 60 } }] }, [data.x, data.y], $("plot"));
    plot.kind = kind;
  } else plot.setData([data.x, data.y]);
}
$("curve").addEventListener("change", drawCurve);
new ResizeObserver(() => { if (plot) plot.setSize({ width: $("plot").clientWidth, height: 260 }); }).observe($("plot"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { if (plot) { plot.destroy(); plot = null; drawCurve(); } });

// --- passes ------------------------------------------------------------------------------------------------------
const passes = new Passes($("passes"), { answer: send });

// --- events ------------------------------------------------------------------------------------------------------
function onRun(event) {
  const data = JSON.parse(event.data), live = data.source === "recon";
  switch (data.event) {
    case "run_started": planned = data.n_frames; log(data, `Scan of ${data.sample}: ${data.n_frames} frames planned`); break;
    case "state": if (!live) { state = data.state; if (["paused", "finishing"].includes(state)) pausing = false; $("message").textContent = data.message; $("said").textContent = ""; if (state === "finishing") passes.finish(); } log(data, `${live ? "volume: " : ""}${data.state.replaceAll("_", " ")}${data.message ? `: ${data.message}` : ""}`); break;
    case "frame": rate = data; ledger.exposed = Math.max(ledger.exposed, data.n); curves.rate.x.push(data.n); curves.rate.y.push(data.frames_per_s); break;
    case "flag": advice.push(data); logFlag(data); break;
    case "beam": curves.beam.unit = data.unit; curves.beam.x.push(data.read_at - (curves.beam.start ??= data.read_at)); curves.beam.y.push(data.value); break;
    case "slices": $("coverage").textContent = `${data.n_views} views${data.degrees < 179 ? `, ${data.degrees.toFixed(0)} of 180 degrees so far` : ""}`; fetchModel(); break;
    case "snapshot": if (data.errors) point(curves.error, data.n_views, Math.min(...Object.values(data.errors).filter((error) => error !== null))); break;
    case "progress": if (data.steps !== undefined) work = data; if (data.n_gaussians) fit = { ...data, views: Math.max(1, data.n_views) }; if (data.residual !== null && data.n_views) point(curves.residual, data.n_views, data.residual); break;
    case "pass_ended": passes.end(data); log(data, `Pass ${data.passes ?? data.number} has ended, ${data.n_views} projections so far`); break;
    case "next_chosen": if (data.choice === "enough") ended = `Ended after pass ${data.passes ?? data.number} because the ${data.by} chose enough: ${data.reason}. ${data.dropped ?? 0} planned frames were not taken.`; passes.choose(data); log(data, `After pass ${data.passes ?? data.number}: ${data.choice}, by the ${data.by}: ${data.reason}`); break;
    case "block_done": log(data, `${data.frames} of ${data.n} ${data.kind} frames taken${data.missing.length ? `, ${data.missing.length} missing` : ""}`, data.missing.length ? "warning" : ""); break;
    case "warning": log(data, data.message, "warning"); break;
    case "failed": log(data, data.message, "failed"); break;
    case "scan_done": rate = null; log(data, `Scan ${data.status}: ${data.n_frames} frames in ${data.seconds.toFixed(0)} s, ${data.missing.length} missing`); break;
    case "recon_done": log(data, `Volume ${data.shape.join(" x ")} from ${data.n_views} projections`); break;
  }
}

/** The newest value for a number of views, which several steps share. */
function point(line, x, y) {
  if (line.x.length && line.x[line.x.length - 1] === x) line.y[line.y.length - 1] = y;
  else { line.x.push(x); line.y.push(y); }
}

const findings = {}; // by check: the newest one
/** A finding of several frames that goes on, such as a crumb that crosses the field, is one line with their number. */
function logFlag(data) {
  const before = findings[data.check], own = data.first ?? data.frame;
  const goesOn = before && data.first != null && data.level === before.level && own <= before.frame + 1;
  if (goesOn) before.item.remove();
  const first = goesOn ? Math.min(own, before.first) : own;
  const where = first === data.frame ? `frame ${first}` : `${data.frame - first + 1} frames, ${first} to ${data.frame}`;
  const item = log(data, `${data.check} (${data.level}), ${where}: ${data.advice}`, data.level === "alarm" ? "failed" : "warning", data.frame);
  findings[data.check] = { first, frame: data.frame, level: data.level, item };
}

/** A line of the log, which is returned; of a flag it leads to its frame. */
function log(data, text, kind = "", at = null) {
  const item = element("li", "", kind), time = element("time", new Date(1000 * data.time).toLocaleTimeString());
  item.append(time, element("span", text));
  if (at !== null) {
    const button = element("button", "show");
    button.setAttribute("aria-label", `show frame ${at}`);
    button.addEventListener("click", () => { go(at); $("view").scrollIntoView({ block: "center" }); });
    item.append(button);
  }
  $("log").prepend(item);
  while ($("log").children.length > 300) $("log").lastChild.remove();
  return item;
}

let fetched = 0, flagsFetched = 0;
async function onState(event) {
  const now = JSON.parse(event.data);
  lastSeen = Date.now();
  if (!facts) { if (!now.frames) { header(now); return; } await begin(); }
  const grew = now.frames !== frames, ended = now.status !== "running" && now.status !== "preparing";
  frames = now.frames;
  header(now);
  if (grew) {
    $("frame-slider").max = Math.max(0, frames - 1);
    const added = await (await fetch(`api/columns?first=${columns.kind.length}`)).json();
    if (added.first === columns.kind.length) for (const name of Object.keys(columns)) columns[name].push(...added[name]);
    if ($("newest").checked) showFrame(newestFrame()); else nameFrame();
    fetchSinogram();
    if ($("curve").value === "trace") fetchTrace();
  }
  if (grew || (ended && flagsFetched !== frames)) { if (Date.now() - fetched > 1500 || ended) { fetched = Date.now(); flagsFetched = frames; fetchFlags(); } }
  if (grew || ended) drawCurve();
  if (now.volume !== volumeKey) { volumeKey = now.volume; if (now.volume) fetchVolume(); }
}

let nextStep = "";  // for a scan that has died or ended early
function header(now) {
  const word = now.over ? now.status : state || now.status, chip = $("state"), told = now.next || ended;
  if (told !== nextStep) $("said").textContent = nextStep = told;
  chip.textContent = pausing && !now.over ? `${word}, pause sent` : word; chip.className = `chip ${COLOURS[word] || ""}`;
  const of = planned >= now.frames ? planned : 0;  // the newest part of a run plans its own frames, and a joined file has those of all
  $("done").value = of ? now.frames / of : now.status === "running" ? 0 : 1;
  const shown = { frames: of ? `${now.frames} stored, ${Math.max(ledger.exposed, now.frames)} exposed, ${of} planned` : `${now.frames}` };
  if (rate && now.status === "running") {
    shown.rate = `${rate.frames_per_s.toFixed(1)} frames/s, ${rate.mb_per_s.toFixed(1)} MB/s`;
    if (rate.eta_s !== null) shown.left = duration(rate.eta_s);
  }
  if (now.status === "running") shown["last frame"] = `${now.age_s.toFixed(0)} s ago`;
  if (curves.beam.y.length) shown.beam = `${curves.beam.y[curves.beam.y.length - 1].toPrecision(4)} ${curves.beam.unit}`;
  if (fit && now.status === "running") shown.volume = `${fit.n_views} views${fit.waiting ? `, ${fit.waiting} wait` : ""}, ${(fit.step / fit.views).toFixed(1)} steps a view, ${fit.n_gaussians} Gaussians`;
  else if (work && work.steps && work.step < work.steps) shown.volume = `final fit: ${work.step} of ${work.steps} ${work.unit || "steps"}${work.eta_s === null ? "" : `, ${duration(work.eta_s)} left for this step`}`;
  shown["free disk"] = `${(now.free / 1e9).toFixed(1)} GB`;
  $("figures").replaceChildren(...Object.entries(shown).map(([name, value]) => { const box = element("div", ""); box.append(element("dt", name), element("dd", value)); return box; }));
  const over = now.status !== "running" && now.status !== "preparing";
  passes.update(!over, mayAct());
  for (const button of document.querySelectorAll("#verbs button")) button.disabled = over || (button.dataset.verb === "resume" && word !== "paused" && !pausing) || (button.dataset.verb === "pause" && word === "paused");
}

async function begin() {
  facts = await (await fetch("api/facts")).json();
  document.title = `${facts.sample} - splatline`;
  $("run").textContent = facts.run;
  timeline.monitored = facts.monitored;
  $("sinogram-row").max = facts.shape[0] - 1; $("sinogram-row").value = Math.floor(facts.shape[0] / 2);
  $("verbs").hidden = !mayAct();
}

// --- verbs -------------------------------------------------------------------------------------------------------
if (location.hash.startsWith("#act=")) { sessionStorage.setItem("act", location.hash.slice(5)); history.replaceState(null, "", location.pathname); }
const act = sessionStorage.getItem("act");
function mayAct() { return Boolean(facts?.may_act && act); }
for (const button of document.querySelectorAll("#verbs button")) button.addEventListener("click", () => {
  const { verb } = button.dataset;
  if (verb !== "abort" || confirm("Abort the scan? The stage stops at once, and no further frame is taken.")) send(verb);
});
async function send(verb) {
  if (verb === "pause" || verb === "resume") pausing = verb === "pause";  // resume takes back a pause that has not begun
  $("said").textContent = verb === "pause" ? "pause: sent. The scan pauses when the current frame, or the current wait, has ended. Until then Resume cancels the pause." : `${verb}: sent`;
  const answer = await fetch(`api/verb/${verb}`, { method: "POST", headers: { "X-Act-Token": act } });
  const data = await answer.json().catch(() => ({}));
  if (!answer.ok && verb === "pause") pausing = false;
  if (!answer.ok || !pausing) $("said").textContent = answer.ok ? "" : data.message || `${verb}: refused (${answer.status})`;
}

// --- feed --------------------------------------------------------------------------------------------------------
let feed = null, over = false, last = "", handling = Promise.resolve();
function follow() {
  feed = new EventSource(`api/feed?last=${last}`);
  feed.addEventListener("run", (event) => { last = event.lastEventId; onRun(event); });
  feed.addEventListener("end", () => { handling = handling.then(onEnd); });
  feed.addEventListener("state", (event) => { handling = handling.then(() => onState(event)).catch((error) => { $("said").textContent = error.message; }); });
}
follow();
/** The server says that it ends, as with the scan that started it. */
function onEnd() {
  over = true; feed.close();
  for (const button of document.querySelectorAll("#verbs button")) button.disabled = true;
  passes.update(false, false);
  $("viewer-link").hidden = true;
  $("said").textContent = `${nextStep} This page has ended and shows what it had last. ${again()}`.trim();
}
function again() { const path = facts ? facts.path : "RUN"; return `To see the run again: beamline watch ${/\s/.test(path) ? `"${path}"` : path}`; }
// A browser has six connections to a server for all its tabs: one that nobody sees keeps none.
document.addEventListener("visibilitychange", () => { if (over) return; feed.close(); if (!document.hidden) { lastSeen = Date.now(); follow(); } });
setInterval(() => {
  const silent = (Date.now() - lastSeen) / 1000, lost = !over && !document.hidden && feed.readyState !== EventSource.OPEN;
  document.body.classList.toggle("lost", lost && silent > 3);
  if (lost && silent > 3) { $("state").textContent = `no connection for ${silent.toFixed(0)} s`; $("state").className = "chip bad"; $("said").textContent = `${nextStep || "The scan continues without its page."} ${again()}`; }
}, 1000);

function element(name, text, kind = "") { const made = document.createElement(name); made.textContent = text; if (kind) made.className = kind; return made; }
function duration(seconds) { return seconds < 90 ? `${seconds.toFixed(0)} s` : seconds < 5400 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(1)} h`; }
