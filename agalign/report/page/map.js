/**
 * The map of the captures, without any map behind it.
 */

const MAP = { width: 900, height: 420, heightOfFew: 230, margin: 34 };
const ONE_PLACE_M = 0.5;
const MAP_FULL_PX = 1; // fixed, so that colours mean the same in every report; above it single plants do not match
/** @typedef {[x: number, y: number]} Point */
/** @type {Map<Row, Element>} */
const dots = new Map();

/** Draw the captures where they were taken, in the order of time. */
function drawMap() {
  const place = document.getElementById("map-place");
  if (place === null) return;
  const placed = captures.filter((row) => row.position !== null).sort((a, b) => a.captured_at.localeCompare(b.captured_at));
  if (!placed.length) return;
  const { metres, reach, centre } = inMetres(placed);
  const isOnePlace = Math.max(...reach) < ONE_PLACE_M;
  byId("map").querySelectorAll("label, #map-legend").forEach((part) => { part.toggleAttribute("hidden", isOnePlace); });
  if (isOnePlace) {
    place.replaceChildren(el("p", {}, `All at ${centre.map((v) => v.toFixed(6)).join(", ")}.`));
    return;
  }
  const width = clamp(place.clientWidth, 300, MAP.width);
  const height = placed.length < 25 ? MAP.heightOfFew : MAP.height;
  const scale = Math.min((width / 2 - MAP.margin) / reach[0], (height / 2 - MAP.margin) / reach[1], 200);
  const points = metres.map(([x, y]) => /** @type {Point} */ ([width / 2 + x * scale, height / 2 - y * scale]));
  const drawn = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `Positions of ${placed.length} captures; the table below has the same captures` });
  drawn.append(svg("polyline", { class: "track", points: points.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" ") }));
  drawn.append(...drawDots(placed, points), ...scaleBar(scale, width, height));
  place.replaceChildren(drawn);
  offerIndices();
  colourMap();
}

/**
 * The positions of captures, metres to the east and north of their centre, and the largest of them. Longitudes continue
 * across the 180th meridian.
 * @param {Row[]} placed
 */
function inMetres(placed) {
  const first = placed[0].position?.[1] ?? 0;
  const positions = placed.map((row) => row.position ?? [0, 0]).map(([lat, lon]) => [lat, lon + 360 * Math.round((first - lon) / 360)]);
  const centre = [0, 1].map((i) => positions.reduce((sum, position) => sum + position[i], 0) / placed.length);
  const metres = positions.map(([lat, lon]) => [(lon - centre[1]) * 111320 * Math.cos((centre[0] * Math.PI) / 180), (lat - centre[0]) * 110540]);
  const reach = [0, 1].map((i) => metres.reduce((largest, m) => Math.max(largest, Math.abs(m[i])), 1e-9));
  return { metres, reach, centre };
}

/** @param {Row[]} placed @param {Point[]} points */
function drawDots(placed, points) {
  const steps = points.slice(1).map(([x, y], i) => Math.hypot(x - points[i][0], y - points[i][1]));
  const radius = clamp(0.5 * (median(steps) ?? 8), 2.5, 8);
  dots.clear();
  placed.forEach((row, i) => {
    const dot = svg("circle", { cx: points[i][0].toFixed(1), cy: points[i][1].toFixed(1), r: radius }, svg("title", {}, row.label));
    dot.addEventListener("click", () => { location.hash = hashOf(row); });
    dots.set(row, dot);
  });
  markOpened();
  return dots.values();
}

/** @param {number} scale Pixels a metre. @param {number} width @param {number} height */
function scaleBar(scale, width, height) {
  const power = 10 ** Math.floor(Math.log10(140 / scale));
  const length = [5, 2, 1].map((n) => n * power).find((n) => n * scale <= 140) ?? power;
  const y = height - 14;
  const text = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`;
  return [
    svg("path", { class: "scale", d: `M14 ${y}h${(length * scale).toFixed(1)}` }),
    svg("text", { x: 14, y: y - 6 }, text),
    svg("text", { x: width - 34, y: 24 }, "N ↑"),
  ];
}

/** Add the indices of all captures to the choice of colours. */
function offerIndices() {
  const known = [...byId("map-colour").querySelectorAll("option")].map((option) => option.value);
  for (const name of new Set(captures.flatMap((row) => Object.keys(row.indices)))) {
    if (!known.includes(`index:${name}`)) byId("map-colour").append(el("option", { value: `index:${name}` }, `median ${name.toUpperCase()}`));
  }
}

function colourMap() {
  const what = inputValue("map-colour");
  if (what === "status") {
    for (const [row, dot] of dots) setAttributes(dot, { fill: statusColour(row.shown) });
    const present = Object.keys(STATUS_COLOURS).filter((status) => captures.some((row) => row.shown === status)).reverse();
    byId("map-legend").replaceChildren(...present.map((status) => legendKey(statusColour(status), statusText(status))));
  } else if (what.startsWith("index:")) {
    colourByIndex(what.slice(6));
  } else {
    /** @param {number} px */
    const text = (px) => `${px.toFixed(2)} px${px === MAP_FULL_PX ? " and more" : ""}`;
    colourByValue((row) => row[/** @type {"residual_px" | "error_px"} */ (what)], [0, MAP_FULL_PX], blueToRed, text);
  }
}

/**
 * From the lowest to the highest median of the captures; without the blue of water, as the lowest median of a flight is
 * no water.
 * @param {string} name
 */
function colourByIndex(name) {
  const known = [...dots.keys()].flatMap((row) => row.indices[name] ?? []);
  const raw = captures.some((row) => name in row.indices && row.raw);
  /** @type {[number, number]} */
  const scale = [known.reduce((a, b) => Math.min(a, b), Infinity), known.reduce((a, b) => Math.max(a, b), -Infinity)];
  colourByValue((row) => row.indices[name] ?? null, scale, (share) => colourBetween(indexStops(raw), raw ? share : 0.2 + 0.8 * share), (value) => value.toFixed(3));
  if (raw) byId("map-legend").append(RAW_NOTE);
}

/**
 * Colour the dots, and show the legend.
 * @param {(row: Row) => number | null} valueIn @param {[number, number]} scale Lowest and highest value.
 * @param {(share: number) => string} colour @param {(value: number) => string} text
 */
function colourByValue(valueIn, scale, colour, text) {
  const [low, high] = scale;
  for (const [row, dot] of dots) {
    const value = valueIn(row);
    setAttributes(dot, { fill: value === null ? MISSING_COLOUR : colour((value - low) / (high - low || 1)) });
  }
  const steps = low <= high ? scaleKeys([0, 0.5, 1], scale, colour, text) : [];
  byId("map-legend").replaceChildren(...steps, legendKey(MISSING_COLOUR, "no value"));
}

/** Of equal lightness. @param {number} share */
function blueToRed(share) {
  return `hsl(${Math.round(200 - 200 * clamp(share, 0, 1))} 70% 45%)`;
}
