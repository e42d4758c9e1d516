// The page of `vbnfault view`: a grid of small images that scrolls any number of samples, and one sample at full size.
import { $, coloured, grouped, make, words } from "/elements.js";
import { player } from "/film.js";
import { difference, nameOf, paint, paintMasks, ramp, read, rooted, sizeOf } from "/layers.js";

const NOT_KNOWN = 255, GAP = 10, CAPTION = 26, MOST_PX = 2e7; // browsers cannot scroll elements of more than 3.3e7 px
const about = await (await fetch("/api/store")).json();
const layerOf = new Map(about.layers.map((layer) => [layer.name, layer]));
const clean = layerOf.has("clean");
const samples = about.samples;
let listing = null; // columns of all samples, once they have arrived
let severities = null;
let times = null; // sequence and time of all samples, of a store with sequences
let order = null; // samples that pass the filters; null: all
const chosen = { splits: new Set(), strata: new Set(), classes: new Set(), thirds: new Set(), none: false, all: false };

document.title = `${about.title || about.name}: vbnfault view`;
$("title").textContent = about.title || about.name;
$("facts").textContent = `${about.name}, ${about.width} × ${about.height} px`;

if (matchMedia("(max-width: 800px)").matches) $("fold").open = false; // on a phone, images come first

// --- the listing and its filters ----------------------------------------------------------------------------

const count = () => (order ? order.length : samples);
const sampleAt = (position) => (order ? order[position] : position);
const has = (index, fault) => ((listing.bits[(fault >> 5) * samples + index] >>> (fault & 31)) & 1) === 1;

function faultsOf(index) {
  return listing ? about.faults.map((_, k) => k).filter((k) => has(index, k)) : [];
}

async function load() {
  const buffer = await (await fetch("/api/listing")).arrayBuffer();
  const wordsOf = Math.ceil(about.faults.length / 32);
  const bytes = new Uint8Array(buffer, 4 * wordsOf * samples);
  listing = {
    bits: new Uint32Array(buffer, 0, wordsOf * samples),
    split: bytes.subarray(0, samples),
    stratum: bytes.subarray(samples, 2 * samples),
    finished: bytes.subarray(2 * samples, 3 * samples),
  };
  filters();
  choose();
  performance.mark("listing");
  if (about.sequences.length) {
    const given = await (await fetch("/api/times")).arrayBuffer();
    times = { time_s: new Float64Array(given, 0, samples), sequence: new Int32Array(given, 8 * samples, samples) };
    if (view.index >= 0) film.moved(view.index);
  }
  const ranked = await fetch("/api/severity");
  severities = new Uint8Array(await ranked.arrayBuffer());
  filters();
}

function filters() {
  const totals = (values, names) => names.map((name, k) => [name, k, values.reduce((n, v) => n + (v === k), 0)]);
  const button = (group, key, text, total, colour) => {
    const element = make("button", { type: "button", className: "filter" }, ...(colour ? [make("i")] : []), text, make("span", { textContent: grouped(total) }));
    if (colour) coloured(element, colour);
    element.setAttribute("aria-pressed", String(key === "none" ? chosen.none : chosen[group].has(key)));
    element.addEventListener("click", () => {
      if (key === "none") chosen.none = !chosen.none;
      else if (!chosen[group].delete(key)) chosen[group].add(key);
      element.setAttribute("aria-pressed", String(key === "none" ? chosen.none : chosen[group].has(key)));
      choose();
    });
    element.dataset.filter = `${group}:${key}`;
    return element;
  };
  const fill = (id, elements) => {
    const focused = document.activeElement?.dataset?.filter;
    $(id).replaceChildren(...elements);
    if (focused) $(id).querySelector(`[data-filter="${focused}"]`)?.focus();
  };
  fill("splits", totals(listing.split, about.splits).filter((t) => t[2]).map(([name, k, n]) => button("splits", k, name, n)));
  fill("strata", totals(listing.stratum, about.strata).filter((t) => t[2]).map(([name, k, n]) => button("strata", k, name, n)));
  const each = about.faults.map(() => 0);
  let without = 0;
  for (let i = 0; i < samples; i++) {
    let any = false;
    for (let k = 0; k < each.length; k++) if (has(i, k)) { each[k] += 1; any = true; }
    without += !any && listing.finished[i];
  }
  const classes = about.faults.map((fault, k) => button("classes", k, words(fault.name), each[k], fault.colour));
  fill("classes", [...classes, button("classes", "none", "no fault", without)]);
  if (severities) {
    const thirds = [0, 0, 0];
    for (const value of severities) if (value !== NOT_KNOWN) thirds[Math.min(2, Math.floor((value / 255) * 3))] += 1;
    fill("severity", ["mild", "middle", "severe"].map((name, k) => button("thirds", k, name, thirds[k])));
  } else $("severity").replaceChildren(make("p", { className: "note", textContent: "reading the parameters …" }));
}

