/**
 * Overlays of the pictures: residuals, expected error, parallax and indices.
 */

/**
 * @typedef {{x: number, y: number, shift: Point | null}} MatchingWindow
 *   Its centre and its residual shift, px of the reference; null if none could be measured.
 */

const ARROW_FULL_PX = 0.5; // the arrow of a residual is full
const ERROR_MARKS_PX = [0, 0.5, 1, 2];
const INDEX_OPACITY = 0.9;
const MAP_OPACITY = 0.75; // of errors and parallax: edges of the picture show through
const OVERLAYS_OF_A_BAND = ["vectors", "heat", "error"];
/** @type {Record<string, string>} */
const OVERLAY_NOTES = {
  vectors: `Residual shift of each window; an arrow of ${ARROW_FULL_PX} px or more reaches most of the way to the next window. Grey: none could be measured.`,
  heat: "Residual shift of each window:",
  error: "Expected error at every pixel (unknown: as the largest):",
  relief: "Parallax relative to the plane that most of the scene is on: the lighter, the nearer.",
};

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

/** The index that the overlay shows. @param {Capture} capture */
function shownIndex(capture) {
  return capture.indices.find((index) => `index:${index.name}` === view.overlay);
}

/** @param {Capture} capture @param {Preview} preview */
function overlayLegend(capture, preview) {
  if (OVERLAYS_OF_A_BAND.includes(view.overlay)) {
    const full_px = view.overlay === "error" ? preview.error_full_px ?? 0 : facts.error_full_px;
    return ERROR_MARKS_PX.filter((px) => px <= full_px).map((px) => legendKey(errorColour(px, full_px), `${px} px${px === full_px ? " and more" : ""}`));
  }
  const index = shownIndex(capture);
  if (index) {
    const keys = scaleKeys([0, 0.2, 0.4, 0.6, 0.8, 1], index.span, (share) => colourBetween(indexStops(index.raw), share), (value) => value.toFixed(2));
    return [...keys, el("span", {}, index.raw ? RAW_NOTE : `${index.name.toUpperCase()} of ${index.unit}.`)];
  }
  if (view.overlay !== "relief" || !preview.relief) return [];
  const keys = scaleKeys([0, 0.5, 1], preview.relief.parallax_px, (share) => colourBetween(PARALLAX_STOPS, share), (px) => `${px.toFixed(1)} px`);
  const range = preview.relief.range_m?.map((m) => m.toFixed(m < 10 ? 2 : 1));
  return range ? [...keys, el("span", {}, `Range of the scene: ${range.join(" to ")} m.`)] : keys;
}

/**
 * @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {Preview} preview @param {When} when
 * @param {Projection} at
 */
function drawOverlay(pen, capture, preview, when, at) {
  const index = shownIndex(capture);
  const column = columnOf(capture, view.overlayBand);
  const pair = capture.bands[column];
  pen.globalAlpha = index ? INDEX_OPACITY : view.overlay === "vectors" ? 1 : MAP_OPACITY;
  if (index) drawOver(pen, at, when === "after" ? indexPicture(capture, index) : coloured(preview, "indices", preview.indices.indexOf(index.name), indexStops(index.raw)));
  else if (when === "before" || !pair) return;
  else if (view.overlay === "heat") drawHeat(pen, windowsOf(pair), fromReferencePx(capture, at));
  else if (view.overlay === "vectors") drawVectors(pen, windowsOf(pair), fromReferencePx(capture, at));
  else if (view.overlay === "error") drawOver(pen, at, coloured(preview, "error", column, ERROR_STOPS));
  else if (view.overlay === "relief") drawOver(pen, at, coloured(preview, "relief", 0, PARALLAX_STOPS));
}

/**
 * A picture of the sheet in the colours of stops; null where there is none.
 * @param {Preview} preview @param {string} line @param {number} column @param {number[][]} stops
 */
function coloured(preview, line, column, stops) {
  return column < 0 ? null : fromSheet(preview, line, [column], (sheet, [place]) => colourGrey(sheet, place, stops));
}

