// The page: receives states, decides when to draw them, and handles the operator's input.

import { askToken, onToken, wasDeclined } from "./access.js";
import { downloadLog, json, token, watch } from "./api.js";
import { listen } from "./keys.js";
import { LiveView } from "./live.js";
import { Past } from "./past.js";
import { say, showFused, showLink, showNumbers, showRecording, showSensors, showVerdict, verdict } from "./status.js";

const find = (id) => document.getElementById(id);
const SLOW_MS = 100; // between drawings of words, numbers and the view in space
const PLOT_MS = 250;
const SHARE = 12; // the view in space and the plots take 1/12 of the time each, or wait a second: the picture has priority
const MOST_MS = 1000;
const POLL_MS = 2000;

const live = new LiveView(find("frame"));
let space = null, plots = null; // loaded after the first picture
let session = null; // name
let info = null; // as the service lists it
let sessions = [];
let past = null;
let leave = null; // closes the watch
let last = null; // the newest message, its jpeg, and its arrival (ms)
let shown = null; // what is drawn: state, contour, silhouette, bitmap, note
let paused = null; // states at the pause, and the index of the shown one
let ended = null; // reason
let decoding = false, fetching = false, drawing = false;
let banner = ""; // phase and status that the banner shows
let fresh = false, slowAt = 0, plotAt = 0, plotCost = 0, moved = false;

/** For tests and experiment service-page: what was drawn, and how often. */
const drawn = (window.rendezview = { received: 0, updates: 0, spaces: 0, frame: null, webgl: null });

// Messages

function received(message, jpeg) {
  drawn.received += 1;
  past.add(message.state);
  last = { message, jpeg, at: performance.now() };
  ended = null;
  if (paused === null) decode();
}

/** Decode one picture at a time; the newest of those that arrive meanwhile is next. */
async function decode() {
  if (decoding || last === null) return;
  decoding = true;
  const { message, jpeg } = last;
  const of = past;
  const bitmap = jpeg === null ? null : await createImageBitmap(jpeg).catch(() => null);
  decoding = false;
  if (paused !== null || of !== past) return bitmap?.close();
  present({
    state: message.state,
    contour: bitmap && message.contour,
    silhouette: bitmap && message.silhouette_px,
    marks: bitmap && message.marks,
    bitmap: bitmap ?? shown?.bitmap ?? null,
    note: bitmap ? `frame ${message.state.frame}` : "no picture of this frame",
  });
  if (last !== null && last.message !== message) decode();
}

function present(next) {
  if (shown?.bitmap && shown.bitmap !== next.bitmap) shown.bitmap.close();
  shown = next;
  fresh = true;
  schedule();
}

// Drawing: at most once per frame of the display

function schedule() {
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(draw);
}

function draw(now) {
  drawing = false;
  if (shown !== null && fresh) {
    fresh = false;
    live.draw(shown);
    drawn.updates += 1;
    drawn.frame = shown.state.frame;
    const first = drawn.updates === 1, news = banner !== shown.state.phase + shown.state.status;
    if (first || news || now - slowAt >= SLOW_MS || paused !== null) {
      slowAt = now;
      banner = shown.state.phase + shown.state.status;
      slow();
    }
    if (first) {
      performance.mark("useful");
      setTimeout(more, 0);
    }
    if (now - plotAt >= Math.max(PLOT_MS, Math.min(MOST_MS, SHARE * plotCost)) || paused !== null) {
      plotAt = now;
      plot();
      plotCost = performance.now() - now;
    }
  }
  drawSpace(now);
}

function drawSpace(now) {
  if (space === null) return;
  // Turning the view by hand has a shorter wait than new states.
  const wait = space.turned ? 1.5 * space.cost : Math.max(SLOW_MS, Math.min(MOST_MS, SHARE * space.cost));
  if (now - space.drawnAt < wait && paused === null) {
    if (space.turned) schedule();
    return;
  }
  if (moved && shown !== null && past !== null) {
    moved = false;
    const states = paused === null ? past.states : paused.states.slice(0, paused.place + 1);
    const from = shown.state.received_unix_s - span();
    space.update(shown.state, states.filter((state) => state.received_unix_s >= from));
    const green = shown.state.fused?.pose ? " · green: fused" : "";
    say(find("space-scale"), (shown.state.covariance ? `target frame · camera position, 3σ × ${space.magnified}` : "target frame") + green);
  }
  if (space.draw(now)) drawn.spaces += 1;
}

/** The verdict on the shown state while paused; else, or with `now`, on the present. */
function words(now = paused === null) {
  if (!now) return verdict(shown?.state ?? null, 0);
  if (ended !== null) return ["ended", "ENDED", ended];
  if (leave === null && session !== null) return ["offline", "NO CONNECTION", "trying again"];
  if (info?.finished) return ["ended", "ENDED", info.reason ?? "the source has ended"];
  return verdict(last?.message.state ?? null, last === null ? 0 : (performance.now() - last.at) / 1000);
}

