// Whether the service answers, and what is known of a session that is not there.

import { json, sessionPath } from "./api.js";

const ANSWER_MS = 3000; // then the service does not answer

export class Reach {
  /** `back(seconds)` when it answers again. */
  constructor(back) {
    this.back = back;
    this.since = null; // ms, of the first request without an answer
    this.refusal = null; // the last error
    this.asking = false;
  }

  /** The service has answered. */
  reached() {
    if (this.since !== null) this.back((performance.now() - this.since) / 1000);
    this.since = this.refusal = null;
  }

  /** All sessions; null: there is no answer yet, or none at all. */
  async sessions() {
    if (this.asking) return null;
    this.asking = true;
    const asked = performance.now();
    try {
      const { sessions } = await json("/v1/sessions", { signal: AbortSignal.timeout(ANSWER_MS) });
      this.reached();
      return sessions;
    } catch (error) {
      this.refusal = error;
      if (!this.wantsToken) this.since ??= asked;
      return null;
    } finally {
      this.asking = false;
    }
  }

  get wantsToken() {
    return this.refusal?.status === 401;
  }

  /** Of the banner; null while it answers. */
  get words() {
    if (this.wantsToken) return ["offline", "NO ACCESS", "the service requires a token: press Token"];
    if (this.since === null) return null;
    const { status, message } = this.refusal, away = (performance.now() - this.since) / 1000;
    const why = status ? `the service does not serve this page (${message})` : message;
    return ["offline", "NO CONNECTION", `${why} for ${away.toFixed(0)} s; trying again`];
  }
}

export class Absent {
  /** A session by the name in the address; empty: any. */
  constructor(name) {
    this.name = name;
    this.end = null; // why it ended, if it is known
    if (name !== "") json(sessionPath(name)).catch(({ message }) => (this.end = / has ended: /.test(message) ? message : null));
  }

  /** Of the banner; another session than the one that was asked for is never shown in its place. */
  words(others) {
    if (this.end !== null) return ["ended", "ENDED", `${this.end}; its log, if any, is among the recordings`];
    if (this.name === "") return ["waiting", "NO SESSION", "open one: rendezview serve --source …, or rendezview.Client"];
    return ["waiting", "NO SESSION", `“${this.name}” is not there (yet): waiting for it${others ? "; others are listed above" : ""}`];
  }
}

/** The chip's text and kind: whether what is shown comes from the service now. */
export function linkOf(reach, { recorded, end, session, leave, openedAt }) {
  if (reach.words !== null) return [reach.wantsToken ? "no access" : "no connection", "bad"];
  if (recorded !== null) return [`recording ${recorded}`, ""];
  if (end !== null) return ["session ended", "bad"];
  if (session === null) return ["no session", ""];
  if (leave === null) return ["no connection", "bad"];
  return openedAt === null ? ["connecting", ""] : ["● connected", "good"];
}

/** Why a session that is still listed ended, and what it was. */
export function endOf({ reason, source, frames, found_fraction: found }) {
  const share = found === null ? "" : `, ${(100 * found).toFixed(0)} % with a pose`;
  return `${reason ?? `the source has ended: ${source}`} · ${frames} frames${share}`;
}
