// Pose, rates, residual and latency over time: uPlot.

import { utc } from "./approach.js";
import { made } from "./status.js";
import uPlot from "./vendor/uplot.js";

const DEGREES = 180 / Math.PI;
const MOST = 900; // points of a curve: more than its pixels help no one
const LEAST_ZOOM_PX = 5;
const HOLE_S = 1; // without frames: no curve is drawn across
const [RED, GREEN, BLUE, YELLOW] = ["--red", "--green", "--blue", "--yellow"]; // of page.css
const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3]];
const LINES = ["solid", "dashed", "dotted", "double"];

const deviation = (s, from) => s.covariance && 3 * Math.sqrt(s.covariance[from][from] + s.covariance[from + 1][from + 1] + s.covariance[from + 2][from + 2]);
const shown = (s) => ({ covariance: s.covariance ?? s.motion?.covariance ?? null });
const turned = (name) => (s) => (s.approach?.[name] == null ? null : DEGREES * s.approach[name]);

// Title; curves: name, colour, value of a state, and "right" for the right axis.
const PORT = ["misalignment, °", [["roll", RED, turned("roll_rad")], ["pitch", GREEN, turned("pitch_rad")], ["yaw", BLUE, turned("yaw_rad")]]];
const QUATERNION = ["attitude, quaternion", ["w", "x", "y", "z"].map((name, k) => [name, [YELLOW, RED, GREEN, BLUE][k], (s) => s.quaternion?.[k]])];
const plotsOf = (hasPort) => [
  ["m, m/s", [["range", BLUE, (s) => s.approach?.range_m], ["rate", YELLOW, (s) => s.approach?.range_rate_m_s, "right"]]],
  ["position, m", [["x", RED, (s) => s.pose?.translation_m[0]], ["y", GREEN, (s) => s.pose?.translation_m[1]], ["z", BLUE, (s) => s.pose?.translation_m[2], "right"]]],
  hasPort ? PORT : QUATERNION,
  ["3σ, m and °", [["position", BLUE, (s) => deviation(shown(s), 3)], ["attitude", YELLOW, (s) => DEGREES * deviation(shown(s), 0) || null, "right"]]],
  ["turning, °/s", ["x", "y", "z"].map((name, k) => [name, [RED, GREEN, BLUE][k], (s) => s.motion?.rates && DEGREES * s.motion.rates.angular_rad_s[k]])],
  ["moving, m/s", ["x", "y", "z"].map((name, k) => [name, [RED, GREEN, BLUE][k], (s) => s.motion?.rates?.linear_m_s[k]])],
  ["fit", [["residual", YELLOW, (s) => s.fit?.residual_px], ["confidence", GREEN, (s) => s.confidence, "right"]]],
  ["ms; drops", [["tracker", BLUE, (s) => s.track_ms], ["latency", YELLOW, (s) => s.latency_ms], ["drops", RED, (s) => s.drops, "right"]]],
];

/** Numbers of an axis with as many digits as its steps have: 1, 2, 2.5 or 5 times a power of ten. */
function ticks(plot, places, axis, space, step) {
  const power = Math.floor(Math.log10(step) + 1e-9), half = Math.abs(step / 10 ** power - 2.5) < 1e-6;
  const digits = Math.min(6, Math.max(0, -power + (half ? 1 : 0)));
  return places.map((at) => (at == null ? "" : at.toFixed(digits)));
}

export class Plots {
  /** `zoomed(from, to)` in s, or `zoomed(null)`, when the operator zooms. */
  constructor(parent, hasPort, zoomed) {
    this.mark = null; // s, where the pause stands
    this.hasPort = hasPort;
    this.zoomed = zoomed;
    this._states = [];
    parent.replaceChildren();
    this._plots = plotsOf(hasPort).map(([title, curves]) => this._make(parent, title, curves));
    this._resizes = new ResizeObserver(() => {
      for (const { box, plot } of this._plots) {
        plot.setSize({ width: box.clientWidth, height: box.clientHeight });
      }
    });
    this._resizes.observe(parent);
  }

  close() {
    this._resizes.disconnect();
    for (const { plot } of this._plots) plot.destroy();
  }

  _make(parent, title, curves) {
    const box = made("div", "", "plot"), head = made("h2", `${title} `);
    const keys = curves.map(([name, colour], k) => {
      const key = made("b", ` ${name}`);
      key.style.color = `var(${colour})`;
      key.style.textDecoration = `underline ${LINES[k]}`;
      head.append(key);
      return key;
    });
    const say = (u) => keys.forEach((key, k) => {
      const value = u.cursor.idx == null ? null : u.data[k + 1][u.cursor.idx];
      const text = ` ${curves[k][0]}${value == null ? "" : ` ${value.toPrecision(4)}`}`;
      if (key.textContent !== text) key.textContent = text;
    });
    const select = (u) => {
      if (u.select.width < LEAST_ZOOM_PX) return;
      const ends = [u.select.left, u.select.left + u.select.width].map((x) => u.posToVal(x, "x"));
      u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
      this.zoomed(...ends);
    };
    box.append(head);
    parent.append(box);
    const right = curves.some((curve) => curve[3] === "right");
    const share = curves.some(([name]) => name === "confidence"); // 0 … 1
    const [text, ...strokes] = [head, ...keys].map((each) => getComputedStyle(each).color);
    const axis = { stroke: text, grid: { stroke: getComputedStyle(box).borderColor, width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
    const plot = new uPlot({
      width: box.clientWidth,
      height: box.clientHeight,
      legend: { show: false },
      cursor: { sync: { key: "time" }, drag: { x: true, y: false, setScale: false } },
      padding: [16, right ? 0 : 12, 0, 0],
      scales: { x: { time: true }, y: {}, ...(right ? { right: share ? { range: [0, 1] } : {} } : {}) },
      axes: [
        { ...axis, size: 20, space: 70, values: (u, places) => places.map((at) => (at == null ? "" : utc(at))) },
        { ...axis, size: 52, space: 22, values: ticks },
        ...(right ? [{ ...axis, values: ticks, scale: "right", side: 1, size: 52, space: 22, grid: { show: false } }] : []),
      ],
      series: [{}, ...curves.map(([name, , , side], k) => ({ label: name, stroke: strokes[k], dash: DASHES[k], width: 1.4, points: { show: false }, scale: side ?? "y" }))],
      hooks: { drawClear: [(u) => this._gaps(u)], draw: [(u) => this._mark(u)], setCursor: [say], setSelect: [select] },
    }, [[], ...curves.map(() => [])], box);
    plot.over.addEventListener("dblclick", () => this.zoomed(null));
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
    const kept = states.slice(from, to).filter((state) => step === 1 || state.frame % step === 0);
    const apart = kept.slice(1).map((state, k) => state.received_unix_s - kept[k].received_unix_s);
    const holeS = Math.max(HOLE_S, 3 * (apart.sort((a, b) => a - b)[apart.length >> 1] ?? 0));
    this._states = [];
    let last = null;
    for (const state of kept) {
      const before = this._states.at(-1)?.received_unix_s ?? Infinity;
      if (state.received_unix_s - before > holeS) this._states.push({ received_unix_s: before + 0.01 });
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
    u.ctx.fillStyle = getComputedStyle(u.root).color;
    u.ctx.fillRect(x - 1, u.bbox.top, 2, u.bbox.height);
    u.ctx.restore();
  }
}
