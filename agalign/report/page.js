// @ts-check
"use strict";
/**
 * What moves on the report: the map, the table, and the capture that is looked at. The page contains the rows of the first
 * captures and the details of fewer; the scripts in the folder report-data contain those of the others. The rows are
 * loaded after the page is shown, details and previews when a capture is looked at. Canvases are drawn on and never read,
 * which a page from a file may not do.
 */

/**
 * @typedef {{from: string, std_px: number, off_px: number | null}} Prediction
 * @typedef {{kind: string, held_out_p95_px: Record<string, number | null>}} Geometry
 * @typedef {{band: string, wavelength_nm: number | null, status: string, reason: string | null, seed: string | null,
 *   seconds: number, written: boolean, offset_px: [number, number] | null, offset_length_px: number | null,
 *   residual_px: number | null, residual_p95_px: number | null, error_px: number | null, error_band_px: number | null, usable: boolean, over_1_px: number | null,
 *   coverage: number | null, retrieval: number | null, corner_std_px: number | null, similarity: Record<string, [number | null, number | null]> | null,
 *   prediction: Prediction | null, geometry: Geometry | null, occluded: number | null, check: string[], lattice: number,
 *   shifts: (number | null)[]}} Pair
 * @typedef {{name: string, median: number | null, p5: number | null, p95: number | null, valid: number, masked: number,
 *   span: [number, number], unit: string, raw: boolean, file: string, picture: string}} Index
 * @typedef {{file: string, tile_px: [number, number], detail_px: [number, number],
 *   detail: [number, number, number, number], error_full_px: number | null,
 *   relief: {parallax_px: [number, number], range_m: [number, number] | null} | null,
 *   indices: string[], rows: Record<string, [number, number, number]>}} Preview `rows` has top, width and height by what it shows.
 * @typedef {{label: string, captured_at: string, camera: string, status: string, shown: string, position: [number, number] | null,
 *   radiometry: string | null, altitude_m: number | null, missing: [string, string][], reference: string, seconds: number,
 *   crop: [number, number, number, number], scale: [number, number], stack: string | null, sidecar: string,
 *   relief: string | null,
 *   picture: string | null, preview: Preview | null, bands: Pair[], indices: Index[],
 *   unwritten: [string, string][]}} Capture `shown` is its status, or "ok_by_prediction"; `unwritten` has index and reason.
 * @typedef {{label: string, captured_at: string, camera: string, status: string, shown: string, position: [number, number] | null,
 *   altitude_m: number | null, missing: [string, string][], seconds: number, stack: string | null, bands: [string, string][],
 *   residual_px: number | null, error_px: number | null, error_band_px: number | null, indices: Record<string, number | null>, raw: boolean,
 *   check: boolean}} Row
 *   The row of a capture in the table, with name and status of each moving band, the largest residual of
 *   the aligned ones, and the largest expected error of those that indices can use.
 *   `error_px` is in px of the reference; `error_band_px` is null if the pixels of the band have the same size.
 * @typedef {{from: number, records: Row[]}} Rows
 * @typedef {{from: number, records: Capture[], first_lattice: number, lattices: number[][]}} Details
 *   `from` is the number of captures before the part, `first_lattice` the number of lattices.
 * @typedef {{captures: number, shift_step_px: number, min_share_over_1_px: number, error_full_px: number, index_picture_px: number, index_colours: number[][], index_greys: number[][], rows: Rows | null, details: Details | null, details_per_part: number,
 *   row_files: string[], detail_files: string[]}} FlightFacts The first part of rows and details, and the files of others. The
 *   colours of errors and residuals are full at `error_full_px`; `index_picture_px` is the longer side of the image in the
 *   picture of an index, above the histogram; its colours and greys are stops at equal distances.
 * @typedef {{column: number, colour: string}} Channel
 * @typedef {"before" | "after"} When
 * @typedef {[text: string, term?: string]} Head The head of a column, and its term in the help of the page.
 */

/** @type {FlightFacts} */
const facts = JSON.parse(byId("facts").textContent ?? "");
/** The rows that are loaded, in the order of the labels. @type {Row[]} */
const captures = [];
/** The details that are loaded, by the number of their part. @type {Map<number, Details>} */
const details = new Map();

// ---- parts of the data, which the scripts in the folder report-data pass to these two functions

/** @param {Rows} part */
function add_rows(part) {
  captures.push(...part.records);
}

/** @param {Details} part */
function add_details(part) {
  details.set(part.from / facts.details_per_part, part);
}

/**
 * Load a script.
 * @param {string} file @param {() => void} then @param {() => void} failed
 */
function load(file, then, failed) {
  const script = el("script", { src: file });
  script.addEventListener("load", then);
  script.addEventListener("error", failed);
  document.head.append(script);
}

/**
 * The centres of the windows of a pair of the capture that is looked at: x, y, x, y …
 * @param {Pair} pair
 */
function latticeOf(pair) {
  return look.part?.lattices[pair.lattice - look.part.first_lattice] ?? [];
}

/** @param {string} file */
function notLoaded(file) {
  return `${file} cannot be loaded: copy the folder report-data together with this page, or make the report again.`;
}

/** Load the rows that are not in the page, one file after another, then show them. @param {number} number Of the file. */
function loadRows(number) {
  const file = facts.row_files[number];
  if (file === undefined) {
    tableBody();
    drawMap();
    if (look.capture === null) followOrChoose();
    return;
  }
  byId("count").textContent = `${captures.length} of ${facts.captures} loaded`;
  load(file, () => loadRows(number + 1), () => { byId("count").textContent = notLoaded(file); });
}

/**
 * Pass on the details of a capture, which may have to be loaded first.
 * @param {Row} row @param {(capture: Capture, part: Details) => void} then
 */
function withDetails(row, then) {
  const number = captures.indexOf(row);
  const part = Math.floor(number / facts.details_per_part);
  const loaded = details.get(part);
  if (loaded !== undefined) {
    then(loaded.records[number - loaded.from], loaded);
    return;
  }
  const file = facts.detail_files[part - 1];
  load(file, () => withDetails(row, then), () => {
    byId("capture").hidden = false;
    byId("capture").replaceChildren(el("h2", { id: "capture-title" }, row.label), el("p", {}, notLoaded(file)));
  });
}

// ---- small things

/** @param {string} id @returns {HTMLElement} */
function byId(id) {
  const found = document.getElementById(id);
  if (found === null) throw new Error(`no element ${id}`);
  return found;
}

/**
 * An element; texts are never taken for HTML.
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag @param {Record<string, string | number | boolean>} [attributes]
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[T]}
 */
function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  set(made, attributes);
  made.append(...children);
  return made;
}

/** @param {string} tag @param {Record<string, string | number | boolean>} attributes @param {...(Node | string)} children */
function svg(tag, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  set(made, attributes);
  made.append(...children);
  return made;
}

/** @param {Element} element @param {Record<string, string | number | boolean>} attributes */
function set(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) element.setAttribute(name, "");
    else if (value !== false) element.setAttribute(name, String(value));
  }
}

/** @param {string} text @param {() => void} then @param {Record<string, string | number | boolean>} [attributes] */
function button(text, then, attributes = {}) {
  const made = el("button", { type: "button", ...attributes }, text);
  made.addEventListener("click", then);
  return made;
}

/** An entry of a legend. @param {string} colour @param {string} text */
function key(colour, text) {
  return el("span", { class: "key", style: `--key:${colour}` }, text);
}

/**
 * A row of a table; the first cell is its head.
 * @param {(Node | string)[]} cells @param {(column: number) => boolean} isNumber
 */
function tableRow(cells, isNumber) {
  return el("tr", {}, ...cells.map((cell, i) => (i === 0 ? el("th", { scope: "row" }, cell) : el("td", { class: isNumber(i) ? "n" : "" }, cell))));
}

/** The meaning of a term in the help of the page; false without a term. @param {string} [term] */
function meaning(term) {
  return term !== undefined && (byId(`term-${term}`).textContent ?? "");
}

