// Tables of numbers with six rows or more sort by a click on a column's head, and filter by what is typed above them.
// A cell counts as its first number: "+0.4 [-0.5, +1.5]" is 0.4, "1294/1300 [99, 100] %" their quotient. Cells without one come last.
const NUMBER = /^[^\d+\-−.]{0,2}([+\-−]?\d*\.?\d+)(?:\/(\d+))?/;

function sortKey(text) {
  const [, number, whole] = NUMBER.exec(text) ?? [];
  if (number === undefined) return text;
  return Number(number.replace("−", "-")) / Number(whole ?? 1);
}

for (const table of document.querySelectorAll(".md-typeset table:not([class])")) {
  const rows = [...table.tBodies[0].rows];
  if (rows.length < 6) continue;
  let numbers = 0;
  for (const column of table.tHead.rows[0].cells) {
    const cells = rows.map((row) => row.cells[column.cellIndex]);
    const keys = cells.map((cell) => sortKey(cell.textContent.trim()));
    const told = keys.filter((key) => key !== "");
    if (!told.length || !told.every((key) => typeof key === "number")) continue;
    cells.forEach((cell, row) => cell.setAttribute("data-order", keys[row] === "" ? "-1e308" : keys[row]));
    numbers += 1;
  }
  if (!numbers) continue;
  new DataTable(table, { paging: false, info: false, order: [], autoWidth: false, language: { search: "Filter:" } });
}