function slow() {
  showVerdict(words());
  say(find("frame-note"), shown.note);
  showNumbers(shown.state);
  showFused(shown.state.fused ?? null);
  sayWhen();
  if (paused === null && last !== null) {
    showSensors(last.message.sensors);
    showRecording(last.message.recording);
  }
  for (const label of document.querySelectorAll(".others")) label.hidden = !shown.state.fused && !shown.marks?.length;
  moved = true;
}

/** The time of the shown state; while paused, also the present verdict. */
function sayWhen() {
  const when = find("when"), at = new Date(1000 * shown.state.received_unix_s).toLocaleTimeString();
  const [key, word] = words(true);
  say(when, paused === null ? at : `paused · now ${word}`);
  when.className = paused !== null && key !== "found" ? "bad" : "";
}

function plot() {
  if (plots === null || past === null || shown === null) return;
  const states = paused?.states ?? past.states;
  if (states.length === 0) return;
  const at = shown.state.received_unix_s, newest = states.at(-1).received_unix_s;
  plots.mark = paused === null ? null : at;
  // While paused, the shown state is in the middle if later states exist.
  const end = paused === null ? newest : Math.min(newest, Math.max(at + span() / 2, states[0].received_unix_s + span()));
  plots.show(states, end, span());
}

const span = () => Number(find("span").value);

/** Loaded after the first picture: plots, the view in space, the past minutes. */
async function more() {
  if (plots === null && space === null) {
    const [curves, view] = await Promise.allSettled([import("./plots.js"), import("./space.js")]);
    if (curves.status === "fulfilled") plots ??= new curves.value.Plots(find("plots"));
    try {
      space ??= new view.value.SpaceView(find("scene"), schedule);
      drawn.webgl = true;
      find("space-note").hidden = true;
    } catch {
      drawn.webgl = false;
      say(find("space-note"), "This browser has no WebGL: the view in space is left out.");
    }
  }
  const of = past;
  await of.load().catch(() => {});
  const geometry = await json(`/v1/models/${encodeURIComponent(info.model)}/geometry`).catch(() => null);
  if (of !== past || geometry === null) return;
  live.geometry = geometry;
  space?.show(geometry, info.camera);
  fresh = true;
  slowAt = plotAt = 0;
  schedule();
}

// Sessions

async function poll() {
  try {
    sessions = (await json("/v1/sessions")).sessions;
  } catch (error) {
    if (error.status === 401) {
      showVerdict(["offline", "NO ACCESS", "the service requires a token: press Token"]);
      if (!wasDeclined()) askToken(token() ? "The given token is not right." : "The service requires a token.");
    } else {
      showLink("no connection", "bad");
      if (paused === null) showVerdict(["offline", "NO CONNECTION", error.message]);
    }
    return;
  }
  list();
  info = sessions.find((one) => one.id === session) ?? info;
  if (session === null || leave === null) {
    const wanted = session ?? decodeURIComponent(location.hash.slice(1));
    const next = sessions.find((one) => one.id === wanted) ?? (session === null ? sessions.at(-1) : null);
    if (next) choose(next.id);
    else if (session === null) showVerdict(["waiting", "NO SESSION", "open one: rendezview serve --source …, or rendezview.client"]);
  }
  if (session !== null) overview();
}

function overview() {
  if (info === null) return;
  const known = info.found_fraction === null ? "" : ` · ${(100 * info.found_fraction).toFixed(1)} % found`;
  say(find("totals"), `${info.model} · ${info.camera.width} × ${info.camera.height} px · ${info.frames} frames${known}`);
  find("download").disabled = info.recording.state === "off";
  if (performance.now() - (last?.at ?? -Infinity) > POLL_MS) {
    showSensors(info.sensors);
    showRecording(info.recording);
  }
}

function list() {
  const select = find("sessions");
  const names = sessions.map((one) => one.id);
  if (session !== null && !names.includes(session)) names.push(session);
  if ([...select.options].map((option) => option.value).join("\n") !== names.join("\n")) {
    select.replaceChildren(...names.map((name) => new Option(name, name)));
  }
  if (session !== null) select.value = session;
}

function choose(name) {
  leave?.();
  goLive();
  session = name;
  info = sessions.find((one) => one.id === name) ?? null;
  past = new Past(name);
  last = null;
  ended = null;
  history.replaceState(null, "", `#${encodeURIComponent(name)}`);
  list();
  live.camera = info?.camera ?? null;
  live.geometry = null;
  connect();
  overview();
  if (drawn.updates > 0) more();
  else showVerdict(words());
}

