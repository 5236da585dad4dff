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
  const coefficients = Array.from({ length: 8 }, (_, k) => camera.lens_coefficients?.[k] ?? 0);
  const lens = { ...camera, rotation, move, centre, coefficients, skew: camera.skew_px ?? 0 };
  return { ...lens, limit: limitOf(lens) };
}

/** The pixel of a point in the world (metres), in `out`; undefined if the camera cannot see it. */
export function project(lens, px, py, pz, out = [0, 0]) {
  const { rotation: r, move: t } = lens;
  const x = r[0] * px + r[1] * py + r[2] * pz + t[0];
  const y = r[3] * px + r[4] * py + r[5] * pz + t[1];
  const z = r[6] * px + r[7] * py + r[8] * pz + t[2];
  return z < 0.05 || Math.hypot(x, y) > lens.limit * z ? undefined : pixel(lens, x / z, y / z, out);
}

/** Where the lens moves a ray. */
function bent(lens, x, y, out = [0, 0]) {
  if (lens.lens === 2) fisheye(x, y, lens.coefficients, out);
  else brown(x, y, lens.coefficients, out);
  return out;
}

/** The pixel of a ray; x and y where it meets the plane at depth 1. */
function pixel(lens, x, y, out = [0, 0]) {
  bent(lens, x, y, out);
  const { focal_px: focal, centre_px: centre } = lens;
  out[0] = focal[0] * out[0] + lens.skew * out[1] + centre[0];
  out[1] = focal[1] * out[1] + centre[1];
  return out;
}

/** Distances from the axis, at depth 1: to where a fold is looked for (84 degrees), and rays of pixels (79 degrees). */
const [FARTHEST, WIDEST] = [10, 5];

/** The ray of a pixel, as x and y at depth 1; undefined if the lens has none there. */
export function ray(lens, u, v) {
  const miss = (x, y) => {
    const [a, b] = pixel(lens, x, y);
    return [u - a, v - b];
  };
  let [x, y] = [(u - lens.centre_px[0]) / lens.focal_px[0], (v - lens.centre_px[1]) / lens.focal_px[1]];
  const limit = Math.min(lens.limit, WIDEST);
  const inside = Math.min(1, (0.9 * limit) / Math.hypot(x, y));
  [x, y] = [x * inside, y * inside];
  const little = 1e-6;
  for (let round = 0; round < 50; round++) {
    const error = miss(x, y);
    if (Math.hypot(...error) < 1e-3) return [x, y];
    const [right, below] = [miss(x + little, y), miss(x, y + little)];
    const [a, c] = [0, 1].map((k) => (error[k] - right[k]) / little);
    const [b, d] = [0, 1].map((k) => (error[k] - below[k]) / little);
    const determinant = a * d - b * c;
    const step = [(d * error[0] - b * error[1]) / determinant, (a * error[1] - c * error[0]) / determinant];
    const isBetter = (x, y) => Math.hypot(x, y) <= limit && Math.hypot(...miss(x, y)) < Math.hypot(...error);
    let part = 1;
    while (part > 1e-6 && !isBetter(x + part * step[0], y + part * step[1])) part /= 2;
    if (part <= 1e-6) return undefined;
    [x, y] = [x + part * step[0], y + part * step[1]];
  }
  return undefined;
}

/** The distance from the axis, at depth 1, at which a lens folds: beyond it, rays come back into the image. */
function limitOf(lens) {
  const radius = (r, turn) => Math.hypot(...bent(lens, r * Math.cos(turn), r * Math.sin(turn)));
  const isRound = lens.lens === 2 || [2, 3].every((k) => !lens.coefficients[k]);
  const turns = isRound ? [0] : Array.from({ length: 16 }, (_, k) => (k * Math.PI) / 8);
  const step = FARTHEST / 1000;
  for (let r = step; r < FARTHEST; r += step) {
    if (turns.some((turn) => !(radius(r, turn) > radius(r - step, turn)))) return r - step;
  }
  return Infinity;
}

/** `k`: k1, k2, p1, p2, k3, k4, k5, k6. */
function brown(x, y, k, out) {
  const r = x * x + y * y;
  const radial = (1 + r * (k[0] + r * (k[1] + r * k[4]))) / (1 + r * (k[5] + r * (k[6] + r * k[7])));
  out[0] = x * radial + 2 * k[2] * x * y + k[3] * (r + 2 * x * x);
  out[1] = y * radial + k[2] * (r + 2 * y * y) + 2 * k[3] * x * y;
}

/** `k`: k1 to k4. */
function fisheye(x, y, k, out) {
  const flat = Math.hypot(x, y);
  const angle = Math.atan(flat);
  const a = angle * angle;
  const bent = angle * (1 + a * (k[0] + a * (k[1] + a * (k[2] + a * k[3]))));
  const scale = flat < 1e-9 ? 1 : bent / flat;
  out[0] = x * scale;
  out[1] = y * scale;
}
