"use strict";
(() => {
  const table = document.getElementById("table"), body = table.tBodies[0], rows = [...body.rows];
  const words = document.getElementById("words"), shown = document.getElementById("shown");
  const chips = [...document.querySelectorAll(".chip")];
  const headings = [...table.tHead.rows[0].cells];
  const texts = new Map(rows.map(row => [row, row.textContent.toLowerCase()]));
  rows.forEach(row => [...row.cells].forEach((cell, i) => {
    if (cell.dataset.order !== undefined) cell.dataset.label = headings[i].textContent.trim();
  }));

  function key(row, column) {
    if (column === "name") return row.dataset.name;
    if (column === "rank") return Number(row.dataset.rank);
    const order = row.cells[Number(column) + 2].dataset.order;
    return order === "" ? NaN : Number(order);
  }
  const byName = new Intl.Collator(undefined, { numeric: true }).compare;

  function sort(column, sign) {
    const keys = new Map(rows.map(row => [row, key(row, column)]));
    rows.sort((a, b) => {
      const x = keys.get(a), y = keys.get(b);
      if (column === "name") return sign * byName(x, y);
      if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);  // unknown comes last
      return sign * (x - y) || byName(a.dataset.name, b.dataset.name);
    });
    body.append(...rows);
  }

  function filter() {
    const wanted = words.value.toLowerCase().split(/\s+/).filter(Boolean);
    const ends = new Set(chips.filter(chip => chip.ariaPressed === "true").map(chip => chip.dataset.end));
    let count = 0;
    for (const row of rows) {
      const text = texts.get(row);
      row.hidden = !((ends.size === 0 || ends.has(row.dataset.end)) && wanted.every(word => text.includes(word)));
      count += !row.hidden;
    }
    shown.textContent = count === rows.length ? "" : `${count} of ${rows.length} shown`;
  }

  headings.forEach(heading => heading.firstElementChild.addEventListener("click", event => {
    const descending = heading.getAttribute("aria-sort") === "ascending";
    headings.forEach(other => other.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", descending ? "descending" : "ascending");
    sort(event.target.dataset.column, descending ? -1 : 1);
  }));
  chips.forEach(chip => chip.addEventListener("click", () => {
    chip.ariaPressed = chip.ariaPressed === "true" ? "false" : "true";
    filter();
  }));
  words.addEventListener("input", filter);
})();
