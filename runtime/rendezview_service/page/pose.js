// Poses and covariances as the page needs them; frames as in docs/conventions.md.

/** Row-major 3 × 3 rotation of a unit quaternion (w, x, y, z). */
export function rotation([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

export const apply = (r, [x, y, z]) => [
  r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z,
];

export const applyInverse = (r, [x, y, z]) => [
  r[0] * x + r[3] * y + r[6] * z, r[1] * x + r[4] * y + r[7] * z, r[2] * x + r[5] * y + r[8] * z,
];

/** Where the camera is in the target frame: −Rᵀ t. */
export const cameraPosition = (pose) =>
  applyInverse(rotation(pose.quat_wxyz), pose.translation_m).map((value) => -value);

const product = ([a, b, c, d], [w, x, y, z]) => [
  a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w,
];

/** The pose of a `Motion` some seconds ahead, at its present rates. */
export function predicted({ pose, rates }, aheadS) {
  const rate = Math.hypot(...rates.angular_rad_s), half = (rate * aheadS) / 2;
  const axis = rates.angular_rad_s.map((value) => (rate > 0 ? value / rate : 0));
  const turn = [Math.cos(half), ...axis.map((value) => Math.sin(half) * value)];
  return {
    quat_wxyz: product(turn, pose.quat_wxyz),
    translation_m: pose.translation_m.map((value, k) => value + aheadS * rates.linear_m_s[k]),
  };
}

/** Eigenvalues and eigenvectors (columns) of a symmetric 3 × 3 matrix, by Jacobi's rotations. */
export function eigen(matrix) {
  const a = matrix.map((row) => [...row]);
  const v = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < 12; sweep++) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      if (Math.abs(a[p][q]) < 1e-300) continue;
      const angle = 0.5 * Math.atan2(2 * a[p][q], a[q][q] - a[p][p]);
      const c = Math.cos(angle), s = Math.sin(angle);
      for (let k = 0; k < 3; k++) [a[k][p], a[k][q]] = [c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]];
      for (let k = 0; k < 3; k++) [a[p][k], a[q][k]] = [c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]];
      for (let k = 0; k < 3; k++) [v[k][p], v[k][q]] = [c * v[k][p] - s * v[k][q], s * v[k][p] + c * v[k][q]];
    }
  }
  return { values: [a[0][0], a[1][1], a[2][2]], vectors: v };
}
