// Poses are camera-to-world matrices, row by row, of three rows: x right, y down, z forward.
const column = (pose, k) => [pose[k], pose[4 + k], pose[8 + k]];
const add = (a, b, share = 1) => a.map((value, k) => value + share * b[k]);
const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const poseOf = (right, down, forward, centre) =>
  [0, 1, 2].flatMap((k) => [right[k], down[k], forward[k], centre[k]]);

// Camera from world, column by column as WebGL takes it.
function viewMatrix(pose) {
  const centre = column(pose, 3), axes = [0, 1, 2].map((k) => column(pose, k));
  const out = new Float32Array(16);
  axes.forEach((axis, row) => {
    for (let k = 0; k < 3; k += 1) out[4 * k + row] = axis[k];
    out[12 + row] = -dot3(axis, centre);
  });
  out[15] = 1;
  return out;
}

// The pose turned by an angle about an axis of the world through a point.
function turned(pose, axis, angle, about) {
  const c = Math.cos(angle), s = Math.sin(angle);
  const spin = (v) => add(add(v.map((value) => c * value), cross(axis, v), s), axis, (1 - c) * dot3(axis, v));
  const [right, down, forward] = [0, 1, 2].map((k) => unit(spin(column(pose, k))));
  return poseOf(right, down, forward, add(about, spin(add(column(pose, 3), about, -1))));
}

function moved(pose, [x, y, z]) {
  let centre = column(pose, 3);
  [x, y, z].forEach((step, k) => { centre = add(centre, column(pose, k), step); });
  return poseOf(column(pose, 0), column(pose, 1), column(pose, 2), centre);
}

// Between two poses: centres on a line, axes mixed and made upright again; frames of a path lie close together.
function between(a, b, t) {
  const mix = a.map((value, k) => value + t * (b[k] - value));
  const forward = unit(column(mix, 2));
  const right = unit(add(column(mix, 0), forward, -dot3(column(mix, 0), forward)));
  return poseOf(right, cross(forward, right), forward, column(mix, 3));
}

function alongPath(poses, at) {
  const last = poses.length - 1, place = Math.min(Math.max(at, 0), last), k = Math.min(Math.floor(place), last - 1);
  return last < 1 ? poses[0] : between(poses[k], poses[k + 1], place - k);
}
