// Keys on the picture: what is held moves the camera, what is struck acts at once.

// Shares of the picture's width a second, factors a second, distances a second.
const TURN = 0.35;
const DOLLY = 2;
const FLY = 0.5;
const LONGEST = 0.1;

const flights = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] };
const arrows = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };
const dollies = { "+": -1, "=": -1, "-": 1, _: 1 };

// on.turn(kind, right, down), on.dolly(factor), on.fly([right, down, forward]), on.strokes: key to action
export function listenToKeys(canvas, on) {
  const held = new Set();
  let modifiers = {};

  canvas.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase();
    modifiers = event;
    if (event.altKey || ((event.ctrlKey || event.metaKey) && !(key in arrows))) return;
    if (key in flights || key in arrows || key in dollies) {
      if (held.size === 0) requestAnimationFrame((now) => move(now, now - 16));
      held.add(key);
    } else if (key in on.strokes) {
      on.strokes[key]();
    } else {
      return;
    }
    event.preventDefault();
  });
  canvas.addEventListener("keyup", (event) => {
    modifiers = event;
    held.delete(event.key.toLowerCase());
  });
  canvas.addEventListener("blur", () => held.clear());

  function move(now, before) {
    if (held.size === 0) return;
    const seconds = Math.min((now - before) / 1000, LONGEST);
    const kind = modifiers.shiftKey ? "pan" : modifiers.ctrlKey || modifiers.metaKey ? "look" : "orbit";
    for (const key of held) {
      if (key in arrows) on.turn(kind, ...arrows[key].map((v) => v * TURN * seconds));
      else if (key in dollies) on.dolly(DOLLY ** (dollies[key] * seconds));
      else on.fly(flights[key].map((v) => v * FLY * seconds));
    }
    requestAnimationFrame((next) => move(next, now));
  }
}
