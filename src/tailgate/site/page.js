"use strict";
(() => {
  const order = new Intl.Collator("en", { numeric: true });

  const key = (row, column) => {
    // a cell without figures spans the rest of its row: such rows stay last
    const cell = row.cells[Math.min(column, row.cells.length - 1)];
    return "sort" in cell.dataset ? cell.dataset.sort : cell.textContent.trim();
  };

  const compare = (a, b) => {
    if (a === b) return 0;
    const numbers = Number(a) - Number(b);
    return Number.isNaN(numbers) ? order.compare(a, b) : numbers;
  };

  const sortable = (table) => {
    const heads = [...table.tHead.rows[0].cells];
    const body = table.tBodies[0];
    heads.forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = head.textContent;
      head.replaceChildren(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((other) => other.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const rows = [...body.rows].map((row) => [key(row, column), row]);
        rows.sort(([a], [b]) => (a === "") - (b === "") || (down ? compare(b, a) : compare(a, b)));
        body.append(...rows.map(([, row]) => row));
      });
    });
  };

  const filterable = (section, table) => {
    const box = section.querySelector(".filters");
    const find = box.querySelector(".find");
    const menus = [...box.querySelectorAll(".by")];
    const rows = [...table.tBodies[0].rows].map((row) => [row, `${row.cells[0].textContent} ${row.cells[1].textContent}`.toLowerCase()]);
    const apply = () => {
      const words = find.value.toLowerCase().split(/\s+/).filter(Boolean);
      let shown = 0;
      for (const [row, text] of rows) {
        const fits = menus.every((menu) => !menu.value || row.dataset[menu.dataset.key] === menu.value);
        row.hidden = !(fits && words.every((word) => text.includes(word)));
        shown += !row.hidden;
      }
      box.querySelector("output").textContent = `${shown} of ${rows.length} cells`;
    };
    find.addEventListener("input", apply);
    menus.forEach((menu) => menu.addEventListener("change", apply));
    box.hidden = false;
    apply();
  };

  for (const section of document.querySelectorAll(".board")) {
    const table = section.querySelector("table.cells");
    sortable(table);
    filterable(section, table);
  }
})();