function passes(index) {
  if (chosen.splits.size && !chosen.splits.has(listing.split[index])) return false;
  if (chosen.strata.size && !chosen.strata.has(listing.stratum[index])) return false;
  const faults = chosen.classes.size ? [...chosen.classes] : about.faults.map((_, k) => k);
  if (chosen.none) {
    const clear = listing.finished[index] && !faultsOf(index).length;
    if (clear) return true;
    if (!chosen.classes.size) return false;
  }
  const met = (k) => has(index, k) && (!chosen.thirds.size || !severities || third(k, index));
  if (chosen.classes.size) return chosen.all ? faults.every(met) : faults.some(met);
  return !chosen.thirds.size || !severities || faults.some(met);
}

function third(fault, index) {
  const value = severities[fault * samples + index];
  return value !== NOT_KNOWN && chosen.thirds.has(Math.min(2, Math.floor((value / 255) * 3)));
}

function choose() {
  if (!listing) return;
  const here = sampleAt(current);
  const any = chosen.splits.size || chosen.strata.size || chosen.classes.size || chosen.thirds.size || chosen.none;
  if (any) {
    const passed = new Uint32Array(samples);
    let n = 0;
    for (let i = 0; i < samples; i++) if (passes(i)) passed[n++] = i;
    order = passed.subarray(0, n);
  } else order = null;
  const kept = order ? order.indexOf(here) : here;
  current = Math.max(0, kept);
  $("clear").disabled = !any;
  status();
  layout();
  reveal(current);
}

function status() {
  const finished = listing ? listing.finished.reduce((n, v) => n + v, 0) : samples;
  const some = finished < samples ? `, ${grouped(finished)} finished` : "";
  $("status").textContent = order ? `${grouped(count())} of ${grouped(samples)} samples` : `${grouped(samples)} samples${some}`;
}

// --- the grid -----------------------------------------------------------------------------------------------

const scroller = $("scroller"), grid = $("grid");
const tiles = new Map(); // position → tile
let side = 240, columns = 1, rowHeight = 1, rows = 0, stretch = 1, current = 0, gridMasks = false, brighter = false, loading = 0;

function layout() {
  const wide = scroller.clientWidth - GAP;
  columns = Math.max(1, Math.floor(wide / (side * 0.82 + GAP)));
  const width = Math.floor(wide / columns) - GAP;
  const height = Math.round((width * about.height) / about.width) + CAPTION;
  rowHeight = height + GAP;
  rows = Math.ceil(count() / columns);
  const whole = rows * rowHeight + GAP, window_ = scroller.clientHeight;
  stretch = whole > MOST_PX ? (whole - window_) / (MOST_PX - window_) : 1; // a scroll of 1 px moves a very long grid more
  grid.style.height = `${Math.min(whole, MOST_PX)}px`;
  grid.setAttribute("aria-rowcount", String(rows));
  grid.setAttribute("aria-colcount", String(columns));
  grid.tile = { width, height };
  for (const tile of tiles.values()) tile.remove();
  tiles.clear();
  grid.querySelector(".empty")?.remove();
  if (!count()) grid.append(make("p", { className: "empty", textContent: "No sample passes these filters." }));
  draw();
}

const topOf = (row) => GAP + row * rowHeight - scroller.scrollTop * (stretch - 1);

