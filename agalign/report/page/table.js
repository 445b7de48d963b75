/**
 * The table of the captures: its columns, filters, order and pages.
 */

/** @type {(Column<Row> & {value: (row: Row) => string | number | null})[]} */
const COLUMNS = [
  { title: "Capture", value: (row) => row.label, cell: (row) => el("a", { href: hashOf(row) }, row.label) },
  { title: "Status", value: (row) => Object.keys(STATUS_COLOURS).indexOf(row.shown), cell: captureBadge },
  { title: "Bands", value: (row) => row.bands.filter(([, status]) => status === "aligned").length / Math.max(1, row.bands.length + row.missing.length), cell: bandChips },
  { title: "Expected error, px", term: "expected_error", isNumber: true, value: (row) => row.error_px, cell: (row) => errorText(row, 3) },
  { title: "Largest residual, px", term: "residual", isNumber: true, isWide: true, value: (row) => row.residual_px, cell: (row) => numberText(row.residual_px, 3) },
  { title: "Taken", isWide: true, value: (row) => row.captured_at, cell: (row) => timeText(row.captured_at) },
  { title: "Seconds", isNumber: true, isWide: true, value: (row) => row.seconds, cell: (row) => numberText(row.seconds, 1) },
];
/** What the filter lets through, besides the states of captures. @type {Record<string, (row: Row) => boolean>} */
const FILTERS = {
  all: () => true,
  check: (row) => row.check,
  short: isUnaligned,
  predicted: (row) => row.bands.some(([, status]) => status === "predicted"),
};
const ROWS_PER_PAGE = 200; // more make the page slow
const naturalOrder = new Intl.Collator(undefined, { numeric: true });
const table = { sorted: 0, isUp: true, page: 0, /** @type {Map<Row, HTMLTableRowElement>} */ lines: new Map() };

/** @param {Row} row */
function bandChips(row) {
  const chips = [...row.bands.map(([name, status]) => [name, status, statusText(status)]), ...row.missing.map(([name, reason]) => [name, "missing", reason])];
  return el("span", {}, ...chips.flatMap(([name, status, why]) => [el("span", { class: `chip ${status}`, title: `${name}: ${why}` }, name), " "]));
}

/** Whether a band is missing or not aligned. @param {Row} row */
function isUnaligned(row) {
  return row.missing.length > 0 || row.bands.some(([, status]) => status !== "aligned");
}

/** @param {number} column */
function sortBy(column) {
  table.isUp = table.sorted === column ? !table.isUp : true;
  table.sorted = column;
  table.page = 0;
  showRows();
}

function showTableHead() {
  byId("table").querySelector("thead")?.replaceChildren(headRow(COLUMNS, (column, i) => button(column.title, () => sortBy(i))));
}

/** The captures that the filters let through, in the order that was chosen; those without a value last. */
function listedRows() {
  const text = inputValue("find").trim().toLowerCase();
  const filter = inputValue("only");
  const passes = FILTERS[filter] ?? ((row) => row.shown === filter);
  const value = COLUMNS[table.sorted].value;
  const sign = table.isUp ? 1 : -1;
  return captures
    .filter((row) => passes(row) && `${row.label} ${row.captured_at} ${row.camera}`.toLowerCase().includes(text))
    .sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === null || y === null) return Number(x === null) - Number(y === null);
      return sign * (typeof x === "string" ? naturalOrder.compare(x, String(y)) : Number(x) - Number(y));
    });
}

/** @param {Row[]} rows */
function showLines(rows) {
  table.lines = new Map(rows.map((row) => [row, bodyRow(COLUMNS, row)]));
  markOpened();
  byId("table").querySelector("tbody")?.replaceChildren(...table.lines.values());
}

/** Show the current page of the table. */
function showRows() {
  const listed = listedRows();
  const pages = Math.max(1, Math.ceil(listed.length / ROWS_PER_PAGE));
  table.page = Math.min(table.page, pages - 1);
  const first = table.page * ROWS_PER_PAGE;
  const end = Math.min(first + ROWS_PER_PAGE, listed.length);
  showLines(listed.slice(first, end));
  /** @param {string} text @param {number} to */
  const turn = (text, to) => button(text, () => { table.page = to; showRows(); }, { class: "button", disabled: to < 0 || to >= pages });
  byId("table-pages").hidden = pages === 1;
  byId("table-pages").replaceChildren(turn("Earlier rows", table.page - 1), turn("Later rows", table.page + 1), `${first + 1} to ${end}`);
  byId("table").querySelectorAll("thead th").forEach((head, i) => {
    setAttributes(head, { "aria-sort": i !== table.sorted ? "none" : table.isUp ? "ascending" : "descending" });
  });
  byId("count").textContent = `${listed.length} of ${facts.captures} shown`;
}

/** Highlight the capture that is open in the table and on the map. */
function markOpened() {
  for (const elements of [table.lines, dots]) {
    for (const [row, element] of elements) element.classList.toggle("open", row === opened.row);
  }
}

/**
 * On paper: what failed, with its reasons; the table has the captures that are not ok, or all where all are.
 * @param {boolean} isPaper
 */
function showForPrint(isPaper) {
  document.querySelectorAll("details.short").forEach((one) => {
    const folded = /** @type {HTMLDetailsElement} */ (one);
    if (isPaper) folded.dataset["was"] = String(folded.open);
    folded.open = isPaper || folded.dataset["was"] === "true";
  });
  const notOk = captures.filter((row) => row.status !== "ok");
  if (!isPaper) showRows();
  else if (notOk.length) showLines(notOk);
}
