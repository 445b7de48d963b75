/**
 * Colours of states, indices, errors and parallax.
 */

const STATUS_COLOURS = { failed: "#d43c3c", degraded: "#d98a1b", ok_by_prediction: "#3b7dd8", ok: "#2f9e61" }; // worst first
const MISSING_COLOUR = "#c9a";
const RAW_NOTE = "From raw numbers, not reflectance: values of different captures are not comparable.";

// Colour stops are at equal distances.
const ERROR_STOPS = [[0, 32, 77], [255, 234, 70]]; // no vegetation has them, neither in true nor in false colour
const PARALLAX_STOPS = [[25, 35, 150], [205, 250, 45]]; // from far to near the lightness grows

/** @param {string} status */
function statusColour(status) {
  return /** @type {Record<string, string>} */ (STATUS_COLOURS)[status] ?? "#888";
}

/** @param {number[]} values Of red, green and blue. */
function rgb(values) {
  return `rgb(${values.map((v) => Math.round(v)).join(" ")})`;
}

/** @param {number[][]} stops @param {number} share */
function colourBetween(stops, share) {
  const at = clamp(share, 0, 1) * (stops.length - 1);
  const k = Math.min(stops.length - 2, Math.floor(at));
  return rgb(stops[k].map((v, i) => v + (at - k) * (stops[k + 1][i] - v)));
}

/** @param {boolean} raw */
function indexStops(raw) {
  return raw ? facts.index_greys : facts.index_colours;
}

/** @param {number} px An expected error, or the length of a residual. @param {number} [full_px] */
function errorColour(px, full_px = facts.error_full_px) {
  return colourBetween(ERROR_STOPS, px / full_px);
}
