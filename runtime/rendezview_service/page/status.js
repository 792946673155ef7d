// The state as text: verdict, pose, sensors, recording.

export const DEGREES = 180 / Math.PI;
const SILENT_S = 3;
const STALE_S = 1, PERIODS = 2.5; // numbers are grey when older, and older than so many frames
const find = (id) => document.getElementById(id);

/** Sets a text only if it has changed, so that the layout is not computed again. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** An element with a text. */
export function made(tag, text = "", kind = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  element.className = kind;
  return element;
}

/** The banner's verdict: key, word, reason. `info`: the session as the service lists it. */
export function verdict(state, silentS, info = null) {
  const camera = info?.sensors?.[0] ?? null;
  const fault = camera !== null && !camera.healthy && !/^no frame yet|^no frame for \d+ s$/.test(camera.reason ?? "") ? camera.reason : null;
  if (state === null && fault !== null) return ["lost", info.source ? "NO SOURCE" : "NO FRAMES", fault];
  if (state === null) return ["waiting", "WAITING", "no frame has been tracked yet"];
  if (silentS > SILENT_S) return ["silent", "NO FRAMES", fault ?? `the last frame came ${silentS.toFixed(0)} s ago`];
  const reason = state.reason ?? state.status;
  if (state.pose !== null) {
    const sure = state.confidence === null ? "" : `confidence ${state.confidence.toFixed(3)}`;
    // Green only where nothing contradicts the pose.
    const { status: filter = "tracking", reason: why, protection } = state.fused ?? {};
    if (filter !== "tracking") return ["unsure", "FOUND", `${sure ? `${sure}; ` : ""}fused state ${filter}: ${why ?? "no reason"}`];
    if (protection?.alarm) return ["unsure", "FOUND", `${sure ? `${sure}; ` : ""}a sensor contradicts the fused state`];
    return ["found", "FOUND", sure];
  }
  if (["ambiguous", "rivals"].includes(state.status)) {
    const several = state.candidates.length > 0 ? ` (${state.candidates.length} poses fit)` : "";
    return ["ambiguous", "AMBIGUOUS", `${state.status}: ${reason}${several}`];
  }
  if (state.fused?.status === "tracking") return ["fused", "FUSED", `by the other sensors; camera ${state.status}: ${reason}`];
  if (state.phase === "coasting") return ["coasting", "COASTING", `${state.status}: ${reason}`];
  return ["lost", "LOST", `${state.status}: ${reason}`];
}

/** Greys what is not of now, and says how old it is; null: it is of now. */
export function showAge(ageS, rateHz) {
  const old = ageS !== null && ageS > Math.min(SILENT_S, Math.max(STALE_S, PERIODS / (rateHz || Infinity)));
  if (document.body.classList.contains("stale") !== old) document.body.classList.toggle("stale", old);
  const text = old ? `${ageS < 10 ? ageS.toFixed(1) : ageS.toFixed(0)} s old` : "";
  for (const label of document.querySelectorAll(".age")) {
    if (label.hidden === old) label.hidden = !old;
    say(label, text);
  }
}

export function showVerdict([key, word, reason]) {
  const banner = find("banner");
  if (banner.dataset.word !== key) banner.dataset.word = document.body.dataset.word = key;
  say(find("word"), word);
  say(find("reason"), reason);
}

export const signed = (value, digits) => (value >= 0 ? "+" : "−") + Math.abs(value).toFixed(digits);

const fixed = (value, digits) => (value >= 0 ? "\u2007" : "−") + Math.abs(value).toFixed(digits);

export function rows(body, entries) {
  while (body.rows.length > entries.length) body.deleteRow(-1);
  entries.forEach(([name, text, kind = ""], place) => {
    let row = body.rows[place];
    if (!row) {
      row = body.insertRow();
      row.append(made("th"), made("td"));
      row.cells[0].scope = "row";
    }
    say(row.cells[0], name);
    say(row.cells[1], text);
    if (row.cells[1].className !== kind) row.cells[1].className = kind;
  });
}

/** The pose of a frame, or else the filter's: its prediction while it coasts, or by other sensors. */
export function poseShown(state) {
  const useful = state?.phase === "coasting" || state?.fused?.status === "tracking";
  if (state === null || state.pose !== null || !useful || !state.motion?.pose) {
    return { pose: state?.pose ?? null, covariance: state?.covariance ?? null, predicted: false };
  }
  const predicted = state.fused?.status !== "tracking";
  return { pose: state.motion.pose, covariance: state.motion.covariance, predicted };
}

