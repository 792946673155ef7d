// The page: receives states, decides when to draw them, and handles the operator's input.

import { askToken, onToken, wasDeclined } from "./access.js";
import { askedSession, downloadLog, json, sessionPath, token, watch } from "./api.js";
import { showAlerts, showApproach, times, utc } from "./approach.js";
import { wire } from "./controls.js";
import { Events, showSessions } from "./events.js";
import { showFlight } from "./flight.js";
import { LiveView } from "./live.js";
import { showRecordings } from "./library.js";
import { Past, placeAway } from "./past.js";
import { Absent, Reach, endOf, linkOf } from "./reach.js";
import { showReadings } from "./readings.js";
import { say, showAge, showLink, showNumbers, showRecording, showSensors, showTotals, showVerdict, verdict } from "./status.js";
import { Views } from "./views.js";

const find = (id) => document.getElementById(id);
const SLOW_MS = 100; // between drawings of words and numbers
const POLL_MS = 2000;
const DEAD_MS = 6000; // a connection that brings none of the frames that the service has

const live = new LiveView(find("frame"));
const events = new Events(find("events").querySelector("ol"));
const reach = new Reach((awayS) => events.note("warning", `connection: none for ${awayS.toFixed(0)} s`));
let session = null; // name
let info = null; // as the service lists it
let sessions = [], past = null;
let leave = null, openedAt = null; // closes the watch; when that was opened (ms), null: not yet
let last = null; // the newest message, its jpeg, and its arrival (ms)
let shown = null; // what is drawn: state, contour, silhouette, bitmap, note
let paused = null; // states at the pause, and the index of the shown one
let ended = null; // reason
let recorded = null, approach = null; // name of the recording that is looked at; of the session
let absent = null; // the session that was asked for, while it is not there
let decoding = false, fetching = false, drawing = false;
let banner = ""; // phase and status that the banner shows
let fresh = false, slowAt = 0, displayed = null; // the state whose words and numbers are shown
// For tests: what was drawn, and how often.
const drawn = (window.rendezview = { received: 0, updates: 0, spaces: 0, frame: null, plotted: null, webgl: null });
const views = new Views(drawn, schedule, again);

// Messages

function received(message, jpeg) {
  drawn.received += 1;
  reach.reached();
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
    marks: bitmap && message.marks, seen: bitmap && message.state,
    bitmap: bitmap ?? shown?.bitmap ?? null,
    note: bitmap ? `frame ${message.state.frame}` : "no picture of this frame",
  });
  if (last !== null && last.message !== message) decode();
}

function present(next) {
  if (shown?.bitmap && shown.bitmap !== next?.bitmap) shown.bitmap.close();
  shown = next;
  fresh = next !== null;
  schedule();
}

/** A past state over the picture that is kept of it or of a frame before; without one, why. */
function presentPast(state, got, why) {
  const seen = (paused?.states ?? past.states).find((kept) => kept.frame === got?.frame) ?? null;
  const note = got === null ? why : [`frame ${state.frame}`, got.frame === state.frame ? [] : `picture: ${got.frame}`, got.lost].flat().join(" · ");
  present({ state, seen, contour: got?.contour ?? null, silhouette: null, marks: got?.marks ?? null, bitmap: got?.bitmap ?? null, note });
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
    if (first || news || now - slowAt >= SLOW_MS || paused !== null) slow(now);
    if (first) {
      performance.mark("useful");
      setTimeout(more, 0);
    }
    views.plot(now, shown, paused?.states ?? past.states, paused !== null);
  }
  if (past !== null) views.drawSpace(now, shown, paused === null ? past.states : paused.states.slice(0, paused.place + 1), paused !== null);
}

/** The verdict on the shown state while paused; else, or with `now`, on the present. */
function words(now = paused === null) {
  if (!now || recorded !== null) return verdict(shown?.state ?? null, 0);
  if (reach.words !== null) return reach.words;
  if (ended !== null) return ["ended", "ENDED", ended];
  if (leave === null && session !== null) return ["offline", "NO CONNECTION", "trying again"];
  if (info?.finished) return ["ended", "ENDED", endOf(info)];
  return verdict(last?.message.state ?? null, ageS() ?? 0, info);
}

const sayLink = () => showLink(...linkOf(reach, { recorded, end: ended ?? absent?.end ?? null, session, leave, openedAt }));

/** Age of the newest state, s; null: there is none, or a past one is looked at. */
const ageS = () => (last === null || paused !== null ? null : (performance.now() - last.at) / 1000);

/** What changes without a message too. */
function tick() {
  showAge(ageS(), info?.sensors?.[0]?.rate_hz);
  if (shown !== null && shown !== displayed) slow(performance.now());
  if (shown !== null) sayWhen(), views.catchUp(shown, paused === null ? past.states : []);
  sayLink();
  if (paused === null && (session !== null || recorded !== null || reach.words !== null)) showVerdict(words());
}

