// Requests to the service, with the token, and the watch socket.

const KEY = "rendezview-token";

export const token = () => sessionStorage.getItem(KEY) ?? "";

export function setToken(value) {
  if (value) sessionStorage.setItem(KEY, value);
  else sessionStorage.removeItem(KEY);
}

/** Whether a token can be the name of a subprotocol (RFC 9110, 5.6.2), as the watch socket sends it. */
export const fitsSocket = (value) => /^[\w!#$%&'*+\-.^`|~]*$/.test(value);

/** An error of the service; `status` as in HTTP, 0 if it cannot be reached. */
export class ApiError extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

export async function request(path, options = {}) {
  const headers = token() ? { Authorization: `Bearer ${token()}` } : {};
  let response;
  try {
    response = await fetch(path, { ...options, headers });
  } catch (error) {
    throw new ApiError(0, `the service ${error.name === "TimeoutError" ? "does not answer" : "cannot be reached"}`);
  }
  if (!response.ok) {
    const fault = await response.json().catch(() => null);
    throw new ApiError(response.status, fault?.error ?? `the service answered ${response.status}`);
  }
  return response;
}

export const json = async (path, options) => (await request(path, options)).json();

export const sessionPath = (name) => `/v1/sessions/${encodeURIComponent(name)}`;

/** The session that the page's address names; empty: none. */
export function askedSession() {
  const name = location.hash.slice(1);
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/** Watches a session; `received(message, jpeg or null)` for each state, `closed(reason, ended)` once. */
export function watch(name, { silhouette, received, opened, closed }) {
  const query = new URLSearchParams({ rate_hz: "30", width: "640", silhouette: silhouette ? "1" : "0" });
  const address = new URL(`${sessionPath(name)}/watch?${query}`, location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  const protocols = token() ? ["rendezview", `token.${token()}`] : ["rendezview"];
  const socket = new WebSocket(address, protocols);
  socket.binaryType = "arraybuffer";
  let before = null; // a state whose picture follows
  let ended = null;
  socket.onopen = () => opened();
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") {
      if (before !== null) received(before, new Blob([new Uint8Array(data, 8)], { type: "image/jpeg" }));
      before = null;
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "end") ended = message.reason;
    else if (message.image_follows) before = message;
    else received(message, null);
  };
  socket.onclose = ({ code, reason }) => closed(ended ?? reason, ended !== null || code === 1001);
  return () => {
    socket.onclose = socket.onmessage = socket.onopen = null;
    socket.close();
  };
}

/** Saves the log at a path of a session or a recording. Without a token the browser itself streams it to the disk. */
export async function downloadLog(path, fileName) {
  const link = document.createElement("a");
  link.download = fileName ?? "log.mcap";
  link.href = `${path}/log`;
  if (token()) {
    const response = await request(link.href);
    link.href = URL.createObjectURL(await response.blob());
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  }
  link.click();
}