export function showNumbers(state) {
  const entries = [], table = find("numbers");
  const { pose, covariance, predicted } = poseShown(state);
  const by = state !== null && state.pose === null && pose !== null ? "Fused pose" : "Pose";
  say(table.caption, predicted ? "Predicted pose, no measurement (± 3σ)" : `${by}, camera from target (± 3σ)`);
  table.className = predicted ? "predicted" : "";
  for (const [axis, name] of ["x", "y", "z"].entries()) {
    const sigma = covariance ? ` ± ${(3 * Math.sqrt(covariance[axis + 3][axis + 3])).toFixed(3)}` : "";
    entries.push([name, pose ? `${fixed(pose.translation_m[axis], 3)}${sigma} m` : "–"]);
  }
  entries.push(["q wxyz", pose ? pose.quat_wxyz.map((value) => fixed(value, 3)).join(" ") : "–"]);
  const turn = covariance
    ? [0, 1, 2].map((k) => (3 * DEGREES * Math.sqrt(covariance[k][k])).toFixed(2)).join(" ") + " °"
    : "–";
  entries.push(["attitude ±", turn]);
  const motion = state?.motion ?? null, rates = motion?.rates ?? null;
  const sigma = (each) => 3 * Math.hypot(...each);
  entries.push(["turning", rates ? `${(DEGREES * Math.hypot(...rates.angular_rad_s)).toFixed(3)} ± ${(DEGREES * sigma(motion.angular_sigma_rad_s)).toFixed(3)} °/s` : "–"]);
  entries.push(["moving", rates ? `${Math.hypot(...rates.linear_m_s).toFixed(4)} ± ${sigma(motion.linear_sigma_m_s).toFixed(4)} m/s` : "–"]);
  entries.push(["residual", state?.fit ? `${state.fit.residual_px.toFixed(2)} px` : "–"]);
  entries.push(["latency", state ? `${state.latency_ms.toFixed(1)} ms` : "–"]);
  entries.push(["frame", state ? `${state.frame} · t = ${state.time_s.toFixed(2)} s` : "–"]);
  rows(table.tBodies[0], entries);
}

/** The fused state; hidden while the camera is the only sensor. */
export function showFused(fused) {
  const table = find("fused");
  if (table.hidden !== (fused === null)) table.hidden = fused === null;
  if (fused === null) return;
  const { pose, covariance, rates } = fused;
  const sigma = (k) => 3 * Math.sqrt(covariance[k][k]);
  const kind = { tracking: "good", lost: "bad wrap", late: "bad wrap" }[fused.status] ?? "warn wrap";
  const entries = [["status", `${fused.status}${fused.reason ? `: ${fused.reason}` : ""}`, kind]];
  if (pose !== null) {
    entries.push(["x y z", `${pose.translation_m.map((value) => fixed(value, 3)).join(" ")} m`]);
    entries.push(["position ±", `${[3, 4, 5].map((k) => sigma(k).toFixed(3)).join(" ")} m`]);
    entries.push(["q wxyz", pose.quat_wxyz.map((value) => fixed(value, 3)).join(" ")]);
    entries.push(["attitude ±", `${[0, 1, 2].map((k) => (DEGREES * sigma(k)).toFixed(2)).join(" ")} °`]);
    const turning = rates && (DEGREES * Math.hypot(...rates.angular_rad_s)).toFixed(2);
    entries.push(["rates", rates ? `${turning} °/s · ${Math.hypot(...rates.linear_m_s).toFixed(3)} m/s` : "–"]);
  }
  if (fused.protection) {
    const { position_m: place, attitude_rad: turn, alarm, risk } = fused.protection;
    const text = `${place === null ? "–" : place.toFixed(3)} m · ${(DEGREES * turn).toFixed(2)} ° at a risk of ${risk}`;
    entries.push(["protection", alarm ? `${text}: sensors contradict it` : text, alarm ? "warn wrap" : ""]);
  }
  if (fused.note) entries.push(["last restart", fused.note, "warn wrap"]);
  rows(table.tBodies[0], entries);
}

export function showSensors(sensors) {
  const entries = [];
  for (const sensor of sensors) {
    const rate = sensor.rate_hz === null ? "– Hz" : `${sensor.rate_hz.toFixed(1)} Hz`;
    entries.push([sensor.name, sensor.healthy ? `● healthy · ${rate}` : `▲ ${sensor.reason}`, sensor.healthy ? "good" : "bad wrap"]);
    if (sensor.kind === "camera") entries.push(["frames · drops", `${sensor.frames} · ${sensor.drops}`, sensor.drops > 0 ? "drops" : ""]);
    const trust = sensor.trust ?? null;
    if (trust === null) continue;
    const nis = trust.mean_nis === null ? "–" : trust.mean_nis.toFixed(2);
    const locked = trust.locked_out ? " · locked out" : "";
    entries.push(["received · accepted · NIS", `${trust.heard} · ${trust.accepted} · ${nis}${locked}`, trust.locked_out ? "bad" : ""]);
  }
  rows(find("sensors").tBodies[0], entries);
}

export function showRecording(recording) {
  const chip = find("recording");
  const words = {
    off: "not recorded",
    on: `● recording ${(recording.size_bytes / 1e6).toFixed(0)} MB`,
    failed: `▲ recording failed, ${recording.lost} lost, ${recording.pending ?? 0} waiting`,
  };
  say(chip, words[recording.state]);
  chip.className = `chip ${{ off: "", on: "good", failed: "bad" }[recording.state]}`;
}

/** Model, camera and counts of a session or recording. */
export function showTotals(info) {
  const known = info.found_fraction === null ? "" : ` · ${(100 * info.found_fraction).toFixed(1)} % found`;
  say(find("totals"), `${info.model} · sha256 ${info.model_sha256.slice(0, 12)} · ${info.camera.width} × ${info.camera.height} px · ${info.frames} frames${known}`);
  find("totals").title = `model sha256 ${info.model_sha256}`;
}

export function showLink(text, kind) {
  const chip = find("link");
  say(chip, text);
  chip.className = `chip ${kind}`;
}
