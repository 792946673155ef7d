// Pose, rates, residual and latency over time: uPlot.

import uPlot from "./vendor/uplot.js";

const DEGREES = 180 / Math.PI;
const MOST = 900; // points of a curve: more than its pixels help no one
const HOLE_S = 1; // without frames: no curve is drawn across
const [RED, GREEN, BLUE, YELLOW] = ["#ff8f87", "#6bdb7b", "#79b8ff", "#f2c14e"];

// Title; curves: name, colour, value of a state, and "right" for the right axis.
const PLOTS = [
  ["position, m", [["x", RED, (s) => s.pose?.translation_m[0]], ["y", GREEN, (s) => s.pose?.translation_m[1]], ["z", BLUE, (s) => s.pose?.translation_m[2], "right"]]],
  ["attitude, quaternion", ["w", "x", "y", "z"].map((name, k) => [name, [YELLOW, RED, GREEN, BLUE][k], (s) => s.quaternion?.[k]])],
  ["residual, px; confidence", [["residual", YELLOW, (s) => s.fit?.residual_px], ["confidence", GREEN, (s) => s.confidence, "right"]]],
  ["turning, °/s", ["x", "y", "z"].map((name, k) => [name, [RED, GREEN, BLUE][k], (s) => s.rates && DEGREES * s.rates.angular_rad_s[k]])],
  ["moving, m/s", ["x", "y", "z"].map((name, k) => [name, [RED, GREEN, BLUE][k], (s) => s.rates?.linear_m_s[k]])],
  ["latency, ms; drops", [["tracker", BLUE, (s) => s.track_ms], ["latency", YELLOW, (s) => s.latency_ms], ["drops", RED, (s) => s.drops, "right"]]],
];

export class Plots {
  constructor(parent) {
    this.mark = null; // s, where the pause stands
    this._states = [];
    const style = document.createElement("link");
    style.rel = "stylesheet";
    style.href = "vendor/uplot.css";
    document.head.append(style);
    this._plots = PLOTS.map(([title, curves]) => this._make(parent, title, curves));
    new ResizeObserver(() => {
      for (const { box, plot } of this._plots) {
        plot.setSize({ width: box.clientWidth, height: box.clientHeight });
      }
    }).observe(parent);
  }

  _make(parent, title, curves) {
    const box = document.createElement("div");
    box.className = "plot";
    const head = document.createElement("h2");
    head.textContent = `${title} `;
    for (const [name, colour] of curves) {
      const key = document.createElement("b");
      key.textContent = ` ${name}`;
      key.style.color = colour;
      head.append(key);
    }
    box.append(head);
    parent.append(box);
    const right = curves.some((curve) => curve[3] === "right");
    const axis = { stroke: "#9aa7b5", grid: { stroke: "#26303b" }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
    const plot = new uPlot({
      width: box.clientWidth,
      height: box.clientHeight,
      legend: { show: false },
      cursor: { sync: { key: "time" }, drag: { setScale: false } },
      padding: [16, right ? 0 : 12, 0, 0],
      scales: { x: { time: true }, y: {}, ...(right ? { right: {} } : {}) },
      axes: [
        { ...axis, size: 20, space: 70 },
        { ...axis, size: 46, space: 22 },
        ...(right ? [{ ...axis, scale: "right", side: 1, size: 40, space: 22, grid: { show: false } }] : []),
      ],
      series: [{}, ...curves.map(([name, stroke, , side]) => ({ label: name, stroke, width: 1.4, points: { show: false }, scale: side ?? "y" }))],
      hooks: { drawClear: [(u) => this._gaps(u)], draw: [(u) => this._mark(u)] },
    }, [[], ...curves.map(() => [])], box);
    return { box, plot, curves };
  }

  /** Shows the last `spanS` seconds of states up to a time. */
  show(states, endS, spanS) {
    let from = states.length;
    while (from > 0 && states[from - 1].received_unix_s >= endS - spanS) from--;
    let to = states.length;
    while (to > from && states[to - 1].received_unix_s > endS) to--;
    // Whole steps of frames, so that the same ones are kept from one drawing to the next.
    const step = Math.max(1, Math.ceil((to - from) / MOST));
    this._states = [];
    let last = null;
    for (let k = from; k < to; k++) {
      const state = states[k];
      if (step > 1 && state.frame % step) continue;
      const before = this._states.at(-1)?.received_unix_s ?? Infinity;
      if (state.received_unix_s - before > HOLE_S) this._states.push({ received_unix_s: before + 0.01 });
      // q and −q are one attitude: of the two the one that stays near the last.
      let quaternion = state.pose?.quat_wxyz;
      if (quaternion && last && quaternion.reduce((sum, value, i) => sum + value * last[i], 0) < 0) {
        quaternion = quaternion.map((value) => -value);
      }
      last = quaternion ?? last;
      this._states.push({ ...state, quaternion });
    }
    const times = this._states.map((state) => state.received_unix_s);
    for (const { plot, curves } of this._plots) {
      plot.batch(() => {
        plot.setData([times, ...curves.map(([, , value]) => this._states.map((state) => value(state) ?? null))], true);
        plot.setScale("x", { min: endS - spanS, max: endS });
      });
    }
  }

  /** Shades times without a pose. */
  _gaps(u) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.fillStyle = "#ff7b7230";
    const states = this._states;
    for (let k = 0; k < states.length; k++) {
      if (states[k].pose !== null) continue; // nor is a hole a frame without a pose
      const first = k;
      while (k + 1 < states.length && states[k + 1].pose === null) k++;
      const end = states[Math.min(k + 1, states.length - 1)].received_unix_s;
      const left = Math.max(bbox.left, u.valToPos(states[first].received_unix_s, "x", true));
      const right = Math.min(bbox.left + bbox.width, u.valToPos(end, "x", true));
      ctx.fillRect(left, bbox.top, Math.max(1, right - left), bbox.height);
    }
    ctx.restore();
  }

  _mark(u) {
    if (this.mark === null) return;
    const x = u.valToPos(this.mark, "x", true);
    if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
    u.ctx.save();
    u.ctx.fillStyle = "#e4e9ef";
    u.ctx.fillRect(x - 1, u.bbox.top, 2, u.bbox.height);
    u.ctx.restore();
  }
}
