// The token that a service asks for, and the dialog where it is given.

import { fitsSocket, setToken } from "./api.js";
import { say } from "./status.js";

const find = (id) => document.getElementById(id);
let declined = false; // not asked again unless by the button
let given = () => {};

/** What is to be done when there is one. */
export const onToken = (then) => (given = then);

export const wasDeclined = () => declined;

export function askToken(why) {
  const dialog = find("token-dialog");
  say(find("token-why"), why);
  if (!dialog.open) dialog.showModal();
}

function useToken() {
  const value = find("token-value").value.trim();
  if (!fitsSocket(value)) {
    askToken("A browser cannot send this token to a WebSocket: it may hold letters, digits and -._~ but no spaces.");
    return;
  }
  setToken(value);
  declined = false;
  find("token-value").value = "";
  find("token-dialog").onclose = () => {
    find("token-dialog").onclose = refuse;
    given();
  };
  find("token-dialog").close();
}

const refuse = () => (declined = true);

find("token").onclick = () => askToken("A token of the service; kept until this tab is closed.");
find("token-use").onclick = useToken;
find("token-cancel").onclick = () => find("token-dialog").close();
find("token-dialog").onclose = refuse;
find("token-value").onkeydown = (event) => {
  if (event.key === "Enter") useToken();
};