/** @param {Head[]} heads @param {(Node | string)[][]} rows @param {(column: number) => boolean} isNumber */
function tableOf(heads, rows, isNumber) {
  const head = el("tr", {}, ...heads.map(([text, term], i) => el("th", { scope: "col", class: isNumber(i) ? "n" : "", title: meaning(term) }, text)));
  const made = el("table", {}, el("thead", {}, head), el("tbody", {}, ...rows.map((cells) => tableRow(cells, isNumber))));
  labelCells(made);
  return el("div", { class: "scroll" }, made);
}

/** Give each cell the head of its column, which a narrow screen shows before it. @param {HTMLTableElement} made */
function labelCells(made) {
  const heads = [...made.querySelectorAll("thead th")].map((head) => head.textContent ?? "");
  made.querySelectorAll("tbody tr").forEach((line) => {
    [...line.children].forEach((cell, i) => { set(cell, { "data-head": heads[i] }); });
  });
}

/** @param {number | null | undefined} value @param {number} [digits] */
function fixed(value, digits = 2) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

/** What follows an expected error in px of the reference. @param {{error_band_px: number | null}} of */
function inBandPx(of) {
  return of.error_band_px === null ? "" : ` (${fixed(of.error_band_px)} px of the band)`;
}

/** @param {number} share */
function percent(share) {
  return `${(100 * share).toFixed(1)} %`;
}

/** @param {string} status */
function inWords(status) {
  return status.replaceAll("_", " ");
}

/** @param {Capture} capture @returns {Pair[]} */
function moving(capture) {
  return capture.bands.filter((b) => b.status !== "reference");
}

/** @param {string} captured_at Cameras count from 1970 until their clock is set; without an offset, it is that clock. */
function taken(captured_at) {
  const zone = captured_at.slice(19).replace(/^\.\d+/, "").replace("+00:00", "UTC");
  return captured_at < "1971" ? "unknown time" : `${captured_at.slice(0, 19).replace("T", " ")} ${zone}`.trim();
}

/** @param {{label: string}} row */
function address(row) {
  return `#capture=${encodeURIComponent(row.label)}`;
}

// ---- the table

const STATUS_COLOURS = { failed: "#d43c3c", degraded: "#d98a1b", ok_by_prediction: "#3b7dd8", ok: "#2f9e61" }; // worst first
/** @type {{title: string, term?: string, numeric: boolean, wide?: boolean, value: (c: Row) => string | number | null, cell: (c: Row) => Node | string}[]} */
const columns = [
  { title: "Capture", numeric: false, value: (c) => c.label, cell: (c) => el("a", { href: address(c) }, c.label) },
  { title: "Status", numeric: false, value: (c) => Object.keys(STATUS_COLOURS).indexOf(c.shown), cell: captureBadge },
  { title: "Bands", numeric: false, value: (c) => c.bands.filter(([, status]) => status === "aligned").length / Math.max(1, c.bands.length + c.missing.length), cell: chips },
  { title: "Expected error, px", term: "expected_error", numeric: true, value: (c) => c.error_px, cell: (c) => `${fixed(c.error_px, 3)}${inBandPx(c)}` },
  { title: "Largest residual, px", term: "residual", numeric: true, wide: true, value: (c) => c.residual_px, cell: (c) => fixed(c.residual_px, 3) },
  { title: "Taken", numeric: false, wide: true, value: (c) => c.captured_at, cell: (c) => taken(c.captured_at) },
  { title: "Seconds", numeric: true, wide: true, value: (c) => c.seconds, cell: (c) => c.seconds.toFixed(1) },
];
const PAGE_ROWS = 200; // of the table: more make the page slow
const table = { sorted: 0, up: true, page: 0, /** @type {Map<Row, HTMLTableRowElement>} */ rows: new Map() };
const inOrder = new Intl.Collator(undefined, { numeric: true });

/** @param {string} status @param {string} [term] */
function badge(status, term = status) {
  return el("span", { class: `badge ${status}`, title: meaning(term) }, inWords(status));
}

/** @param {{shown: string}} row */
function captureBadge(row) {
  return badge(row.shown, row.shown === "failed" ? "degraded" : row.shown);
}

/** @param {Pair} pair */
function bandBadge(pair) {
  return badge(pair.status, pair.status === "failed" ? "seed_only" : pair.status);
}

/** @param {Row} row */
function chips(row) {
  const line = el("span");
  for (const [name, status] of row.bands) line.append(el("span", { class: `chip ${status}`, title: `${name}: ${inWords(status)}` }, name), " ");
  for (const [name, reason] of row.missing) line.append(el("span", { class: "chip missing", title: `${name}: ${reason}` }, name), " ");
  return line;
}

function tableHead() {
  const line = el("tr");
  columns.forEach((column, i) => {
    const sort = () => {
      table.up = table.sorted === i ? !table.up : true;
      table.sorted = i;
      table.page = 0;
      tableBody();
    };
    line.append(el("th", { scope: "col", class: `${column.numeric ? "n" : ""}${column.wide ? " wide-only" : ""}`, title: meaning(column.term) }, button(column.title, sort)));
  });
  byId("table").querySelector("thead")?.replaceChildren(line);
}

/** @param {Row} capture */
function row(capture) {
  const made = table.rows.get(capture) ?? tableRow(columns.map((c) => c.cell(capture)), (i) => columns[i].numeric);
  columns.forEach((column, i) => { made.children[i].classList.toggle("wide-only", column.wide ?? false); });
  made.classList.toggle("open", capture.label === look.capture?.label);
  table.rows.set(capture, made);
  return made;
}

/** The captures that the filters let through, in the order that was chosen; those without a value last. */
function chosen() {
  const text = /** @type {HTMLInputElement} */ (byId("find")).value.trim().toLowerCase();
  const only = /** @type {HTMLSelectElement} */ (byId("only")).value;
  const value = columns[table.sorted].value;
  const sign = table.up ? 1 : -1;
  return captures
    .filter((c) => !text || `${c.label} ${c.captured_at} ${c.camera}`.toLowerCase().includes(text))
    .filter((c) => only === "all" || only === c.shown || (only === "check" && c.check) || (only === "short" && isShort(c)) || (only === "predicted" && c.bands.some(([, status]) => status === "predicted")))
    .sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === null || y === null) return Number(x === null) - Number(y === null);
      return sign * (typeof x === "string" ? inOrder.compare(x, String(y)) : Number(x) - Number(y));
    });
}

/** @param {Row} row */
function isShort(row) {
  return row.missing.length > 0 || row.bands.some(([, status]) => status !== "aligned");
}

function tableBody() {
  const shown = chosen();
  const pages = Math.max(1, Math.ceil(shown.length / PAGE_ROWS));
  table.page = Math.min(table.page, pages - 1);
  const first = table.page * PAGE_ROWS;
  table.rows.clear();
  byId("table").querySelector("tbody")?.replaceChildren(...shown.slice(first, first + PAGE_ROWS).map(row));
  /** @param {string} text @param {number} to */
  const turn = (text, to) => button(text, () => { table.page = to; tableBody(); }, { class: "button", disabled: to < 0 || to >= pages });
  byId("table-pages").hidden = pages === 1;
  byId("table-pages").replaceChildren(turn("Earlier rows", table.page - 1), turn("Later rows", table.page + 1), `${first + 1} to ${Math.min(first + PAGE_ROWS, shown.length)}`);
  byId("table").querySelectorAll("thead th").forEach((head, i) => {
    set(head, { "aria-sort": i !== table.sorted ? "none" : table.up ? "ascending" : "descending" });
  });
  byId("count").textContent = `${shown.length} of ${facts.captures} shown`;
}

// ---- the map

const MAP = { width: 900, height: 420, few: 230, margin: 34 };
const ONE_PLACE_M = 0.5;
const MAP_FULL_PX = 1; // fixed, so that colours mean the same in every report; above it single plants do not match
const MISSING_COLOUR = "#c9a";
const RAW_NOTE = "From raw numbers, not reflectance: values of different captures are not comparable.";
/** @type {Map<Row, Element>} */
const dots = new Map();

