// The last minutes: states as they arrived, and pictures and contours of past frames.

import { json, request } from "./api.js";

const KEEP_S = 300;

/** Index of a state some seconds away. */
export function placeAway({ states, place }, seconds) {
  const wanted = states[place].received_unix_s + seconds;
  const later = states.findIndex((state) => state.received_unix_s >= wanted);
  return later < 0 ? states.length - 1 : later;
}

export class Past {
  /** `path`: of a session, or of a recording. */
  constructor(path) {
    this.path = path;
    this.states = []; // oldest first
  }

  get newest() {
    return this.states.at(-1) ?? null;
  }

  /** Add a new state. */
  add(state) {
    if (this.newest !== null && state.frame <= this.newest.frame) return;
    this.states.push(state);
    // Rarely, many at once: removing single states from the front is slow.
    const oldest = state.received_unix_s - KEEP_S;
    if (this.states[0].received_unix_s < oldest - 10) {
      this.states = this.states.filter((kept) => kept.received_unix_s >= oldest);
    }
  }

  /** Load the states that the service has kept, however old; the events of a recording. */
  async load() {
    const kept = await json(`${this.path}/history?seconds=1e6&limit=2000`);
    const byFrame = new Map(this.states.map((state) => [state.frame, state]));
    for (const state of kept.states) byFrame.set(state.frame, state);
    this.states = [...byFrame.values()].sort((a, b) => a.frame - b.frame);
    return kept.events;
  }

  /** The picture of a frame, or of the last kept frame before it, with its contour and marks.
   *  lost: which of these could not be had, and why. */
  async picture(frame) {
    const response = await request(`${this.path}/images/${frame}`);
    const shown = Number(response.headers.get("X-Frame"));
    const lost = [];
    const of = (what) =>
      json(`${this.path}/${what}/${shown}`).catch(({ status, message }) => {
        if (status !== 404) lost.push(`no ${what}: ${message}`); // 404: this frame has none
        return null;
      });
    const [blob, contour, marks] = await Promise.all([response.blob(), of("contour"), of("marks")]);
    return { frame: shown, bitmap: await createImageBitmap(blob), contour, marks, lost };
  }
}
