// How far a training is: its stage, and the curves so far.

const [WIDTH, HEIGHT] = [240, 56];
const SVG = "http://www.w3.org/2000/svg";

const lines = {
  loss: { values: [(p) => p.l1, (p) => 1 - p.ssim], text: (p) => `L1 ${p.l1.toFixed(4)}, 1 − SSIM ${(1 - p.ssim).toFixed(3)}` },
  psnr: { values: [(p) => p.psnr], text: (p) => (p.psnr === null ? "–" : `${p.psnr.toFixed(2)} dB`) },
  count: { values: [(p) => p.gaussians], text: (p) => p.gaussians.toLocaleString("en") },
};

export class Training {
  // The section's elements: stage, bar, and by the name of a line { svg, text }.
  constructor(section, stage, bar, curves) {
    Object.assign(this, { section, stage, bar, curves });
  }

  show(status) {
    this.section.hidden = false;
    const known = status.of > 0;
    this.stage.textContent = status.end ?? (status.stage ? `${status.stage}${known ? share(status) : ""}` : "beginning");
    this.bar.hidden = status.end !== null;
    if (known) {
      this.bar.max = status.of;
      this.bar.value = status.done;
    } else {
      this.bar.removeAttribute("value");
    }
    for (const [name, { svg, text }] of Object.entries(this.curves)) draw(svg, text, lines[name], status.curves);
  }
}

function share({ done, of, unit }) {
  if (unit === "%") return `: ${done} %`;
  return `: ${done.toLocaleString("en")} of ${of.toLocaleString("en")} ${unit}`;
}

// Lines over the steps, from 0 or the least value to the most.
function draw(svg, text, line, points) {
  const last = points.at(-1);
  text.textContent = last ? line.text(last) : "–";
  const all = line.values.flatMap((value) => points.map(value)).filter((v) => v !== null);
  if (all.length === 0) return svg.replaceChildren();
  const [low, high] = [Math.min(...all), Math.max(...all)];
  const room = 0.08 * (high - low) || 1;
  const steps = Math.max(last.step, 1);
  const place = (point, value) => {
    const x = (WIDTH * point.step) / steps;
    const y = HEIGHT * (1 - (value - low + room) / (high - low + 2 * room));
    return `${x.toFixed(1)} ${y.toFixed(1)}`;
  };
  const paths = line.values.map((value) => {
    const path = document.createElementNS(SVG, "path");
    const places = points.filter((p) => value(p) !== null).map((p) => place(p, value(p)));
    path.setAttribute("d", places.length ? `M${places.join("L")}` : "");
    return path;
  });
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  svg.replaceChildren(...paths);
}
