// Where a camera sees a point.

/** A camera of a rig, ready to project. */
export function lensOf(camera) {
  const [x, y, z, w] = camera.camera_from_world_rotation;
  const rotation = [
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
  ];
  const move = camera.camera_from_world_translation_m;
  const centre = [0, 1, 2].map((k) => -(rotation[k] * move[0] + rotation[3 + k] * move[1] + rotation[6 + k] * move[2]));
  return { ...camera, rotation, move, centre, coefficients: camera.lens_coefficients ?? [], skew: camera.skew_px ?? 0 };
}

/** The pixel of a point in the world (metres); undefined behind the camera. */
export function project(lens, px, py, pz) {
  const { rotation: r, move: t } = lens;
  const x = r[0] * px + r[1] * py + r[2] * pz + t[0];
  const y = r[3] * px + r[4] * py + r[5] * pz + t[1];
  const z = r[6] * px + r[7] * py + r[8] * pz + t[2];
  return z < 0.05 ? undefined : pixel(lens, x / z, y / z);
}

/** The pixel of a ray; x and y where it meets the plane at depth 1. */
function pixel(lens, x, y) {
  const [u, v] = lens.lens === 2 ? fisheye(x, y, lens.coefficients) : brown(x, y, lens.coefficients);
  const [fx, fy] = lens.focal_px;
  const [cx, cy] = lens.centre_px;
  return [fx * u + lens.skew * v + cx, fy * v + cy];
}

/** Rays that are farther from the axis than this, as x and y at depth 1, are not looked for. */
const WIDEST = 5;

/** The ray of a pixel; undefined if the lens has none there. */
export function ray(lens, u, v) {
  const [fx, fy] = lens.focal_px;
  let [x, y] = [(u - lens.centre_px[0]) / fx, (v - lens.centre_px[1]) / fy];
  const step = 1e-5;
  for (let round = 0; round < 30; round++) {
    const [at, right, below] = [pixel(lens, x, y), pixel(lens, x + step, y), pixel(lens, x, y + step)];
    const [du, dv] = [u - at[0], v - at[1]];
    if (Math.hypot(du, dv) < 1e-3) return Math.hypot(x, y) < WIDEST ? [x, y] : undefined;
    const [a, c] = [0, 1].map((k) => (right[k] - at[k]) / step);
    const [b, d] = [0, 1].map((k) => (below[k] - at[k]) / step);
    const determinant = a * d - b * c;
    x += (d * du - b * dv) / determinant;
    y += (a * dv - c * du) / determinant;
  }
  return undefined;
}

function brown(x, y, [k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0]) {
  const r = x * x + y * y;
  const radial = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)));
  return [
    x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
    y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
  ];
}

function fisheye(x, y, [k1 = 0, k2 = 0, k3 = 0, k4 = 0]) {
  const flat = Math.hypot(x, y);
  if (flat < 1e-9) return [x, y];
  const angle = Math.atan(flat);
  const a = angle * angle;
  const bent = angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4))));
  return [(x / flat) * bent, (y / flat) * bent];
}
