// The operator's numbers: approach, mission time, alerts.

import { made, poseShown, rows, say, signed, DEGREES } from "./status.js";

const find = (id) => document.getElementById(id);
const degrees = (radians, digits = 2) => `${signed(DEGREES * radians, digits)}°`;

/** Minutes and seconds, with hours where needed. */
export function spanText(seconds) {
  const whole = Math.floor(Math.abs(seconds)), sign = seconds < 0 ? "−" : "";
  const [h, m, s] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60].map((n) => String(n).padStart(2, "0"));
  return `${sign}${h}:${m}:${s}`;
}

export const utc = (unixS, digits = 0) => {
  const text = new Date(1000 * unixS).toISOString().slice(11, 23);
  return digits ? text.slice(0, 9 + digits) : text.slice(0, 8);
};

/** UTC and mission time of a state. */
export const times = (state, startUnixS) =>
  `${utc(state.received_unix_s)} UTC · T${state.received_unix_s < startUnixS ? "" : "+"}${spanText(state.received_unix_s - startUnixS)}`;

export function showApproach(state) {
  const now = state?.approach ?? null, entries = [], table = find("approach");
  table.className = poseShown(state ?? null).predicted ? "predicted" : "";
  const limits = new Map((now?.alarms ?? []).map((alarm) => [alarm.quantity, alarm.level === "alarm" ? "bad" : "warn"]));
  const kind = (...names) => names.map((name) => limits.get(name)).find(Boolean) ?? "";
  const add = (name, text, ...quantities) => entries.push([name, text, kind(...quantities)]);
  if (now === null) {
    const filter = state && ["filter", `${state.motion?.status ?? "waiting"}: ${state.motion?.reason ?? "no pose yet"}`, "wrap"];
    rows(table.tBodies[0], [["range", "–"], ["range rate", "–"], ...(filter ? [filter] : [])]);
    return;
  }
  add("range", `${now.range_m.toFixed(3)} ± ${(3 * now.range_sigma_m).toFixed(3)} m`, "range_m", "range_sigma_m");
  add("range rate", `${signed(now.range_rate_m_s, 4)} ± ${(3 * now.range_rate_sigma_m_s).toFixed(4)} m/s`, "range_rate_m_s");
  add("bearing az, el", `${degrees(now.azimuth_rad)} ${degrees(now.elevation_rad)}`, "bearing_deg");
  if (now.along_m !== null) {
    add("along axis", `${signed(now.along_m, 3)} m · ${signed(now.along_rate_m_s, 4)} m/s`, "along_m");
    add("right, up", `${signed(now.right_m, 3)} ${signed(now.up_m, 3)} m`, "lateral_m");
    add("drift", `${signed(now.right_rate_m_s, 4)} ${signed(now.up_rate_m_s, 4)} m/s`, "lateral_rate_m_s");
    add("roll pitch yaw", [now.roll_rad, now.pitch_rad, now.yaw_rad].map((angle) => degrees(angle, 1)).join(" "), "roll_deg", "pitch_deg", "yaw_deg", "misalignment_deg");
    add("off axis", degrees(now.off_axis_rad), "off_axis_deg");
    const contact = now.contact_s === null ? "not closing" : `in ${spanText(now.contact_s)}, miss ${now.miss_m.toFixed(3)} m`;
    add("contact", contact, "miss_m");
  }
  add("turning", `${(DEGREES * now.turn_rate_rad_s).toFixed(3)} °/s`, "turn_rate_deg_s");
  if (now.in_corridor !== null) add("corridor", now.in_corridor ? "● inside" : "▲ outside", "corridor");
  if (now.in_keep_out !== null) add("keep-out zone", now.in_keep_out ? (now.in_corridor ? "entered in the corridor" : "▲ inside") : "● outside", "keep_out");
  if (now.plan_m !== null) add("from the plan", `${now.plan_m.toFixed(3)} m`, "plan_m");
  rows(table.tBodies[0], entries);
}

/** What must not be missed: alarms, a recording that fails, and doubts about the session's files. */
export function showAlerts(state, recording, doubts = []) {
  const list = find("alerts"), found = [];
  if (recording?.state === "failed") found.push(["alarm", `NOT RECORDED: ${recording.reason ?? "unknown"} (${recording.lost} lost, ${recording.pending ?? 0} waiting)`]);
  for (const { level, text } of state?.approach?.alarms ?? []) found.push([level, `${level === "alarm" ? "ALARM" : "Warning"}: ${text}`]);
  for (const text of doubts) found.push(["warning", `Check: ${text}`]);
  const text = JSON.stringify(found);
  if (list.dataset.shown === text) return;
  list.dataset.shown = text;
  list.hidden = found.length === 0;
  list.replaceChildren(...found.map(([level, said]) => made("li", said, level)));
}
