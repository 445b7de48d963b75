/**
 * Numbers, times and states as texts, and small calculations.
 */

/** @param {number | null | undefined} value @param {number} [digits] */
function numberText(value, digits = 2) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

/** @param {number | null} share @param {number} [digits] */
function percentText(share, digits = 1) {
  return share === null ? "–" : `${(100 * share).toFixed(digits)} %`;
}

/**
 * An expected error in px of the reference, and of the band if these differ.
 * @param {ExpectedError} of @param {number} digits @param {string} [unit]
 */
function errorText(of, digits, unit = "") {
  return `${numberText(of.error_px, digits)}${unit}${of.error_band_px === null ? "" : ` (${numberText(of.error_band_px)} px of the band)`}`;
}

/** @param {string} status */
function statusText(status) {
  return status.replaceAll("_", " ");
}

/** @param {string} captured_at Cameras count from 1970 until their clock is set; without an offset, it is that clock. */
function timeText(captured_at) {
  const zone = captured_at.slice(19).replace(/^\.\d+/, "").replace("+00:00", "UTC");
  return captured_at < "1971" ? "unknown time" : `${captured_at.slice(0, 19).replace("T", " ")} ${zone}`.trim();
}

const HASH = "#capture=";

/** The address of a capture in the page. @param {{label: string}} capture */
function hashOf(capture) {
  return `${HASH}${encodeURIComponent(capture.label)}`;
}

/** @param {number} value @param {number} low @param {number} high */
function clamp(value, low, high) {
  return Math.min(high, Math.max(low, value));
}

/** The upper median. @param {number[]} values @returns {number | undefined} */
function median(values) {
  return [...values].sort((a, b) => a - b)[Math.floor(values.length / 2)];
}
