"use strict";
// A click on the head of a sortable table sorts its rows; a second click turns the order round.
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending";
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = (row) => {
      const cell = row.cells[column];
      return cell.dataset.sort === undefined ? cell.textContent : cell.dataset.sort;
    };
    const rows = [...table.tBodies[0].rows].map((row) => [key(row), row]);
    const order = (a, b) => {
      if (a === "" || b === "") return (a === "") - (b === "");  // what has no value stays last
      const [x, y] = [Number(a), Number(b)];
      const way = Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b, "en", { numeric: true }) : x - y;
      return down ? -way : way;
    };
    rows.sort((a, b) => order(a[0], b[0]));
    table.tBodies[0].append(...rows.map((pair) => pair[1]));
  }));
}
// A filter hides the rows of the next table that do not contain its words, or have no mark.
for (const filter of document.querySelectorAll(".filter")) {
  const [words, marked] = filter.querySelectorAll("input");
  const body = filter.nextElementSibling.querySelector("tbody");
  filter.addEventListener("input", () => {
    for (const row of body.rows) {
      const fits = row.textContent.toLowerCase().includes(words.value.toLowerCase());
      row.hidden = !fits || (marked.checked && row.querySelector(".mark") === null);
    }
  });
}