function connect() {
  leave?.();
  leave = watch(session, {
    silhouette: live.layers.silhouette,
    received,
    opened: () => showLink("● connected", "good"),
    closed: (reason, isEnd) => {
      leave = null;
      if (isEnd) ended = reason || "the session is closed";
      showLink(isEnd ? "session ended" : "no connection", "bad");
      if (paused === null) showVerdict(isEnd ? words() : ["offline", "NO CONNECTION", reason || "trying again"]);
    },
  });
}

// Looking back

function pause() {
  if (paused !== null || shown === null || past.states.length === 0) return;
  // The drawn state may be a frame older than the newest.
  const place = Math.max(0, past.states.findLastIndex((state) => state.frame <= shown.state.frame));
  paused = { states: past.states.slice(), place };
  find("pause").textContent = "Live";
  find("pause").setAttribute("aria-pressed", "true");
  const scrub = find("scrub");
  scrub.disabled = false;
  scrub.max = paused.states.length - 1;
  seek(place);
}

function goLive() {
  paused = null;
  find("pause").textContent = "Pause";
  find("pause").setAttribute("aria-pressed", "false");
  find("scrub").disabled = true;
  say(find("at"), "live");
  decode();
}

function seek(place) {
  paused.place = Math.min(paused.states.length - 1, Math.max(0, place));
  find("scrub").value = paused.place;
  const state = paused.states[paused.place];
  const ago = paused.states.at(-1).received_unix_s - state.received_unix_s;
  const text = `${new Date(1000 * state.received_unix_s).toLocaleTimeString()} (−${ago.toFixed(1)} s)`;
  say(find("at"), text);
  find("scrub").setAttribute("aria-valuetext", text);
  present({ ...shown, state, marks: null, note: shown.state.frame === state.frame ? shown.note : `frame ${state.frame} · picture: …` });
  fetchPicture();
}

/** One request at a time; then the frame that is selected by then. */
async function fetchPicture() {
  if (fetching) return;
  fetching = true;
  const of = past;
  for (let done = null; paused !== null && of === past && done !== paused.states[paused.place].frame; ) {
    done = paused.states[paused.place].frame;
    const got = await of.picture(done).catch((error) => ({ failure: error.message }));
    if (paused === null || of !== past) break;
    const state = paused.states[paused.place];
    if (got.failure) present({ state, contour: null, silhouette: null, marks: null, bitmap: null, note: `no picture: ${got.failure}` });
    else {
      const away = got.frame === state.frame ? "" : ` · picture: ${got.frame}`;
      present({ state, contour: got.contour, silhouette: null, marks: got.marks, bitmap: got.bitmap, note: `frame ${state.frame}${away}` });
    }
  }
  fetching = false;
}

/** Index of a state some seconds away. */
function placeAway(seconds) {
  const wanted = paused.states[paused.place].received_unix_s + seconds;
  const later = paused.states.findIndex((state) => state.received_unix_s >= wanted);
  return later < 0 ? paused.states.length - 1 : later;
}

// Input of the operator

function download() {
  if (find("download").disabled) return;
  downloadLog(session, info.recording.name).catch((error) => say(find("totals"), `The log: ${error.message}`));
}

function toggle(layer) {
  const box = find(`layer-${layer}`);
  live.layers[layer] = box.checked;
  if (layer === "silhouette" && session !== null && leave !== null) connect();
  fresh = shown !== null;
  schedule();
}

const press = (layer) => find(`layer-${layer}`).click();
const KEYS = {
  " ": () => (paused === null ? pause() : goLive()),
  ArrowLeft: (event) => (pause(), paused && seek(event.shiftKey ? placeAway(-10) : paused.place - 1)),
  ArrowRight: (event) => paused && seek(event.shiftKey ? placeAway(10) : paused.place + 1),
  Home: () => (pause(), paused && seek(0)),
  End: goLive,
  c: () => press("contour"),
  n: () => press("nodes"),
  o: () => press("silhouette"),
  e: () => press("ellipses"),
  p: () => press("spots"),
  d: download,
  s: () => find("sessions").focus(),
  "?": () => find("help-dialog").showModal(),
};

listen(KEYS);
onToken(poll);
find("pause").onclick = KEYS[" "];
find("scrub").oninput = (event) => paused && seek(Number(event.target.value));
find("span").onchange = () => {
  if (shown === null) return;
  fresh = true;
  slowAt = plotAt = 0;
  schedule();
};
find("sessions").onchange = (event) => choose(event.target.value);
find("download").onclick = download;
find("help").onclick = KEYS["?"];
find("help-close").onclick = () => find("help-dialog").close();
for (const layer of ["contour", "nodes", "silhouette", "ellipses", "spots"]) {
  live.layers[layer] = find(`layer-${layer}`).checked;
  find(`layer-${layer}`).onchange = () => toggle(layer);
}

poll();
setInterval(() => document.querySelector("dialog[open]") || poll(), POLL_MS);
setInterval(() => {
  // No message arrives when frames stop.
  if (session === null) return;
  if (paused === null) showVerdict(words());
  else sayWhen();
}, 500);
