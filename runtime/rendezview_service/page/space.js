// The target frame in space: contour points, view sphere, camera, trajectory, uncertainty.

import * as three from "./vendor/three.js";
import { applyInverse, cameraPosition, eigen, predicted, rotation } from "./pose.js";
import { arrow, axes, buffer, dashes, fill, frustum, grid, gridStep, lines, surface, zones } from "./space_parts.js";
import { pathPlaces } from "./readings.js";
import { poseShown } from "./status.js";

const SIGMAS = 3;
const AHEAD_S = 60; // of the predicted path
const TRAIL = 4000; // points at most
const FUSED = 0x56d364, FITTED = 0xff7bd5, BURN = 0xff4d4d;
const BARS = 60; // of the trajectory's uncertainty

export class SpaceView {
  /** Calls `changed()` when there is something to draw. Throws if the browser has no WebGL. */
  constructor(canvas, changed) {
    this.renderer = new three.WebGLRenderer({ canvas, antialias: !drawnBySoftware(), powerPreference: "low-power" });
    this.renderer.setClearColor(0x10161e);
    this.canvas = canvas;
    this.scene = new three.Scene();
    this.eye = new three.PerspectiveCamera(40, 1, 0.1, 1e5);
    this.eye.up.set(0, 0, 1);
    this.controls = new three.OrbitControls(this.eye, canvas);
    this.changed = () => {
      this.stale = this.turned = true;
      changed();
    };
    this.turned = false; // by hand, since the last drawing
    this.cost = 0; // ms, of the last drawing
    this.drawnAt = -Infinity;
    this.controls.addEventListener("change", this.changed);
    this.stale = true;
    this.magnified = 1;
    canvas.addEventListener("keydown", (event) => this._key(event));
    new ResizeObserver(() => this._resize()).observe(canvas);
    this._resize();
  }

  /** Shows a target, its view sphere, and what an approach is compared with. */
  show(geometry, camera, approach) {
    this.scene.clear();
    this.geometry = geometry;
    const radius = geometry.target_radius_m;
    this.following = false;
    this.grid = gridStep(geometry.sphere_radius_m);
    if (geometry.surface_m.length) this.scene.add(surface(geometry));
    this.scene.add(this._sphere(geometry));
    this.scene.add(dashes(geometry), axes(0.6 * radius), grid(geometry.centre_m, geometry.sphere_radius_m));
    if (approach !== null) {
      for (const part of zones(approach, geometry.centre_m)) this.scene.add(part);
      const path = approach.plan.map((point) => point.position_m);
      if (path.length > 1) this.scene.add(lines(path.slice(1).flatMap((to, k) => [path[k], to]), 0xb392f0));
    }
    this.ahead = new three.Line(buffer(40 * 3), new three.LineBasicMaterial({ color: 0xf2c14e }));
    this.nodes = new three.Points(buffer(64 * 3), new three.PointsMaterial({ color: 0xf2c14e, size: 6, sizeAttenuation: false }));
    this.trail = new three.Line(buffer(TRAIL * 3), new three.LineBasicMaterial({ color: 0x58c4dd }));
    this.bars = new three.LineSegments(buffer(BARS * 6), new three.LineBasicMaterial({ color: 0xb8871f }));
    this.body = frustum(camera, 0.35 * radius);
    this.fusedBody = frustum(camera, 0.35 * radius, FUSED);
    this.fusedTrail = new three.Line(buffer(TRAIL * 3), new three.LineBasicMaterial({ color: FUSED }));
    this.fitted = new three.Line(buffer(13 * 3), new three.LineBasicMaterial({ color: FITTED }));
    this.coming = new three.LineSegments(buffer(13 * 3), new three.LineBasicMaterial({ color: FITTED }));
    this.burn = new three.LineSegments(buffer(6 * 3), new three.LineBasicMaterial({ color: BURN }));
    this.line = new three.Line(buffer(6), new three.LineBasicMaterial({ color: 0x3d5a6b }));
    this.ellipsoid = new three.Mesh(
      new three.SphereGeometry(1, 20, 14),
      new three.MeshBasicMaterial({ color: 0xf2c14e, transparent: true, opacity: 0.35, depthWrite: false }),
    );
    this.ellipsoid.matrixAutoUpdate = this.body.matrixAutoUpdate = this.fusedBody.matrixAutoUpdate = false;
    for (const part of [this.nodes, this.trail, this.bars, this.ahead, this.fusedTrail, this.body, this.fusedBody, this.fitted, this.coming, this.burn, this.line, this.ellipsoid]) {
      part.frustumCulled = false;
      part.visible = false;
      this.scene.add(part);
    }
    const centre = new three.Vector3(...geometry.centre_m);
    this.controls.target.copy(centre);
    this.aimed = false;
    this._aim([0.8, -0.55, 0.35], geometry.sphere_radius_m);
  }