/** Words and numbers of the shown state. */
function slow(now) {
  [slowAt, displayed, banner] = [now, shown, shown.state.phase + shown.state.status];
  showVerdict(words());
  say(find("frame-note"), shown.note);
  showApproach(shown.state);
  showNumbers(shown.state);
  showReadings(shown.state);
  sayWhen();
  if (paused === null && last !== null) {
    showSensors(last.message.sensors);
    showRecording(last.message.recording);
  }
  showAlerts(shown.state, paused === null ? (info?.recording.state === "failed" ? info.recording : last?.message.recording) : null, info?.warnings);
  showAge(ageS(), info?.sensors?.[0]?.rate_hz);
  for (const label of document.querySelectorAll(".others")) label.hidden = !(shown.state.fused || shown.state.ring || shown.marks?.length);
  views.moved = true;
}

/** The time of the shown state; while paused, also the present verdict. */
function sayWhen() {
  const when = find("when"), at = times(shown.state, approach?.start_unix_s ?? info?.created_unix_s ?? shown.state.received_unix_s);
  const [key, word] = words(true);
  say(when, recorded !== null ? `recording · ${at}` : paused === null ? at : `paused · now ${word}`);
  when.className = paused !== null && recorded === null && key !== "found" ? "bad" : "";
}

/** After the first picture: plots, the view in space, the past minutes. */
async function more() {
  await views.load();
  const of = past;
  if (recorded === null) await of.load().catch(() => {});
  const [geometry, asked] = await Promise.all(["geometry", "approach"].map((what) => json(`${of.path}/${what}`).catch(() => null)));
  if (of !== past) return;
  approach = asked;
  if (geometry === null) return;
  live.geometry = geometry;
  views.show(geometry, info.camera, asked);
  again();
}

/** Draws all of it anew. */
function again() {
  slowAt = 0;
  views.renew();
  fresh = shown !== null;
  schedule();
}

// Sessions

async function poll() {
  const found = await reach.sessions();
  sayLink();
  if (found === null) {
    if (paused === null && reach.words !== null) showVerdict(reach.words);
    if (reach.wantsToken && !wasDeclined()) askToken(token() ? "The given token is not right." : "The service requires a token.");
    return;
  }
  sessions = found;
  showSessions(sessions, session, choose);
  if (recorded !== null) return;
  const present = sessions.find((one) => one.id === session);
  if (session !== null && present === undefined && leave === null && ended === null) ended = "this session is not there any more: it ended, or the service was restarted";
  info = present ?? info;
  // A connection may die without a word, as while a machine sleeps.
  const silentMs = performance.now() - Math.max(openedAt, last?.at ?? 0);
  if (leave !== null && openedAt !== null && present?.age_s < 1 && silentMs > DEAD_MS) connect();
  if (session !== null && present !== undefined) events.load().catch(() => {});
  if (session === null || leave === null) {
    const wanted = session ?? askedSession();
    const next = wanted === "" ? sessions.at(-1) : sessions.find((one) => one.id === wanted);
    if (next) choose(next.id);
    else if (session === null) {
      if (absent?.name !== wanted) absent = new Absent(wanted);
      showVerdict(absent.words(sessions.length));
    }
  }
  if (session !== null) overview();
}

function overview() {
  if (info === null) return;
  showTotals(info);
  showFlight(session, ended === null ? (info.flight ?? null) : null);
  find("download").disabled = info.recording.state === "off";
  if (performance.now() - (last?.at ?? -Infinity) > POLL_MS) {
    showSensors(info.sensors);
    showRecording(info.recording);
    showAlerts(shown?.state ?? null, info.recording, info.warnings);
  }
}

function choose(name) {
  begin(sessions.find((one) => one.id === name) ?? null, sessionPath(name));
  session = name;
  events.clear(name);
  events.load().catch(() => {});
  history.replaceState(null, "", `#${encodeURIComponent(name)}`);
  showSessions(sessions, session, choose);
  connect();
  overview();
  showVerdict(words());
  restore().catch(() => {});
}

/** Nothing is chosen; then the session that the address names. */
function anew() {
  begin(null, "");
  session = null;
  events.clear(null);
  poll();
}

/** Nothing is shown yet of what comes now. */
function begin(of, path) {
  leave?.();
  leave = openedAt = null;
  recorded = null;
  goLive();
  info = of;
  past = new Past(path);
  last = ended = approach = absent = null;
  present(null);
  views.clear();
  live.camera = info?.camera ?? null;
  live.geometry = null;
  live.unzoom();
  live.draw({ bitmap: null, contour: null, silhouette: null, marks: null, state: null });
  [showApproach, showNumbers, showReadings].forEach((show) => show(null));
  showAlerts(null, null);
}

