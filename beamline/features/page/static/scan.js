// What the viewer shows of a scan beside the slices of its views: the rotation axis by picture, means, angles, light.
import { Picture, debounce, fetchTile, packed, usualWindow, valueAt, windowButtons } from "./picture.js";

const $ = (name) => document.getElementById(name);
const json = async (url) => { const answer = await fetch(url), body = await answer.json(); if (!answer.ok) throw new Error(body.message); return body; };
const BESIDE = 16;  // columns that the slider of the axis goes to either side

let stack = null, views = [], start = { axis: 0, tilt: 0 };
const row = () => Number($("at1").value);
const chosen = () => ({ axis: Number($("axis-col").value), tilt: Number($("tilt-deg").value) });
const pair = new Picture($("pair")), mean = new Picture($("mean"));
const slice = new Picture($("fbp"), { moved: debounce(() => redraw(false), 150) });

/** `facts` of the stack; `draw(name, title, unit, x, lines, scales)` a plot. */
export async function showScan(facts, draw) {
  stack = facts;
  for (const name of ["axis", "means", "angles-box"]) $(name).hidden = false;
  const told = await json("api/scan"), number = facts.angles.map((_, i) => i);
  $("names").textContent += `; ${told.said}`;
  $("mean-of").append(...told.means.map((name) => new Option(name)));
  $("mean-of").addEventListener("change", showMean);
  draw("angles", "projection", "degrees", number, [{ name: "angle", values: facts.angles }], { x: { time: false } });
  const light = async () => {
    const values = (await json("api/scan")).light, known = number.filter((i) => values[i] !== null);
    draw("light", "projection", "mean", known, [{ name: "mean", values: known.map((i) => values[i]) }], { x: { time: false } });
    await showMean();
    if (known.length < number.length && $("reading").textContent) setTimeout(light, 3000);
  };
  await Promise.all([light(), showAxis(told.pair)]);
}

async function showMean() {
  const tile = await fetchTile(`api/mean/${$("mean-of").value}`);
  mean.window = usualWindow(tile); mean.show(tile, stack.shape.slice(1));
}

// --- the axis ------------------------------------------------------------------------------------------------------
async function showAxis(opposite) {
  $("pair-name").textContent = opposite ? `projection ${opposite[0]} minus projection ${opposite[1]} mirrored about the axis${Math.abs(opposite[2]) > 0.01 ? ` (their angles differ from 180° by ${opposite[2].toFixed(2)}°)` : ""}: uniformly grey if the axis is right` : "No two projections are 180° apart: judge by the slice.";
  if (opposite) views = await Promise.all(opposite.slice(0, 2).map((view) => fetchTile(`api/slice/0/0/${view}`)));
  try {
    const found = await json(`api/axis/${row()}`);
    start = { axis: found.axis, tilt: 0 };
    $("leans").hidden = !found.leans;
    $("axis-said").textContent = `column ${found.axis}: ${found.said}; 0 is the centre of the first column`;
  } catch (error) { $("axis-said").textContent = error.message; return; }
  set(start);
  for (const [slider, box] of [["axis-slider", "axis-col"], ["tilt-slider", "tilt-deg"]]) {
    $(slider).addEventListener("input", () => { $(box).value = $(slider).value; redraw(true); });
    $(box).addEventListener("input", () => set(chosen()));
  }
  $("at1").addEventListener("input", debounce(() => redraw(false), 100));
  $("axis-reset").addEventListener("click", () => { slice.settled = false; set(start); });
  $("axis-copy").addEventListener("click", async () => {
    getSelection().selectAllChildren($("axis-option"));
    await navigator.clipboard?.writeText($("axis-option").textContent).catch(() => {});
    $("axis-copy").textContent = "Copied";
  });
}

function set({ axis, tilt }) {
  Object.assign($("axis-slider"), { min: Math.round(axis) - BESIDE, max: Math.round(axis) + BESIDE });
  $("axis-slider").value = $("axis-col").value = axis; $("tilt-slider").value = $("tilt-deg").value = tilt;
  redraw(false);
}

/** Both pictures; `moving`: the slice of fewer views and pixels, a whole one soon after. */
function redraw(moving) {
  const { axis, tilt } = chosen();
  $("axis-option").textContent = `--axis ${axis}${tilt ? ` --tilt ${tilt}` : ""}`;
  $("axis-copy").textContent = "Copy";
  if (views.length) showPair(axis, tilt);
  showSlice(moving);
  if (moving) settle();
}
const settle = debounce(() => redraw(false), 400);

let busy = false, wanted = null;
async function showSlice(moving) {
  wanted = moving;
  if (busy) return;
  busy = true;
  while (wanted !== null) {
    const fast = wanted, { axis, tilt } = chosen(), began = performance.now();
    wanted = null;
    const part = slice.tile && slice.zoom > 1 ? `&region=${slice.seen().join(",")}` : "";
    try {
      const tile = await fetchTile(`api/fbp/${row()}?axis=${axis},${tilt}&fast=${fast ? 1 : 0}${part}`);
      const n = Math.max(stack.shape[2], tile.region[1], slice.extent[0] > 1 && part ? slice.extent[0] : 0);
      if (!fast) {  // beside a pin of metal all other matter would be black
        const { weak, matter } = tile.windows;
        windowButtons($("fbp-window"), tile.windows, (window) => slice.setWindow(window));
        if (!slice.settled) slice.window = weak && weak[1] - weak[0] < 0.2 * (matter[1] - matter[0]) ? weak : matter;
        slice.settled = true;
      }
      slice.show(tile, [n, n], tile.region);
      $("fbp-name").textContent = `FBP slice of row ${row()}, axis ${axis}${tilt ? `, tilt ${tilt}°` : ""}: arcs and double edges disappear if the axis is right`;
      $("fbp").dataset.shown = `${axis} ${tilt} ${(performance.now() - began).toFixed(0)}`;
    } catch (error) { $("fbp-name").textContent = error.message; }
  }
  busy = false;
}

/** The first view less the second one mirrored about the axis, which leans by the tilt about the detector's middle row. */
function showPair(axis, tilt) {
  const [one, other] = views, [rows, cols] = one.shape, bin = one.bin, middle = (n) => (n - 1) / 2, off = middle(bin);
  const lean = tilt * Math.PI / 180, [s, c] = [Math.sin(lean), Math.cos(lean)], [height, width] = stack.shape.slice(1);
  const foot = middle(width) + (axis - middle(width)) / c, difference = new Float32Array(rows * cols);
  for (let i = 0; i < rows; i++) for (let k = 0; k < cols; k++) {
    const x = k * bin + off - foot, y = i * bin + off - middle(height), along = 2 * (x * s + y * c);
    const row = (along * c - y + middle(height) - off) / bin, col = (along * s - x + foot - off) / bin, r = Math.floor(row), q = Math.floor(col);
    if (r < -1 || q < 0 || r > rows - 1 || q > cols - 2) continue;
    const near = Math.max(r, 0), far = Math.min(r + 1, rows - 1), a = row - r, b = col - q;
    const mirrored = (1 - a) * ((1 - b) * valueAt(other, near, q) + b * valueAt(other, near, q + 1)) + a * ((1 - b) * valueAt(other, far, q) + b * valueAt(other, far, q + 1));
    difference[i * cols + k] = valueAt(one, i, k) - mirrored;
  }
  const [low, high] = usualWindow(one), reach = (high - low) / 4;
  pair.window = [-reach, reach]; pair.show(packed(difference, one.shape), stack.shape.slice(1));
}
