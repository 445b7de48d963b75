/**
 * The capture that is open: its heading, and what became of its bands in words and in numbers.
 */

/** @type {{row: Row | null, capture: Capture | null, part: Details | null}} */
const opened = { row: null, capture: null, part: null };
/** The row whose details are being loaded, or are open. @type {Row | null} */
let wantedRow = null;

/** @type {Column<Index>[]} */
const INDEX_COLUMNS = [
  { title: "Index", cell: (index) => el("a", { href: index.file }, index.name.toUpperCase()) },
  { title: "Median", isNumber: true, cell: (index) => numberText(index.median, 3) },
  { title: "5th percentile", isNumber: true, cell: (index) => numberText(index.p5, 3) },
  { title: "95th percentile", isNumber: true, cell: (index) => numberText(index.p95, 3) },
  { title: "Valid pixels", isNumber: true, cell: (index) => percentText(index.valid) },
  { title: "Masked by quality flags", isNumber: true, cell: (index) => percentText(index.masked) },
  { title: "Unit of the bands", cell: (index) => index.unit },
];
/** @type {Column<Pair>[]} */
const BAND_COLUMNS = [
  { title: "Band", cell: (pair) => pair.band },
  { title: "Status", cell: (pair) => badge(pair.status, pair.status === "failed" ? "seed_only" : pair.status) },
  { title: "Start", term: "seed", cell: (pair) => pair.seed ?? "–" },
  { title: "Expected error, px of the reference", term: "expected_error", isNumber: true, cell: (pair) => errorText(pair, 3) },
  { title: "Over 1 px", term: "over_1_px", isNumber: true, cell: (pair) => percentText(pair.over_1_px) },
  { title: "Residual, median, px", term: "residual", isNumber: true, cell: (pair) => numberText(pair.residual_px, 3) },
  { title: "Residual, p95, px", term: "residual", isNumber: true, cell: (pair) => numberText(pair.residual_p95_px, 3) },
  { title: "Windows measured", term: "coverage", isNumber: true, cell: (pair) => percentText(pair.coverage, 0) },
  { title: "Retrieval", term: "retrieval", isNumber: true, cell: (pair) => numberText(pair.retrieval) },
  { title: "Geometry, p95, px", term: "geometry", cell: (pair) => geometryText(pair.geometry) },
  { title: "Occluded", term: "occluded", isNumber: true, cell: (pair) => percentText(pair.occluded) },
  { title: "Seconds", isNumber: true, cell: (pair) => numberText(pair.seconds, 1) },
];
/** @type {Column<Pair>[]} */
const SIMILARITY_COLUMNS = [
  { title: "Band", cell: (pair) => pair.band },
  ...[["mattes_mi", "Mattes MI"], ["nmi", "NMI"], ["ncc", "NCC"], ["gradient_correlation", "Gradients"], ["structure_ssim", "SSIM"]].map(([name, title]) => ({
    title, term: "similarity", isNumber: true, cell: (/** @type {Pair} */ pair) => [0, 1].map((i) => numberText(pair.similarity?.[name]?.[i], 3)).join(" → "),
  })),
];

/**
 * Show a capture, as soon as its details are loaded.
 * @param {Row} row @param {() => void} [onShown]
 */
function openCapture(row, onShown = () => {}) {
  wantedRow = row;
  withDetails(row, (capture, part) => {
    if (wantedRow !== row) return;
    Object.assign(opened, { row, capture, part });
    markOpened();
    const dot = dots.get(row);
    dot?.parentNode?.append(dot); // drawn on top
    prepareView(capture);
    byId("capture").hidden = false;
    byId("capture").replaceChildren(...heading(row, capture), ...viewer(capture), ...indexTable(capture), bandsInWords(capture), tableOf(BAND_COLUMNS, movingBands(capture)), similarityTable(capture));
    paint();
    onShown();
  });
}

/** The label of a capture in the address of the page; null without one. */
function labelInHash() {
  if (!location.hash.startsWith(HASH)) return null;
  const label = location.hash.slice(HASH.length);
  try {
    return decodeURIComponent(label);
  } catch {
    return label; // the address was cut within a character
  }
}

/** Show the capture of the address, if it is known, and scroll to it. */
function openByHash() {
  const label = labelInHash();
  const row = captures.find((one) => one.label === label);
  if (row === undefined) return;
  openCapture(row, () => {
    byId("capture").scrollIntoView({ block: "start" });
    byId("capture").focus({ preventScroll: true });
  });
}

/**
 * Show the capture of the address, else one with a failed band; while rows are still loaded, the address may be that of
 * one of them. @param {boolean} isLoaded
 */
function openByHashOrWorst(isLoaded) {
  const label = labelInHash();
  if (label !== null && (!isLoaded || captures.some((row) => row.label === label))) openByHash();
  else if (captures.length) openCapture(captures.find((row) => row.status === "failed") ?? captures.find(isUnaligned) ?? captures[0]);
}

/** @param {Capture} capture @returns {Pair[]} */
function movingBands(capture) {
  return capture.bands.filter((b) => b.status !== "reference");
}

