// The operator's input: keys and buttons, each with its action.

import { listen } from "./keys.js";
import { showModels } from "./library.js";
import { switchTheme } from "./theme.js";

const find = (id) => document.getElementById(id);
const LAYERS = ["contour", "nodes", "silhouette", "ellipses", "spots"];

/** Wires the page; `act` has its actions, `live` the layers, `views` the view in space and plots. */
export function wire(act, live, views) {
  const press = (layer) => find(`layer-${layer}`).click();
  const keys = {
    " ": act.pauseOrLive,
    ArrowLeft: (event) => act.step(-1, event.shiftKey),
    ArrowRight: (event) => act.step(1, event.shiftKey),
    Home: act.oldest,
    End: act.goLive,
    c: () => press("contour"),
    n: () => press("nodes"),
    o: () => press("silhouette"),
    e: () => press("ellipses"),
    p: () => press("spots"),
    d: act.download,
    f: () => find("fit").click(),
    g: () => find("follow").click(),
    z: () => (live.unzoom(), views.zoomed(null)),
    r: () => find("recordings").click(),
    m: () => find("models").click(),
    s: () => find("sessions").focus(),
    l: () => find("theme").click(),
    "?": () => find("help-dialog").showModal(),
  };
  listen(keys);
  find("pause").onclick = act.pauseOrLive;
  find("scrub").oninput = (event) => act.seek(Number(event.target.value));
  find("span").onchange = act.again;
  find("sessions").onchange = (event) => act.choose(event.target.value);
  find("download").onclick = act.download;
  find("models").onclick = showModels;
  find("recordings").onclick = act.recordings;
  find("help").onclick = keys["?"];
  switchTheme(find("theme"), () => (views.themed(), act.again()));
  for (const layer of LAYERS) {
    live.layers[layer] = find(`layer-${layer}`).checked;
    find(`layer-${layer}`).onchange = () => {
      live.layers[layer] = find(`layer-${layer}`).checked;
      act.layer(layer);
    };
  }
}
