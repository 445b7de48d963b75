/**
 * Pictures in colour from the sheet of grey ones. Canvases are drawn on and never read, which a page from a file may not
 * do: their blend modes add and multiply.
 */

const CHANNELS = ["#f00", "#0f0", "#00f"];
const WHITE = [255, 255, 255];
/** @type {{made: Record<string, HTMLCanvasElement>, loaded: Record<string, HTMLImageElement>}} Of the capture that is open. */
const pictures = { made: {}, loaded: {} };

function forgetPictures() {
  pictures.made = {};
  pictures.loaded = {};
}

/** The image in a file, which is loaded when it is first needed, and then painted; null until then. @param {string} file */
function imageIn(file) {
  if (!(file in pictures.loaded)) {
    const image = new Image();
    for (const end of ["load", "error"]) image.addEventListener(end, () => { if (pictures.loaded[file] === image) paint(); });
    image.src = file;
    pictures.loaded[file] = image;
  }
  const image = pictures.loaded[file];
  return image.complete && image.naturalWidth ? image : null;
}

/** Whether a file could not be loaded. @param {string} file */
function isMissing(file) {
  const image = pictures.loaded[file];
  return image?.complete && !image.naturalWidth;
}

/** @param {HTMLCanvasElement} canvas */
function penOf(canvas) {
  return /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
}

/** @param {HTMLCanvasElement} canvas @param {GlobalCompositeOperation} blend @param {string} colour */
function fill(canvas, blend, colour) {
  const pen = penOf(canvas);
  pen.globalCompositeOperation = blend;
  pen.fillStyle = colour;
  pen.fillRect(0, 0, canvas.width, canvas.height);
}

/** @param {HTMLCanvasElement} canvas @param {GlobalCompositeOperation} blend @param {HTMLCanvasElement} other */
function blendIn(canvas, blend, other) {
  penOf(canvas).globalCompositeOperation = blend;
  penOf(canvas).drawImage(other, 0, 0);
}

/** A part of an image or canvas, as a canvas. @param {CanvasImageSource} image @param {Rectangle} place */
function cutOut(image, place) {
  const [, , width, height] = place;
  const made = el("canvas", { width, height });
  penOf(made).drawImage(image, ...place, 0, 0, width, height);
  return made;
}

/**
 * Draw pictures from a row of the sheet on a canvas, once; null if the sheet is not loaded or has no such row.
 * @param {Preview} preview @param {string} line @param {number[]} columns
 * @param {(sheet: HTMLImageElement, places: Rectangle[]) => HTMLCanvasElement} make
 */
function fromSheet(preview, line, columns, make) {
  const sheet = imageIn(preview.file);
  if (sheet === null || !(line in preview.rows)) return null;
  const [top, width, height] = preview.rows[line];
  const key = `${line} ${columns.join(" ")}`;
  pictures.made[key] ??= make(sheet, columns.map((column) => [column * width, top, width, height]));
  return pictures.made[key];
}

/**
 * Grey pictures as the channels of one: each is dyed in its colour, and they add up.
 * @param {CanvasImageSource} sheet @param {Rectangle[]} places Of red, green and blue.
 */
function compose(sheet, places) {
  const [, , width, height] = places[0];
  const sum = el("canvas", { width, height });
  fill(sum, "source-over", "#000");
  places.forEach((place, i) => {
    const dyed = cutOut(sheet, place);
    fill(dyed, "multiply", CHANNELS[i]);
    blendIn(sum, "lighter", dyed);
  });
  return sum;
}

/**
 * A grey picture in the colours of stops at equal distances: the sum of the first stop and of each step to the next one
 * times how far the grey is between them.
 * @param {CanvasImageSource} sheet @param {Rectangle} place @param {number[][]} stops
 */
function colourGrey(sheet, place, stops) {
  const [, , width, height] = place;
  const sum = el("canvas", { width, height });
  fill(sum, "source-over", rgb(stops[0]));
  const step = 1 / (stops.length - 1);
  stops.slice(1).forEach((stop, k) => {
    for (const sign of [1, -1]) {
      const difference = stop.map((v, i) => Math.max(0, sign * (v - stops[k][i])));
      if (!difference.some(Boolean)) continue;
      const part = cutOut(sheet, place);
      fill(part, "difference", rgb(WHITE));
      fill(part, "lighter", rgb(WHITE.map((v) => v * k * step))); // white up to the stop before
      fill(part, "difference", rgb(WHITE));
      fill(part, "color-dodge", rgb(WHITE.map((v) => v * (1 - step)))); // divides by the distance of the stops
      fill(part, "multiply", rgb(difference));
      blendIn(sum, sign > 0 ? "lighter" : "difference", part);
    }
  });
  return sum;
}