function draw() {
  const shown = scroller.scrollTop * stretch;
  const first = Math.max(0, Math.floor((shown - GAP) / rowHeight) - 1);
  const last = Math.min(rows - 1, Math.ceil((shown + scroller.clientHeight) / rowHeight) + 1);
  for (const [position, tile] of tiles) {
    const row = Math.floor(position / columns);
    if (row < first || row > last) {
      if (tile === document.activeElement) scroller.focus({ preventScroll: true });
      tile.remove();
      tiles.delete(position);
    }
  }
  for (let row = first; row <= last; row++)
    for (let column = 0; column < columns; column++) {
      const position = row * columns + column;
      if (position >= count()) break;
      let tile = tiles.get(position);
      if (!tile) {
        tile = tileOf(position);
        tiles.set(position, tile);
        grid.append(tile);
      }
      tile.style.transform = `translate(${GAP + column * (grid.tile.width + GAP)}px, ${topOf(row)}px)`;
    }
  clearTimeout(loading);
  loading = setTimeout(images, tiles.fresh ? 0 : 60); // a fast scroll asks for no image that has left already
  tiles.fresh = false;
}

function tileOf(position) {
  const index = sampleAt(position);
  const image = make("span", { className: "image" });
  const tile = make("button", { type: "button", className: "tile" }, image, caption(index));
  tile.style.width = `${grid.tile.width}px`;
  tile.style.height = `${grid.tile.height}px`;
  tile.tabIndex = position === current ? 0 : -1;
  tile.classList.toggle("current", position === current);
  tile.setAttribute("role", "gridcell");
  tile.setAttribute("aria-rowindex", String(Math.floor(position / columns) + 1));
  tile.setAttribute("aria-colindex", String((position % columns) + 1));
  tile.setAttribute("aria-label", described(index));
  tile.dataset.position = position;
  tile.dataset.index = index;
  return tile;
}

function described(index) {
  if (!listing) return `Sample ${index}`;
  if (!listing.finished[index]) return `Sample ${index}, not finished`;
  const faults = faultsOf(index).map((k) => words(about.faults[k].name)).join(", ");
  return `Sample ${index}, ${about.splits[listing.split[index]] ?? ""}, ${about.strata[listing.stratum[index]]}, ${faults || "no fault"}`;
}

function caption(index) {
  const dots = make("span", { className: "dots" });
  for (const k of faultsOf(index)) dots.append(coloured(make("i", { title: words(about.faults[k].name) }), about.faults[k].colour));
  const split = listing && listing.finished[index] ? about.splits[listing.split[index]] ?? "" : "";
  return make("span", { className: "caption" }, make("b", { textContent: index }), split, dots);
}

function images() {
  const middle = scroller.scrollTop * stretch + scroller.clientHeight / 2;
  const waiting = [...tiles.values()].filter((tile) => !tile.dataset.asked);
  const distance = (tile) => Math.abs(Math.floor(tile.dataset.position / columns) * rowHeight - middle);
  for (const tile of waiting.sort((a, b) => distance(a) - distance(b))) {
    const index = Number(tile.dataset.index), holder = tile.firstChild;
    tile.dataset.asked = "1";
    if (listing && !listing.finished[index]) {
      holder.replaceChildren(make("span", { className: "why", textContent: "not finished" }));
      continue;
    }
    const image = make("img", { alt: "", decoding: "async", className: Math.max(about.width, about.height) < 160 ? "waiting coarse" : "waiting" });
    image.addEventListener("load", () => {
      image.classList.remove("waiting");
      if (!performance.getEntriesByName("first-image").length) performance.mark("first-image");
    });
    image.addEventListener("error", () => holder.replaceChildren(make("span", { className: "why", textContent: "cannot be read" })));
    image.src = `/api/small/${index}?side=${side}&masks=${gridMasks ? 1 : 0}&brighter=${brighter ? 1 : 0}`;
    holder.replaceChildren(image);
  }
}

function reveal(position, focus = false) {
  current = Math.max(0, Math.min(count() - 1, position));
  const row = Math.floor(current / columns), top = row * rowHeight, height = scroller.clientHeight;
  const shown = scroller.scrollTop * stretch;
  if (top < shown) scroller.scrollTop = top / stretch;
  else if (top + rowHeight + GAP > shown + height) scroller.scrollTop = (top + rowHeight + GAP - height) / stretch;
  draw();
  for (const [at, tile] of tiles) {
    tile.tabIndex = at === current ? 0 : -1;
    tile.classList.toggle("current", at === current);
  }
  if (focus) tiles.get(current)?.focus({ preventScroll: true });
}

