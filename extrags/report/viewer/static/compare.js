// Two pictures of a held-out view on each other, divided by a line that can be moved. They are those of the page.
function comparison(root) {
  const rows = [...document.querySelectorAll("#held-out .view")].filter((row) => row.querySelectorAll("figure").length > 1);
  if (!rows.length) return;
  root.hidden = false;
  const part = (name) => root.querySelector(`[data-part="${name}"]`);
  const [view, left, right, place] = ["view", "left", "right", "divide"].map(part);
  const [under, over] = [part("under"), part("over")].map((box) => box.appendChild(document.createElement("img")));
  rows.forEach((row, k) => view.append(new Option(row.querySelector("h3").firstChild.textContent, k)));
  const cells = () => [...rows[Number(view.value)].querySelectorAll("figure")];
  const labels = cells().map((cell) => cell.querySelector("figcaption").textContent);
  labels.forEach((label, k) => { left.append(new Option(label, k)); right.append(new Option(label, k)); });
  // The first two are renders, or a render and the truth.
  left.value = 0;
  right.value = 1;
  const show = () => {
    const shown = cells();
    for (const [picture, chosen] of [[over, left], [under, right]]) {
      const from = shown[Number(chosen.value)].querySelector("img");
      picture.src = from.src;
      picture.alt = from.alt;
    }
  };
  const divide = () => {
    part("over").style.clipPath = `inset(0 ${100 - place.value}% 0 0)`;
    part("line").style.left = `${place.value}%`;
  };
  [view, left, right].forEach((input) => input.addEventListener("change", show));
  place.addEventListener("input", divide);
  show();
  divide();
}
