// The viewer: what is shown from where, and under which light. `window.extragsViewer` is its interface for scripts.
const SLOW_MS = 90;
const REST_MS = 350;

class Viewer {
  constructor(root, data, shaders, worker) {
    this.root = root;
    this.data = data;
    this.canvas = root.querySelector("canvas");
    this.renderer = new Renderer(this.canvas, shaders);
    this.worker = worker;
    this.shaders = shaders;
    this.scenes = {};
    this.name = data.scenes[data.scenes.length - 1].name;
    this.camera = { group: 0, index: 0 };
    this.K = data.groups[0].cameras[0].K;
    this.pose = data.groups[0].cameras[0].pose;
    this.light = null;
    this.lampPose = null;
    this.quantity = "";
    this.shown = { train: false, held_out: false, virtual: false, mesh: false, free: false, slice: false, one_sided: true };
    this.shapes = {};
    this.clearance = null;
    this.sliceDepth = data.distance;
    this.native = false;
    this.sorting = false;
    this.wanted = true;
    this.waiting = [];
    this.flight = null;
    this.frames = [];
    this.coarseness = 1;
    this.sharpening = 0;
    this.onchange = () => {};
    worker.onmessage = (event) => this.sorted(event.data);
  }

  async load() {
    for (const header of this.data.scenes) {
      const scene = await decodedScene(header);
      this.worker.postMessage({ scene: scene.name, means: scene.means, sides: scene.sides });
      scene.sides = null;
      this.renderer.upload(scene);
      this.scenes[scene.name] = scene;
    }
    this.makeShapes();
    if (this.data.free) {
      const grid = await decodedFreeSpace(this.data.free), { corners, tints } = freeSpaceBoundary(grid);
      this.shapes.free = this.renderer.makeShape(corners, tints, this.renderer.gl.TRIANGLES);
      this.clearance = new ClearanceSlice(this.renderer, this.shaders, grid);
    }
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => window.location.reload());
    new ResizeObserver(() => this.change()).observe(this.canvas);
    this.resetLight();
    return this.jump(0, 0);
  }

  get scene() { return this.scenes[this.name]; }

  sceneLight() {
    const light = this.scene.light;
    const exposures = this.camera ? this.data.groups[this.camera.group].cameras[this.camera.index].exposure : null;
    const exposure = (exposures && exposures[this.name]) || 1;
    return light ? { ...light, home: light.offset, on: true, exposure }
      : { on: false, exposure: 1, softening: 1, exponent: 0, spread: 0, cosine: 0, offset: [0, 0, 0], home: [0, 0, 0], shoulder: 0, specular: 0, roughness: 1, glare: [0, 0, 0], reference: 1 };
  }

  resetLight() {
    this.light = this.sceneLight();
    this.lampPose = null;
    return this.change();
  }

  setLight(values) {
    Object.assign(this.light, values);
    return this.change();
  }

  pinLamp(pinned) {
    this.lampPose = pinned ? this.pose.slice() : null;
    return this.change();
  }

  setScene(name) {
    this.name = name;
    this.sceneChanged = true;
    if (this.quantity && !this.scene.quantities_shown.some((item) => item.name === this.quantity)) this.quantity = "";
    this.light = this.sceneLight();
    return this.change();
  }

  setQuantity(name) {
    this.quantity = name;
    return this.change();
  }

  show(what, on) {
    this.shown[what] = on;
    return this.change();
  }

  // Where the slice of clearance lies: z-depth before the camera.
  setSlice(depth) {
    this.sliceDepth = Math.min(Math.max(depth, this.data.near), 4 * this.data.distance);
    this.shown.slice = true;
    return this.change();
  }

  // Into a camera of the run, at its exposure.
  jump(group, index) {
    const cameras = this.data.groups[group].cameras;
    index = ((index % cameras.length) + cameras.length) % cameras.length;
    this.camera = { group, index };
    this.pose = cameras[index].pose.slice();
    this.K = cameras[index].K;
    this.light.exposure = this.sceneLight().exposure;
    return this.change();
  }

  get target() { return add(column(this.pose, 3), column(this.pose, 2), this.data.distance); }

  orbit(across, up) {
    const about = this.target;
    this.pose = turned(this.pose, column(this.pose, 1), -across, about);
    this.pose = turned(this.pose, column(this.pose, 0), up, about);
    return this.left();
  }

  look(across, up) {
    const about = column(this.pose, 3);
    this.pose = turned(this.pose, column(this.pose, 1), across, about);
    this.pose = turned(this.pose, column(this.pose, 0), -up, about);
    return this.left();
  }

  roll(angle) {
    this.pose = turned(this.pose, column(this.pose, 2), angle, column(this.pose, 3));
    return this.left();
  }

  move(step) {
    this.pose = moved(this.pose, step.map((share) => share * this.data.distance));
    return this.left();
  }

  left() {
    this.camera = null;
    return this.change();
  }

  // Flight along the poses of a path; resolves when it has ended or was stopped.
  play(path, from = 0, rate = 6) {
    this.stop();
    return new Promise((resolve) => {
      this.flight = { path, at: from, rate, resolve, then: performance.now() };
      this.step(this.flight);
    });
  }

  step(flight) {
    if (this.flight !== flight) return;
    const now = performance.now(), { poses } = this.data.paths[flight.path];
    // A slow machine shows all of the path, slower.
    flight.at += flight.rate * Math.min(0.1, (now - flight.then) / 1000);
    flight.then = now;
    const ended = flight.at >= poses.length - 1;
    this.seek(flight.path, flight.at).then(() => {
      if (ended) this.stop();
      else window.requestAnimationFrame(() => this.step(flight));
    });
  }

  seek(path, at) {
    this.pose = alongPath(this.data.paths[path].poses, at);
    this.progress = { path, at };
    return this.left();
  }

  stop() {
    const flight = this.flight;
    this.flight = null;
    if (flight) flight.resolve(flight.at);
    this.onchange();
  }

  state() {
    const first = this.data, [fx, fy, cx, cy] = this.K;
    const { width, height } = this.canvas;
    const scale = Math.min(width / first.width, height / first.height);
    const K = [fx * scale, fy * scale, cx * scale + (width - first.width * scale) / 2,
      cy * scale + (height - first.height * scale) / 2];
    const item = this.scene.quantities_shown.findIndex(({ name }) => name === this.quantity);
    return {
      view: viewMatrix(this.pose), lamp: viewMatrix(this.lampPose || this.pose), eye: column(this.pose, 3), K,
      // Larger pictures show what the training images showed, enlarged.
      dilation: first.dilation * Math.max(1, scale * scale),
      near: first.near, far: 1000 * first.distance, light: this.light, shade: item + 1,
    };
  }

  fit() {
    const { canvas, data } = this, ratio = Math.min(2, window.devicePixelRatio || 1) / this.coarseness;
    const width = this.native ? data.width : Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = this.native ? data.height : Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
  }

  // Ask for a new picture; resolves when it has been drawn with an order of its own.
  change() {
    this.wanted = true;
    this.onchange();
    const drawn = new Promise((resolve) => this.waiting.push(resolve));
    this.sort();
    return drawn;
  }

  sort() {
    if (this.sorting || !this.wanted || !this.scene || !this.light) return;
    this.wanted = false;
    this.sorting = true;
    this.answered = this.waiting;
    this.waiting = [];
    const view = viewMatrix(this.pose);
    this.pending = { name: this.name };
    this.worker.postMessage({
      scene: this.name, near: this.data.near, row: [view[2], view[6], view[10], view[14]],
      behind: this.data.behind, eye: this.shown.one_sided ? column(this.pose, 3) : null,
    });
  }

  sorted({ scene, order }) {
    if (scene === this.name) {
      this.renderer.setOrder(order);
      if (this.native) this.draw();
      else this.paced();
    } else {
      this.wanted = true;
    }
    this.sorting = false;
    if (this.wanted && scene !== this.name) this.waiting.push(...this.answered);
    else this.answered.forEach((resolve) => resolve());
    this.sort();
  }

  // A slow machine draws fewer pixels while the view moves, and all of them when it has come to rest.
  paced() {
    const { gl } = this.renderer, begun = performance.now();
    this.draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    const took = performance.now() - begun;
    if (took > SLOW_MS && this.coarseness < 4) this.coarseness *= 2;
    else if (took < SLOW_MS / 6 && this.coarseness > 1) this.coarseness /= 2;
    window.clearTimeout(this.sharpening);
    if (this.coarseness > 1) this.sharpening = window.setTimeout(() => this.sharp(), REST_MS);
  }

  sharp() {
    const { coarseness } = this;
    this.coarseness = 1;
    if (!this.sorting) this.draw();
    this.coarseness = coarseness;
  }

  draw() {
    this.fit();
    const state = this.state(), { renderer } = this;
    renderer.drawSplats(this.scene, state);
    if (this.shown.mesh && this.shapes.mesh) renderer.drawShape(this.shapes.mesh, state, 0.6);
    if (this.shown.free && this.shapes.free) renderer.drawShape(this.shapes.free, state, 0.55);
    if (this.shown.slice && this.clearance) this.clearance.draw(this.pose, state, this.sliceDepth);
    this.data.groups.forEach((group, k) => {
      if (this.shown[group.kind]) renderer.drawShape(this.shapes[k], state, 0.9);
    });
    const now = performance.now();
    this.frames = this.frames.filter((time) => now - time < 1000);
    this.frames.push(now);
  }

  makeShapes() {
    const { gl } = this.renderer, { data } = this;
    data.groups.forEach((group, k) => {
      const lines = [], size = 0.12 * data.distance;
      let last = null;
      for (const { pose, K } of group.cameras) {
        const centre = column(pose, 3);
        const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([x, y]) => {
          const ray = [(x * data.width - K[2]) / K[0], (y * data.height - K[3]) / K[1], 1];
          return add(column(moved(pose, ray.map((value) => (value * size) / Math.hypot(...ray))), 3), [0, 0, 0]);
        });
        corners.forEach((corner, side) => lines.push(centre, corner, corner, corners[(side + 1) % 4]));
        if (last && group.kind !== "held_out") lines.push(last, centre);
        last = centre;
      }
      const tints = lines.flatMap(() => group.color);
      this.shapes[k] = this.renderer.makeShape(new Float32Array(lines.flat()), new Float32Array(tints), gl.LINES);
    });
    if (data.mesh) {
      const raw = Uint8Array.from(atob(data.mesh.corners), (letter) => letter.charCodeAt(0));
      const levels = new Uint16Array(raw.buffer), { low, step } = data.mesh;
      const corners = Float32Array.from(levels, (level, k) => low[k % 3] + level * step[k % 3]);
      const tints = new Float32Array(corners.length).map((_, k) => [0.86, 0.74, 0.68][k % 3]);
      this.shapes.mesh = this.renderer.makeShape(corners, tints, gl.TRIANGLES);
    }
  }

  // The camera whose centre is drawn nearest to a place of the canvas, of those shown; null when none is near.
  pick(x, y, reach) {
    const { view, K, near } = this.state();
    let best = null, least = reach;
    this.data.groups.forEach((group, g) => {
      if (!this.shown[group.kind]) return;
      group.cameras.forEach(({ pose }, index) => {
        const c = column(pose, 3);
        const t = [0, 1, 2].map((k) => view[k] * c[0] + view[4 + k] * c[1] + view[8 + k] * c[2] + view[12 + k]);
        if (t[2] < near) return;
        const away = Math.hypot((K[0] * t[0]) / t[2] + K[2] - x, (K[1] * t[1]) / t[2] + K[3] - y);
        if (away < least) [best, least] = [{ group: g, index }, away];
      });
    });
    return best;
  }

  // The picture as PNG; `native`: with the pixels of the run's images.
  async picture(native = false) {
    this.native = native;
    await this.change();
    this.draw();
    const url = this.canvas.toDataURL("image/png");
    this.native = false;
    await this.change();
    return url;
  }

  // Pictures per second over so many, each with an order and a direction of its own.
  async speed(pictures = 20) {
    const pose = this.pose.slice(), pixel = new Uint8Array(4), { gl } = this.renderer;
    const begun = performance.now();
    for (let k = 0; k < pictures; k += 1) {
      await this.look(k < pictures / 2 ? 0.02 : -0.02, 0);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    }
    const seconds = (performance.now() - begun) / 1000;
    this.pose = pose;
    await this.change();
    return pictures / seconds;
  }
}