/** @param {Row} row @param {Capture} capture */
function heading(row, capture) {
  const order = listedRows();
  const at = order.indexOf(row);
  /** @param {string} text @param {Row | undefined} to */
  const step = (text, to) => button(text, () => { if (to !== undefined) location.hash = hashOf(to); }, { class: "button", disabled: to === undefined });
  const altitude = capture.altitude_m === null ? "" : `, ${capture.altitude_m.toFixed(0)} m`;
  const position = capture.position === null ? "" : ` · ${capture.position.map((v) => v.toFixed(6)).join(", ")}${altitude}`;
  const files = el("span", {}, capture.radiometry === null ? "" : ` · ${capture.radiometry}`);
  for (const [file, name] of [[capture.stack, "aligned stack"], [capture.sidecar, "sidecar"], [capture.relief, "relief"], [capture.picture, "picture"]]) {
    if (file !== null) files.append(" · ", el("a", { href: String(file) }, String(name)));
  }
  return [
    el("div", { class: "heading" }, el("h2", { id: "capture-title" }, capture.label, " ", captureBadge(capture)), step("Previous", at < 0 ? undefined : order[at - 1]), step("Next", at < 0 ? undefined : order[at + 1])),
    el("p", { class: "soft" }, `${capture.camera} · ${timeText(capture.captured_at)}${position} · reference ${capture.reference}`, files),
  ];
}

/** @param {Capture} capture */
function indexTable(capture) {
  const unwritten = capture.unwritten.map(([name, reason]) => el("p", { class: "unwritten" }, el("b", {}, name.toUpperCase()), ` was not written: ${reason}.`));
  return capture.indices.length ? [el("div", { id: "indices" }, tableOf(INDEX_COLUMNS, capture.indices)), ...unwritten] : unwritten;
}

/** @param {Capture} capture */
function similarityTable(capture) {
  return el("details", { class: "more" }, el("summary", {}, "Similarity of the images before → after alignment (Mattes MI: lower is better, others: higher)"), tableOf(SIMILARITY_COLUMNS, movingBands(capture)));
}

/** @param {Geometry | null} geometry */
function geometryText(geometry) {
  if (geometry === null) return "–";
  const heldOut = Object.entries(geometry.held_out_p95_px).map(([kind, px]) => `${kind} ${numberText(px)}`);
  return heldOut.length > 1 ? `${geometry.kind} (${heldOut.join(", ")})` : geometry.kind;
}

/** @param {Capture} capture */
function bandsInWords(capture) {
  return el("ul", { class: "words" },
    ...movingBands(capture).map((pair) => el("li", {}, el("b", {}, pair.band), ` ${sentence(pair, capture)}`)),
    ...capture.bands.filter((b) => b.check.length).map((b) => el("li", {}, "Check ", el("b", {}, b.band), `: ${b.check.join("; ")}.`)),
    ...capture.missing.map(([name, reason]) => el("li", {}, el("b", {}, name), `: ${reason}.`)));
}

/**
 * What became of a band, for the user of the map.
 * @param {Pair} pair @param {Capture} capture
 */
function sentence(pair, capture) {
  const offset_px = pair.offset_length_px ?? 0;
  const offset = offset_px < 0.05 ? "" : `had an offset of ${numberText(offset_px, offset_px < 10 ? 1 : 0)} px from ${capture.reference} and `;
  const reason = pair.reason ?? "no reason was recorded";
  const off = pair.over_1_px === null || pair.over_1_px <= facts.min_share_over_1_px ? "" : ` ${percentText(pair.over_1_px)} of its pixels may be off by more than 1 px of the reference.`;
  if (pair.status === "aligned") return `${offset}is aligned${alignmentInWords(pair, off)}`;
  if (pair.status === "predicted") {
    const source = pair.prediction?.from === "windows" ? "its windows" : "the rig of the flight";
    const use = pair.usable ? "indices can use it, but its own image does not confirm it" : "not suitable for indices";
    return `${offset}is predicted by ${source}, ${expectedError(pair)}; ${use}: ${reason}.${off}`;
  }
  if (pair.status === "seed_only") return `is not aligned: ${reason}. Only its seed is applied; exclude it from indices.`;
  return `failed: ${reason}. It is nodata in the output.`;
}

/** @param {Pair} pair */
function expectedError(pair) {
  return `expected error ${errorText(pair, 2, " px of the reference")}`;
}

/** @param {Pair} pair @param {string} off The sentence about pixels that may be off. */
function alignmentInWords(pair, off) {
  if (pair.residual_px === null) return "; no window could measure a residual.";
  const error = pair.error_px === null ? "" : `${expectedError(pair)} (RMS), and `;
  const area = pair.occluded === null ? "the area that both images show" : "its windows";
  const p95 = pair.residual_p95_px === null ? "" : `, 95 % ${numberText(pair.residual_p95_px)} px`;
  const relief = pair.occluded === null ? "" : ` The relief of the capture is corrected; ${percentText(pair.occluded)} of its image is occluded.`;
  return `: ${error}at most 0.5 px in 90 % of ${area}, suitable for indices of single plants. Median residual ${numberText(pair.residual_px)} px${p95}.${off}${relief}`;
}