scroller.addEventListener("scroll", draw, { passive: true });
new ResizeObserver(() => { const at = current; tiles.fresh = true; layout(); reveal(at); }).observe(scroller);
grid.addEventListener("click", (event) => {
  const tile = event.target.closest(".tile");
  if (!tile) return;
  current = Number(tile.dataset.position);
  reveal(current);
  show(Number(tile.dataset.index));
});

function toggleGridMasks() {
  gridMasks = !gridMasks;
  $("grid-masks").setAttribute("aria-pressed", String(gridMasks));
  tiles.fresh = true;
  layout();
}
$("grid-masks").addEventListener("click", toggleGridMasks);
// Dark ground is hardly seen on a screen. The values of the data, which the probe shows, stay as they are.
function toggleBrighter() {
  brighter = !brighter;
  for (const button of document.querySelectorAll(".brighter")) button.setAttribute("aria-pressed", String(brighter));
  tiles.fresh = true;
  layout();
  redraw();
}
for (const button of document.querySelectorAll(".brighter")) button.addEventListener("click", toggleBrighter);
$("grid-masks").hidden = !about.faults.length;
for (const button of document.querySelectorAll("[data-size]"))
  button.addEventListener("click", () => {
    side = Number(button.dataset.size);
    for (const other of document.querySelectorAll("[data-size]")) other.setAttribute("aria-pressed", String(other === button));
    tiles.fresh = true;
    layout();
    reveal(current);
  });
$("mode").addEventListener("click", () => {
  chosen.all = !chosen.all;
  $("mode").textContent = chosen.all ? "all" : "any";
  $("mode").setAttribute("aria-pressed", String(chosen.all));
  choose();
});
function clear() {
  for (const group of ["splits", "strata", "classes", "thirds"]) chosen[group].clear();
  chosen.none = false;
  if (listing) { filters(); choose(); }
}
$("clear").addEventListener("click", clear);
$("go").addEventListener("submit", (event) => {
  event.preventDefault();
  const index = Number($("number").value);
  const position = order ? order.indexOf(index) : index;
  const known = /^\d+$/.test($("number").value) && index < samples;
  $("status").textContent = !known ? `samples are 0 to ${grouped(samples - 1)}` : position < 0 ? `the filters hide sample ${grouped(index)}` : $("status").textContent;
  if (known && position >= 0) { status(); reveal(position, true); }
});

// --- one sample ---------------------------------------------------------------------------------------------

const canvas = $("canvas"), context = canvas.getContext("2d", { alpha: false });
const view = { index: -1, layer: "image", hidden: new Set(), effect: false, zoom: 0, x: 0, y: 0, base: null, root: null, masks: [], pixels: null, turn: 0 };
for (const [k, fault] of about.faults.entries()) if (!fault.localised) view.hidden.add(k);

const choices = () => {
  const names = about.layers.filter((l) => !/^mask/.test(l.name)).map((l) => l.name);
  if (clean) names.splice(names.indexOf("clean") + 1, 0, "difference");
  return names;
};

const film = player({
  names: about.sequences,
  times: () => times,
  order: () => order,
  show: (index) => show(index),
  ahead: readAhead,
  paused: () => { located(); details(view.index, view.turn); },
});

const located = () => history.replaceState(null, "", `#${view.index}`);

