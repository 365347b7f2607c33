// Order of the Gaussians of each scene from the farthest to the nearest, by z-depth: a radix sort of its bits.
// What the eye sees from behind comes before all else: extrags/facing.py.
"use strict";
const places = {};
function sorted({ means, sides }, { row, near, eye, behind }) {
  const n = means.length / 3;
  const keys = new Uint32Array(n), ids = new Uint32Array(n);
  const depth = new Float32Array(1), bits = new Uint32Array(depth.buffer);
  const sided = Boolean(sides && eye), limit = -behind * behind;
  let count = 0;
  for (let i = 0; i < n; i += 1) {
    depth[0] = row[0] * means[3 * i] + row[1] * means[3 * i + 1] + row[2] * means[3 * i + 2] + row[3];
    if (depth[0] < near) continue;
    // Positive floats are ordered as their bits are; turned round, so that the farthest comes first.
    let key = ~bits[0];
    if (sided) {
      const x = eye[0] - means[3 * i], y = eye[1] - means[3 * i + 1], z = eye[2] - means[3 * i + 2];
      const along = sides[3 * i] * x + sides[3 * i + 1] * y + sides[3 * i + 2] * z;
      // The highest bit, set in all of these keys, tells the two apart.
      if (along * Math.abs(along) < limit * (x * x + y * y + z * z)) key &= 0x7fffffff;
    }
    keys[count] = key;
    ids[count] = i;
    count += 1;
  }
  let from = [keys, ids], to = [new Uint32Array(count), new Uint32Array(count)];
  for (let shift = 0; shift < 33; shift += 11) {
    const start = new Uint32Array(2049);
    for (let i = 0; i < count; i += 1) start[((from[0][i] >>> shift) & 2047) + 1] += 1;
    for (let i = 0; i < 2048; i += 1) start[i + 1] += start[i];
    for (let i = 0; i < count; i += 1) {
      const at = start[(from[0][i] >>> shift) & 2047]++;
      to[0][at] = from[0][i];
      to[1][at] = from[1][i];
    }
    [from, to] = [to, from];
  }
  return from[1].slice(0, count);
}
function answer(message) {
  if (message.means) {
    places[message.scene] = { means: message.means, sides: message.sides };
    return null;
  }
  return { ...message, order: sorted(places[message.scene], message) };
}
if (typeof WorkerGlobalScope !== "undefined") {
  self.onmessage = (event) => {
    const reply = answer(event.data);
    if (reply) self.postMessage(reply, [reply.order.buffer]);
  };
}
