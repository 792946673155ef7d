// The camera's picture with the tracker's result drawn over it.

import { apply, rotation } from "./pose.js";

// Outline, step, crease: they differ in lightness too.
const KINDS = ["#58e0ff", "#ffb454", "#d2a8ff"];
const NODE = "#f2c14e";
const MARK = "#ff7bd5"; // what other sensors saw
const RING = "#ff9f43"; // the docking ring that the session found
const PREDICTED = "#f2c14e";
const MOST_ZOOM = 40;

export class LiveView {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d", { alpha: false });
    this.layers = { contour: true, nodes: true, silhouette: false, ellipses: true, spots: true };
    this.geometry = null;
    this.camera = null; // of the session: places are in its full pixels
    this.zoom = { scale: 1, x: 0, y: 0 }; // of the canvas, about its corner, px
    this.changed = () => {};
    this._listen();
  }

  /** The whole picture again. */
  unzoom() {
    this.zoom = { scale: 1, x: 0, y: 0 };
    this.changed();
  }

  _listen() {
    const { canvas } = this;
    const place = (event) => {
      // The canvas is fitted into its box (object-fit: contain).
      const box = canvas.getBoundingClientRect();
      const fit = Math.min(box.width / canvas.width, box.height / canvas.height);
      return [(event.clientX - box.left - (box.width - fit * canvas.width) / 2) / fit, (event.clientY - box.top - (box.height - fit * canvas.height) / 2) / fit];
    };
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const [x, y] = place(event), old = this.zoom.scale;
      const scale = Math.min(MOST_ZOOM, Math.max(1, old * Math.exp(-0.002 * event.deltaY)));
      this._move(scale, x - (scale / old) * (x - this.zoom.x), y - (scale / old) * (y - this.zoom.y));
    }, { passive: false });
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      if (this.zoom.scale === 1) return;
      from = place(event);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (from === null) return;
      const to = place(event);
      this._move(this.zoom.scale, this.zoom.x + to[0] - from[0], this.zoom.y + to[1] - from[1]);
      from = to;
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (from = null));
    canvas.addEventListener("dblclick", () => this.unzoom());
  }

  _move(scale, x, y) {
    const { width, height } = this.canvas;
    const within = (value, size) => Math.min(0, Math.max(size * (1 - scale), value));
    this.zoom = { scale, x: within(x, width), y: within(y, height) };
    this.changed();
  }

  /** Draws a picture (dark if there is none), and the contour, outlines and nodes of a state; `seen`: the state of the picture's own frame. */
  draw({ bitmap, contour, silhouette, marks, state, seen = null }) {
    const { canvas, pen } = this;
    const width = bitmap?.width ?? canvas.width, height = bitmap?.height ?? canvas.height;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    pen.setTransform(this.zoom.scale, 0, 0, this.zoom.scale, this.zoom.x, this.zoom.y);
    if (bitmap) pen.drawImage(bitmap, 0, 0);
    else {
      pen.fillStyle = "#000";
      pen.fillRect(0, 0, width, height);
    }
    // Pixel (0, 0) of the full frame is the centre of its first pixel; a canvas counts corners.
    const scale = width / (this.camera?.width ?? width);
    const place = ([u, v]) => [(u + 0.5) * scale, (v + 0.5) * scale];
    if (this.layers.silhouette && silhouette) this._outlines(silhouette, place);
    if (this.layers.contour && contour) this._contour(contour, place);
    for (const sensor of marks ?? []) {
      if (this.layers.ellipses) this._ellipses(sensor, place, scale);
      if (this.layers.spots) this._spots(sensor, place);
    }
    if (this.layers.ellipses && seen?.ring) this._ring(seen.ring, place, scale);
    if (this.layers.spots && seen?.reflectors) this._spots({ spots_px: seen.reflectors.spots.map((spot) => [spot.x_px, spot.y_px]) }, place);
    pen.setTransform(1, 0, 0, 1, 0, 0);
    if (this.layers.nodes && state) this._nodes(state);
  }

  _outlines(outlines, place) {
    const { pen } = this;
    pen.strokeStyle = "#56d364";
    pen.lineWidth = 1;
    pen.beginPath();
    for (const outline of outlines) {
      outline.forEach((point, k) => (k ? pen.lineTo(...place(point)) : pen.moveTo(...place(point))));
      pen.closePath();
    }
    pen.stroke();
  }

  /** The ellipse that the poses belong to has a thick line. */
  _ellipses({ ellipses, chosen }, place, scale) {
    const { pen } = this;
    pen.strokeStyle = MARK;
    ellipses.forEach(({ centre_px: centre, semi_axes_px: [a, b], angle_rad: angle }, k) => {
      pen.lineWidth = k === chosen ? 2.5 : 1;
      pen.beginPath();
      pen.ellipse(...place(centre), Math.abs(a) * scale, Math.abs(b) * scale, angle, 0, 2 * Math.PI);
      pen.stroke();
    });
  }

  /** The ring's ellipse and axis; thin and dashed where it is open which ellipse it is. */
  _ring({ ellipse, poses, candidates }, place, scale) {
    const { pen, camera } = this;
    const open = candidates.length > 0;
    pen.strokeStyle = RING;
    pen.setLineDash(open ? [6, 5] : []);
    for (const each of candidates.length > 0 ? candidates.map((one) => one.ellipse) : ellipse ? [ellipse] : []) {
      const [a, b] = each.semi_axes_px;
      pen.lineWidth = open ? 1.5 : 3;
      pen.beginPath();
      pen.ellipse(...place(each.centre_px), Math.abs(a) * scale, Math.abs(b) * scale, each.angle_rad, 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.setLineDash([]);
    const chosen = poses.find((pose) => pose.chosen);
    if (!chosen || !camera || !ellipse) return;
    const { centre_m: centre, axis } = chosen;
    const length = (0.6 * ellipse.semi_axes_px[0] * centre[2]) / camera.fx;
    const pixel = (along) => {
      const [x, y, z] = centre.map((value, k) => value + along * axis[k]);
      return place([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]);
    };
    pen.beginPath();
    pen.arc(...pixel(0), 3, 0, 2 * Math.PI);
    pen.moveTo(...pixel(0));
    pen.lineTo(...pixel(length));
    pen.lineWidth = 2;
    pen.stroke();
  }

  _spots({ spots_px: spots }, place) {
    const { pen } = this;
    pen.strokeStyle = MARK;
    pen.lineWidth = 1.5;
    for (const spot of spots) {
      const [x, y] = place(spot);
      pen.beginPath();
      pen.arc(x, y, 6, 0, 2 * Math.PI);
      pen.moveTo(x - 9, y);
      pen.lineTo(x - 3, y);
      pen.moveTo(x + 3, y);
      pen.lineTo(x + 9, y);
      pen.stroke();
    }
  }

  /** A predicted contour has one colour, and every third point only. */
  _contour({ points_px: points, kinds, predicted }, place) {
    const size = 1.8 / Math.sqrt(this.zoom.scale);
    KINDS.forEach((colour, kind) => {
      this.pen.fillStyle = predicted ? PREDICTED : colour;
      for (let k = 0; k < points.length; k += predicted ? 3 : 1) {
        if (!predicted && kinds[k] !== kind) continue;
        const [x, y] = place(points[k]);
        this.pen.fillRect(x - size / 2, y - size / 2, size, size);
      }
    });
  }

  /** The half of the view sphere that faces the camera. */
  _nodes(state) {
    const { pen, canvas } = this;
    const radius = 0.11 * Math.min(canvas.width, canvas.height);
    const x0 = canvas.width - radius - 10, y0 = radius + 10;
    pen.fillStyle = "#0009";
    pen.beginPath();
    pen.arc(x0, y0, radius + 4, 0, 2 * Math.PI);
    pen.fill();
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "center";
    if (state.pose === null || this.geometry === null) {
      pen.fillStyle = NODE;
      pen.fillText(`${state.on_nodes.length} on`, x0, y0 + 4);
      return;
    }
    const turn = rotation(state.pose.quat_wxyz);
    const dot = (direction, size) => {
      const [x, y, z] = apply(turn, direction);
      if (z > 0) return;
      pen.beginPath();
      pen.arc(x0 + radius * x, y0 + radius * y, size, 0, 2 * Math.PI);
      pen.fill();
    };
    pen.fillStyle = "#7d8b99";
    for (const node of this.geometry.nodes) dot(node, 0.8);
    pen.fillStyle = NODE;
    for (const node of state.on_nodes) dot(node.direction, 1.5 + 2.5 * node.weight);
  }
}