async function show(index, layer = view.layer) {
  const turn = ++view.turn, playing = film.playing;
  if ($("viewer").hidden) {
    $("viewer").hidden = false;
    for (const other of [document.querySelector("header"), $("filters"), scroller]) other.inert = true;
    canvas.focus({ preventScroll: true });
  }
  const fresh = index !== view.index;
  Object.assign(view, { index, layer });
  if (!playing) located(); // browsers refuse more than some 100 in half a minute
  if (times) film.moved(index);
  $("name").textContent = `Sample ${grouped(index)}`;
  const position = order ? order.indexOf(index) : index;
  $("previous").disabled = position <= 0;
  $("next").disabled = position + 1 >= count();
  for (const button of $("layers").children) {
    button.setAttribute("aria-checked", String(button.dataset.layer === layer));
    button.tabIndex = button.dataset.layer === layer ? 0 : -1;
  }
  if (fresh) {
    $("probe").textContent = "";
    if (!playing) {
      view.masks = [];
      details(index, turn);
    }
    if (listing && !listing.finished[index]) {
      Object.assign(view, { base: null, root: null, pixels: null });
      complain("This sample is not finished yet.");
      return redraw();
    }
  }
  try {
    const reading = layer === "difference" ? Promise.all([read(layerOf.get("image"), index), read(layerOf.get("clean"), index)]) : read(layerOf.get(layer), index);
    const masks = !fresh ? null : playing ? masksOf(index) : maskLayer(index);
    const pixels = await reading;
    const together = playing && masks ? await masks : null; // a frame of a film appears with its masks
    if (turn !== view.turn) return;
    if (together) { view.masks = together; maskButtons(); }
    const painted = layer === "difference" ? difference(pixels[0], pixels[1], pixels[0].shape) : paint(layerOf.get(layer), pixels);
    view.base = painted.canvas;
    view.root = painted.photograph ? () => rooted(painted.canvas) : null;
    view.pixels = layer === "difference" ? null : { ...pixels, layer: layerOf.get(layer) };
    legend(painted.legend);
    complain("");
    redraw();
    await masks;
    if (turn !== view.turn) return;
    performance.mark("sample");
    ahead(position);
  } catch (error) {
    if (turn === view.turn) { Object.assign(view, { base: null, root: null, pixels: null }); complain(error.message); redraw(); }
  }
}

const layerOfMasks = () => (about.faults.length ? layerOf.get(view.effect && layerOf.has("mask_effect") ? "mask_effect" : "mask") : undefined);

async function masksOf(index) {
  const layer = layerOfMasks();
  return layer ? paintMasks(await read(layer, index), about.faults, Math.max(about.width, about.height) / 700) : [];
}

async function maskLayer(index) {
  const masks = await masksOf(index);
  if (index !== view.index) return;
  view.masks = masks;
  maskButtons();
  redraw();
}

function ahead(position) {
  for (const next of [position + 1, position - 1]) if (next >= 0 && next < count()) readAhead(sampleAt(next));
}

function readAhead(index) {
  if (listing && !listing.finished[index]) return;
  for (const layer of [layerOf.get(layerOf.has(view.layer) ? view.layer : "image"), layerOfMasks()]) if (layer) read(layer, index).catch(() => {});
}

function complain(text) {
  $("message").textContent = text;
  $("message").hidden = !text;
}

function fitted() {
  return Math.min(canvas.clientWidth / about.width, canvas.clientHeight / about.height) * 0.97;
}

function redraw() {
  const ratio = devicePixelRatio, wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== wide || canvas.height !== high) { canvas.width = wide; canvas.height = high; }
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = "#0b0c0f";
  context.fillRect(0, 0, wide, high);
  if (!view.base) return;
  const zoom = (view.zoom || fitted()) * ratio;
  const left = (wide - about.width * zoom) / 2 + view.x * ratio, top = (high - about.height * zoom) / 2 + view.y * ratio;
  context.setTransform(zoom, 0, 0, zoom, left, top);
  context.imageSmoothingEnabled = zoom < 2;
  context.imageSmoothingQuality = "high";
  if (brighter && typeof view.root === "function") view.root = view.root(); // made once, when it is first asked for
  const { width, height } = view.base; // those of the render with its guard band are greater than those of the frame
  context.drawImage((brighter && view.root) || view.base, (about.width - width) / 2, (about.height - height) / 2);
  view.masks.forEach((mask, k) => { if (mask && !view.hidden.has(k)) context.drawImage(mask.canvas, 0, 0); });
}

// Buttons stay the same elements, so that a click succeeds while a film plays.
const maskOf = about.faults.map((fault, k) => {
  const button = make("button", { type: "button", className: "toggle" }, make("i"), words(fault.name));
  if (k < 9) button.append(make("kbd", { textContent: k + 1 }));
  button.dataset.fault = k;
  button.addEventListener("click", () => toggle(k));
  return coloured(button, fault.colour);
});
$("masks").replaceChildren(...maskOf);

