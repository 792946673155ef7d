// The view in space and the plots: loaded after the first picture, and drawn less often.

import { poseShown, say } from "./status.js";

const find = (id) => document.getElementById(id);
const SLOW_MS = 100; // between drawings of the view in space
const PLOT_MS = 250;
const SHARE = 12; // each takes 1/12 of the time, or waits a second: the picture has priority
const MOST_MS = 1000;

const span = () => Number(find("span").value);

export class Views {
  /** `drawn` counts for tests; `schedule()` asks for a drawing, `again()` for one of everything. */
  constructor(drawn, schedule, again) {
    this.drawn = drawn;
    this.schedule = schedule;
    this.again = again;
    this.space = this.plots = null;
    this.zoom = null; // of the plots: [from, to] in s
    this.moved = false; // the view in space lacks the newest state
    this.plotAt = this.plotCost = 0;
    find("unzoom").onclick = () => this.zoomed(null);
    find("fit").onclick = () => this.space?.fit();
    find("follow").onclick = () => {
      const on = find("follow").getAttribute("aria-pressed") !== "true";
      find("follow").setAttribute("aria-pressed", String(on));
      this.space?.follow(on);
    };
  }

  async load() {
    if (this.space !== null || this.plots !== null) return;
    const [curves, view] = await Promise.allSettled([import("./plots.js"), import("./space.js")]);
    if (this.plots === null && curves.status === "fulfilled") this._plots(curves.value.Plots, false);
    try {
      this.space ??= new view.value.SpaceView(find("scene"), this.schedule);
      this.drawn.webgl = true;
    } catch {
      this.drawn.webgl = false;
      say(find("space-note"), "This browser has no WebGL: the view in space is left out.");
    }
  }

  _plots(Plots, hasPort) {
    this.plots?.close();
    this.plots = new Plots(find("plots"), hasPort, (from, to) => this.zoomed(from, to));
  }

  /** The plots have the page's colours. */
  themed() {
    if (this.plots !== null) this._plots(this.plots.constructor, this.plots.hasPort);
    this.renew();
  }

  /** A target, a camera, and what the approach is compared with. */
  show(geometry, camera, approach) {
    if (this.space === null) return;
    this.space.show(geometry, camera, approach);
    find("space-note").hidden = true;
    find("follow").setAttribute("aria-pressed", "false");
    this.renew();
  }

  /** Nothing of another session stays. */
  clear() {
    this.drawn.plotted = null;
    this.plots?.show([], Date.now() / 1000, span());
    this.space?.clear();
    if (this.space !== null) find("space-note").hidden = false;
    say(find("space-scale"), "");
    this.zoomed(null);
  }

  /** Everything is drawn with the next frame. */
  renew() {
    this.plotAt = 0;
    this.moved = true;
  }

  zoomed(from, to) {
    this.zoom = from === null ? null : [from, to];
    find("unzoom").hidden = this.zoom === null;
    this.renew();
    this.again();
  }

  /** `states`: up to the shown one. */
  drawSpace(now, shown, states, paused) {
    const { space } = this;
    if (space === null) return;
    // Turning the view by hand has a shorter wait than new states.
    const wait = space.turned ? 1.5 * space.cost : Math.max(SLOW_MS, Math.min(MOST_MS, SHARE * space.cost));
    if (now - space.drawnAt < wait && !paused) {
      if (space.turned) this.schedule();
      return;
    }
    if (this.moved && shown !== null && space.geometry) {
      this.moved = false;
      const from = shown.state.received_unix_s - span();
      space.update(shown.state, states.filter((state) => state.received_unix_s >= from));
      const green = shown.state.fused?.pose ? " · green: fused" : "";
      const sigma = poseShown(shown.state).covariance ? ` · camera position, 3σ × ${space.magnified}` : "";
      const path = shown.state.trajectory?.segment ? " · pink: fitted path, dashes: predicted, red: correction" : "";
      say(find("space-scale"), `target frame · grid ${space.grid} m${sigma}${green}${path}`);
    }
    if (space.draw(now)) this.drawn.spaces += 1;
  }

  /** What was left out in favour of the picture is drawn when no frames come. */
  catchUp(shown, states) {
    if (this.drawn.plotted !== shown.state.frame) this.plot(performance.now(), shown, states, false);
    if (this.moved) this.schedule();
  }

  /** All states, with the shown one marked while paused. */
  plot(now, shown, states, paused) {
    if (this.plots === null || states.length === 0) return;
    if (now - this.plotAt < Math.max(PLOT_MS, Math.min(MOST_MS, SHARE * this.plotCost)) && !paused) return;
    this.plotAt = now;
    this.drawn.plotted = shown.state.frame;
    const hasPort = shown.state.approach?.along_m != null;
    if (this.plots.hasPort !== hasPort) this._plots(this.plots.constructor, hasPort);
    const at = shown.state.received_unix_s, newest = states.at(-1).received_unix_s;
    this.plots.mark = paused ? at : null;
    // While paused, the shown state is in the middle if later states exist.
    const end = paused ? Math.min(newest, Math.max(at + span() / 2, states[0].received_unix_s + span())) : newest;
    if (this.zoom === null) this.plots.show(states, end, span());
    else this.plots.show(states, this.zoom[1], this.zoom[1] - this.zoom[0]);
    this.plotCost = performance.now() - now;
  }
}