/** The last state and its picture, where no frame comes now. */
async function restore() {
  const of = past, ageAtFirst = info?.age_s ?? null, at = performance.now();
  await of.load();
  if (of === past && last === null && of.newest !== null && ageAtFirst !== null) {
    const state = of.newest;
    last = { message: { state, contour: null, silhouette_px: null, marks: null, sensors: info.sensors, recording: info.recording }, jpeg: null, at: at - 1000 * ageAtFirst };
    const got = await of.picture(state.frame).catch(() => null);
    if (of !== past || last.message.state !== state || paused !== null) return;
    presentPast(state, got, "no picture is kept");
  }
  if (drawn.updates > 0) more();
}

/** A log of the service, from its start. */
async function look(recording) {
  begin({ ...recording, created_unix_s: recording.opened_unix_s ?? recording.began_unix_s, sensors: [], recording: { state: "off" }, frames: recording.frames ?? 0, found_fraction: null }, `/v1/recordings/${encodeURIComponent(recording.name)}`);
  recorded = recording.name;
  session = null;
  events.clear(null);
  showSessions(sessions, session, choose);
  sayLink();
  showVerdict(["waiting", "READING", recording.name]);
  try {
    for (const event of await past.load()) events.add(event);
  } catch (error) {
    showVerdict(["offline", "NO RECORDING", error.message]);
    return;
  }
  if (past.states.length === 0) return showVerdict(["waiting", "EMPTY", "this recording has no frames"]);
  overview();
  shown = { state: past.states[0], contour: null, silhouette: null, marks: null, bitmap: null, note: "" };
  pause();
  more();
}

function connect() {
  leave?.();
  openedAt = null;
  leave = watch(session, {
    silhouette: live.layers.silhouette,
    received,
    opened: () => ((openedAt = performance.now()), sayLink()),
    closed: (reason, isEnd) => {
      leave = openedAt = null;
      if (isEnd) ended = reason || "the session is closed";
      sayLink();
      if (paused === null) showVerdict(words());
      if (!isEnd) poll();
    },
  });
}

// Looking back

/** The drawn state may be a frame older than the newest. */
function pause() {
  if (paused !== null || shown === null || past.states.length === 0) return;
  const place = Math.max(0, past.states.findLastIndex((state) => state.frame <= shown.state.frame));
  paused = { states: past.states.slice(), place };
  find("pause").textContent = recorded === null ? "Live" : "Close";
  find("pause").setAttribute("aria-pressed", "true");
  const scrub = find("scrub");
  scrub.disabled = false;
  scrub.max = paused.states.length - 1;
  seek(place);
}

function goLive() {
  if (recorded !== null) return anew();
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
  const text = `${utc(state.received_unix_s, 2)} UTC (−${ago.toFixed(1)} s)`;
  say(find("at"), text);
  find("scrub").setAttribute("aria-valuetext", text);
  present({ ...shown, state, marks: null, seen: null, note: shown.state.frame === state.frame ? shown.note : `frame ${state.frame} · picture: …` });
  fetchPicture();
}

/** One request at a time; then the frame that is selected by then. */
async function fetchPicture() {
  if (fetching) return;
  fetching = true;
  const of = past;
  for (let done = null; paused !== null && of === past && done !== paused.states[paused.place].frame; ) {
    done = paused.states[paused.place].frame;
    let why = "";
    const got = await of.picture(done).catch((error) => ((why = `no picture: ${error.message}`), null));
    if (paused === null || of !== past) break;
    presentPast(paused.states[paused.place], got, why);
  }
  fetching = false;
}

// Input of the operator

function download() {
  if (find("download").disabled || session === null) return;
  downloadLog(sessionPath(session), info.recording.name).catch((error) => say(find("totals"), `The log: ${error.message}`));
}

wire({
  pauseOrLive: () => (paused === null ? pause() : goLive()),
  step: (by, far) => {
    if (by < 0) pause();
    if (paused !== null) seek(far ? placeAway(paused, 10 * by) : paused.place + by);
  },
  oldest: () => (pause(), paused && seek(0)),
  seek: (place) => paused && seek(place),
  layer: (layer) => (layer === "silhouette" && session !== null && leave !== null ? connect() : again()),
  recordings: () => showRecordings(look, (one) => downloadLog(`/v1/recordings/${encodeURIComponent(one.name)}`, one.name)),
  goLive, download, choose, again,
}, live, views);
live.changed = again;
onToken(poll);
addEventListener("hashchange", anew);

poll();
setInterval(() => document.querySelector("dialog[open]") || poll(), POLL_MS);
setInterval(tick, 250); // no message arrives when frames stop
