/**
 * Zooming and moving in the pictures, by buttons, pointer and keys.
 */

const LARGEST_ZOOM = 40;
const ZOOM_STEP = 1.6;
const GRAB_PX = 18; // from the line between before and after

/** @param {number} factor @param {Point} about In shares of what is seen. */
function zoomBy(factor, about = [0.5, 0.5]) {
  const [x, y] = about;
  const zoom = clamp(view.zoom * factor, 1, LARGEST_ZOOM);
  showPart(zoom, view.x + x / view.zoom - x / zoom, view.y + y / view.zoom - y / zoom);
}

/** @param {number} zoom @param {number} x @param {number} y The left upper corner, in shares of the picture. */
function showPart(zoom, x, y) {
  const most = 1 - 1 / zoom;
  Object.assign(view, { zoom, x: clamp(x, 0, most), y: clamp(y, 0, most) });
  paint();
}

/** In shares of what is seen. @param {number} dx @param {number} dy */
function pan(dx, dy) {
  showPart(view.zoom, view.x + dx / view.zoom, view.y + dy / view.zoom);
}

function zoomIn() {
  zoomBy(ZOOM_STEP);
}

function zoomOut() {
  zoomBy(1 / ZOOM_STEP);
}

function showAll() {
  showPart(1, 0, 0);
}

function showDetail() {
  const detail = opened.capture?.preview?.detail;
  if (!detail) return;
  const [x, y, width, height] = detail;
  const zoom = Math.min(LARGEST_ZOOM, 1 / Math.max(width, height));
  showPart(zoom, x + (width - 1 / zoom) / 2, y + (height - 1 / zoom) / 2);
}

/** The zoom about the place of a pointer. @param {MouseEvent} event @param {number} factor */
function zoomAt(event, factor) {
  const box = stage.getBoundingClientRect();
  zoomBy(factor, [(((event.clientX - box.left) / box.width) * panes()) % 1, (event.clientY - box.top) / box.height]);
}

/** Move the picture, or the line between before and after. @param {PointerEvent} down */
function drag(down) {
  if (down.button !== 0) return;
  const box = stage.getBoundingClientRect();
  const grabsLine = view.mode === "swipe" && Math.abs(down.clientX - box.left - view.split * box.width) < GRAB_PX;
  let [x, y] = [down.clientX, down.clientY];
  /** @param {PointerEvent} move */
  const follow = (move) => {
    if (grabsLine) {
      view.split = clamp((move.clientX - box.left) / box.width, 0, 1);
      /** @type {HTMLInputElement} */ (byId("swipe")).value = String(Math.round(view.split * 1000));
      paint();
    } else pan(((x - move.clientX) / box.width) * panes(), (y - move.clientY) / box.height);
    [x, y] = [move.clientX, move.clientY];
  };
  stage.setPointerCapture(down.pointerId);
  const dragging = new AbortController();
  const { signal } = dragging;
  stage.addEventListener("pointermove", follow, { signal });
  for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => dragging.abort(), { signal });
}

/** @type {Record<string, () => void>} */
const KEYS = {
  "+": zoomIn, "=": zoomIn, "-": zoomOut, "0": showAll,
  ArrowLeft: () => pan(-0.1, 0), ArrowRight: () => pan(0.1, 0), ArrowUp: () => pan(0, -0.1), ArrowDown: () => pan(0, 0.1),
  " ": () => {
    if (view.mode !== "blink") setMode("blink");
    window.clearInterval(view.timer); // from here on it is changed by hand
    flip();
  },
};

function listenToStage() {
  stage.addEventListener("pointerdown", drag);
  stage.addEventListener("dblclick", (event) => zoomAt(event, 2));
  stage.addEventListener("wheel", (event) => {
    if (event.deltaY > 0 && view.zoom === 1) return; // all is seen: the page scrolls
    event.preventDefault();
    zoomAt(event, event.deltaY < 0 ? 1.2 : 1 / 1.2);
  }, { passive: false });
  stage.addEventListener("keydown", (event) => {
    const act = KEYS[event.key];
    if (act === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  });
  window.addEventListener("resize", paint);
}
