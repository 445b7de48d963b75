"use strict";
/**
 * The data of the captures. The page contains the rows of the first captures and the details of fewer; the scripts in the
 * folder report-data contain those of the others. The rows are loaded after the page is shown, details and previews when
 * a capture is opened.
 *
 * report/pages.py joins the scripts of this folder in one order; they share their top-level names.
 */

/**
 * @typedef {{error_px: number | null, error_band_px: number | null}} ExpectedError
 *   `error_px` is in px of the reference; `error_band_px` is null if the pixels of the band have the same size.
 * @typedef {{kind: string, held_out_p95_px: Record<string, number | null>}} Geometry
 * @typedef {ExpectedError & {band: string, wavelength_nm: number | null, status: string, reason: string | null, seed: string | null,
 *   seconds: number, written: boolean, offset_px: [number, number] | null, offset_length_px: number | null,
 *   residual_px: number | null, residual_p95_px: number | null, usable: boolean, over_1_px: number | null,
 *   coverage: number | null, retrieval: number | null, similarity: Record<string, [number | null, number | null]> | null,
 *   prediction: {from: string} | null, geometry: Geometry | null, occluded: number | null, check: string[], lattice: number,
 *   shifts: (number | null)[]}} Pair A band and its alignment to the reference; also the reference itself.
 * @typedef {{name: string, median: number | null, p5: number | null, p95: number | null, valid: number, masked: number,
 *   span: [number, number], unit: string, raw: boolean, file: string, picture: string}} Index
 * @typedef {{file: string, tile_px: [number, number], detail_px: [number, number], detail: Rectangle, error_full_px: number | null,
 *   relief: {parallax_px: [number, number], range_m: [number, number] | null} | null,
 *   indices: string[], rows: Record<string, [number, number, number]>}} Preview The file is a sheet of grey pictures: `rows`
 *   has top, width and height by what they show; each row has a picture of each band.
 * @typedef {[x: number, y: number, width: number, height: number]} Rectangle
 * @typedef {ExpectedError & {label: string, captured_at: string, camera: string, status: string, shown: string,
 *   position: [number, number] | null, altitude_m: number | null, missing: [string, string][], seconds: number,
 *   stack: string | null, residual_px: number | null}} CaptureFacts `shown` is the status, or "ok_by_prediction"; `missing`
 *   has band and reason; residual and error are the largest of the aligned bands and of those that indices can use.
 * @typedef {CaptureFacts & {radiometry: string | null, reference: string, crop: Rectangle, scale: [number, number], sidecar: string,
 *   relief: string | null, picture: string | null, preview: Preview | null, bands: Pair[], indices: Index[],
 *   unwritten: [string, string][]}} Capture `unwritten` has index and reason.
 * @typedef {CaptureFacts & {bands: [string, string][], indices: Record<string, number | null>, raw: boolean, check: boolean}} Row
 *   The row of a capture in the table, with name and status of each moving band, and the medians of indices.
 * @typedef {{from: number, records: Row[]}} Rows
 * @typedef {{from: number, records: Capture[], first_lattice: number, lattices: number[][]}} Details
 *   `from` is the number of captures before the part, `first_lattice` the number of lattices.
 * @typedef {{captures: number, shift_step_px: number, min_share_over_1_px: number, error_full_px: number, index_picture_px: number,
 *   index_colours: number[][], index_greys: number[][], rows: Rows | null, details: Details | null, details_per_part: number, row_files: string[], detail_files: string[]}} FlightFacts
 *   The first part of rows and details, and the files of others. The colours of errors and residuals are full at
 *   `error_full_px`; `index_picture_px` is the longer side of the image in the picture of an index, above the histogram;
 *   its colours and greys are stops at equal distances.
 */

/** @type {FlightFacts} */
const facts = JSON.parse(byId("facts").textContent ?? "");
/** The rows that are loaded, in the order of the labels. @type {Row[]} */
const captures = [];
/** The details that are loaded, by the number of their part. @type {Map<number, Details>} */
const details = new Map();

/** The scripts in the folder report-data call this and `add_details`. @param {Rows} part */
function add_rows(part) {
  captures.push(...part.records);
}

/** @param {Details} part */
function add_details(part) {
  details.set(part.from / facts.details_per_part, part);
}

/** @param {string} file @param {() => void} onLoad @param {() => void} onError */
function loadScript(file, onLoad, onError) {
  const script = el("script", { src: file });
  script.addEventListener("load", onLoad);
  script.addEventListener("error", onError);
  document.head.append(script);
}

/** @param {string} file */
function notLoadedText(file) {
  return `${file} cannot be loaded: copy the folder report-data together with this page, or make the report again.`;
}

/** Load the rows that are not in the page, one file after another, then show them. */
function loadRows(number = 0) {
  const file = facts.row_files[number];
  if (file === undefined) {
    showRows();
    drawMap();
    if (opened.capture === null) openByHashOrWorst(true);
    return;
  }
  byId("count").textContent = `${captures.length} of ${facts.captures} loaded`;
  loadScript(file, () => loadRows(number + 1), () => { byId("count").textContent = notLoadedText(file); });
}

/**
 * Pass on the details of a capture, which may have to be loaded first.
 * @param {Row} row @param {(capture: Capture, part: Details) => void} onDetails
 */
function withDetails(row, onDetails) {
  const number = captures.indexOf(row);
  const part = Math.floor(number / facts.details_per_part);
  const loaded = details.get(part);
  if (loaded !== undefined) {
    onDetails(loaded.records[number - loaded.from], loaded);
    return;
  }
  const file = facts.detail_files[part - 1];
  loadScript(file, () => withDetails(row, onDetails), () => {
    byId("capture").hidden = false;
    byId("capture").replaceChildren(el("h2", { id: "capture-title" }, row.label), el("p", {}, notLoadedText(file)));
  });
}
