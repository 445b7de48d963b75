/**
 * What the canvas of the viewer shows: the composite before and after, with the overlay.
 */

/** @typedef {(u: number, v: number) => [number, number]} Projection Shares of the picture's sides to px of the canvas. */

const SCREEN_SHARE = 78; // of its height, at most, for a picture
const CLOSE_ENOUGH = 1.5; // as wide as the small picture has pixels, the detail is drawn over it
/** @type {Rectangle} */
const WHOLE = [0, 0, 1, 1];

/** Number of pictures side by side. */
function panes() {
  return view.mode === "side" ? 2 : 1;
}

function paint() {
  const { capture } = opened;
  const preview = capture?.preview;
  if (!capture || !preview || !stage.isConnected) return;
  fitStage(capture);
  const { width, height } = stage;
  const pen = penOf(stage);
  pen.clearRect(0, 0, width, height);
  if (view.mode === "blink") drawPicture(pen, capture, preview, view.blinking, [0, width], 0);
  else {
    const middle = view.mode === "side" ? paneWidth() : Math.round(view.split * width);
    drawPicture(pen, capture, preview, "before", [0, middle], 0);
    drawPicture(pen, capture, preview, "after", [middle, width], view.mode === "side" ? middle : 0);
    pen.fillStyle = "#fff";
    pen.fillRect(middle - 1, 0, 2, height);
  }
  describe(capture, preview);
}

/** Give the canvas the pixels of the screen. @param {Capture} capture */
function fitStage(capture) {
  const aspect = capture.crop[3] / capture.crop[2] / panes();
  byId("viewer").style.maxWidth = `${SCREEN_SHARE / aspect}vh`;
  const width = Math.max(1, Math.round(stage.clientWidth * window.devicePixelRatio));
  const height = Math.round(width * aspect);
  if (stage.width !== width) stage.width = width;
  if (stage.height !== height) stage.height = height;
  stage.style.touchAction = view.zoom > 1 ? "none" : "pan-y"; // all is seen: the page scrolls
}

/** The width of what one picture is shown in, px of the canvas. */
function paneWidth() {
  return Math.floor(stage.width / panes());
}

/**
 * Tell which bands are shown, and what the overlay means.
 * @param {Capture} capture @param {Preview} preview
 */
function describe(capture, preview) {
  const blinking = view.mode === "blink" ? view.blinking : "";
  byId("over-note").replaceChildren(channelNote(capture), " ", OVERLAY_NOTES[view.overlay] ?? "", " ", ...overlayLegend(capture, preview));
  byId("tag-left").textContent = blinking || "before";
  byId("tag-right").textContent = isMissing(preview.file) ? "the preview is not there" : capture.bands.some((b) => b.written) ? "after" : "after: nothing was written";
  byId("tag-right").hidden = blinking !== "";
  stage.dataset["blinking"] = blinking;
}

/** Which bands are shown, and which of them differ from other captures. @param {Capture} capture */
function channelNote(capture) {
  const black = capture.bands.filter((b) => view.bands.includes(b.band) && !b.written).map((b) => b.band);
  const absent = (view.wantedBands ?? []).filter((name) => columnOf(capture, name) < 0);
  return [
    `Shown: ${view.bands.join(", ")} as red, green, blue.`,
    black.length ? ` ${black.join(", ")} was not written: black after, and the colours differ from those of other captures.` : "",
    absent.length ? ` Other bands than for other captures, because ${absent.join(", ")} is missing.` : "",
  ].join("");
}

/** The place of a band on the sheet. @param {Capture} capture @param {string} band */
function columnOf(capture, band) {
  return capture.bands.findIndex((b) => b.band === band);
}

/**
 * Draw one picture and its overlay, within a strip of the canvas.
 * @param {CanvasRenderingContext2D} pen @param {Capture} capture @param {Preview} preview @param {When} when
 * @param {[number, number]} strip Left and right end. @param {number} origin Left end of the picture if all is seen.
 */
function drawPicture(pen, capture, preview, when, [left, right], origin) {
  const [width, height] = [view.zoom * paneWidth(), view.zoom * stage.height];
  /** @type {Projection} */
  const at = (u, v) => [origin + (u - view.x) * width, (v - view.y) * height];
  const columns = view.bands.map((name) => columnOf(capture, name));
  const detail = onCanvas(at, preview.detail);
  pen.save();
  pen.beginPath();
  pen.rect(left, 0, right - left, stage.height);
  pen.clip();
  drawOver(pen, at, fromSheet(preview, when, columns, compose));
  if (view.zoom > 1 && width / preview.tile_px[0] > CLOSE_ENOUGH) {
    pen.imageSmoothingEnabled = detail[2] / preview.detail_px[0] < 3; // pixels are to be seen as such
    drawOver(pen, at, fromSheet(preview, `${when}_detail`, columns, compose), preview.detail);
  }
  pen.strokeStyle = "#fff8";
  pen.strokeRect(...detail);
  drawOverlay(pen, capture, preview, when, at);
  pen.restore();
}

/**
 * @param {Projection} at @param {Rectangle} rectangle In shares of the picture's sides.
 * @returns {Rectangle} In px of the canvas.
 */
function onCanvas(at, [x, y, width, height]) {
  const [left, top] = at(x, y);
  const [right, bottom] = at(x + width, y + height);
  return [left, top, right - left, bottom - top];
}

/**
 * Draw an image over the picture, or over a part of it; nothing if it is not loaded yet.
 * @param {CanvasRenderingContext2D} pen @param {Projection} at @param {HTMLCanvasElement | null} image @param {Rectangle} [place]
 */
function drawOver(pen, at, image, place = WHOLE) {
  if (image) pen.drawImage(image, ...onCanvas(at, place));
}
