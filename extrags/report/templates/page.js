// What every page does where scripts run; nothing on it is out of reach without them.
(() => {
  // A picture is saved from where it stands: its bytes are in the page once.
  for (const place of document.querySelectorAll("[data-save]")) {
    const link = document.createElement("a");
    const image = place.closest("figure").querySelector("img");
    link.href = image.src;
    link.download = place.dataset.save;
    link.textContent = "SVG";
    link.setAttribute("aria-label", `SVG of this chart: ${image.alt}`);
    place.prepend(link, " ");
  }
  // What scrolls must be reachable with the keyboard.
  const reachable = () => {
    for (const box of document.querySelectorAll(".scroll, .chart, nav ul")) {
      if (box.scrollWidth > box.clientWidth + 1) box.tabIndex = 0;
      else box.removeAttribute("tabindex");
    }
  };
  reachable();
  addEventListener("resize", reachable);
  // On paper nothing can be unfolded.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("details:not([open])")];
    for (const part of folded) part.open = true;
    for (const image of document.querySelectorAll('img[loading="lazy"]')) image.loading = "eager";
  });
  addEventListener("afterprint", () => {
    for (const part of folded) part.open = false;
  });
})();
