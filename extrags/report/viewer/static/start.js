// Decoding begins when the viewer comes near the window, or when a script asks for `ready`.
function started() {
  const compare = document.getElementById("compare");
  if (compare) comparison(compare);
  const root = document.getElementById("viewer");
  if (!root) return;
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  let begun = null;
  const begin = () => {
    if (!begun) {
      begun = (async () => {
        const text = document.getElementById("viewer-sorter").textContent;
        const worker = new Worker(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
        const viewer = new Viewer(root, read("viewer-data"), read("viewer-shaders"), worker);
        viewer.light = { on: false };
        await viewer.load();
        connected(viewer);
        root.dataset.state = "ready";
        root.querySelector('[data-part="notice"]').hidden = true;
        window.extragsViewer.viewer = viewer;
        return viewer;
      })();
      begun.catch((error) => {
        root.dataset.state = "failed";
        root.querySelector('[data-part="notice"]').textContent = `The scene cannot be shown: ${error.message}. All figures of the page stand without it.`;
      });
    }
    return begun;
  };
  window.extragsViewer = { get ready() { return begin(); }, viewer: null };
  new IntersectionObserver((entries, observer) => {
    if (entries.some((entry) => entry.isIntersecting)) {
      observer.disconnect();
      begin();
    }
  }, { rootMargin: "300px" }).observe(root);
}
started();
