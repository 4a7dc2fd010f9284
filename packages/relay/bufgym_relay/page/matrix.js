// Four by four matrices in columns, as WebGL takes them, and where a point comes to lie on the screen.

const range = [0, 1, 2, 3];

export function multiply(a, b) {
  const product = new Float32Array(16);
  for (const column of range)
    for (const row of range) product[4 * column + row] = range.reduce((sum, k) => sum + a[4 * k + row] * b[4 * column + k], 0);
  return product;
}

// What is turned by a quaternion (x, y, z, w) and then moved to ``at``.
/** @type {(pose: {at: number[], turn: number[]}) => Float32Array} */
export const rigid = ({at: [x, y, z], turn: [a, b, c, w]}) =>
  new Float32Array([
    1 - 2 * (b * b + c * c), 2 * (a * b + c * w), 2 * (a * c - b * w), 0,
    2 * (a * b - c * w), 1 - 2 * (a * a + c * c), 2 * (b * c + a * w), 0,
    2 * (a * c + b * w), 2 * (b * c - a * w), 1 - 2 * (a * a + b * b), 0, x, y, z, 1,
  ]);

// A camera; a metre at a metre's distance is ``zoom`` of the picture's height.
function perspective(zoom, aspect, near, far) {
  const f = 2 * zoom, depth = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) / depth, -1, 0, 0, 2 * near * far / depth, 0]);
}

// How a camera sees the scene: from ``distance`` metres of ``target``, at ``yaw`` round it and ``pitch`` above it, with z upwards.
/** @param {{target: number[], yaw: number, pitch: number, distance: number}} view */
export function seen({target: [x, y, z], yaw, pitch, distance}, zoom, aspect) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const right = [-sy, cy, 0], up = [-sp * cy, -sp * sy, cp], back = [cp * cy, cp * sy, sp];
  const along = axis => -(axis[0] * x + axis[1] * y + axis[2] * z);
  const axes = [0, 1, 2].flatMap(k => [right[k], up[k], back[k], 0]);
  return multiply(perspective(zoom, aspect, distance / 100, distance * 100), new Float32Array([...axes, along(right), along(up), along(back) - distance, 1]));
}

// Where a point is on the screen, [x, y] from 0 to 1 from the upper left; undefined for one behind the camera.
export function project(m, [x, y, z]) {
  const [cx, cy, , w] = range.map(row => m[row] * x + m[4 + row] * y + m[8 + row] * z + m[12 + row]);
  return w > 0 ? [(1 + cx / w) / 2, (1 - cy / w) / 2] : undefined;
}