function maskButtons() {
  $("kind").hidden = !layerOf.has("mask_effect");
  $("kind").firstChild.textContent = view.effect ? "effects" : "footprints";
  for (const [k, button] of maskOf.entries()) {
    button.classList.toggle("absent", !view.masks[k]);
    button.setAttribute("aria-pressed", String(!view.hidden.has(k)));
    button.title = view.masks[k] ? `${(100 * view.masks[k].area).toPrecision(2)} % of the frame` : "no mask in this sample";
  }
}

function toggle(k) {
  const begin = performance.now();
  if (!view.hidden.delete(k)) view.hidden.add(k);
  $("masks").querySelector(`[data-fault="${k}"]`)?.setAttribute("aria-pressed", String(!view.hidden.has(k)));
  redraw();
  requestAnimationFrame(() => { window.vbnfault.toggled = performance.now() - begin; });
}

function toggleAll() {
  const all = about.faults.map((_, k) => k);
  const visible = all.some((k) => view.masks[k] && !view.hidden.has(k));
  view.hidden = new Set(visible ? all : []);
  maskButtons();
  redraw();
}

function legend({ low, high, units, table, names, note }) {
  const parts = [];
  const number = (value) => Number(value.toPrecision(4)).toString().replace("-", "−");
  if (table) {
    const strip = make("canvas", { width: 256, height: 1 });
    const line = strip.getContext("2d").createImageData(256, 1);
    for (let k = 0; k < 256; k++) line.data.set([table[3 * k], table[3 * k + 1], table[3 * k + 2], 255], 4 * k);
    strip.getContext("2d").putImageData(line, 0, 0);
    parts.push(number(low), strip, `${number(high)} ${units === "1" ? "" : units}`);
  }
  for (const [name, colour] of names ?? []) parts.push(make("span", {}, coloured(make("i"), colour), name));
  if (note) parts.push(note);
  $("scale").replaceChildren(...parts);
}

// --- parameters and scalars ---------------------------------------------------------------------------------

function short(value) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value === "number") return (Number.isInteger(value) ? grouped(value) : Number(value.toPrecision(5)).toString()).replace("-", "−");
  if (Array.isArray(value)) {
    const flat = value.flat(3);
    if (flat.length <= 9) return flat.map(short).join(", ") || "none";
    const numbers = flat.filter((v) => typeof v === "number");
    return numbers.length === flat.length ? `${flat.length} values, ${short(Math.min(...numbers))} to ${short(Math.max(...numbers))}` : `${flat.length} values`;
  }
  if (typeof value === "object") return "value" in value ? `${short(value.value)} ${value.units}` : JSON.stringify(value);
  return String(value);
}

const row = (name, text) => make("tr", {}, make("th", { scope: "row", textContent: name }), make("td", { textContent: text }));

function tables(drawn) {
  const plain = make("table"), parts = [plain];
  for (const [name, value] of Object.entries(drawn ?? {})) {
    if (Array.isArray(value) && value.length && value.every((entry) => entry && typeof entry === "object" && !Array.isArray(entry))) {
      const keys = [...new Set(value.flatMap(Object.keys))];
      const head = make("tr", {}, ...keys.map((key) => make("th", { scope: "col", textContent: key })));
      const body = value.slice(0, 500).map((entry) => make("tr", {}, ...keys.map((key) => make("td", { textContent: short(entry[key]) }))));
      const table = make("table", { className: "many" }, head, ...body);
      parts.push(make("h4", { textContent: `${name} (${value.length})` }), make("div", { className: "scroll", tabIndex: 0 }, table));
    } else if (value && typeof value === "object" && !Array.isArray(value)) parts.push(make("h4", { textContent: name }), ...tables(value));
    else plain.append(row(name, short(value)));
  }
  return parts;
}