  /** Shows nothing. */
  clear() {
    this.scene.clear();
    this.geometry = undefined;
    this.place = null;
    this.stale = true;
  }

  /** Shows a state, and the states before it as the trajectory. */
  update(state, states) {
    if (!this.geometry) return;
    this.stale = true;
    const centre = this.geometry.centre_m, reach = this.geometry.sphere_radius_m;
    const on = state?.on_nodes.slice(0, 64) ?? [];
    fill(this.nodes, on.map(({ direction }) => direction.map((d, k) => centre[k] + reach * d)));
    const drawn = poseShown(state), pose = drawn.pose;
    this.body.material.color.set(drawn.predicted ? 0xf2c14e : 0xffffff);
    const motion = state?.motion ?? null;
    fill(this.ahead, motion?.pose && motion.rates ? [...Array(40).keys()].map((k) => cameraPosition(predicted(motion, (k * AHEAD_S) / 39))) : []);
    this.body.visible = this.ellipsoid.visible = this.line.visible = pose !== null;
    if (pose !== null) {
      const at = cameraPosition(pose);
      this.body.matrix.set(...placed(rotation(pose.quat_wxyz), at));
      fill(this.line, [at, centre]);
      if (!this.aimed) {
        // Beside the line of sight, with camera and target both in the view.
        const out = at.map((value, k) => value - centre[k]), far = Math.hypot(...out);
        const side = Math.hypot(out[0], out[1]) > 0.2 * far ? [-out[1], out[0], 0] : [far, 0, 0];
        const flat = Math.hypot(...side);
        this._aim(out.map((value, k) => 0.45 * value / far + 0.8 * side[k] / flat + (k === 2 ? 0.4 : 0)), Math.max(far, reach));
        this.aimed = true;
      }
      this.place = at;
      if (this.following) this._follow();
      this.ellipsoid.visible = drawn.covariance !== null;
      if (drawn.covariance !== null) {
        const { half, directions } = spread(drawn);
        this.magnified = magnification(Math.max(...half), 0.25 * this.geometry.target_radius_m);
        // An axis that is too thin to see gets a minimum width.
        const least = 0.01 * this.geometry.target_radius_m;
        const size = half.map((value) => Math.max(least, this.magnified * value));
        this.ellipsoid.matrix.set(...placed(transposed(directions.flatMap((d, k) => d.map((v) => v * size[k]))), at, true));
      }
    }
    const fused = state?.fused?.pose ?? null;
    this.fusedBody.visible = fused !== null;
    if (fused !== null) this.fusedBody.matrix.set(...placed(rotation(fused.quat_wxyz), cameraPosition(fused)));
    this._fitted(state?.trajectory ? pathPlaces(state.trajectory) : null);
    this._trajectory(states);
  }

  /** The fitted path, the predicted one in dashes, and the direction of the correction. */
  _fitted(found) {
    fill(this.fitted, found?.path ?? []);
    fill(this.coming, found?.predicted.slice(0, 12) ?? []);
    fill(this.burn, found?.direction ? arrow(found.now, found.direction, 0.2 * Math.hypot(...found.now.map((value, k) => value - this.geometry.centre_m[k]))) : []);
  }

  _trajectory(states) {
    const together = states.filter((state) => state.fused?.pose);
    const each = Math.max(1, Math.ceil(together.length / TRAIL));
    fill(this.fusedTrail, together.filter((_, k) => k % each === 0).map((state) => cameraPosition(state.fused.pose)));
    const kept = states.filter((state) => state.pose !== null);
    const step = Math.max(1, Math.ceil(kept.length / TRAIL));
    fill(this.trail, kept.filter((_, k) => k % step === 0).map((state) => cameraPosition(state.pose)));
    const ends = [];
    const every = Math.max(1, Math.ceil(kept.length / BARS));
    for (const state of kept.filter((s) => s.frame % every === 0 && s.covariance !== null).slice(-BARS)) {
      const at = cameraPosition(state.pose), { half, directions } = spread(state);
      const longest = half.indexOf(Math.max(...half));
      const bar = directions[longest].map((value) => value * half[longest] * this.magnified);
      ends.push(at.map((value, k) => value - bar[k]), at.map((value, k) => value + bar[k]));
    }
    fill(this.bars, ends);
  }

  /** Draws if anything has changed, and measures the time it took. */
  draw(now) {
    if (!this.stale) return false;
    this.stale = this.turned = false;
    this.drawnAt = now;
    const start = performance.now();
    this.renderer.render(this.scene, this.eye);
    this.renderer.getContext().finish(); // what takes long without a graphics card comes after render()
    this.cost = performance.now() - start;
    return true;
  }

