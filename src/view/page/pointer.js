// Mouse, pen and fingers on the picture.

const RADIANS = Math.PI;
const CLICK = 4;

// on.move(kind, right, down) in shares of the width; on.dolly(factor); on.click(x, y) in CSS pixels
export function listen(canvas, mode, on) {
  const fingers = new Map();
  let travelled = 0;
  let button = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (fingers.size === 0) travelled = 0;
    button = event.button;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    travelled += Math.hypot(dx, dy);
    const width = canvas.clientWidth;
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const spread = (place) => Math.max(Math.hypot(place[0] - other[0], place[1] - other[1]), 8);
      on.dolly(spread(before) / spread(now));
      on.move("pan", dx / 2 / width, dy / 2 / width);
    } else {
      on.move(kind(event, button, mode()), dx / width, dy / width);
    }
    fingers.set(event.pointerId, now);
  });
  const release = (event) => {
    if (!fingers.delete(event.pointerId)) return;
    const box = canvas.getBoundingClientRect();
    const isClick = event.type === "pointerup" && travelled < CLICK && fingers.size === 0;
    if (isClick) on.click(event.clientX - box.left, event.clientY - box.top);
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
      on.dolly(Math.exp(Math.min(Math.max(pixels, -300), 300) * 0.0015));
    },
    { passive: false },
  );
}

function kind(event, button, mode) {
  if (button !== 0 || event.shiftKey) return "pan";
  return event.ctrlKey || event.metaKey ? "look" : mode;
}

export function apply(viewer, kind, right, down, size) {
  if (kind === "pan") viewer.pan(right, down, size);
  else if (kind === "look") viewer.look(right * RADIANS * 0.5, down * RADIANS * 0.5);
  else viewer.orbit(right * RADIANS, down * RADIANS);
}
