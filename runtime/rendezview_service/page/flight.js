// The flight that is attached to a session: what it does, and the operator's orders.

import { request, sessionPath } from "./api.js";
import { made, say } from "./status.js";

const find = (id) => document.getElementById(id);
const WORDS = { hand: "hand before the camera" };
let session = null, waits = ""; // the words of an order until the flight reports again

async function send(order, words) {
  waits = `${words} …`;
  say(find("flight-mode"), waits);
  const body = new Blob([JSON.stringify(order)], { type: "application/json" });
  await request(`${sessionPath(session)}/orders`, { method: "POST", body }).catch((error) => (waits = error.message));
}

/** Mode, reason and buttons of a session's flight; null: none is attached. */
export function showFlight(name, flight) {
  const bar = find("flight");
  bar.hidden = flight === null;
  if (flight === null) return;
  session = name;
  bar.dataset.mode = flight.mode;
  const range = flight.range_m === null ? "" : ` · ${flight.range_m.toFixed(2)} m`;
  say(find("flight-mode"), waits || `${flight.mode}${range}${flight.reason && flight.mode !== "approach" ? ` · ${flight.reason}` : ""}`);
  waits = "";
  for (const button of bar.querySelectorAll("[data-do]")) button.onclick = () => send({ do: button.dataset.do }, button.textContent);
  const box = find("flight-switches"), names = Object.keys(flight.switches);
  if (box.dataset.names !== names.join()) box.replaceChildren(...names.map((what) => made("button", WORDS[what] ?? what)));
  box.dataset.names = names.join();
  names.forEach((what, k) => {
    const button = box.children[k], on = flight.switches[what];
    button.setAttribute("aria-pressed", String(on));
    button.onclick = () => send({ do: "switch", what, on: !on }, `${button.textContent} ${on ? "off" : "on"}`);
  });
}
