// Free space of the run: its boundary as squares, and a slice across the view coloured by clearance.
// One byte per voxel, see extrags/report/viewer/free_space.py.
const FREE_FROM = 2;
const WALL_TINT = [0.87, 0.47, 0.33], UNSEEN_TINT = [0.36, 0.62, 0.95];

async function decodedFreeSpace(header) {
  const levels = await inflated(header.body), [nx, ny, nz] = header.size;
  if (levels.length !== nx * ny * nz) throw new Error("the free space of the page is not whole");
  return { ...header, levels };
}

// Squares between free voxels and others: of one tint at walls, of another where it ends at what no view saw.
function freeSpaceBoundary({ levels, size, origin, axes, voxel }) {
  const [nx, ny, nz] = size, strides = [ny * nz, nz, 1], corners = [], tints = [];
  const world = (index) => [0, 1, 2].map((k) =>
    origin[k] + voxel * (index[0] * axes[0][k] + index[1] * axes[1][k] + index[2] * axes[2][k]));
  const square = (at, axis, tint) => {
    const [u, v] = [0, 1, 2].filter((other) => other !== axis);
    const ring = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([a, b]) => {
      const index = at.slice();
      index[u] += a;
      index[v] += b;
      return world(index);
    });
    for (const k of [0, 1, 2, 0, 2, 3]) {
      corners.push(...ring[k]);
      tints.push(...tint);
    }
  };
  for (let i = 0; i < nx; i += 1) for (let j = 0; j < ny; j += 1) for (let k = 0; k < nz; k += 1) {
    const at = [i, j, k], place = i * strides[0] + j * strides[1] + k;
    if (levels[place] < FREE_FROM) continue;
    for (let axis = 0; axis < 3; axis += 1) for (const step of [-1, 1]) {
      const there = at[axis] + step, outside = there < 0 || there >= size[axis];
      const beside = outside ? 0 : levels[place + step * strides[axis]];
      if (beside >= FREE_FROM) continue;
      const corner = at.slice();
      if (step > 0) corner[axis] += 1;
      square(corner, axis, beside === 1 ? WALL_TINT : UNSEEN_TINT);
    }
  }
  return { corners: new Float32Array(corners), tints: new Float32Array(tints) };
}

// The slice: a plane at one z-depth of the view, looked up in a table of the grid.
class ClearanceSlice {
  constructor(renderer, shaders, grid) {
    const { gl } = renderer;
    this.renderer = renderer;
    this.grid = grid;
    this.program = program(gl, shaders["screen.vert"], shaders["slice.frag"]);
    const clearance = Uint8Array.from(grid.levels, (level) => (level < FREE_FROM ? 0 : level));
    this.table = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_3D, this.table);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, ...grid.size.slice().reverse(), 0, gl.RED, gl.UNSIGNED_BYTE, clearance);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
    for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${name}`], gl.LINEAR);
    for (const side of ["S", "T", "R"]) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_WRAP_${side}`], gl.CLAMP_TO_EDGE);
  }

  draw(pose, state, depth) {
    const { gl, size } = this.renderer, { made, places } = this.program, { origin, axes, voxel } = this.grid;
    // From the camera into the table, whose last axis runs fastest: its coordinates come in turned order.
    const turn = new Float32Array(9), shift = new Float32Array(3);
    for (let k = 0; k < 3; k += 1) {
      const axis = axes[2 - k], share = 1 / (voxel * this.grid.size[2 - k]);
      for (let c = 0; c < 3; c += 1) turn[3 * c + k] = share * dot3(axis, column(pose, c));
      shift[k] = share * dot3(axis, add(column(pose, 3), origin, -1));
    }
    gl.useProgram(made);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_3D, this.table);
    gl.uniform1i(places.table, 0);
    gl.uniformMatrix3fv(places.turn, false, turn);
    gl.uniform3fv(places.shift, shift);
    gl.uniform4fv(places.K, state.K);
    gl.uniform2fv(places.size, size);
    gl.uniform1f(places.depth, depth);
    gl.uniform1f(places.least, FREE_FROM / 2 + (253 * 0.25 * voxel) / this.grid.largest);
    gl.bindVertexArray(this.renderer.empty);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
  }
}
