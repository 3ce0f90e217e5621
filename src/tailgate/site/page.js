"use strict";
(() => {
  const order = new Intl.Collator("en", { numeric: true });

  const key = (row, column, level) => {
    const cell = row.cells[Math.min(column, row.cells.length - 1)];
    return cell.dataset[level] ?? cell.dataset.sort ?? cell.textContent.trim();
  };

  const compare = (a, b) => {
    if (a === b) return 0;
    const numbers = Number(a) - Number(b);
    return Number.isNaN(numbers) ? order.compare(a, b) : numbers;
  };

  // groups keep their places and their heads; within each the rows are sorted, those without a figure last
  // (a cell without figures spans the rest of its row)
  const arrange = (table) => {
    const heads = [...table.tHead.rows[0].cells];
    const column = heads.findIndex((head) => head.getAttribute("aria-sort") !== "none");
    if (column < 0) return;
    const down = heads[column].getAttribute("aria-sort") === "descending";
    for (const body of table.tBodies) {
      const rows = [...body.rows].filter((row) => !row.classList.contains("group")).map((row) => [key(row, column, table.dataset.knows), row]);
      const none = (text) => text === "" || text === "\u2013";
      rows.sort(([a], [b]) => none(a) - none(b) || (down ? compare(b, a) : compare(a, b)));
      body.append(...rows.map(([, row]) => row));
    }
  };

  const sortable = (table) => {
    const heads = [...table.tHead.rows[0].cells];
    for (const head of heads) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = head.textContent;
      head.replaceChildren(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((other) => other.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        arrange(table);
      });
    }
  };

  // a row of the table goes with its row of the heat map; a group without rows goes too
  const filterable = (box, section) => {
    const table = box.nextElementSibling.querySelector("table");
    const find = box.querySelector(".find");
    const menus = [...box.querySelectorAll(".by")];
    const rows = [...table.tBodies].flatMap((body) => [...body.rows]).filter((row) => !row.classList.contains("group"));
    const searched = Number(box.dataset.searched); // cells at the start of a row
    const wordsOf = (row) => [...row.cells].slice(0, searched).map((cell) => cell.textContent).join(" ");
    const texts = new Map(rows.map((row) => [row, wordsOf(row).toLowerCase()]));
    const apply = () => {
      const words = find.value.toLowerCase().split(/\s+/).filter(Boolean);
      const shown = new Set(rows.filter((row) => {
        const fits = menus.every((menu) => !menu.value || row.dataset[menu.dataset.key] === menu.value);
        return fits && words.every((word) => texts.get(row).includes(word));
      }));
      for (const row of rows) row.hidden = !shown.has(row);
      const kept = new Set([...shown].map((row) => row.dataset.row));
      for (const row of section.querySelectorAll(".map tr[data-row]")) row.hidden = !kept.has(row.dataset.row);
      for (const body of section.querySelectorAll(".ranks tbody, .map tbody")) body.hidden = !body.querySelector("tr[data-row]:not([hidden])");
      box.querySelector("output").textContent = `${shown.size} of ${rows.length} ${box.dataset.noun}`;
    };
    find.addEventListener("input", apply);
    menus.forEach((menu) => menu.addEventListener("change", apply));
    const knows = box.querySelector(".knows");
    knows?.addEventListener("change", () => {
      table.dataset.knows = knows.value;
      arrange(table);
    });
    apply();
  };

  const percent = (value) => {
    if (value === 0 || value === 1 || (value >= 0.005 && value < 0.995)) return `${even(100 * value, 0)}%`;
    if (value < 0.0005 || value > 0.9995) return value < 0.5 ? "<0.1%" : ">99.9%";
    return `${even(100 * value, 1)}%`;
  };

  // halves go to the even digit, as in the page as it was written
  const even = (value, digits) => {
    const scaled = value * 10 ** digits;
    const down = Math.floor(scaled);
    const up = scaled - down > 0.5 || (scaled - down === 0.5 && down % 2 === 1);
    return ((down + up) / 10 ** digits).toFixed(digits);
  };

  const mapped = (section) => {
    const table = section.querySelector(".map");
    const data = JSON.parse(section.querySelector(".figures").textContent);
    const scenario = section.querySelector(".pick .scenario");
    const dose = section.querySelector(".pick .dose");
    const rows = [...table.querySelectorAll("tr[data-row]")];

    const worse = (cells) => {
      const there = cells.filter(Boolean);
      const known = there.filter((cell) => cell[0] !== null);
      return known.length ? known.reduce((a, b) => (b[0] > a[0] ? b : a)) : there[0];
    };

    const put = (td, cell) => {
      const first = td.classList.contains("worst");
      const [value, low, high, n, failed, reason] = cell || [null, 0, 0, 0, 0, 0];
      const why = data.reasons[reason];
      let text = "n/a";
      let label = ["not played", "failed", "skipped"][!why && !failed ? 0 : failed ? 1 : 2] + (why ? `: ${why}` : "");
      td.className = "na";
      if (value !== null) {
        text = percent(value) + (failed ? "†" : "");
        label = `${percent(low)} to ${percent(high)}, ${n} episodes` + (failed ? `; ${failed} more failed: ${why}` : "");
        td.className = `s${Math.ceil(Math.min(Math.max(value, 0), 1) * 10 - 1e-9)}${value > data.limit ? " over" : ""}`;
      }
      td.classList.toggle("worst", first);
      td.title = label;
      const spoken = document.createElement("span");
      spoken.className = "sr";
      spoken.textContent = `, ${label}`;
      td.replaceChildren(text, spoken);
    };

    const draw = () => {
      const chosen = Number(scenario.value) < 0 ? [...Array(data.scenarios).keys()] : [Number(scenario.value)];
      for (const row of rows) {
        const start = Number(row.dataset.row) * data.columns;
        const cells = data.apart.map((_, c) => worse(chosen.map((s) => data.figures[s * data.doses + Number(dose.value)][start + c])));
        put(row.cells[1], worse(cells.filter((_, c) => !data.apart[c])));
        cells.forEach((cell, c) => put(row.cells[c + 2], cell));
      }
      const place = Number(scenario.value) < 0 ? "worst of all scenarios" : scenario.selectedOptions[0].textContent;
      section.querySelector(".told").textContent = `${place}, ${dose.selectedOptions[0].textContent} attacked steps`;
    };
    scenario.addEventListener("change", draw);
    dose.addEventListener("change", draw);
  };

  for (const table of document.querySelectorAll("table.cells")) sortable(table);
  for (const section of document.querySelectorAll("section")) {
    for (const box of section.querySelectorAll(".filters[data-noun]")) filterable(box, section);
    if (section.querySelector(".map")) mapped(section);
    const axis = section.querySelector("select.axis");
    axis?.addEventListener("change", () => {
      for (const chart of section.querySelectorAll(".scale")) chart.hidden = !chart.classList.contains(axis.value);
    });
  }
  // where there is little room the filters are folded: the first defences shall be seen
  const wide = matchMedia("(min-width: 48.01rem)");
  const unfold = () => document.querySelectorAll(".fold").forEach((fold) => (fold.open = wide.matches));
  wide.addEventListener("change", unfold);
  unfold();
  // browsers keep the choice of a menu over a reload, but not what it did
  document.querySelectorAll("select").forEach((menu) => menu.dispatchEvent(new Event("change")));
  document.querySelectorAll(".filters").forEach((box) => (box.hidden = false));
})();
