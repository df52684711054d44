// A picture on a canvas: window of grey values, zoom, position, value under the pointer, choice of a region.

/** Numbers of a tile as the server packs them: value = offset + scale * number; 65535 stands for no number. */
export async function fetchTile(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).message || `${answer.status}`);
  const buffer = await answer.arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { ...facts, numbers: new Uint16Array(buffer, 4 + length) };
}

export function valueAt(tile, row, col) {
  const number = tile.numbers[row * tile.shape[1] + col];
  return number === 65535 ? NaN : tile.offset + tile.scale * number;
}

/** Grey window that leaves out the darkest and brightest parts of a tile. */
export function usualWindow(tile, low = 0.005, high = 0.995) {
  const step = Math.max(1, Math.floor(tile.numbers.length / 20000));
  const sample = [];
  for (let i = 0; i < tile.numbers.length; i += step) if (tile.numbers[i] !== 65535) sample.push(tile.numbers[i]);
  if (!sample.length) return [0, 1];
  sample.sort((a, b) => a - b);
  const at = (share) => tile.offset + tile.scale * sample[Math.min(sample.length - 1, Math.floor(share * sample.length))];
  return [at(low), Math.max(at(high), at(low) + 1e-9)];
}

export class Picture {
  /**
   * `extent`: [rows, cols] of the whole picture. Callbacks: `point(row, col, value)` under the pointer (null: outside),
   * `pick(row, col)` a click, `region([r0, r1, c0, c1])` or `line([r0, c0, r1, c1])` chosen with Shift, `moved([r0, r1, c0, c1])` the part that is seen, `draw(context, place)` on top.
   * `stretch`: rows and columns each fill the canvas, as those of a strip always do. `choosing`: says that a drag chooses without Shift, as on a tablet.
   */
  constructor(canvas, { point = () => {}, pick = () => {}, region = null, line = null, moved = () => {}, draw = () => {}, stretch = false, choosing = () => false } = {}) {
    Object.assign(this, { canvas, point, pick, region, line, moved, drawOver: draw, stretch, choosing });
    this.extent = [1, 1]; this.window = [0, 1]; this.zoom = 1; this.centre = [0.5, 0.5];
    this.image = document.createElement("canvas"); this.tile = null; this.dragged = null; this.pending = false;
    new ResizeObserver(() => this.redraw()).observe(canvas);
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoomBy(event.deltaY < 0 ? 1.25 : 0.8, this.place(event)); }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointerleave", () => this.point(null));
    canvas.addEventListener("dblclick", () => { this.zoom = 1; this.centre = [0.5, 0.5]; this.redraw(); this.moved(this.seen()); });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  show(tile, extent, region = [0, extent[0], 0, extent[1]]) {
    this.tile = tile; this.extent = extent; this.shown = region; this.paint();
  }

  setWindow(window) { this.window = window; this.paint(); }

  paint() {
    const tile = this.tile;
    if (!tile) return;
    const [rows, cols] = tile.shape;
    this.image.width = cols; this.image.height = rows;
    const context = this.image.getContext("2d"), pixels = context.createImageData(cols, rows), bytes = pixels.data;
    const factor = 255 * tile.scale / (this.window[1] - this.window[0]), shift = 255 * (tile.offset - this.window[0]) / (this.window[1] - this.window[0]);
    for (let i = 0, k = 0; i < tile.numbers.length; i++, k += 4) {
      const none = tile.numbers[i] === 65535, grey = shift + factor * tile.numbers[i];
      bytes[k] = none ? 90 : grey; bytes[k + 1] = none ? 0 : grey; bytes[k + 2] = none ? 90 : grey; bytes[k + 3] = 255;
    }
    context.putImageData(pixels, 0, 0);
    this.redraw();
  }

