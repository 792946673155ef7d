// Parts of the view in space: three.js objects of the target, the camera, grid, corridor and zone.

import * as three from "./vendor/three.js";

const KINDS = [[0.35, 0.72, 0.85], [1.0, 0.7, 0.33], [0.72, 0.6, 0.95]];
const LIGHT = [0.42, -0.53, 0.74]; // of the shaded target, target frame
const CORNERS = 6; // of a disc

export function buffer(length) {
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(length), 3));
  return geometry;
}

export function fill(part, places) {
  const attribute = part.geometry.attributes.position;
  places.forEach((place, k) => attribute.setXYZ(k, ...place));
  attribute.needsUpdate = true;
  part.geometry.setDrawRange(0, places.length);
  part.visible = places.length > 0;
}

/** A dash along the edge at each contour point. */
export function dashes({ points_m: points, tangents, kinds, spacing_m: spacing }) {
  const places = new Float32Array(points.length * 6), colours = new Float32Array(points.length * 6);
  points.forEach((point, n) => {
    for (let end = 0; end < 2; end++) {
      for (let k = 0; k < 3; k++) {
        places[6 * n + 3 * end + k] = point[k] + (end - 0.5) * spacing * tangents[n][k];
        colours[6 * n + 3 * end + k] = KINDS[kinds[n]][k];
      }
    }
  });
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.BufferAttribute(places, 3));
  geometry.setAttribute("color", new three.BufferAttribute(colours, 3));
  return new three.LineSegments(geometry, new three.LineBasicMaterial({ vertexColors: true }));
}

/** x red, y green, z blue, at the target frame's origin. */
export function axes(length) {
  const geometry = new three.BufferGeometry();
  const places = [[length, 0, 0], [0, length, 0], [0, 0, length]].flatMap((end) => [0, 0, 0, ...end]);
  const colours = [[1, 0.35, 0.3], [0.35, 0.9, 0.4], [0.4, 0.6, 1]].flatMap((colour) => [...colour, ...colour]);
  geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(places), 3));
  geometry.setAttribute("color", new three.BufferAttribute(new Float32Array(colours), 3));
  return new three.LineSegments(geometry, new three.LineBasicMaterial({ vertexColors: true }));
}

/** The camera's field of view, in its own frame, with its up direction. */
export function frustum({ width, height, fx, fy, cx, cy }, depth, color = 0xffffff) {
  const corner = (u, v) => [((u - 0.5 - cx) / fx) * depth * 1.6, ((v - 0.5 - cy) / fy) * depth * 1.6, depth * 1.6];
  const corners = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
  const roof = [corner(0.3 * width, 0), corner(0.5 * width, -0.3 * height), corner(0.7 * width, 0)];
  const ends = corners.flatMap((place, k) => [[0, 0, 0], place, place, corners[(k + 1) % 4]]);
  ends.push(roof[0], roof[1], roof[1], roof[2]);
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(ends.flat()), 3));
  return new three.LineSegments(geometry, new three.LineBasicMaterial({ color }));
}

/** The target's surface: a disc at each point, lit from one side. */
export function surface({ surface_m: points, normals, albedo, disc_m: radius }) {
  const places = new Float32Array(points.length * CORNERS * 9), colours = new Float32Array(places.length);
  points.forEach((point, n) => {
    const normal = normals[n], [nx, ny, nz] = normal;
    const side = Math.abs(nz) < 0.9 ? unit([-ny, nx, 0]) : unit([0, -nz, ny]);
    const other = cross(normal, side);
    const lit = 0.25 + 0.75 * Math.max(0, normal.reduce((sum, value, k) => sum + value * LIGHT[k], 0));
    const grey = (0.35 + 0.65 * albedo[n]) * lit;
    const rim = [...Array(CORNERS + 1).keys()].map((c) => {
      const [cos, sin] = [Math.cos((2 * Math.PI * c) / CORNERS), Math.sin((2 * Math.PI * c) / CORNERS)];
      return point.map((value, k) => value + radius * (cos * side[k] + sin * other[k]));
    });
    for (let c = 0; c < CORNERS; c++) {
      [point, rim[c], rim[c + 1]].forEach((corner, v) => {
        for (let k = 0; k < 3; k++) {
          const at = 9 * (CORNERS * n + c) + 3 * v + k;
          places[at] = corner[k];
          colours[at] = grey * [0.92, 0.96, 1][k];
        }
      });
    }
  });
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.BufferAttribute(places, 3));
  geometry.setAttribute("color", new three.BufferAttribute(colours, 3));
  return new three.Mesh(geometry, new three.MeshBasicMaterial({ vertexColors: true, side: 2 }));
}