  _sphere({ nodes, edges, centre_m: centre, sphere_radius_m: reach }) {
    const ends = edges.flatMap(([a, b]) => [...nodes[a], ...nodes[b]]);
    const places = new Float32Array(ends.length).map((_, k) => centre[k % 3] + reach * ends[k]);
    const geometry = new three.BufferGeometry();
    geometry.setAttribute("position", new three.BufferAttribute(places, 3));
    return new three.LineSegments(geometry, new three.LineBasicMaterial({ color: 0x3c4a59, transparent: true, opacity: this.geometry.surface_m.length ? 0.18 : 0.55 }));
  }

  /** The whole scene: target and camera. */
  fit() {
    if (!this.geometry) return;
    const centre = this.geometry.centre_m;
    const far = this.place ? Math.hypot(...this.place.map((value, k) => value - centre[k])) : 0;
    this.following = false;
    this._aim(this.eye.position.clone().sub(this.controls.target).toArray(), Math.max(0.6 * far, this.geometry.sphere_radius_m / 2));
    this.changed();
  }

  /** Looks past the camera at the target, and stays there; or no longer. */
  follow(on) {
    this.following = on && this.geometry !== undefined;
    if (this.following && this.place) this._follow();
    this.changed();
  }

  _follow() {
    const centre = this.geometry.centre_m, out = this.place.map((value, k) => value - centre[k]);
    const far = Math.hypot(...out), lift = 0.25 * far;
    this.eye.position.set(...this.place.map((value, k) => value + 0.35 * out[k] + (k === 2 ? lift : 0)));
    this.controls.update();
  }

  _aim(direction, reach) {
    const length = Math.hypot(...direction);
    const far = 3 * reach;
    this.eye.position.copy(this.controls.target).add(new three.Vector3(...direction.map((value) => (far * value) / length)));
    this.eye.near = reach / 100;
    this.eye.far = reach * 50;
    this.eye.updateProjectionMatrix();
    this.controls.update();
    this.stale = true;
  }

  _key(event) {
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const zoom = { "+": 1 / 1.15, "=": 1 / 1.15, "-": 1.15 }[event.key];
    if (!turn && !zoom) return;
    event.preventDefault();
    event.stopPropagation();
    const offset = this.eye.position.clone().sub(this.controls.target);
    if (zoom) offset.multiplyScalar(zoom);
    else {
      offset.applyAxisAngle(this.eye.up, 0.1 * turn[0]);
      const side = new three.Vector3().crossVectors(this.eye.up, offset).normalize();
      const tilted = offset.clone().applyAxisAngle(side, 0.1 * turn[1]);
      if (Math.abs(tilted.z) < 0.98 * tilted.length()) offset.copy(tilted);
    }
    this.eye.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.changed();
  }

  _resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.setSize(width, height, false);
    this.eye.aspect = width / height;
    // A tall window sees as much sideways as a wide one upwards.
    this.eye.fov = width < height ? (360 / Math.PI) * Math.atan(Math.tan(Math.PI / 9) * (height / width)) : 40;
    this.eye.updateProjectionMatrix();
    this.changed();
  }
}

function drawnBySoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const name = gl?.getExtension("WEBGL_debug_renderer_info");
  const software = /swiftshader|llvmpipe|software/i.test(name ? gl.getParameter(name.UNMASKED_RENDERER_WEBGL) : "");
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return software;
}

/** Half axes (3σ) and directions (target frame) of the camera's position, from a state's covariance. */
export function spread({ pose, covariance }) {
  // c = −Rᵀ t with R' = exp([w]×) R and t' = t + v:  c' − c = −Rᵀ (v + [t]× w).
  const [x, y, z] = pose.translation_m;
  const jacobian = [[0, -z, y, 1, 0, 0], [z, 0, -x, 0, 1, 0], [-y, x, 0, 0, 0, 1]];
  const half = jacobian.map((row) => covariance.map((column) => row.reduce((sum, value, k) => sum + value * column[k], 0)));
  const matrix = half.map((row) => jacobian.map((other) => row.reduce((sum, value, k) => sum + value * other[k], 0)));
  const { values, vectors } = eigen(matrix);
  const turn = rotation(pose.quat_wxyz);
  return {
    half: values.map((value) => SIGMAS * Math.sqrt(Math.max(0, value))),
    directions: [0, 1, 2].map((k) => applyInverse(turn, vectors.map((row) => row[k]))),
  };
}

/** 1, 2, 5, 10 …, the magnification that makes a length visible. */
function magnification(length, wanted) {
  if (!(length > 0) || length >= wanted) return 1;
  const power = 10 ** Math.floor(Math.log10(wanted / length));
  return power * [5, 2, 1].find((step) => step * power * length <= wanted);
}

/** Row-major 4 × 4 of Rᵀ (or of R itself) and a position. */
function placed(r, at, asItIs = false) {
  const m = asItIs ? r : transposed(r);
  return [m[0], m[1], m[2], at[0], m[3], m[4], m[5], at[1], m[6], m[7], m[8], at[2], 0, 0, 0, 1];
}

const transposed = (m) => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];