/** The captures where they were taken, metres along and across; drawn without any map behind it. */
function drawMap() {
  const place = document.getElementById("map-place");
  if (place === null) return;
  const placed = captures.filter((c) => c.position !== null);
  if (!placed.length) return;
  const [lat, lon] = [0, 1].map((i) => placed.reduce((sum, c) => sum + (c.position ?? [0, 0])[i], 0) / placed.length);
  const metres = placed.map((c) => {
    const [y, x] = c.position ?? [0, 0];
    return [(x - lon) * 111320 * Math.cos((lat * Math.PI) / 180), (y - lat) * 110540];
  });
  const reach = [0, 1].map((i) => metres.reduce((largest, m) => Math.max(largest, Math.abs(m[i])), 1e-9));
  if (Math.max(...reach) < ONE_PLACE_M) {
    place.replaceChildren(el("p", {}, `All at ${lat.toFixed(6)}, ${lon.toFixed(6)}.`));
    byId("map").querySelectorAll("label, #map-legend").forEach((part) => { part.remove(); });
    return;
  }
  const width = Math.min(MAP.width, Math.max(place.clientWidth, 300));
  const height = placed.length < 25 ? MAP.few : MAP.height;
  const scale = Math.min((width / 2 - MAP.margin) / reach[0], (height / 2 - MAP.margin) / reach[1], 200);
  const at = metres.map(([x, y]) => [width / 2 + x * scale, height / 2 - y * scale]);
  const inTime = placed.map((c, i) => ({ c, at: at[i] })).sort((a, b) => a.c.captured_at.localeCompare(b.c.captured_at));
  const steps = inTime.slice(1).map((p, i) => Math.hypot(p.at[0] - inTime[i].at[0], p.at[1] - inTime[i].at[1])).sort((a, b) => a - b);
  const radius = Math.min(8, Math.max(2.5, 0.5 * (steps[Math.floor(steps.length / 2)] ?? 8)));
  dots.clear();
  const drawn = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `Positions of ${placed.length} captures; the table below has the same captures` });
  drawn.append(svg("polyline", { class: "track", points: inTime.map((p) => p.at.map((v) => v.toFixed(1)).join(",")).join(" ") }));
  for (const { c, at: [x, y] } of inTime) {
    const dot = svg("circle", { cx: x.toFixed(1), cy: y.toFixed(1), r: radius }, svg("title", {}, c.label));
    dot.addEventListener("click", () => { location.hash = address(c); });
    dots.set(c, dot);
    drawn.append(dot);
  }
  drawn.append(...scaleBar(scale, width, height));
  place.replaceChildren(drawn);
  const known = [...byId("map-colour").querySelectorAll("option")].map((option) => option.value);
  for (const name of indexNames().filter((one) => !known.includes(`index:${one}`))) {
    byId("map-colour").append(el("option", { value: `index:${name}` }, `median ${name.toUpperCase()}`));
  }
  colourMap();
}

