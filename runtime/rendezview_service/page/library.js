// The dialogs of recordings and models: look back at a log, send a model, train one of a mesh.

import { json, request } from "./api.js";
import { spanText } from "./approach.js";
import { made, say } from "./status.js";

const find = (id) => document.getElementById(id);
const JOBS_MS = 2000;
const megabytes = (bytes) => `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB`;

function fill(table, lines) {
  table.tBodies[0].replaceChildren(...lines.map((cells) => {
    const row = made("tr");
    for (const cell of cells) row.insertCell().append(cell);
    return row;
  }));
}

function button(text, act) {
  const element = made("button", text);
  element.onclick = act;
  return element;
}

// Recordings

/** Lists the logs; `open(recording)` shows one, `save(recording)` downloads it. */
export async function showRecordings(open, save) {
  const dialog = find("recordings-dialog");
  say(find("recordings-note"), "");
  fill(find("recordings-list"), []);
  if (!dialog.open) dialog.showModal();
  try {
    const { recordings } = await json("/v1/recordings");
    if (recordings.length === 0) say(find("recordings-note"), "There are none: start the service with --record FOLDER.");
    fill(find("recordings-list"), recordings.map((one) => {
      const buttons = made("span");
      buttons.append(button("Look", () => {
        dialog.close();
        open(one);
      }), " ", button("Download", () => save(one)));
      const began = one.began_unix_s === null ? "–" : new Date(1000 * one.began_unix_s).toISOString().slice(0, 19).replace("T", " ");
      const length = one.length_s === null ? "–" : spanText(one.length_s);
      return [one.name, began, length, one.frames === null ? "–" : String(one.frames), megabytes(one.size_bytes), buttons];
    }));
  } catch (error) {
    say(find("recordings-note"), error.message);
  }
}

// Models

let timer = null;
let proposed = ""; // name that the last file gave

export async function showModels() {
  const dialog = find("models-dialog");
  say(find("models-note"), "");
  if (!dialog.open) dialog.showModal();
  await refresh();
  clearInterval(timer);
  timer = setInterval(() => (dialog.open ? refresh() : clearInterval(timer)), JOBS_MS);
}

async function refresh() {
  try {
    const [{ models }, { jobs }] = await Promise.all([json("/v1/models"), json("/v1/jobs")]);
    fill(find("models-list"), models.map((one) => {
      const hash = made("code", one.error ?? one.sha256.slice(0, 12));
      hash.title = one.error ?? one.sha256;
      if (one.error) return [one.name, "cannot be read", hash, "", ""];
      return [one.name, one.target, hash, String(one.nodes), megabytes(one.size_bytes)];
    }));
    find("jobs").replaceChildren(...jobs.map((job) => {
      const item = made("li");
      const part = job.state === "running" && job.stage ? `: ${job.stage} ${(100 * (job.progress ?? 0)).toFixed(0)} %` : "";
      item.append(`${job.model}: ${job.state}${part}${job.reason ? `: ${job.reason}` : ""} `);
      item.append(...job.warnings.map((text) => made("div", `Check: ${text}`, "warn")));
      if (["queued", "running"].includes(job.state)) item.append(button("Cancel", () => request(`/v1/jobs/${job.id}`, { method: "DELETE" }).then(refresh, report)));
      return item;
    }));
  } catch (error) {
    report(error);
  }
}

const report = (error) => say(find("models-note"), error.message);

async function send() {
  const [file] = find("model-file").files, name = find("model-name").value.trim();
  if (!file) return say(find("models-note"), "Choose a file: a model (*.rvm) or a mesh.");
  if (!/^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$/.test(name)) return say(find("models-note"), "A name has letters, digits, - and _.");
  find("model-send").disabled = true;
  say(find("models-note"), `sending ${file.name} …`);
  try {
    if (/\.rvm$/i.test(file.name)) {
      const sent = await json(`/v1/models/${encodeURIComponent(name)}?replace=true`, { method: "PUT", body: file });
      say(find("models-note"), `${sent.name} is here: ${sent.sha256.slice(0, 12)}`);
    } else {
      const query = new URLSearchParams({ model: name, file: file.name, order: find("model-order").value });
      const [camera] = find("model-camera").files, unit = find("model-unit").value;
      if (unit) query.set("unit", unit);
      if (camera) query.set("camera", await camera.text());
      const job = await json(`/v1/jobs?${query}`, { method: "POST", body: file });
      say(find("models-note"), `training ${job.model}: ${job.state}`);
    }
    await refresh();
  } catch (error) {
    report(error);
  }
  find("model-send").disabled = false;
}

find("model-send").onclick = send;
find("model-file").onchange = () => {
  const [file] = find("model-file").files;
  if (!file) return;
  const isModel = /\.rvm$/i.test(file.name);
  for (const label of document.querySelectorAll(".mesh")) label.hidden = isModel;
  const field = find("model-name");
  if (field.value && field.value !== proposed) return; // typed by the operator
  field.value = proposed = file.name.replace(/\.[^.]*$/, "").replace(/[^A-Za-z0-9_-]+/g, "-").replace(/^[-_]+/, "");
};
for (const close of document.querySelectorAll("dialog .close")) close.onclick = () => close.closest("dialog").close();
