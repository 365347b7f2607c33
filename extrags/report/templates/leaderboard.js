// Sorting and filtering of the tables that stand in the page.
(() => {
  const value = (row, column) => {
    const cell = row.cells[column];
    return cell.dataset.value !== undefined ? cell.dataset.value : cell.textContent.trim();
  };
  const sort = (table, column, sign) => {
    const body = table.tBodies[0];
    const numeric = table.tHead.rows[0].cells[column].classList.contains("n");
    const rows = [...body.rows].map((row) => [value(row, column), row]);
    rows.sort(([one], [other]) => {
      // What is missing stands last, whichever way is sorted.
      if (one === "" || other === "") return (one === "") - (other === "");
      return sign * (numeric ? Number(one) - Number(other) : one.localeCompare(other, undefined, { numeric: true }));
    });
    body.append(...rows.map(([, row]) => row));
  };
  for (const table of document.querySelectorAll("table.sortable")) {
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const first = head.classList.contains("n") ? "descending" : "ascending";
        const other = first === "ascending" ? "descending" : "ascending";
        const order = head.getAttribute("aria-sort") === first ? other : first;
        for (const cell of table.tHead.rows[0].cells) cell.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", order);
        sort(table, column, order === "ascending" ? 1 : -1);
      });
    });
  }
  const chosen = (form) => Object.fromEntries([...form.querySelectorAll("[data-choose]")].map((input) => [input.dataset.choose, input.value]));
  const filter = (form, rows, among) => {
    const wanted = Object.entries(chosen(form)).filter(([name, text]) => text && among.includes(name));
    const part = form.querySelector("[data-search]").value.trim().toLowerCase();
    let shown = 0;
    for (const row of rows) {
      row.hidden = !wanted.every(([name, text]) => row.dataset[name] === text) || !row.dataset.sequence.toLowerCase().includes(part);
      shown += !row.hidden;
    }
    return shown;
  };
  const boards = document.querySelector('[data-for="boards"]');
  if (boards) {
    const show = () => {
      const { figure, profile } = chosen(boards);
      let any = false;
      for (const board of document.querySelectorAll(".board")) {
        board.hidden = board.dataset.figure !== figure || (profile !== undefined && board.dataset.profile !== profile);
        any ||= !board.hidden;
        filter(boards, board.querySelectorAll("tbody tr"), ["dataset"]);
        // A mean over all would be taken for one over those that are shown.
        const foot = board.querySelector("tfoot");
        if (foot) foot.hidden = [...board.querySelectorAll("tbody tr")].some((row) => row.hidden);
      }
      document.querySelector('[data-part="none"]').hidden = any;
    };
    boards.hidden = false;
    boards.addEventListener("input", show);
    show();
  }
  const runs = document.querySelector('[data-for="runs"]');
  if (runs) {
    const rows = [...document.querySelectorAll("#runs tbody tr")];
    const show = () => {
      const shown = filter(runs, rows, ["dataset", "method", "profile", "status"]);
      runs.querySelector('[data-part="count"]').textContent = `${shown} of ${rows.length} runs`;
    };
    runs.hidden = false;
    runs.addEventListener("input", show);
    show();
  }
})();