/** @param {number} scale Pixels a metre. @param {number} width @param {number} height */
function scaleBar(scale, width, height) {
  const power = 10 ** Math.floor(Math.log10(140 / scale));
  const length = [5, 2, 1].map((n) => n * power).find((n) => n * scale <= 140) ?? power;
  const y = height - 14;
  const name = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`;
  return [
    svg("path", { class: "scale", d: `M14 ${y}h${(length * scale).toFixed(1)}` }),
    svg("text", { x: 14, y: y - 6 }, name),
    svg("text", { x: width - 34, y: 24 }, "N ↑"),
  ];
}

function colourMap() {
  const what = /** @type {HTMLSelectElement} */ (byId("map-colour")).value;
  const legend = byId("map-legend");
  if (what === "status") {
    for (const [c, dot] of dots) set(dot, { fill: colourOf(c.shown) });
    const present = Object.keys(STATUS_COLOURS).filter((s) => captures.some((c) => c.shown === s)).reverse();
    legend.replaceChildren(...present.map((s) => key(colourOf(s), inWords(s))));
    return;
  }
  if (what.startsWith("index:")) {
    colourByIndex(what.slice(6), legend);
    return;
  }
  for (const [c, dot] of dots) {
    const value = c[/** @type {"residual_px" | "error_px"} */ (what)];
    set(dot, { fill: value === null ? MISSING_COLOUR : ramp(value / MAP_FULL_PX) });
  }
  const steps = [0, 0.5, 1].map((s) => key(ramp(s), `${(s * MAP_FULL_PX).toFixed(2)} px${s === 1 ? " and more" : ""}`));
  legend.replaceChildren(...steps, key(MISSING_COLOUR, "no value"));
}

/**
 * From the lowest to the highest median of the captures.
 * @param {string} name @param {HTMLElement} legend
 */
function colourByIndex(name, legend) {
  const known = [...dots.keys()].flatMap((c) => c.indices[name] ?? []);
  const [low, high] = known.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
  const raw = captures.some((c) => name in c.indices && c.raw);
  for (const [c, dot] of dots) {
    const value = c.indices[name] ?? null;
    set(dot, { fill: value === null ? MISSING_COLOUR : medianColour((value - low) / (high - low || 1), raw) });
  }
  const steps = known.length ? [0, 0.5, 1].map((s) => key(medianColour(s, raw), (low + s * (high - low)).toFixed(3))) : [];
  legend.replaceChildren(...steps, key(MISSING_COLOUR, "no value"), raw ? RAW_NOTE : "");
}

/** The names of all indices, of whichever captures have them. */
function indexNames() {
  return [...new Set(captures.flatMap((c) => Object.keys(c.indices)))];
}

/** @param {number} share @param {boolean} raw */
function indexColour(share, raw) {
  const stops = raw ? facts.index_greys : facts.index_colours;
  const at = Math.min(1, Math.max(0, share)) * (stops.length - 1);
  const k = Math.min(stops.length - 2, Math.floor(at));
  return `rgb(${stops[k].map((v, i) => Math.round(v + (at - k) * (stops[k + 1][i] - v))).join(" ")})`;
}

/**
 * Without the blue of water, as the lowest median of a flight is no water.
 * @param {number} share @param {boolean} raw
 */
function medianColour(share, raw) {
  return indexColour(raw ? share : 0.2 + 0.8 * share, raw);
}

/** What the map shows, as a file for a GIS. */
function saveMap() {
  const features = captures.filter((c) => c.position !== null).map((c) => ({
    type: "Feature",
    geometry: { type: "Point", coordinates: [c.position?.[1], c.position?.[0], ...(c.altitude_m === null ? [] : [c.altitude_m])] },
    properties: {
      capture: c.label, captured_at: c.captured_at, camera: c.camera, status: c.status, stack: c.stack,
      residual_px: c.residual_px, expected_error_px: c.error_px,
      ...Object.fromEntries(Object.entries(c.indices).map(([name, median]) => [`${name}_median`, median])),
    },
  }));
  const text = JSON.stringify({ type: "FeatureCollection", features });
  const link = el("a", { href: URL.createObjectURL(new Blob([text], { type: "application/geo+json" })), download: "captures.geojson" });
  link.click();
  window.setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** @param {string} status */
function colourOf(status) {
  return /** @type {Record<string, string>} */ (STATUS_COLOURS)[status] ?? "#888";
}

/**
 * From blue-green to red, of equal lightness.
 * @param {number} share
 */
function ramp(share) {
  return `hsl(${Math.round(200 - 200 * Math.min(1, Math.max(0, share)))} 70% 45%)`;
}

// ---- one capture

const CHANNELS = ["#f00", "#0f0", "#00f"];
const LARGEST_ZOOM = 40;
const ERROR_MARKS_PX = [0, 0.5, 1, 2];
const SMALL = [0, 32, 77]; // colours of errors; no vegetation has them, neither in true nor in false colour
const LARGE = [255, 234, 70];
const ARROW_FULL_PX = 0.5; // the arrow of a residual is full
const FAR = [25, 35, 150]; // colours of the relief; between them the lightness grows with the parallax
const NEAR = [205, 250, 45];
const INDEX_OPACITY = 0.9;
const MAP_OPACITY = 0.75; // of errors and relief: edges of the picture show through
/** @type {Record<string, string>} */
const NOTES = {
  vectors: `Residual shift of each window; an arrow of ${ARROW_FULL_PX} px or more reaches most of the way to the next window. Grey: none could be measured.`,
  heat: "Residual shift of each window:",
  error: "Expected error at every pixel (unknown: as the largest):",
  relief: "Parallax relative to the plane that most of the scene is on: the lighter, the nearer.",
};
const BLINK_MS = 700;
const NARROW_PX = 640; // as in page.css
const SCREEN_SHARE = 78; // of its height, at most, for a picture
const CLOSE_ENOUGH = 1.5; // as wide as the small picture has pixels, the detail is drawn over it

/** What is looked at, and how; it stays from capture to capture. */
const look = {
  /** @type {Capture | null} */ capture: null,
  /** @type {Details | null} */ part: null, // of the details of the capture
  /** @type {HTMLImageElement | null} */ sheet: null,
  /** @type {[string, string, string] | null} */ wanted: null, // kept for the captures that have these bands
  /** @type {[string, string, string]} */ bands: ["", "", ""],
  /** @type {"swipe" | "blink" | "side"} */ mode: "swipe",
  split: 0.5,
  /** @type {When} */ blinking: "before",
  timer: 0,
  zoom: 1, x: 0, y: 0,
  overlay: "none", overlayBand: "",
  /** @type {Record<string, HTMLCanvasElement>} */ composed: {},
  /** @type {Record<string, HTMLImageElement>} */ indices: {},
};
/** @type {HTMLCanvasElement} */
const stage = el("canvas", { tabindex: 0, role: "img", "aria-label": "The composite before and after" });

/** The row that is looked at. @type {Row | null} */
let open_row = null;

/**
 * Show a capture, as soon as its details are loaded.
 * @param {Row} row @param {() => void} [then]
 */
function show(row, then = () => {}) {
  open_row = row;
  withDetails(row, (capture, part) => {
    if (open_row !== row) return;
    showDetails(row, capture, part);
    then();
  });
}

/** @param {Row} row @param {Capture} capture @param {Details} part */
function showDetails(row, capture, part) {
  for (const one of [...table.rows.values(), ...dots.values()]) one.classList.remove("open");
  look.capture = capture;
  look.part = part;
  look.sheet = null;
  look.composed = {};
  look.indices = {};
  if (!overlaysOf(capture).some(([value]) => value === look.overlay)) look.overlay = "none";
  const names = capture.bands.map((b) => b.band);
  look.wanted ??= presets(facts.details?.records.find((c) => c.missing.length === 0) ?? capture)[0].bands;
  look.bands = look.wanted.every((b) => names.includes(b)) ? look.wanted : presets(capture)[0].bands;
  if (!names.includes(look.overlayBand)) look.overlayBand = moving(capture)[0]?.band ?? "";
  table.rows.get(row)?.classList.add("open");
  const dot = dots.get(row);
  dot?.classList.add("open");
  dot?.parentNode?.append(dot); // drawn on top
  const place = byId("capture");
  place.hidden = false;
  place.replaceChildren(...heading(row, capture), ...pictures(capture), ...indexTable(capture), words(capture), numbers(capture), similarities(capture));
  paint();
}

/** @param {Row} row @param {Capture} capture */
function heading(row, capture) {
  const order = chosen();
  const at = order.indexOf(row);
  /** @param {string} text @param {Row | undefined} to */
  const step = (text, to) => button(text, () => { if (to !== undefined) location.hash = address(to); }, { class: "button", disabled: to === undefined });
  const where = capture.position === null ? "" : ` · ${capture.position.map((v) => v.toFixed(6)).join(", ")}${capture.altitude_m === null ? "" : `, ${capture.altitude_m.toFixed(0)} m`}`;
  const files = el("span", {}, capture.radiometry === null ? "" : ` · ${capture.radiometry}`);
  for (const [file, name] of [[capture.stack, "aligned stack"], [capture.sidecar, "sidecar"], [capture.relief, "relief"], [capture.picture, "picture"]]) {
    if (file !== null) files.append(" · ", el("a", { href: String(file) }, String(name)));
  }
  return [
    el("div", { class: "heading" }, el("h2", { id: "capture-title" }, capture.label, " ", captureBadge(capture)), step("Previous", at < 0 ? undefined : order[at - 1]), step("Next", at < 0 ? undefined : order[at + 1])),
    el("p", { class: "soft" }, `${capture.camera} · ${taken(capture.captured_at)}${where} · reference ${capture.reference}`, files),
  ];
}

/**
 * Composites by what the bands are, each where the bands are there.
 * @param {Capture} capture @returns {{name: string, bands: [string, string, string]}[]}
 */
function presets(capture) {
  /** @param {number} low @param {number} high @param {RegExp} name */
  const find = (low, high, name) =>
    (capture.bands.find((b) => b.wavelength_nm !== null && b.wavelength_nm >= low && b.wavelength_nm < high) ?? capture.bands.find((b) => b.wavelength_nm === null && name.test(b.band)))?.band;
  const [blue, green, red, nir, edge] = [find(430, 495, /^blue/i), find(520, 585, /^green/i), find(620, 690, /^red$/i), find(760, 1000, /^nir/i), find(695, 755, /red ?edge/i)];
  const others = capture.bands.filter((b) => b.status !== "reference").map((b) => b.band);
  /** @type {[string, (string | undefined)[]][]} */
  const known = [["false colour", [nir, red, green]], ["true colour", [red, green, blue]], ["red edge", [nir, edge, green]], ["first bands", [others[0], others[1] ?? others[0], capture.reference]]];
  return known.flatMap(([name, bands]) => (bands.every((b) => b !== undefined) ? [{ name, bands: /** @type {[string, string, string]} */ (bands) }] : []));
}

/** @param {Capture} capture */
function pictures(capture) {
  if (capture.preview === null) {
    return capture.picture === null ? [] : [el("img", { class: "wide", src: capture.picture, loading: "lazy", alt: "Before and after alignment" })];
  }
  const sheet = new Image();
  sheet.addEventListener("load", () => {
    if (look.capture !== capture) return;
    look.sheet = sheet;
    paint();
  });
  sheet.addEventListener("error", () => { if (look.capture === capture) byId("tag-right").textContent = "the preview is not there"; });
  sheet.src = capture.preview.file;
  const frame = el("div", { class: "stage" }, stage, el("span", { class: "tag left", id: "tag-left" }), el("span", { class: "tag right", id: "tag-right" }));
  const swipe = el("input", { type: "range", id: "swipe", min: 0, max: 1000, value: Math.round(look.split * 1000), hidden: look.mode !== "swipe", "aria-label": "How much of the picture is before: the rest is after" });
  swipe.addEventListener("input", () => {
    look.split = Number(swipe.value) / 1000;
    setMode("swipe");
  });
  const folded = el("details", { class: "controls", open: window.innerWidth > NARROW_PX }, el("summary", {}, "Bands and overlay"), compositeTools(capture), overlayTools(capture));
  return [folded, viewTools(), el("div", { id: "viewer" }, frame, swipe), el("p", { class: "soft", id: "over-note" }),
    el("p", { class: "soft hint mouse" }, "Drag the line, or drag the picture; the wheel zooms. The thin frame is the detail, which is shown at full resolution. On the picture the keys + and − zoom, arrows move, 0 shows all, the space bar changes between before and after."),
    el("p", { class: "soft hint touch" }, "Drag the white line with a finger to compare before and after; + and − zoom, and a finger then moves the picture; All shows all of it again. The thin frame is the detail, which is shown at full resolution.")];
}

/**
 * @param {string} label @param {string[][]} options Value and text. @param {string} value
 * @param {(value: string) => void} then @param {string} [spoken] The label for who does not see what stands around it.
 */
function choice(label, options, value, then, spoken = label) {
  const made = el("select", { "aria-label": spoken }, ...options.map(([v, text]) => el("option", { value: v, selected: v === value }, text)));
  made.addEventListener("change", () => then(made.value));
  return el("label", { class: "tool" }, `${label} `, made);
}

/** @param {Capture} capture */
function compositeTools(capture) {
  const known = presets(capture);
  const bands = look.bands;
  const named = known.find((p) => p.bands.every((b, i) => b === bands[i]))?.name ?? "other";
  const line = el("div", { class: "tools" });
  const again = () => {
    look.composed = {};
    line.replaceWith(compositeTools(capture));
    paint();
  };
  line.append(
    choice("Composite", [...known.map((p) => [p.name, p.name]), ...(named === "other" ? [["other", "other"]] : [])], named, (name) => {
      look.bands = look.wanted = known.find((p) => p.name === name)?.bands ?? bands;
      again();
    }),
    ...["Red", "Green", "Blue"].map((channel, i) =>
      choice(channel, capture.bands.map((b) => [b.band, b.band]), bands[i], (name) => {
        look.bands = look.wanted = /** @type {[string, string, string]} */ (bands.map((b, k) => (k === i ? name : b)));
        again();
      }, `${channel} channel`),
    ),
  );
  return line;
}

function viewTools() {
  /** @type {["swipe" | "blink" | "side", string][]} */
  const modes = [["swipe", "Swipe"], ["blink", "Blink"], ["side", "Side by side"]];
  return el("div", { class: "tools", id: "view-tools" },
    ...modes.map(([mode, text]) => button(text, () => setMode(mode), { class: "button", "data-mode": mode, "aria-pressed": String(look.mode === mode) })),
    button("−", () => zoomBy(1 / 1.6), { class: "button", "aria-label": "Zoom out" }),
    button("+", () => zoomBy(1.6), { class: "button", "aria-label": "Zoom in" }),
    button("All", showAll, { class: "button" }),
    button("Detail", showDetail, { class: "button" }),
  );
}

/**
 * Value and name of the overlays that a capture has.
 * @param {Capture} capture @returns {[string, string][]}
 */
function overlaysOf(capture) {
  /** @type {[string, string][]} */
  const overlays = [["none", "none"], ["vectors", "residual vectors"], ["heat", "residual heat map"]];
  if (capture.preview?.error_full_px) overlays.push(["error", "expected error"]);
  if (capture.preview?.relief) overlays.push(["relief", "parallax of the capture"]);
  for (const index of capture.indices) overlays.push([`index:${index.name}`, index.name.toUpperCase()]);
  return overlays;
}

/** @param {Capture} capture */
function overlayTools(capture) {
  const line = el("div", { class: "tools" });
  const band = choice("for band", moving(capture).map((b) => [b.band, b.band]), look.overlayBand, (value) => { look.overlayBand = value; paint(); }, "Band of the overlay");
  /** The other overlays are of all bands. */
  const showBand = () => { band.hidden = !["vectors", "heat", "error"].includes(look.overlay); };
  line.append(choice("Overlay", overlaysOf(capture), look.overlay, (value) => { look.overlay = value; showBand(); paint(); }, "Overlay"), band);
  showBand();
  return line;
}

/** @param {"swipe" | "blink" | "side"} mode */
function setMode(mode) {
  look.mode = mode;
  window.clearInterval(look.timer);
  byId("swipe").hidden = mode !== "swipe";
  if (mode === "blink") look.timer = window.setInterval(flip, BLINK_MS);
  document.querySelectorAll("#view-tools [data-mode]").forEach((b) => set(b, { "aria-pressed": String(b.getAttribute("data-mode") === mode) }));
  paint();
}

function flip() {
  look.blinking = look.blinking === "before" ? "after" : "before";
  paint();
}

/** The width of what one picture is shown in, px of the canvas. */
function frameWidth() {
  return look.mode === "side" ? Math.floor(stage.width / 2) : stage.width;
}

/**
 * About a point, in shares of what is seen.
 * @param {number} factor @param {number} [atX] @param {number} [atY]
 */
function zoomBy(factor, atX = 0.5, atY = 0.5) {
  const zoom = Math.min(LARGEST_ZOOM, Math.max(1, look.zoom * factor));
  look.x += atX / look.zoom - atX / zoom;
  look.y += atY / look.zoom - atY / zoom;
  look.zoom = zoom;
  pan(0, 0);
}

/**
 * In shares of what is seen.
 * @param {number} dx @param {number} dy
 */
function pan(dx, dy) {
  const most = 1 - 1 / look.zoom;
  look.x = Math.min(most, Math.max(0, look.x + dx / look.zoom));
  look.y = Math.min(most, Math.max(0, look.y + dy / look.zoom));
  paint();
}

function showAll() {
  look.zoom = 1;
  pan(0, 0);
}

function showDetail() {
  const detail = look.capture?.preview?.detail;
  if (!detail) return;
  look.zoom = Math.min(LARGEST_ZOOM, 1 / Math.max(detail[2], detail[3]));
  look.x = detail[0] + (detail[2] - 1 / look.zoom) / 2;
  look.y = detail[1] + (detail[3] - 1 / look.zoom) / 2;
  pan(0, 0);
}

/**
 * Place of a picture on the sheet: x, y, width, height.
 * @param {Preview} preview @param {number} column @param {string} line @returns {[number, number, number, number]}
 */
function onSheet(preview, column, line) {
  const [top, width, height] = preview.rows[line];
  return [column * width, top, width, height];
}

/** @param {number} share From far to near. */
function reliefColour(share) {
  return mixed(FAR, NEAR, share);
}

/** @param {number} px An expected error, or the length of a residual. @param {number} [full_px] */
function errorColour(px, full_px = facts.error_full_px) {
  return mixed(SMALL, LARGE, Math.min(1, px / full_px));
}

/** @param {number[]} from @param {number[]} to @param {number} share */
function mixed(from, to, share) {
  return `rgb(${from.map((v, i) => Math.round(v + share * (to[i] - v))).join(" ")})`;
}

/**
 * Grey pictures of a row of the sheet as the channels of one: each is dyed in its colour, and they add up.
 * @param {HTMLImageElement} sheet @param {Preview} preview @param {string} line
 * @param {Channel[]} channels
 */
function compose(sheet, preview, line, channels) {
  const [, , width, height] = onSheet(preview, 0, line);
  const whole = el("canvas", { width, height });
  const sum = /** @type {CanvasRenderingContext2D} */ (whole.getContext("2d"));
  sum.fillRect(0, 0, width, height);
  sum.globalCompositeOperation = "lighter";
  for (const { column, colour } of channels) {
    const one = el("canvas", { width, height });
    const dyed = /** @type {CanvasRenderingContext2D} */ (one.getContext("2d"));
    dyed.drawImage(sheet, ...onSheet(preview, column, line), 0, 0, width, height);
    dyed.globalCompositeOperation = "multiply";
    dyed.fillStyle = colour;
    dyed.fillRect(0, 0, width, height);
    sum.drawImage(one, 0, 0);
  }
  return whole;
}

/**
 * The composite of a row, made when it is first needed.
 * @param {string} line @param {Channel[]} channels
 */
function composed(line, channels) {
  const preview = look.capture?.preview;
  if (look.sheet === null || !preview) return null;
  const key = `${line} ${channels.map((c) => c.column).join(" ")}`;
  look.composed[key] ??= compose(look.sheet, preview, line, channels);
  return look.composed[key];
}

/**
 * A picture of the sheet in the colours of stops, made when it is first needed; null where the sheet has no such row.
 * @param {Preview} preview @param {string} line @param {number} column @param {number[][]} stops
 */
function dyed(preview, line, column, stops) {
  if (look.sheet === null || !(line in preview.rows)) return null;
  const key = `stops ${line} ${column}`;
  look.composed[key] ??= inStops(look.sheet, onSheet(preview, column, line), stops);
  return look.composed[key];
}

function paint() {
  const capture = look.capture;
  const preview = capture?.preview;
  if (!capture || !preview || !stage.isConnected) return;
  const aspect = capture.crop[3] / capture.crop[2] / (look.mode === "side" ? 2 : 1);
  byId("viewer").style.maxWidth = `${SCREEN_SHARE / aspect}vh`;
  const wide = Math.max(1, Math.round(stage.clientWidth * window.devicePixelRatio));
  const high = Math.round(wide * aspect);
  if (stage.width !== wide || stage.height !== high) {
    stage.width = wide;
    stage.height = high;
  }
  const pen = /** @type {CanvasRenderingContext2D} */ (stage.getContext("2d"));
  pen.clearRect(0, 0, wide, high);
  const frame = frameWidth();
  const split = Math.round(look.split * wide);
  if (look.mode === "blink") picture(pen, capture, look.blinking, 0, 0, wide);
  else {
    const middle = look.mode === "side" ? frame : split;
    picture(pen, capture, "before", 0, 0, middle);
    picture(pen, capture, "after", look.mode === "side" ? frame : 0, middle, wide - middle);
    pen.fillStyle = "#fff";
    pen.fillRect(middle - 1, 0, 2, high);
  }
  byId("over-note").replaceChildren(channelNote(capture), " ", NOTES[look.overlay] ?? "", " ", ...legend(preview));
  stage.style.touchAction = look.zoom > 1 ? "none" : "pan-y"; // all is seen: the page scrolls
  const now = look.mode === "blink" ? look.blinking : "";
  byId("tag-left").textContent = now || "before";
  byId("tag-right").textContent = capture.bands.some((b) => b.written) ? "after" : "after: nothing was written";
  byId("tag-right").hidden = Boolean(now);
  stage.dataset["blinking"] = now;
}

/**
 * Which bands are shown, and which of them differ from other captures.
 * @param {Capture} capture
 */
function channelNote(capture) {
  const black = capture.bands.filter((b) => look.bands.includes(b.band) && !b.written).map((b) => b.band);
  const absent = (look.wanted ?? []).filter((b) => !capture.bands.some((one) => one.band === b));
  return `Shown: ${look.bands.join(", ")} as red, green, blue.` + (black.length ? ` ${black.join(", ")} was not written: black after, and the colours differ from those of other captures.` : "") + (absent.length ? ` Other bands than for other captures, because ${absent.join(", ")} is missing.` : "");
}

/**
 * The legends of the overlays.
 * @param {Preview} preview
 */
function legend(preview) {
  if (["vectors", "heat", "error"].includes(look.overlay)) {
    const full_px = look.overlay === "error" ? preview.error_full_px ?? 0 : facts.error_full_px;
    return ERROR_MARKS_PX.filter((px) => px <= full_px).map((px) => key(errorColour(px, full_px), `${px} px${px === full_px ? " and more" : ""}`));
  }
  const index = look.capture ? indexOf(look.capture) : undefined;
  if (index) {
    const [low, high] = index.span;
    const steps = [0, 0.2, 0.4, 0.6, 0.8, 1].map((s) => key(indexColour(s, index.raw), (low + s * (high - low)).toFixed(2)));
    return [...steps, el("span", {}, index.raw ? RAW_NOTE : `${index.name.toUpperCase()} of ${index.unit}.`)];
  }
  if (look.overlay !== "relief" || !preview.relief) return [];
  const [low, high] = preview.relief.parallax_px;
  const keys = [0, 0.5, 1].map((share) => key(reliefColour(share), `${(low + share * (high - low)).toFixed(1)} px`));
  const range = preview.relief.range_m;
  return range ? [...keys, el("span", {}, `Range of the scene: ${inMetres(range[0])} to ${inMetres(range[1])} m.`)] : keys;
}

/** @param {number} range_m */
function inMetres(range_m) {
  return range_m.toFixed(range_m < 10 ? 2 : 1);
}

/**
 * One picture and its overlays, within a strip of the canvas.
 * @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {When} when
 * @param {number} origin Where the picture's frame begins. @param {number} from @param {number} width Of the strip.
 */
function picture(pen, capture, when, origin, from, width) {
  const preview = /** @type {Preview} */ (capture.preview);
  const [frame, high] = [frameWidth(), stage.height];
  const columns = look.bands.map((name, i) => ({ column: capture.bands.findIndex((b) => b.band === name), colour: CHANNELS[i] }));
  /** @param {number} u @param {number} v Shares of the picture's sides. @returns {[number, number]} */
  const at = (u, v) => [origin + (u - look.x) * look.zoom * frame, (v - look.y) * look.zoom * high];
  pen.save();
  pen.beginPath();
  pen.rect(from, 0, width, high);
  pen.clip();
  const whole = composed(when, columns);
  const close = composed(`${when}_detail`, columns);
  if (whole) pen.drawImage(whole, ...at(0, 0), look.zoom * frame, look.zoom * high);
  const [x, y, w, h] = preview.detail;
  if (close && look.zoom > 1 && (look.zoom * frame) / preview.tile_px[0] > CLOSE_ENOUGH) {
    pen.imageSmoothingEnabled = (w * look.zoom * frame) / preview.detail_px[0] < 3; // pixels are to be seen as such
    pen.drawImage(close, ...at(x, y), w * look.zoom * frame, h * look.zoom * high);
  }
  pen.strokeStyle = "#fff8";
  pen.strokeRect(...at(x, y), w * look.zoom * frame, h * look.zoom * high);
  if (when === "after") over(pen, capture, at);
  else overIndexBefore(pen, capture, at);
  pen.restore();
}

/** @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {(u: number, v: number) => [number, number]} at */
function over(pen, capture, at) {
  const column = capture.bands.findIndex((b) => b.band === look.overlayBand);
  const pair = capture.bands[column];
  if (look.overlay.startsWith("index:")) overIndex(pen, capture, at);
  else if (!pair || look.overlay === "none") return;
  else if (look.overlay === "heat") overHeat(pen, capture, pair, at);
  else if (look.overlay === "vectors") overVectors(pen, capture, pair, at);
  else {
    const preview = capture.preview;
    const made = preview && (look.overlay === "relief" ? dyed(preview, "relief", 0, [FAR, NEAR]) : dyed(preview, "error", column, [SMALL, LARGE]));
    pen.globalAlpha = MAP_OPACITY;
    const [x, y] = at(0, 0);
    const [right, bottom] = at(1, 1);
    if (made) pen.drawImage(made, x, y, right - x, bottom - y);
  }
}

/**
 * An arrow for each window along its shift.
 * @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {Pair} pair
 * @param {(u: number, v: number) => [number, number]} at
 */
function overVectors(pen, capture, pair, at) {
  const lattice = latticeOf(pair);
  const [x0, y0, width, height] = capture.crop;
  const [sx, sy] = capture.scale;
  const apart = 0.5 * nearest(lattice);
  const cell = at((apart * sx) / width, (apart * sy) / height).map((v, i) => Math.abs(v - at(0, 0)[i]));
  for (let i = 0; i < lattice.length; i += 2) {
    const [dx, dy] = [pair.shifts[i], pair.shifts[i + 1]];
    const [x, y] = at((sx * (lattice[i] + 0.5) - x0) / width, (sy * (lattice[i + 1] + 0.5) - y0) / height);
    const shift = dx === null || dy === null ? null : [dx * facts.shift_step_px, dy * facts.shift_step_px];
    pen.fillStyle = shift === null ? "#bbb" : errorColour(Math.hypot(...shift));
    arrow(pen, x, y, shift === null ? [0, 0] : shift.map((v, k) => 1.6 * cell[k] * v / Math.max(ARROW_FULL_PX, Math.hypot(...shift))));
  }
}

/** @param {Capture} capture The index that the overlay shows. */
function indexOf(capture) {
  return capture.indices.find((i) => `index:${i.name}` === look.overlay);
}

/**
 * The image of an index, loaded when it is first shown.
 * @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {(u: number, v: number) => [number, number]} at
 */
function overIndex(pen, capture, at) {
  const index = indexOf(capture);
  if (!index) return;
  if (!(index.name in look.indices)) {
    const image = new Image();
    image.addEventListener("load", () => { if (look.capture === capture) paint(); });
    image.src = index.picture;
    look.indices[index.name] = image;
  }
  const image = look.indices[index.name];
  if (!image.complete || !image.naturalWidth) return;
  const [, , width, height] = capture.crop;
  const scale = Math.min(1, facts.index_picture_px / Math.max(width, height));
  const [x, y] = at(0, 0);
  const [right, bottom] = at(1, 1);
  pen.globalAlpha = INDEX_OPACITY;
  pen.drawImage(image, 0, 0, Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale)), x, y, right - x, bottom - y);
}

/**
 * The index of the unaligned bands; nothing where there is none.
 * @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {(u: number, v: number) => [number, number]} at
 */
function overIndexBefore(pen, capture, at) {
  const [preview, index] = [capture.preview, indexOf(capture)];
  const column = preview && index ? preview.indices.indexOf(index.name) : -1;
  if (!preview || !index || column < 0) return;
  const made = dyed(preview, "indices", column, index.raw ? facts.index_greys : facts.index_colours);
  const [x, y] = at(0, 0);
  const [right, bottom] = at(1, 1);
  pen.globalAlpha = INDEX_OPACITY;
  if (made) pen.drawImage(made, x, y, right - x, bottom - y);
}

/**
 * A grey picture in the colours of stops at equal distances: the sum of the first stop and of each step to the next one
 * times how far the grey is between them. A canvas that is never read adds and multiplies by its blend modes.
 * @param {HTMLImageElement} sheet @param {[number, number, number, number]} place @param {number[][]} stops
 */
function inStops(sheet, place, stops) {
  const [, , width, height] = place;
  const sum = el("canvas", { width, height });
  fill(sum, "source-over", stops[0]);
  const step = 1 / (stops.length - 1);
  stops.slice(1).forEach((stop, k) => {
    for (const sign of [1, -1]) {
      const difference = stop.map((v, i) => Math.max(0, sign * (v - stops[k][i])));
      if (!difference.some(Boolean)) continue;
      const part = el("canvas", { width, height });
      part.getContext("2d")?.drawImage(sheet, ...place, 0, 0, width, height);
      fill(part, "difference", [255, 255, 255]);
      fill(part, "lighter", [k, k, k].map((n) => 255 * n * step)); // white up to the stop before
      fill(part, "difference", [255, 255, 255]);
      fill(part, "color-dodge", [255, 255, 255].map((v) => v * (1 - step))); // divides by the distance of the stops
      fill(part, "multiply", difference);
      const pen = /** @type {CanvasRenderingContext2D} */ (sum.getContext("2d"));
      pen.globalCompositeOperation = sign > 0 ? "lighter" : "difference";
      pen.drawImage(part, 0, 0);
    }
  });
  return sum;
}

/** @param {HTMLCanvasElement} canvas @param {GlobalCompositeOperation} blend @param {number[]} colour */
function fill(canvas, blend, colour) {
  const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  pen.globalCompositeOperation = blend;
  pen.fillStyle = mixed(colour, colour, 0);
  pen.fillRect(0, 0, canvas.width, canvas.height);
}

/**
 * A cell for each window, up to the middle between it and the next one, on whole pixels: cells neither overlap nor part.
 * @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {Pair} pair
 * @param {(u: number, v: number) => [number, number]} at
 */
function overHeat(pen, capture, pair, at) {
  const lattice = latticeOf(pair);
  const [x0, y0, width, height] = capture.crop;
  const [sx, sy] = capture.scale;
  const columns = edges(lattice.filter((_, i) => i % 2 === 0));
  const rows = edges(lattice.filter((_, i) => i % 2 === 1));
  /** @param {number} px */
  const toX = (px) => Math.round(at((sx * (px + 0.5) - x0) / width, 0)[0]);
  /** @param {number} px */
  const toY = (px) => Math.round(at(0, (sy * (px + 0.5) - y0) / height)[1]);
  pen.globalAlpha = MAP_OPACITY;
  for (let i = 0; i < lattice.length; i += 2) {
    const [dx, dy] = [pair.shifts[i], pair.shifts[i + 1]];
    const [column, line] = [columns.get(lattice[i]), rows.get(lattice[i + 1])];
    if (dx === null || dy === null || !column || !line) continue;
    const [left, right, top, bottom] = [toX(column[0]), toX(column[1]), toY(line[0]), toY(line[1])];
    pen.fillStyle = errorColour(Math.hypot(dx, dy) * facts.shift_step_px);
    pen.fillRect(left, top, right - left, bottom - top);
  }
}

/**
 * By the place of each window along an axis, where its cell begins and ends.
 * @param {number[]} places @returns {Map<number, [number, number]>}
 */
function edges(places) {
  const sorted = [...new Set(places)].sort((a, b) => a - b);
  const steps = sorted.slice(1).map((v, i) => v - sorted[i]).sort((a, b) => a - b);
  const half = (steps[Math.floor(steps.length / 2)] ?? 64) / 2;
  /** @param {number} from @param {number | undefined} to @param {number} sign */
  const edge = (from, to, sign) => (to === undefined || Math.abs(to - from) > 3 * half ? from + sign * half : (from + to) / 2);
  return new Map(sorted.map((v, i) => [v, [edge(v, sorted[i - 1], -1), edge(v, sorted[i + 1], 1)]]));
}

/**
 * In the pen's colour on a white edge, which shows on any picture.
 * @param {CanvasRenderingContext2D} pen @param {number} x @param {number} y @param {number[]} along
 */
function arrow(pen, x, y, along) {
  const unit = window.devicePixelRatio;
  const colour = pen.fillStyle;
  for (const [paint, edge] of /** @type {[typeof colour, number][]} */ ([["#fff", 1.5], [colour, 0]])) {
    pen.fillStyle = pen.strokeStyle = paint;
    pen.lineWidth = (2.5 + 2 * edge) * unit;
    pen.beginPath();
    pen.arc(x, y, (4 + edge) * unit, 0, 7);
    pen.fill();
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + along[0], y + along[1]);
    pen.stroke();
  }
}

/**
 * The distance between windows, px.
 * @param {number[]} lattice
 */
function nearest(lattice) {
  let found = Infinity;
  for (let i = 2; i < lattice.length; i += 2) {
    const step = Math.max(Math.abs(lattice[i] - lattice[0]), Math.abs(lattice[i + 1] - lattice[1]));
    if (step > 0) found = Math.min(found, step);
  }
  return Number.isFinite(found) ? found : 64;
}

/** @param {PointerEvent} down */
function drag(down) {
  if (down.button !== 0) return;
  const box = stage.getBoundingClientRect();
  const grabs = look.mode === "swipe" && Math.abs(down.clientX - box.left - look.split * box.width) < 18;
  let [x, y] = [down.clientX, down.clientY];
  stage.setPointerCapture(down.pointerId);
  /** @param {PointerEvent} move */
  const follow = (move) => {
    if (grabs) {
      look.split = Math.min(1, Math.max(0, (move.clientX - box.left) / box.width));
      /** @type {HTMLInputElement} */ (byId("swipe")).value = String(Math.round(look.split * 1000));
      paint();
    } else {
      const across = look.mode === "side" ? box.width / 2 : box.width;
      pan((x - move.clientX) / across, (y - move.clientY) / box.height);
    }
    [x, y] = [move.clientX, move.clientY];
  };
  stage.addEventListener("pointermove", follow);
  for (const end of ["pointerup", "pointercancel"]) {
    stage.addEventListener(end, () => stage.removeEventListener("pointermove", follow), { once: true });
  }
}

/** @type {Record<string, () => void>} */
const keys = {
  "+": () => zoomBy(1.6), "=": () => zoomBy(1.6), "-": () => zoomBy(1 / 1.6), "0": showAll,
  ArrowLeft: () => pan(-0.1, 0), ArrowRight: () => pan(0.1, 0), ArrowUp: () => pan(0, -0.1), ArrowDown: () => pan(0, 0.1),
  " ": () => {
    if (look.mode !== "blink") setMode("blink");
    window.clearInterval(look.timer); // from here on it is changed by hand
    flip();
  },
};

function listenToStage() {
  stage.addEventListener("pointerdown", drag);
  stage.addEventListener("dblclick", (event) => {
    const box = stage.getBoundingClientRect();
    zoomBy(2, ((event.clientX - box.left) / box.width * (look.mode === "side" ? 2 : 1)) % 1, (event.clientY - box.top) / box.height);
  });
  stage.addEventListener("wheel", (event) => {
    if (event.deltaY > 0 && look.zoom === 1) return; // all is seen: the page scrolls
    event.preventDefault();
    const box = stage.getBoundingClientRect();
    const across = ((event.clientX - box.left) / box.width * (look.mode === "side" ? 2 : 1)) % 1;
    zoomBy(event.deltaY < 0 ? 1.2 : 1 / 1.2, across, (event.clientY - box.top) / box.height);
  }, { passive: false });
  stage.addEventListener("keydown", (event) => {
    const act = keys[event.key];
    if (act === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  });
  window.addEventListener("resize", paint);
}

// ---- a capture in words and in numbers

/** @param {Capture} capture */
function indexTable(capture) {
  const absent = capture.unwritten.map(([name, reason]) => el("p", { class: "unwritten" }, el("b", {}, name.toUpperCase()), ` was not written: ${reason}.`));
  if (!capture.indices.length) return absent;
  /** @type {Head[]} */
  const heads = [["Index"], ["Median"], ["5th percentile"], ["95th percentile"], ["Valid pixels"], ["Masked by quality flags"], ["Unit of the bands"]];
  const rows = capture.indices.map((index) => [
    el("a", { href: index.file }, index.name.toUpperCase()), fixed(index.median, 3), fixed(index.p5, 3), fixed(index.p95, 3),
    percent(index.valid), percent(index.masked), index.unit,
  ]);
  return [el("div", { id: "indices" }, tableOf(heads, rows, (i) => i > 0 && i < 6)), ...absent];
}

/** @param {Capture} capture */
function words(capture) {
  const list = el("ul", { class: "words" });
  for (const pair of moving(capture)) list.append(el("li", {}, el("b", {}, pair.band), ` ${sentence(pair, capture)}`));
  for (const band of capture.bands.filter((b) => b.check.length)) list.append(el("li", {}, "Check ", el("b", {}, band.band), `: ${band.check.join("; ")}.`));
  for (const [name, reason] of capture.missing) list.append(el("li", {}, el("b", {}, name), `: ${reason}.`));
  return list;
}

/**
 * What became of a band, for the user of the map.
 * @param {Pair} pair @param {Capture} capture
 */
function sentence(pair, capture) {
  const offset = pair.offset_length_px === null || pair.offset_length_px < 0.05 ? "" : `had an offset of ${fixed(pair.offset_length_px, pair.offset_length_px < 10 ? 1 : 0)} px from ${capture.reference} and `;
  const over = pair.over_1_px === null || pair.over_1_px <= facts.min_share_over_1_px ? "" : ` ${percent(pair.over_1_px)} of its pixels may be off by more than 1 px of the reference.`;
  if (pair.status === "aligned") {
    const left = pair.residual_px;
    if (left === null) return `${offset}is aligned; no window could measure a residual.`;
    const most = pair.residual_p95_px === null ? "" : `, 95 % ${fixed(pair.residual_p95_px)} px`;
    const seen = pair.occluded === null ? "" : ` The relief of the capture is corrected; ${percent(pair.occluded)} of its image is occluded.`;
    const error = pair.error_px === null ? "" : `expected error ${fixed(pair.error_px)} px of the reference${inBandPx(pair)} (RMS), and `;
    return `${offset}is aligned: ${error}at most 0.5 px in 90 % of ${pair.occluded === null ? "the area that both images show" : "its windows"}, suitable for indices of single plants. Median residual ${fixed(left)} px${most}.${over}${seen}`;
  }
  if (pair.status === "predicted") {
    const use = pair.usable ? "indices can use it, but its own image does not confirm it" : "not suitable for indices";
    const how = pair.prediction?.from === "windows" ? "is predicted by its windows" : "is predicted by the rig of the flight";
    return `${offset}${how}, expected error ${fixed(pair.error_px)} px of the reference${inBandPx(pair)}; ${use}: ${pair.reason ?? "no reason was recorded"}.${over}`;
  }
  if (pair.status === "seed_only") return `is not aligned: ${pair.reason ?? "no reason was recorded"}. Only its seed is applied; exclude it from indices.`;
  return `failed: ${pair.reason ?? "no reason was recorded"}. It is nodata in the output.`;
}

/** @param {Capture} capture */
function numbers(capture) {
  /** @type {Head[]} */
  const heads = [
    ["Band"], ["Status"], ["Start", "seed"], ["Expected error, px of the reference", "expected_error"], ["Over 1 px", "over_1_px"], ["Residual, median, px", "residual"],
    ["Residual, p95, px", "residual"], ["Windows measured", "coverage"], ["Retrieval", "retrieval"], ["Geometry, p95, px", "geometry"], ["Occluded", "occluded"], ["Seconds"],
  ];
  const rows = moving(capture).map((pair) => {
    const heldOut = pair.geometry === null ? {} : pair.geometry.held_out_p95_px;
    const geometry = pair.geometry === null ? "–" : `${pair.geometry.kind}${Object.keys(heldOut).length > 1 ? ` (${Object.entries(heldOut).map(([kind, px]) => `${kind} ${fixed(px)}`).join(", ")})` : ""}`;
    return [
      pair.band, bandBadge(pair), pair.seed ?? "–", `${fixed(pair.error_px, 3)}${inBandPx(pair)}`, pair.over_1_px === null ? "–" : percent(pair.over_1_px),
      fixed(pair.residual_px, 3), fixed(pair.residual_p95_px, 3), pair.coverage === null ? "–" : `${Math.round(pair.coverage * 100)} %`, fixed(pair.retrieval), geometry,
      pair.occluded === null ? "–" : percent(pair.occluded), pair.seconds.toFixed(1),
    ];
  });
  const words = heads.findIndex(([, term]) => term === "geometry");
  return tableOf(heads, rows, (i) => i > 2 && i !== words);
}

/** @type {[string, string][]} Name and column. */
const SIMILARITIES = [["mattes_mi", "Mattes MI"], ["nmi", "NMI"], ["ncc", "NCC"], ["gradient_correlation", "Gradients"], ["structure_ssim", "SSIM"]];

/** @param {Capture} capture */
function similarities(capture) {
  const rows = moving(capture).map((pair) => [pair.band, ...SIMILARITIES.map(([name]) => {
    const [before, after] = pair.similarity?.[name] ?? [null, null];
    return `${fixed(before, 3)} → ${fixed(after, 3)}`;
  })]);
  /** @type {Head[]} */
  const heads = [["Band"], ...SIMILARITIES.map(([, title]) => /** @type {Head} */ ([title, "similarity"]))];
  return el("details", { class: "more" }, el("summary", {}, "Similarity of the images before → after alignment (Mattes MI: lower is better, others: higher)"), tableOf(heads, rows, (i) => i > 0));
}

// ---- what happens

function follow() {
  const wanted = location.hash.startsWith("#capture=") ? decodeURIComponent(location.hash.slice(9)) : null;
  const row = wanted === null ? undefined : captures.find((c) => c.label === wanted);
  if (row === undefined) return;
  show(row, () => {
    byId("capture").scrollIntoView({ block: "start" });
    byId("capture").focus({ preventScroll: true });
  });
}

/** Show the capture of the address, else one with a failed band. */
function followOrChoose() {
  if (location.hash.startsWith("#capture=")) follow();
  else if (captures.length) show(captures.find((c) => c.status === "failed") ?? captures.find(isShort) ?? captures[0]);
}

/**
 * On paper: what failed, with its reasons; the table has the captures that are not ok, or all where all are.
 * @param {boolean} paper
 */
function forPaper(paper) {
  document.querySelectorAll("details.short").forEach((one) => {
    const details = /** @type {HTMLDetailsElement} */ (one);
    if (paper) details.dataset["was"] = String(details.open);
    details.open = paper || details.dataset["was"] === "true";
  });
  const failed = captures.filter((c) => c.status !== "ok");
  if (!paper) tableBody();
  else if (failed.length) byId("table").querySelector("tbody")?.replaceChildren(...failed.map(row));
}

if (facts.rows !== null) add_rows(facts.rows);
if (facts.details !== null) add_details(facts.details);
document.querySelectorAll("table").forEach(labelCells);
tableHead();
tableBody();
drawMap();
document.getElementById("map-colour")?.addEventListener("change", colourMap);
document.getElementById("map-save")?.addEventListener("click", saveMap);
window.matchMedia("print").addEventListener("change", (event) => forPaper(event.matches));
listenToStage();
byId("find").addEventListener("input", tableBody);
byId("only").addEventListener("change", tableBody);
window.addEventListener("hashchange", follow);
followOrChoose();
if (facts.row_files.length) loadRows(0);