/** The image in the picture of an index, above the histogram. @param {Capture} capture @param {Index} index */
function indexPicture(capture, index) {
  const image = imageIn(index.picture);
  if (image === null) return null;
  const [, , ...size_px] = capture.crop;
  const scale = Math.min(1, facts.index_picture_px / Math.max(...size_px));
  const [width, height] = size_px.map((px) => Math.max(1, Math.round(px * scale)));
  pictures.made[index.picture] ??= cutOut(image, [0, 0, width, height]);
  return pictures.made[index.picture];
}

/** @param {Pair} pair @returns {MatchingWindow[]} */
function windowsOf(pair) {
  const lattice = opened.part?.lattices[pair.lattice - opened.part.first_lattice] ?? [];
  return [...Array(lattice.length / 2).keys()].map((n) => {
    const [dx, dy] = pair.shifts.slice(2 * n, 2 * n + 2);
    return { x: lattice[2 * n], y: lattice[2 * n + 1], shift: dx === null || dy === null ? null : [dx * facts.shift_step_px, dy * facts.shift_step_px] };
  });
}

/**
 * Project px of the reference instead of shares of the picture.
 * @param {Capture} capture @param {Projection} at @returns {Projection}
 */
function fromReferencePx(capture, at) {
  const [x0, y0, width, height] = capture.crop;
  const [sx, sy] = capture.scale;
  return (x, y) => at((sx * (x + 0.5) - x0) / width, (sy * (y + 0.5) - y0) / height);
}

/**
 * An arrow for each window along its shift.
 * @param {CanvasRenderingContext2D} pen @param {MatchingWindow[]} windows @param {Projection} project
 */
function drawVectors(pen, windows, project) {
  const step_px = Math.min(windowStep(windows.map(({ x }) => x)), windowStep(windows.map(({ y }) => y)));
  const [origin, end] = [project(0, 0), project(step_px, step_px)];
  for (const { x, y, shift } of windows) {
    const length_px = shift === null ? 0 : Math.hypot(...shift);
    pen.fillStyle = shift === null ? "#bbb" : errorColour(length_px);
    const along = (shift ?? [0, 0]).map((v, i) => (0.8 * (end[i] - origin[i]) * v) / Math.max(ARROW_FULL_PX, length_px));
    drawArrow(pen, project(x, y), along);
  }
}

/**
 * In the pen's colour on a white edge, which shows on any picture.
 * @param {CanvasRenderingContext2D} pen @param {Point} start @param {number[]} along
 */
function drawArrow(pen, [x, y], along) {
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
 * A cell for each window, up to the middle between it and the next one, on whole pixels: cells neither overlap nor part.
 * @param {CanvasRenderingContext2D} pen @param {MatchingWindow[]} windows @param {Projection} project
 */
function drawHeat(pen, windows, project) {
  const [columns, rows] = [cellEdges(windows.map(({ x }) => x)), cellEdges(windows.map(({ y }) => y))];
  for (const { x, y, shift } of windows) {
    const [column, row] = [columns.get(x), rows.get(y)];
    if (shift === null || !column || !row) continue;
    const [left, top] = project(column[0], row[0]).map(Math.round);
    const [right, bottom] = project(column[1], row[1]).map(Math.round);
    pen.fillStyle = errorColour(Math.hypot(...shift));
    pen.fillRect(left, top, right - left, bottom - top);
  }
}

/** @param {number[]} places Of windows along an axis. */
function sortedPlaces(places) {
  return [...new Set(places)].sort((a, b) => a - b);
}

/** The distance between windows along an axis, px. @param {number[]} places */
function windowStep(places) {
  const sorted = sortedPlaces(places);
  return median(sorted.slice(1).map((v, i) => v - sorted[i])) ?? 64;
}

/**
 * By the place of each window along an axis, where its cell begins and ends.
 * @param {number[]} places @returns {Map<number, [number, number]>}
 */
function cellEdges(places) {
  const sorted = sortedPlaces(places);
  const half = windowStep(places) / 2;
  /** @param {number} from @param {number | undefined} to @param {number} sign */
  const edge = (from, to, sign) => (to === undefined || Math.abs(to - from) > 3 * half ? from + sign * half : (from + to) / 2);
  return new Map(sorted.map((v, i) => [v, [edge(v, sorted[i - 1], -1), edge(v, sorted[i + 1], 1)]]));
}