  /** Screen pixels a picture pixel, down and across, and where the first pixel is. */
  layout() {
    const box = this.canvas.getBoundingClientRect(), [rows, cols] = this.extent;
    const fit = [box.height / rows, box.width / cols], least = Math.min(...fit);
    const [down, across] = (this.stretch || Math.max(rows / cols, cols / rows) > 8 ? fit : [least, least]).map((scale) => scale * this.zoom);
    return { down, across, left: box.width / 2 - this.centre[1] * cols * across, top: box.height / 2 - this.centre[0] * rows * down, box };
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => { this.pending = false; this.drawNow(); });
  }

  drawNow() {
    const ratio = window.devicePixelRatio || 1, { down, across, left, top, box } = this.layout();
    this.canvas.width = Math.round(box.width * ratio); this.canvas.height = Math.round(box.height * ratio);
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (!this.tile) return;
    const [r0, r1, c0, c1] = this.shown;
    context.imageSmoothingEnabled = false;
    const y = (row) => top + row * down, x = (col) => left + col * across;
    context.drawImage(this.image, x(c0), y(r0), (c1 - c0) * across, (r1 - r0) * down);
    this.drawOver(context, { x, y });
    if (this.chosen && this.line) {
      const [ra, ca, rb, cb] = this.chosen;
      context.strokeStyle = "#3fb950"; context.lineWidth = 2;
      context.beginPath(); context.moveTo(x(ca), y(ra)); context.lineTo(x(cb), y(rb)); context.stroke();
    } else if (this.chosen) this.box(context, { x, y }, this.chosen, "#3fb950");
  }

  box(context, { x, y }, [r0, r1, c0, c1], colour, label = "") {
    context.strokeStyle = colour; context.lineWidth = 2;
    context.strokeRect(x(c0), y(r0), x(c1) - x(c0), y(r1) - y(r0));
    if (label) { context.fillStyle = colour; context.font = "12px system-ui"; context.fillText(label, x(c0) + 2, y(r0) - 4); }
  }

  /** Row and column under an event, as real numbers. */
  place(event) {
    const { down, across, left, top, box } = this.layout();
    return [(event.clientY - box.top - top) / down, (event.clientX - box.left - left) / across];
  }

  seen() {
    const { down, across: wide, left, top, box } = this.layout(), [rows, cols] = this.extent;
    const clip = (value, most) => Math.max(0, Math.min(most, value));
    const first = clip(-top / down, rows), last = clip((box.height - top) / down, rows);
    const across = [Math.floor(clip(-left / wide, cols)), Math.ceil(clip((box.width - left) / wide, cols))];
    return [Math.floor(first), Math.ceil(last), ...across];
  }

  zoomBy(factor, about = null) {
    const before = about || [this.centre[0] * this.extent[0], this.centre[1] * this.extent[1]];
    const next = Math.max(1, Math.min(200, this.zoom * factor)), keep = this.zoom / next;
    this.centre = this.centre.map((centre, i) => { const p = before[i] / this.extent[i]; return p + (centre - p) * keep; });
    this.zoom = next;
    if (next === 1) this.centre = [0.5, 0.5];
    this.redraw(); this.moved(this.seen());
  }

  moveBy(dy, dx) {
    const { down, across } = this.layout();
    this.centre = [this.centre[0] - dy / down / this.extent[0], this.centre[1] - dx / across / this.extent[1]].map((c) => Math.max(0, Math.min(1, c)));
    this.redraw(); this.moved(this.seen());
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.dragged = { x: event.clientX, y: event.clientY, moved: 0, from: this.place(event), choose: (event.shiftKey || this.choosing()) && (this.region || this.line) };
  }

  drag(event) {
    const [row, col] = this.place(event);
    if (this.dragged && this.dragged.choose) { this.chosen = (this.line ? this.lineTo : this.between).call(this, this.dragged.from, [row, col]); this.redraw(); return; }
    if (this.dragged) { this.dragged.moved += Math.hypot(event.movementX, event.movementY); this.moveBy(event.clientY - this.dragged.y, event.clientX - this.dragged.x); this.dragged.x = event.clientX; this.dragged.y = event.clientY; }
    this.tell(row, col);
  }

  release() {
    if (this.dragged && this.dragged.choose && this.chosen) (this.line || this.region)(this.chosen);
    else if (this.dragged && this.dragged.moved < 3) this.pick(...this.dragged.from);
    this.dragged = null;
  }

  between([ra, ca], [rb, cb]) {
    const clip = (value, most) => Math.max(0, Math.min(most, Math.round(value)));
    const [rows, cols] = this.extent;
    return [clip(Math.min(ra, rb), rows - 1), clip(Math.max(ra, rb), rows), clip(Math.min(ca, cb), cols - 1), clip(Math.max(ca, cb), cols)];
  }

  lineTo(from, to) {
    const clip = (value, i) => Math.max(0, Math.min(this.extent[i], value));
    return [clip(from[0], 0), clip(from[1], 1), clip(to[0], 0), clip(to[1], 1)];
  }

  /** The value at a row and a column; undefined where nothing is shown. */
  at(row, col) {
    if (!this.tile) return undefined;
    const [r0, , c0] = this.shown, bin = this.tile.bin || 1, i = Math.floor((row - r0) / bin), k = Math.floor((col - c0) / bin);
    const inside = row >= 0 && col >= 0 && row < this.extent[0] && col < this.extent[1] && i >= 0 && k >= 0 && i < this.tile.shape[0] && k < this.tile.shape[1];
    return inside ? valueAt(this.tile, i, k) : undefined;
  }

  tell(row, col) {
    const value = this.at(row, col);
    if (value === undefined) this.point(null); else this.point(Math.floor(row), Math.floor(col), value, this.tile.bin || 1);
  }

  key(event) {
    const step = 40, moves = { ArrowUp: [step, 0], ArrowDown: [-step, 0], ArrowLeft: [0, step], ArrowRight: [0, -step] };
    if (event.key === "+" || event.key === "=") this.zoomBy(1.25);
    else if (event.key === "-") this.zoomBy(0.8);
    else if (event.key === "0") { this.zoom = 1; this.centre = [0.5, 0.5]; this.redraw(); this.moved(this.seen()); }
    else if (moves[event.key]) this.moveBy(...moves[event.key]);
    else return;
    event.preventDefault();
  }
}