async function details(index, turn) {
  const given = await (await fetch(`/api/sample/${index}`)).json();
  if (turn !== view.turn && index !== view.index) return;
  const values = given.values ?? {};
  $("where").textContent = given.finished ? [values.split, values.stratum, values.site].filter((v) => v !== undefined).join(", ") : "not finished";
  const injected = values.injected ?? [];
  const parameters = about.faults.flatMap((fault, k) => {
    if (!injected[k]) return [];
    const head = make("summary", {}, make("i"), words(fault.name), make("span", { textContent: fault.model }));
    return [coloured(make("details", { open: true }, head, ...tables(values.parameters?.[fault.name])), fault.colour)];
  });
  $("parameters").replaceChildren(...(parameters.length ? parameters : [make("p", { className: "none", textContent: "no fault is injected" })]));
  const hidden = new Set(["parameters", "proposal", "injected", "split", "stratum", "site"]);
  $("scalars").replaceChildren(...Object.entries(values).filter(([name]) => !hidden.has(name)).map(([name, value]) => row(name, short(value))));
  if (given.damaged?.length) complain(`Damaged: ${given.damaged.join(", ")}; the build command repairs the store.`);
}

// --- moving about -------------------------------------------------------------------------------------------

function leave() {
  film.pause();
  view.turn++;
  $("viewer").hidden = true;
  for (const other of [document.querySelector("header"), $("filters"), scroller]) other.inert = false;
  history.replaceState(null, "", location.pathname);
  const position = order ? order.indexOf(view.index) : view.index;
  reveal(position < 0 ? current : position, true);
}

function step(by) {
  film.pause();
  const position = (order ? order.indexOf(view.index) : view.index) + by;
  if (position >= 0 && position < count()) show(sampleAt(position));
}

function zoomTo(zoom, x = 0, y = 0) {
  const before = view.zoom || fitted();
  const after = Math.max(0.05, Math.min(32, zoom));
  view.x = x - ((x - view.x) * after) / before;
  view.y = y - ((y - view.y) * after) / before;
  view.zoom = after;
  redraw();
}

function pixelAt(event) {
  const zoom = view.zoom || fitted(), box = canvas.getBoundingClientRect();
  const x = (event.clientX - box.x - (box.width - about.width * zoom) / 2 - view.x) / zoom;
  const y = (event.clientY - box.y - (box.height - about.height * zoom) / 2 - view.y) / zoom;
  return [Math.floor(x), Math.floor(y)];
}

let held = null;
canvas.addEventListener("pointerdown", (event) => {
  held = [event.clientX - view.x, event.clientY - view.y];
  canvas.setPointerCapture(event.pointerId);
  canvas.classList.add("grabbed");
});
canvas.addEventListener("pointerup", () => { held = null; canvas.classList.remove("grabbed"); });
canvas.addEventListener("pointermove", (event) => {
  if (held) {
    view.x = event.clientX - held[0];
    view.y = event.clientY - held[1];
    return redraw();
  }
  const [x, y] = pixelAt(event);
  if (!view.pixels || x < 0 || y < 0 || x >= about.width || y >= about.height) { $("probe").textContent = ""; return; }
  const { data, shape, layer } = view.pixels, [height, width] = sizeOf(layer, shape);
  const at = (y + (height - about.height) / 2) * width + x + (width - about.width) / 2;
  const channels = layer.dims[0] === "band" ? null : shape[2] ?? 1;
  const values = channels === null ? [...Array(shape[0]).keys()].map((b) => data[b * width * height + at]) : [...data.subarray(at * channels, (at + 1) * channels)];
  const said = values.map((v) => (layer.names.length ? nameOf(layer, v) : Number.isFinite(v) ? short(Number(v)) : "–"));
  const masks = view.masks.flatMap((mask, k) => (mask && !view.hidden.has(k) && mask.canvas.getContext("2d").getImageData(x, y, 1, 1).data[3] ? [words(about.faults[k].name)] : []));
  $("probe").textContent = `x ${x}, y ${y}: ${said.join(" ")} ${layer.units === "1" ? "" : layer.units}${masks.length ? ` · ${masks.join(", ")}` : ""}`;
});
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const box = canvas.getBoundingClientRect();
  zoomTo((view.zoom || fitted()) * Math.exp(-event.deltaY / 400), event.clientX - box.x - box.width / 2, event.clientY - box.y - box.height / 2);
}, { passive: false });
new ResizeObserver(() => { if (!$("viewer").hidden) redraw(); }).observe(canvas);

