// The encoded scene of the page as arrays: see extrags/report/viewer/encoding.py.
async function inflated(text) {
  const packed = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Axis of the smallest of three scales, the first of equals: a column of the rotation.
function shortestAxis([w, x, y, z], scales, at) {
  const [a, b, c] = [scales[at], scales[at + 1], scales[at + 2]];
  if (a <= b && a <= c) return [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)];
  if (b <= c) return [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)];
  return [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
}

async function decodedScene(header) {
  const raw = await inflated(document.getElementById(header.element).textContent);
  const n = header.count, blocks = Math.ceil(n / header.block);
  let at = 0;
  const take = (size) => raw.subarray(at, (at += size));
  const channel = (bytes) => {
    const ranges = new Float32Array(raw.slice(at, (at += 8 * blocks)).buffer);
    const planes = Array.from({ length: bytes }, () => take(n));
    const out = new Float32Array(n);
    for (let i = 0; i < n; i += 1) {
      const block = Math.floor(i / header.block), low = ranges[block];
      const level = bytes === 2 ? planes[0][i] + 256 * planes[1][i] : planes[0][i];
      out[i] = low + (level * (ranges[blocks + block] - low)) / (256 ** bytes - 1);
    }
    return out;
  };
  const channels = (number, bytes) => Array.from({ length: number }, () => channel(bytes));
  const [x, y, z] = channels(3, 2);
  const words = Array.from({ length: 4 }, () => take(n));
  const scales = channels(3, 1), [opacity] = channels(1, 1);
  const terms = (header.degree + 1) ** 2, sh = channels(3 * terms, 1);
  const levels = header.quantities.map(() => take(n));
  const packed = header.sided ? take(Math.ceil(n / 4)) : null;

  const means = new Float32Array(3 * n), geometry = new Float32Array(12 * n);
  const harmonics = new Float32Array(4 * terms * n), quantities = new Uint8Array(4 * n);
  // Normals to the side from which a Gaussian was seen; zero where it has no sides.
  const sides = packed && new Float32Array(3 * n);
  const rest = [0, 0, 0];
  for (let i = 0; i < n; i += 1) {
    means.set([x[i], y[i], z[i]], 3 * i);
    const word = words[0][i] + words[1][i] * 2 ** 8 + words[2][i] * 2 ** 16 + words[3][i] * 2 ** 24;
    const largest = Math.floor(word / 2 ** 30), q = [0, 0, 0, 0];
    for (let k = 0; k < 3; k += 1) rest[k] = (((word >>> (10 * k)) & 1023) / 1023 * 2 - 1) * Math.SQRT1_2;
    for (let k = 0, from = 0; k < 4; k += 1) if (k !== largest) q[k] = rest[from++];
    q[largest] = Math.sqrt(Math.max(0, 1 - rest[0] ** 2 - rest[1] ** 2 - rest[2] ** 2));
    geometry.set([x[i], y[i], z[i], opacity[i], ...q], 12 * i);
    for (let k = 0; k < 3; k += 1) geometry[12 * i + 8 + k] = Math.exp(scales[k][i]);
    for (let k = 0; k < terms; k += 1) {
      for (let c = 0; c < 3; c += 1) harmonics[4 * (terms * i + k) + c] = sh[3 * k + c][i];
    }
    const side = packed ? ((packed[i >> 2] >> (2 * (i & 3))) & 3) - 1 : 0;
    if (side) sides.set(shortestAxis(q, geometry, 12 * i + 8).map((value) => side * value), 3 * i);
    for (let k = 0; k < levels.length; k += 1) quantities[4 * i + k] = levels[k][i];
  }
  return { ...header, terms, means, sides, geometry, harmonics, quantities };
}
