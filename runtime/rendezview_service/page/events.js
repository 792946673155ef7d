// The log of events, and all sessions at a glance.

import { json, sessionPath } from "./api.js";
import { utc } from "./approach.js";
import { made, say } from "./status.js";

const find = (id) => document.getElementById(id);
const MOST = 200; // shown
const MARKS = { tracking: ["●", "good"], coasting: ["◐", "warn"], searching: ["▲", "bad"], waiting: ["○", ""] };

export class Events {
  constructor(list) {
    this.list = list;
    this.clear(null);
  }

  clear(session) {
    this.session = session;
    this.next = 0;
    this.list.replaceChildren();
  }

  /** Adds what is new, the newest first. */
  async load() {
    const of = this.session;
    if (of === null) return;
    const { events } = await json(`${sessionPath(of)}/events?since=${this.next}`);
    if (of !== this.session) return;
    for (const event of events) this.add(event);
  }

  add({ number, unix_s: at, level, kind, text }) {
    if (number < this.next) return;
    this.next = number + 1;
    this.note(level, `${kind}: ${text}`, at);
  }

  /** What the page itself has noticed. */
  note(level, text, at = Date.now() / 1000) {
    const item = made("li", "", level);
    item.append(made("time", utc(at)), ` ${text}`);
    this.list.prepend(item);
    while (this.list.children.length > MOST) this.list.lastChild.remove();
  }
}

/** All sessions in the list and at a glance; the chosen one (null: none) stays when it has ended. */
export function showSessions(sessions, chosen, choose) {
  showStrip(find("strip"), sessions, chosen, choose);
  const select = find("sessions");
  const names = sessions.map((one) => one.id);
  if (chosen !== null && !names.includes(chosen)) names.push(chosen);
  if ([...select.options].map((option) => option.value).join("\n") !== names.join("\n")) {
    select.replaceChildren(...names.map((name) => new Option(name, name)));
  }
  select.value = chosen ?? ""; // nothing is selected
}

/** One button for each session: its phase, rate, alarms and recording. */
function showStrip(strip, sessions, chosen, choose) {
  strip.hidden = sessions.every((one) => one.id === chosen);
  while (strip.children.length > sessions.length) strip.lastChild.remove();
  sessions.forEach((one, place) => {
    const button = strip.children[place] ?? strip.appendChild(made("button"));
    button.onclick = () => choose(one.id);
    const camera = one.sensors[0];
    const stale = one.age_s === null || one.age_s > 3;
    const [mark, kind] = one.finished ? ["■", ""] : stale ? ["○", "bad"] : MARKS[one.phase];
    const words = [`${mark} ${one.id}`, one.finished ? "ended" : stale ? "no frames" : one.phase];
    if (!stale && camera.rate_hz !== null) words.push(`${camera.rate_hz.toFixed(0)} Hz`);
    if (one.alarms.length) words.push(`${one.alarms.length} alarm${one.alarms.length > 1 ? "s" : ""}`);
    if (one.recording.state === "failed") words.push("not recorded");
    say(button, words.join(" · "));
    const bad = one.alarms.length || one.recording.state === "failed" ? "bad" : kind;
    button.className = bad;
    button.setAttribute("aria-pressed", String(one.id === chosen));
  });
}
