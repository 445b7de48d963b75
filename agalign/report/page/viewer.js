/**
 * The viewer of a capture: what it shows, which stays from capture to capture, and its tools.
 */

/**
 * @typedef {"swipe" | "blink" | "side"} Mode
 * @typedef {"before" | "after"} When
 * @typedef {[red: string, green: string, blue: string]} Composite Names of bands.
 */

const BLINK_MS = 700;
const NARROW_PX = 640; // as in page.css

const view = {
  /** @type {Composite | null} */ wantedBands: null, // kept for the captures that have these bands
  /** @type {Composite} */ bands: ["", "", ""],
  /** @type {Mode} */ mode: "swipe",
  split: 0.5, // share of the width that is before
  /** @type {When} */ blinking: "before",
  timer: 0,
  zoom: 1, x: 0, y: 0, // the left upper corner that is seen, in shares of the picture
  overlay: "none", overlayBand: "",
};
/** @type {HTMLCanvasElement} */
const stage = el("canvas", { tabindex: 0, role: "img", "aria-label": "The composite before and after" });

/** Choose the bands and the overlay of a capture: those of the capture before, if it has them. @param {Capture} capture */
function prepareView(capture) {
  forgetPictures();
  const names = capture.bands.map((b) => b.band);
  view.wantedBands ??= presets(facts.details?.records.find((c) => c.missing.length === 0) ?? capture)[0].bands;
  view.bands = view.wantedBands.every((b) => names.includes(b)) ? view.wantedBands : presets(capture)[0].bands;
  if (!overlaysOf(capture).some(([value]) => value === view.overlay)) view.overlay = "none";
  if (!names.includes(view.overlayBand)) view.overlayBand = movingBands(capture)[0]?.band ?? "";
}

/**
 * Composites by what the bands are, each where the bands are there.
 * @param {Capture} capture @returns {{name: string, bands: Composite}[]}
 */
function presets(capture) {
  /** @param {number} low @param {number} high @param {RegExp} name */
  const find = (low, high, name) =>
    (capture.bands.find((b) => b.wavelength_nm !== null && b.wavelength_nm >= low && b.wavelength_nm < high) ?? capture.bands.find((b) => b.wavelength_nm === null && name.test(b.band)))?.band;
  const [blue, green, red, nir, edge] = [find(430, 495, /^blue/i), find(520, 585, /^green/i), find(620, 690, /^red$/i), find(760, 1000, /^nir/i), find(695, 755, /red ?edge/i)];
  const [first, second] = movingBands(capture).map((b) => b.band);
  /** @type {[string, (string | undefined)[]][]} */
  const known = [["false colour", [nir, red, green]], ["true colour", [red, green, blue]], ["red edge", [nir, edge, green]], ["first bands", [first ?? capture.reference, second ?? first ?? capture.reference, capture.reference]]];
  return known.flatMap(([name, bands]) => (bands.every((b) => b !== undefined) ? [{ name, bands: /** @type {Composite} */ (bands) }] : []));
}

/** @param {Capture} capture */
function viewer(capture) {
  if (capture.preview === null) {
    return capture.picture === null ? [] : [el("img", { class: "wide", src: capture.picture, loading: "lazy", alt: "Before and after alignment" })];
  }
  const frame = el("div", { class: "stage" }, stage, el("span", { class: "tag left", id: "tag-left" }), el("span", { class: "tag right", id: "tag-right" }));
  const swipe = el("input", { type: "range", id: "swipe", min: 0, max: 1000, value: Math.round(view.split * 1000), hidden: view.mode !== "swipe", "aria-label": "How much of the picture is before: the rest is after" });
  swipe.addEventListener("input", () => {
    view.split = Number(swipe.value) / 1000;
    paint();
  });
  const folded = el("details", { class: "controls", open: window.innerWidth > NARROW_PX }, el("summary", {}, "Bands and overlay"), compositeTools(capture), overlayTools(capture));
  return [folded, viewTools(), el("div", { id: "viewer" }, frame, swipe), el("p", { class: "soft", id: "over-note" }),
    el("p", { class: "soft hint mouse" }, "Drag the line, or drag the picture; the wheel zooms. The thin frame is the detail, which is shown at full resolution. On the picture the keys + and − zoom, arrows move, 0 shows all, the space bar changes between before and after."),
    el("p", { class: "soft hint touch" }, "Drag the white line with a finger to compare before and after; + and − zoom, and a finger then moves the picture; All shows all of it again. The thin frame is the detail, which is shown at full resolution.")];
}

/** @param {Capture} capture */
function compositeTools(capture) {
  const known = presets(capture);
  const named = known.find((p) => p.bands.every((b, i) => b === view.bands[i]))?.name ?? "other";
  /** @param {Composite} bands */
  const show = (bands) => {
    view.bands = view.wantedBands = bands;
    pictures.made = {};
    line.replaceWith(compositeTools(capture));
    paint();
  };
  const names = [...known.map((p) => p.name), ...(named === "other" ? ["other"] : [])];
  const line = el("div", { class: "tools" },
    choice("Composite", names.map((name) => [name, name]), named, (name) => show(known.find((p) => p.name === name)?.bands ?? view.bands)),
    ...["Red", "Green", "Blue"].map((channel, i) =>
      choice(channel, capture.bands.map((b) => [b.band, b.band]), view.bands[i], (name) => {
        show(/** @type {Composite} */ (view.bands.map((b, k) => (k === i ? name : b))));
      }, `${channel} channel`)));
  return line;
}

/** @param {Capture} capture */
function overlayTools(capture) {
  const band = choice("for band", movingBands(capture).map((b) => [b.band, b.band]), view.overlayBand, (name) => { view.overlayBand = name; paint(); }, "Band of the overlay");
  const showOrHideBand = () => { band.hidden = !OVERLAYS_OF_A_BAND.includes(view.overlay); };
  showOrHideBand();
  return el("div", { class: "tools" }, choice("Overlay", overlaysOf(capture), view.overlay, (overlay) => { view.overlay = overlay; showOrHideBand(); paint(); }), band);
}

function viewTools() {
  /** @type {[Mode, string][]} */
  const modes = [["swipe", "Swipe"], ["blink", "Blink"], ["side", "Side by side"]];
  return el("div", { class: "tools", id: "view-tools" },
    ...modes.map(([mode, text]) => button(text, () => setMode(mode), { class: "button", "data-mode": mode, "aria-pressed": String(view.mode === mode) })),
    button("−", zoomOut, { class: "button", "aria-label": "Zoom out" }),
    button("+", zoomIn, { class: "button", "aria-label": "Zoom in" }),
    button("All", showAll, { class: "button" }),
    button("Detail", showDetail, { class: "button" }),
  );
}

/** @param {Mode} mode */
function setMode(mode) {
  view.mode = mode;
  window.clearInterval(view.timer);
  if (mode === "blink") view.timer = window.setInterval(flip, BLINK_MS);
  byId("swipe").hidden = mode !== "swipe";
  document.querySelectorAll("#view-tools [data-mode]").forEach((b) => setAttributes(b, { "aria-pressed": String(b.getAttribute("data-mode") === mode) }));
  paint();
}

function flip() {
  view.blinking = view.blinking === "before" ? "after" : "before";
  paint();
}