for (const name of choices()) {
  const button = make("button", { type: "button", textContent: name, title: layerOf.get(name)?.about ?? "image less clean twin" });
  button.setAttribute("role", "radio");
  button.dataset.layer = name;
  button.addEventListener("click", () => show(view.index, name));
  $("layers").append(button);
}
maskButtons();
$("previous").addEventListener("click", () => step(-1));
$("next").addEventListener("click", () => step(1));
$("close").addEventListener("click", leave);
function otherKind() {
  if (!layerOf.has("mask_effect")) return;
  view.effect = !view.effect;
  maskLayer(view.index);
}
$("kind").addEventListener("click", otherKind);
$("help-button").addEventListener("click", () => $("help").showModal());

function pick(name) {
  if (choices().includes(name)) show(view.index, name);
}

function nextLayer(by) {
  const names = choices();
  show(view.index, names[(names.indexOf(view.layer) + by + names.length) % names.length]);
}

function inSample(key, shift) {
  const moves = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] };
  const named = { i: "image", x: "difference", d: "depth_m", n: "normal", s: "semantic", r: "raw" };
  if (key === "Escape") leave();
  else if (key === " " && times) $("play").click();
  else if (shift && moves[key]) { view.x += moves[key][0]; view.y += moves[key][1]; redraw(); }
  else if (key === "ArrowLeft") step(-1);
  else if (key === "ArrowRight") step(1);
  else if (key === "c") pick(view.layer === "clean" ? "image" : "clean");
  else if (key === "m") toggleAll();
  else if (key === "b") toggleBrighter();
  else if (key === "e") otherKind();
  else if (/^[1-9]$/.test(key) && key <= about.faults.length) toggle(key - 1);
  else if (key === "+" || key === "=") zoomTo((view.zoom || fitted()) * 1.25);
  else if (key === "-") zoomTo((view.zoom || fitted()) / 1.25);
  else if (key === "0") { Object.assign(view, { zoom: 0, x: 0, y: 0 }); redraw(); }
  else if (key === "[") nextLayer(-1);
  else if (key === "]") nextLayer(1);
  else if (named[key]) pick(named[key]);
  else return false;
  return true;
}

function inGrid(key) {
  const page = Math.max(1, Math.floor(scroller.clientHeight / rowHeight)) * columns;
  const moves = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns, PageUp: -page, PageDown: page, Home: -current, End: count() - 1 - current };
  if (key in moves) reveal(current + moves[key], true);
  else if (key === "m") toggleGridMasks();
  else if (key === "b") toggleBrighter();
  else if (key === "0") clear();
  else if (key === "g" || key === "/") { $("number").focus(); $("number").select(); }
  else if (key === "f") { $("fold").open = true; $("filters").querySelector(".filter")?.focus(); }
  else return false;
  return true;
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || $("help").open) return;
  if (event.target.closest("select") || (event.key === " " && event.target.closest("button, summary"))) return;
  if (event.target.closest("input:not([type=range])")) {
    if (event.key === "Escape") reveal(current, true);
    return;
  }
  const inScroll = event.target.closest(".scroll") && event.key.startsWith("Arrow");
  if (event.key === "?") $("help").showModal();
  else if ($("viewer").hidden) {
    if (event.key.startsWith("Arrow") && event.target.closest("nav, header")) return;
    if (!inGrid(event.key)) return;
  } else if (inScroll || !inSample(event.key, event.shiftKey)) return;
  event.preventDefault();
});

// --- begin --------------------------------------------------------------------------------------------------

window.vbnfault = { view, film, toggled: null, get listing() { return listing; }, get count() { return count(); } };
tiles.fresh = true;
status();
layout();
load();
const asked = /^#(\d+)$/.exec(window.location.hash);
if (asked && Number(asked[1]) < samples) show(Number(asked[1]));
window.addEventListener("hashchange", () => {
  const wanted = /^#(\d+)$/.exec(window.location.hash);
  if (wanted && Number(wanted[1]) < samples) show(Number(wanted[1]));
});