/** Two sliders for a grey window, in a row; `changed([low, high])`. Returns a function that sets range and window. */
export function windowSliders(row, changed) {
  const inputs = ["darkest", "brightest"].map((name) => {
    const label = document.createElement("label"), input = document.createElement("input"), text = document.createElement("span");
    Object.assign(input, { type: "range", min: 0, max: 1000, value: 0 });
    label.append(`${name} `, input, " ", text); row.append(label);
    return { input, text };
  });
  let range = [0, 1];
  const values = () => inputs.map(({ input }) => range[0] + (range[1] - range[0]) * input.value / 1000);
  const write = () => values().forEach((value, i) => { inputs[i].text.textContent = value.toPrecision(4); });
  for (const { input } of inputs) input.addEventListener("input", () => {
    const [low, high] = values();
    write(); changed(high > low ? [low, high] : [low, low + Math.abs(range[1] - range[0]) / 1000]);
  });
  return (from, window) => {
    range = from;
    window.forEach((value, i) => { inputs[i].input.value = 1000 * (value - range[0]) / (range[1] - range[0]); });
    write();
  };
}

/** Values [row, col] as a tile, as the server packs them. */
export function packed(values, [rows, cols]) {
  let low = Infinity, high = -Infinity;
  for (const value of values) { if (value < low) low = value; if (value > high) high = value; }
  const scale = (high - low) / 65534 || 1;
  return { numbers: Uint16Array.from(values, (value) => value === value ? Math.round((value - low) / scale) : 65535), shape: [rows, cols], offset: low, scale, bin: 1 };
}

/** Buttons that set named grey windows, in a row: `choose(window)`. */
export function windowButtons(row, windows, choose) {
  row.querySelectorAll("button").forEach((button) => button.remove());
  for (const [name, window] of Object.entries(windows)) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: name, title: "grey window" });
    button.addEventListener("click", () => choose(window));
    row.append(button);
  }
}

/** The axes down and across a slice across each axis of a volume. */
export const PLANES = [[1, 2], [0, 2], [0, 1]];
/** Names of the axes of a volume, or of the stack of a scan's views. */
export const namesOf = ({ angles }) => angles.length ? ["view", "row", "column"] : ["z", "y", "x"];

/** A voxel's place along an axis from the volume's middle, in its unit of length; its number where that is unknown; of a view its angle, too. */
export function position({ shape, voxel, length_unit: unit, angles }, axis, index) {
  if (unit !== "px") return `${((index - (shape[axis] - 1) / 2) * voxel[axis]).toPrecision(4)} ${unit}`;
  return axis === 0 && angles.length ? `${index} (${angles[index] === null ? "no angle" : `${angles[index].toFixed(2)}°`})` : `${index}`;
}

export function debounce(call, ms) { let timer = 0; return (...values) => { clearTimeout(timer); timer = setTimeout(() => call(...values), ms); }; }
