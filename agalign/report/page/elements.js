/**
 * Elements of the page: tables, controls, legends. Texts are never taken for HTML.
 */

/** @typedef {Record<string, string | number | boolean>} Attributes */

/**
 * @template T
 * @typedef {{title: string, term?: string, isNumber?: boolean, isWide?: boolean, cell: (of: T) => Node | string}} Column
 *   A column of a table of T. `term` is its key in the help of the page; narrow screens do not show a wide column.
 */

/** @param {string} id @returns {HTMLElement} */
function byId(id) {
  const found = document.getElementById(id);
  if (found === null) throw new Error(`no element ${id}`);
  return found;
}

/** The value of an input or of a choice. @param {string} id */
function inputValue(id) {
  return /** @type {HTMLInputElement | HTMLSelectElement} */ (byId(id)).value;
}

/** @param {Element} element @param {Attributes} attributes */
function setAttributes(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) element.setAttribute(name, "");
    else if (value !== false) element.setAttribute(name, String(value));
  }
}

/**
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag @param {Attributes} [attributes] @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[T]}
 */
function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  setAttributes(made, attributes);
  made.append(...children);
  return made;
}

/** @param {string} tag @param {Attributes} attributes @param {...(Node | string)} children */
function svg(tag, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  setAttributes(made, attributes);
  made.append(...children);
  return made;
}

/** @param {string} text @param {() => void} onClick @param {Attributes} [attributes] */
function button(text, onClick, attributes = {}) {
  const made = el("button", { type: "button", ...attributes }, text);
  made.addEventListener("click", onClick);
  return made;
}

/**
 * @param {string} label @param {string[][]} options Value and text. @param {string} value
 * @param {(value: string) => void} onChange @param {string} [spoken] The label for a screen reader.
 */
function choice(label, options, value, onChange, spoken = label) {
  const made = el("select", { "aria-label": spoken }, ...options.map(([v, text]) => el("option", { value: v, selected: v === value }, text)));
  made.addEventListener("change", () => onChange(made.value));
  return el("label", { class: "tool" }, `${label} `, made);
}

/** An entry of a legend. @param {string} colour @param {string} text */
function legendKey(colour, text) {
  return el("span", { class: "key", style: `--key:${colour}` }, text);
}

/**
 * The entries of the legend of a scale from `low` to `high`.
 * @param {number[]} shares Of the scale. @param {[number, number]} scale
 * @param {(share: number) => string} colour @param {(value: number) => string} text
 */
function scaleKeys(shares, [low, high], colour, text) {
  return shares.map((share) => legendKey(colour(share), text(low + share * (high - low))));
}

/** The meaning of a term in the help of the page; false without a term. @param {string} [term] */
function meaning(term) {
  return term !== undefined && (byId(`term-${term}`).textContent ?? "");
}

/** @param {string} status @param {string} [term] */
function badge(status, term = status) {
  return el("span", { class: `badge ${status}`, title: meaning(term) }, statusText(status));
}

/** @param {{shown: string}} capture */
function captureBadge(capture) {
  return badge(capture.shown, capture.shown === "failed" ? "degraded" : capture.shown);
}

/** @param {{isNumber?: boolean, isWide?: boolean}} column */
function cellClass(column) {
  return [column.isNumber ? "n" : "", column.isWide ? "wide-only" : ""].join(" ").trim() || false;
}

/**
 * @template T
 * @param {Column<T>[]} columns @param {(column: Column<T>, i: number) => Node | string} content
 */
function headRow(columns, content) {
  return el("tr", {}, ...columns.map((column, i) => el("th", { scope: "col", class: cellClass(column), title: meaning(column.term) }, content(column, i))));
}

/**
 * A row of a table; the first cell is its head.
 * @template T
 * @param {Column<T>[]} columns @param {T} item
 */
function bodyRow(columns, item) {
  return el("tr", {}, ...columns.map((column, i) => (i === 0 ? el("th", { scope: "row" }, column.cell(item)) : el("td", { class: cellClass(column) }, column.cell(item)))));
}

/**
 * @template T
 * @param {Column<T>[]} columns @param {T[]} items
 */
function tableOf(columns, items) {
  const made = el("table", {}, el("thead", {}, headRow(columns, (column) => column.title)), el("tbody", {}, ...items.map((item) => bodyRow(columns, item))));
  labelCells(made);
  return el("div", { class: "scroll" }, made);
}

/** Give each cell the head of its column, which a narrow screen shows before it. @param {HTMLTableElement} made */
function labelCells(made) {
  const heads = [...made.querySelectorAll("thead th")].map((head) => head.textContent ?? "");
  made.querySelectorAll("tbody tr").forEach((line) => {
    [...line.children].forEach((cell, i) => { setAttributes(cell, { "data-head": heads[i] }); });
  });
}
