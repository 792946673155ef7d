// The service's token, and the dialog to enter it.

import { fitsSocket, setToken } from "./api.js";
import { say } from "./status.js";

const find = (id) => document.getElementById(id);
let declined = false; // then only the button asks again
let given = () => {};

/** Sets the action after a token is given. */
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
    askToken("A browser cannot send this token to a WebSocket: use letters, digits and -._~, no spaces.");
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

find("token").onclick = () => askToken("Enter a token of the service. It is kept until this tab is closed.");
find("token-use").onclick = useToken;
find("token-cancel").onclick = () => find("token-dialog").close();
find("token-dialog").onclose = refuse;
find("token-value").onkeydown = (event) => {
  if (event.key === "Enter") useToken();
};
