// What the session's own sensors saw in the frame, the fused state, and the fitted path, as tables.

import { DEGREES, rows, showFused, signed } from "./status.js";

const find = (id) => document.getElementById(id);
const place = (values, digits = 3) => `${values.map((value) => signed(value, digits)).join(" ")} m`;

/** Fills a table and shows it; null hides it. */
function table(id, caption, entries) {
  const whole = find(id), hidden = entries === null;
  if (whole.hidden !== hidden) whole.hidden = hidden;
  if (hidden) return;
  if (whole.caption.textContent !== caption) whole.caption.textContent = caption;
  rows(whole.tBodies[0], entries);
}

function verdictOf(verdict) {
  if (verdict === null) return ["not fused", ""];
  return verdict.accepted ? ["accepted", "good"] : [verdict.reason ?? "rejected", "bad wrap"];
}

function ringRows(ring) {
  const good = ring.status === "ok";
  const entries = [["status", `${ring.status}${ring.reason ? `: ${ring.reason}` : ""}`, good ? "good" : "warn wrap"]];
  const chosen = ring.poses.find((pose) => pose.chosen) ?? null;
  if (chosen !== null) {
    const sigma = chosen.covariance && [0, 1, 2].map((k) => (3 * Math.sqrt(chosen.covariance[k][k])).toFixed(3)).join(" ");
    const away = Math.acos(Math.min(1, Math.max(-1, -chosen.axis[2]))) * DEGREES;
    entries.push(["centre", place(chosen.centre_m)]);
    if (sigma) entries.push(["centre ±", `${sigma} m`]);
    entries.push(["tilt of the axis", `${away.toFixed(2)}°`]);
  }
  if (ring.candidates.length > 0) entries.push(["candidates", String(ring.candidates.length)]);
  if (ring.verdict !== null) entries.push(["filter", ...verdictOf(ring.verdict)]);
  return entries;
}

function reflectorRows(reading) {
  const good = reading.status === "ok";
  const entries = [["status", `${reading.status}${reading.reason ? `: ${reading.reason}` : ""}`, good ? "good" : "warn wrap"]];
  if (reading.pose !== null) {
    entries.push(["x y z", place(reading.pose.translation_m)]);
    entries.push(["spots", reading.spots.map((spot) => spot.reflector).join(", "), "wrap"]);
  }
  if (reading.verdict !== null) entries.push(["filter", ...verdictOf(reading.verdict)]);
  return entries;
}

function pathRows(path) {
  const { segment, correction, spin } = path;
  if (segment === null) return [["fit", path.segment_reason, "warn wrap"]];
  const sigma = 3 * Math.sqrt(Math.max(...[0, 1, 2].map((k) => segment.place_covariance_m2[k][k])));
  const entries = [
    ["place", `${place(segment.place_m, 2)} ± ${sigma.toFixed(3)}`],
    ["speed", `${Math.hypot(...segment.velocity_m_s).toFixed(4)} m/s · ${segment.frames} frames`],
  ];
  if (correction) {
    entries.push(["off the plan", `${Math.hypot(...correction.error_m).toFixed(3)} m`]);
    entries.push(["predicted", `${Math.hypot(...correction.predicted_error_m).toFixed(3)} ± ${(3 * correction.predicted_sigma_m).toFixed(3)} m`]);
    const size = 1000 * Math.hypot(...correction.delta_v_m_s);
    entries.push(["correction", `Δv ${size.toFixed(2)} mm/s`, "warn"]);
    if (correction.direction) entries.push(["along", correction.direction.map((value) => signed(value, 2)).join(" ")]);
  } else if (path.correction_reason) entries.push(["correction", path.correction_reason, "warn wrap"]);
  if (spin) entries.push([spin.tumbling ? "tumble" : "spin", `${(DEGREES * spin.speed_rad_s).toFixed(4)} °/s`]);
  return entries;
}

/** All of a state; null: nothing is shown. */
export function showReadings(state) {
  showFused(state?.fused ?? null);
  const { ring = null, reflectors = null, trajectory = null } = state ?? {};
  table("ring", "Docking ring, in the frame (± 3σ)", ring && ringRows(ring));
  table("reflectors", "Reflectors", reflectors && reflectorRows(reflectors));
  const shape = trajectory?.segment?.shape;
  table("path", `Fitted path${shape ? `, ${shape}` : ""} (± 3σ)`, trajectory && pathRows(trajectory));
}

/** Fitted path, predicted path and place now, target frame (m), and the correction's direction; null without a fit. */
export function pathPlaces({ segment, centre_m: centre, path_from_target: turn, correction }) {
  if (segment === null) return null;
  const back = (v) => [0, 1, 2].map((k) => turn[0][k] * v[0] + turn[1][k] * v[1] + turn[2][k] * v[2]);
  const at = (v) => back(v).map((value, k) => centre[k] + value);
  return {
    path: segment.path_m.map(at),
    predicted: segment.predicted_m.map(at),
    now: at(segment.place_m),
    direction: correction?.direction ? back(correction.direction) : null,
  };
}
