// Pointer, touch, keys and the form round the canvas.
function connected(viewer) {
  const { root, canvas, data } = viewer;
  const part = (name) => root.querySelector(`[data-part="${name}"]`);
  const said = part("status"), speed = part("speed");

  const pointers = new Map();
  let travelled = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    travelled = 0;
    viewer.stop();
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    pointers.set(event.pointerId, now);
    travelled += Math.abs(dx) + Math.abs(dy);
    const turn = 3 / canvas.clientHeight;
    if (others.length) {
      const apart = (place) => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]);
      viewer.move([-0.5 * turn * dx, -0.5 * turn * dy, 1.2 * Math.log(Math.max(apart(now), 1) / Math.max(apart(before), 1))]);
    } else if (event.shiftKey || event.buttons & 2) viewer.move([-turn * dx * 0.5, -turn * dy * 0.5, 0]);
    else if (event.ctrlKey || event.altKey || root.querySelector('[name="drag"]:checked').value === "look") {
      viewer.look(-turn * dx * 0.5, -turn * dy * 0.5);
    } else viewer.orbit(turn * dx, turn * dy * -1);
  });
  const released = (event) => {
    if (!pointers.delete(event.pointerId) || travelled > 6 || event.type === "pointercancel") return;
    const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
    const found = viewer.pick((event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio, 16 * ratio);
    if (found) viewer.jump(found.group, found.index);
  };
  canvas.addEventListener("pointerup", released);
  canvas.addEventListener("pointercancel", released);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    // The page scrolls until the viewer has been chosen.
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    viewer.move([0, 0, -0.001 * event.deltaY]);
  }, { passive: false });

  const neighbour = (step) => {
    const at = viewer.camera || viewer.lastCamera || { group: 0, index: -step };
    viewer.jump(at.group, at.index + step);
  };
  const hasFree = Boolean(data.free), toggled = (what) => hasFree && viewer.show(what, !viewer.shown[what]);
  const slid = (factor) => hasFree && viewer.setSlice(factor * viewer.sliceDepth);
  const keys = {
    ArrowLeft: () => viewer.orbit(-0.06, 0), ArrowRight: () => viewer.orbit(0.06, 0),
    ArrowUp: () => viewer.orbit(0, -0.06), ArrowDown: () => viewer.orbit(0, 0.06),
    w: () => viewer.move([0, 0, 0.06]), s: () => viewer.move([0, 0, -0.06]),
    a: () => viewer.move([-0.06, 0, 0]), d: () => viewer.move([0.06, 0, 0]),
    e: () => viewer.move([0, -0.06, 0]), c: () => viewer.move([0, 0.06, 0]),
    q: () => viewer.roll(-0.06), r: () => viewer.roll(0.06),
    j: () => viewer.look(-0.06, 0), l: () => viewer.look(0.06, 0),
    i: () => viewer.look(0, 0.06), k: () => viewer.look(0, -0.06),
    "+": () => viewer.move([0, 0, 0.06]), "-": () => viewer.move([0, 0, -0.06]),
    f: () => toggled("free"), x: () => toggled("slice"),
    b: () => viewer.scene.sided && viewer.show("one_sided", !viewer.shown.one_sided),
    "[": () => slid(1 / 1.1), "]": () => slid(1.1),
    n: () => neighbour(1), p: () => neighbour(-1), Home: () => viewer.jump(0, 0), " ": () => part("play").click(),
  };
  canvas.addEventListener("keydown", (event) => {
    const does = keys[event.key];
    if (!does || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    if (event.key !== " ") viewer.stop();
    does();
  });

  root.querySelectorAll('[name="scene"]').forEach((input) => {
    input.addEventListener("change", () => viewer.setScene(input.value));
  });
  const quantity = part("quantity"), legend = part("legend");
  let listed = null;
  const quantities = () => {
    listed = `${viewer.name} ${viewer.quantity}`;
    quantity.replaceChildren(new Option("Colour", ""), ...viewer.scene.quantities_shown.map(({ name, title }) => new Option(title, name)));
    quantity.value = viewer.quantity;
    const item = viewer.scene.quantities_shown.find(({ name }) => name === viewer.quantity);
    legend.hidden = !item;
    if (item) [legend.firstElementChild.textContent, legend.lastElementChild.textContent] = item.ends;
  };
  quantity.addEventListener("change", () => viewer.setQuantity(quantity.value));

  const cameras = part("camera");
  data.groups.forEach((group, g) => {
    const list = document.createElement("optgroup");
    list.label = group.title;
    group.cameras.forEach(({ name }, index) => list.append(new Option(name, `${g} ${index}`)));
    cameras.append(list);
  });
  cameras.addEventListener("change", () => {
    viewer.stop();
    if (cameras.value) viewer.jump(...cameras.value.split(" ").map(Number));
  });
  part("previous").addEventListener("click", () => neighbour(-1));
  part("next").addEventListener("click", () => neighbour(1));

  const path = part("path"), play = part("play"), place = part("place");
  data.paths.forEach(({ title }, k) => path.append(new Option(title, k)));
  const ends = () => { place.max = data.paths[path.value].poses.length - 1; };
  path.addEventListener("change", () => { viewer.stop(); ends(); place.value = 0; viewer.seek(Number(path.value), 0); });
  place.addEventListener("input", () => { viewer.stop(); viewer.seek(Number(path.value), Number(place.value)); });
  play.addEventListener("click", () => {
    if (viewer.flight) viewer.stop();
    else viewer.play(Number(path.value), Number(place.value) >= Number(place.max) ? 0 : Number(place.value));
  });
  if (data.paths.length) ends();

  const sliders = root.querySelectorAll("[data-light]");
  const worded = (input) => { input.nextElementSibling.textContent = Number(input.value).toFixed(2); };
  sliders.forEach((input) => input.addEventListener("input", () => {
    const name = input.dataset.light, value = Number(input.value);
    if (name === "exposure") viewer.setLight({ exposure: 2 ** value });
    else if (name.startsWith("offset")) {
      const offset = viewer.light.offset.slice();
      offset[Number(name.slice(-1))] = value;
      viewer.setLight({ offset });
    } else viewer.setLight({ [name]: value });
  }));
  part("lit").addEventListener("change", (event) => viewer.setLight({ on: event.target.checked }));
  part("pinned").addEventListener("change", (event) => viewer.pinLamp(event.target.checked));
  part("reset").addEventListener("click", () => viewer.resetLight());
  root.querySelectorAll("[data-show]").forEach((input) => {
    input.addEventListener("change", () => viewer.show(input.dataset.show, input.checked));
  });
  const cut = part("slice");
  if (cut) {
    cut.max = 4 * data.distance;
    cut.step = data.distance / 100;
    cut.addEventListener("input", () => viewer.setSlice(Number(cut.value)));
    part("largest").textContent = `${data.free.largest.toPrecision(3)} ${data.free.unit}`;
  }
  part("full").addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else root.requestFullscreen();
  });

  viewer.onchange = () => {
    const { camera, light } = viewer;
    if (camera) viewer.lastCamera = camera;
    cameras.value = camera ? `${camera.group} ${camera.index}` : "";
    const where = camera ? `${data.groups[camera.group].title}, ${data.groups[camera.group].cameras[camera.index].name}` : "free view";
    const over = [viewer.shown.free && "free space", viewer.shown.slice && `clearance at ${viewer.sliceDepth.toPrecision(3)} ${data.free.unit}`];
    const told = [where, ...over.filter(Boolean)].join(", ");
    if (said.textContent !== told) said.textContent = told;
    play.textContent = viewer.flight ? "Pause" : "Play";
    if (viewer.progress && Number(path.value) === viewer.progress.path && !camera) place.value = viewer.progress.at;
    sliders.forEach((input) => {
      const name = input.dataset.light;
      if (name === "exposure") input.value = Math.log2(light.exposure);
      else input.value = name.startsWith("offset") ? light.offset[Number(name.slice(-1))] : light[name];
      input.disabled = !light.on;
      worded(input);
    });
    root.querySelectorAll('[name="scene"]').forEach((input) => { input.checked = input.value === viewer.name; });
    if (listed !== `${viewer.name} ${viewer.quantity}`) quantities();
    root.querySelectorAll("[data-show]").forEach((input) => { input.checked = viewer.shown[input.dataset.show]; });
    root.querySelectorAll("[data-legend]").forEach((item) => { item.hidden = !viewer.shown[item.dataset.legend]; });
    if (cut) {
      cut.value = viewer.sliceDepth;
      cut.nextElementSibling.textContent = viewer.sliceDepth.toPrecision(3);
    }
    const sided = root.querySelector('[data-show="one_sided"]');
    if (sided) sided.disabled = !viewer.scene.sided;
    part("lit").checked = light.on;
    part("lit").disabled = !viewer.scene.light;
    part("pinned").checked = Boolean(viewer.lampPose);
  };
  window.setInterval(() => {
    const now = performance.now(), recent = viewer.frames.filter((time) => now - time < 1000).length;
    speed.textContent = recent > 2 ? `${recent} pictures/s` : "";
  }, 1000);
  viewer.onchange();
}
