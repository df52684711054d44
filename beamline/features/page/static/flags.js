// The flags of the monitor along the scan: frames across, a line a check; a click goes to the frame.

export class Timeline {
  constructor(canvas, { go }) {
    Object.assign(this, { canvas, go, flags: [], planned: 1, current: 0, monitored: true });
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("click", (event) => this.pick(event));
    canvas.addEventListener("keydown", (event) => {
      if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
      const frames = [...new Set(this.flags.map((flag) => flag.frame))].sort((a, b) => a - b);
      const next = event.key === "ArrowRight" ? frames.find((frame) => frame > this.current) : frames.filter((frame) => frame < this.current).pop();
      if (next !== undefined) this.go(next);
      event.preventDefault();
    });
  }

  show(flags, planned, current) {
    Object.assign(this, { flags, planned: Math.max(1, planned), current });
    this.checks = [...new Set(flags.map((flag) => flag.check))];
    this.draw();
  }

  draw() {
    const box = this.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    this.canvas.width = box.width * ratio; this.canvas.height = box.height * ratio;
    const context = this.canvas.getContext("2d"), style = getComputedStyle(document.body);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.font = "12px system-ui"; context.fillStyle = style.getPropertyValue("--faint");
    const checks = this.checks || [], left = 80, width = box.width - left - 8, line = Math.min(22, (box.height - 20) / Math.max(1, checks.length));
    if (!checks.length) context.fillText(this.monitored ? "no frame is flagged" : "the monitor did not check these frames: beamline monitor FILE checks them", 8, 20);
    checks.forEach((check, i) => context.fillText(check, 6, 14 + i * line));
    for (const flag of this.flags) {
      context.fillStyle = style.getPropertyValue(flag.alarm ? "--bad" : "--warn");
      context.fillRect(left + width * flag.frame / this.planned, 4 + checks.indexOf(flag.check) * line, Math.max(3, width / this.planned), line - 6);
    }
    context.fillStyle = style.getPropertyValue("--accent");
    context.fillRect(left + width * this.current / this.planned, 0, 1.5, box.height - 14);
    context.fillStyle = style.getPropertyValue("--faint");
    context.fillText("frame 0", left, box.height - 3); context.fillText(`${this.planned}`, box.width - 40, box.height - 3);
    Object.assign(this, { left, width, line });
  }

  pick(event) {
    const box = this.canvas.getBoundingClientRect(), frame = (event.clientX - box.left - this.left) / this.width * this.planned;
    const nearest = [...this.flags].sort((a, b) => Math.abs(a.frame - frame) - Math.abs(b.frame - frame))[0];
    const near = nearest && Math.abs(nearest.frame - frame) < 8 * this.planned / this.width + 1;
    this.go(Math.max(0, Math.round(near ? nearest.frame : frame)));
  }
}
