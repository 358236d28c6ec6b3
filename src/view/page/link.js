// The socket. At most a few requests are under way; of those that wait here the newest is sent.

const LEAST_PAUSE = 16;
const MOST_UNDER_WAY = 3;
const LONGEST_RETRY = 8000;
const TURNED_AWAY = 1008;

export class Link {
  // on.picture(header, points, blob, request), on.refusal(text), on.state(text), on.status(status)
  constructor(on) {
    this.on = on;
    this.sent = new Map();
    this.number = 0;
    this.waiting = null;
    this.last = 0;
    this.retry = 500;
    this.open();
  }

  open() {
    const address = new URL("socket", location.href);
    address.protocol = "ws:";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.retry = 500;
      this.on.state("");
      this.pump();
    };
    this.socket.onmessage = ({ data }) => this.take(data);
    this.socket.onclose = ({ code, reason }) => this.closed(code, reason);
  }

  closed(code, reason) {
    const newest = [...this.sent.values()].pop();
    this.sent.clear();
    this.waiting ??= newest ?? this.shown ?? null;
    // What it showed has ended: there is nothing to come back to.
    if (this.ended) return;
    if (code === TURNED_AWAY) {
      this.on.state(`Not connected: ${reason}`);
      return;
    }
    this.on.state("The connection is lost; trying again …");
    setTimeout(() => this.open(), this.retry);
    this.retry = Math.min(2 * this.retry, LONGEST_RETRY);
  }

  ask(request) {
    this.waiting = request;
    this.pump();
  }

  pump() {
    if (!this.waiting || this.socket.readyState !== WebSocket.OPEN) return;
    if (this.sent.size >= MOST_UNDER_WAY) return;
    const pause = this.last + LEAST_PAUSE - performance.now();
    if (pause > 0) {
      this.timer ??= setTimeout(() => {
        this.timer = undefined;
        this.pump();
      }, pause);
      return;
    }
    const id = ++this.number;
    this.sent.set(id, this.waiting);
    this.socket.send(JSON.stringify({ ...this.waiting, id }));
    this.waiting = null;
    this.last = performance.now();
  }

  take(data) {
    if (typeof data === "string") {
      const { id, error, status } = JSON.parse(data);
      if (status) {
        this.ended = status.end !== null;
        this.on.status(status);
        return;
      }
      this.settle(id ?? this.number);
      this.on.refusal(error);
    } else {
      const length = new DataView(data).getUint32(0, true);
      const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      const from = 4 + length;
      const until = from + 16 * header.points;
      const points = new Float32Array(data.slice(from, until));
      const blob = new Blob([data.slice(until)], { type: `image/${header.format}` });
      this.shown = this.sent.get(header.id);
      this.settle(header.id);
      this.on.picture(header, points, blob, this.shown);
    }
    this.pump();
  }

  // What was asked before an answered request is answered no more.
  settle(id) {
    for (const number of this.sent.keys()) if (number <= id) this.sent.delete(number);
  }
}