const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((value) => value / length);
}

export function lines(places, color, opacity = 1) {
  const geometry = new three.BufferGeometry();
  geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(places.flat()), 3));
  return new three.LineSegments(geometry, new three.LineBasicMaterial({ color, transparent: opacity < 1, opacity }));
}

/** Ends of the lines of an arrow: shaft and two barbs. */
export function arrow(from, direction, length) {
  const side = unit(cross(direction, Math.abs(direction[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
  const at = (along, aside) => from.map((value, k) => value + length * (along * direction[k] + aside * side[k]));
  return [from, at(1, 0), at(1, 0), at(0.8, 0.1), at(1, 0), at(0.8, -0.1)];
}

/** 1, 2, 5, 10 … metres, about a tenth of a length. */
export function gridStep(reach) {
  const power = 10 ** Math.floor(Math.log10(reach / 5));
  return power * [5, 2, 1].find((step) => step * power <= reach / 5);
}

/** Squares of a step in the plane z = 0 of the target frame, about its centre. */
export function grid(centre, reach) {
  const step = gridStep(reach), count = Math.ceil(reach / step), end = count * step, places = [];
  const [x0, y0] = [0, 1].map((k) => step * Math.round(centre[k] / step));
  for (let k = -count; k <= count; k++) {
    places.push([x0 + k * step, y0 - end, centre[2]], [x0 + k * step, y0 + end, centre[2]]);
    places.push([x0 - end, y0 + k * step, centre[2]], [x0 + end, y0 + k * step, centre[2]]);
  }
  return lines(places, 0x33424f, 0.5);
}

/** The port's axis, the corridor's cone about it, and the keep-out zone. */
export function zones({ port, corridor, keep_out_m: keepOut }, centre) {
  const found = [];
  if (port) {
    const out = unit(port.axis), side = unit(cross(out, Math.abs(out[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
    const other = cross(out, side);
    const at = (along, wide, angle) => port.centre_m.map((value, k) =>
      value + along * out[k] + wide * (Math.cos(angle) * side[k] + Math.sin(angle) * other[k]));
    const length = corridor?.length_m ?? 3;
    found.push(lines([at(0, 0, 0), at(length, 0, 0)], 0x7fd1ff));
    if (corridor) {
      const wide = (along) => corridor.radius_m + along * Math.tan((corridor.half_angle_deg * Math.PI) / 180);
      const places = [];
      for (let k = 0; k < 24; k++) {
        const [a, b] = [(k * Math.PI) / 12, ((k + 1) * Math.PI) / 12];
        for (const share of [0.001, 0.25, 0.5, 0.75, 1]) places.push(at(share * length, wide(share * length), a), at(share * length, wide(share * length), b));
        if (k % 3 === 0) places.push(at(0, wide(0), a), at(length, wide(length), a));
      }
      found.push(lines(places, 0x56d364, 0.55));
    }
  }
  if (keepOut) {
    const places = [];
    for (let k = 0; k < 48; k++) {
      const [a, b] = [(k * Math.PI) / 24, ((k + 1) * Math.PI) / 24];
      const circle = (angle) => [keepOut * Math.cos(angle), keepOut * Math.sin(angle)];
      for (const put of [([x, y]) => [x, y, 0], ([x, y]) => [x, 0, y], ([x, y]) => [0, x, y]]) {
        places.push(...[a, b].map((angle) => put(circle(angle)).map((value, i) => value + centre[i])));
      }
    }
    found.push(lines(places, 0xff7b72, 0.6));
  }
  return found;
}
