// The pixel inspector of the report: a map to look at, histograms to brush, and one pixel in full.
// It reads what the page holds (elements inspector-facts, map-N and inspector-sample; see report/inspector.py
// for their form); under `pchem view` it asks that server for the rest. It writes text nodes and
// attributes only, never markup.
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const app = byId("inspector-app");
  if (!app) return;
  const facts = JSON.parse(byId("inspector-facts").textContent);
  const [ny, nx] = facts.shape;
  const n = ny * nx;
  const served = document.querySelector('meta[name="pchem-view"]') !== null;
  const factOf = new Map(facts.maps.map((fact) => [fact.path, fact]));
  const NONE = 0, BELOW = 1, FIRST = 2, ABOVE = 65535;

  // -- small helpers -------------------------------------------------------------------------
  const el = (tag, attributes = {}, ...children) => {
    const node = document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
  const svgEl = (tag, attributes = {}, ...children) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
  const cssColour = (name) => getComputedStyle(app).getPropertyValue(name).trim();
  const whole = (number) => number.toLocaleString("en-US");
  const minus = (text) => text.replace("-", "−");
  const superscript = (power) => String(power).replace(/./g, (sign) => "⁰¹²³⁴⁵⁶⁷⁸⁹"["0123456789".indexOf(sign)] ?? "⁻");
  const plural = (count, noun) => `${whole(count)} ${noun}${count === 1 ? "" : "s"}`;

  // the same rounding as in the rest of the report
  const short = (value, digits = 3) => {
    if (!Number.isFinite(value)) return "not known";
    if (value === 0) return "0";
    const exponent = Math.floor(Math.log10(Math.abs(Number(value.toExponential(digits - 1)))));
    const decimals = Math.max(digits - 1 - exponent, 0);
    if (exponent > -4 && exponent < Math.max(digits, 5)) return minus(value.toFixed(decimals));
    return minus(`${(value / 10 ** exponent).toFixed(digits - 1)}×10`) + superscript(exponent);
  };
  const measured = (value, error, unit = "") => {
    const tail = unit ? ` ${unit}` : "";
    if (!Number.isFinite(value)) return "no value";
    if (!Number.isFinite(error) || error <= 0) return short(value, 4) + tail;
    const exponent = Math.floor(Math.log10(Number(error.toExponential(1))));
    if (exponent < -6 || exponent > 5) return `${short(value, 6)} ± ${short(error, 2)}${tail}`;
    const decimals = Math.max(1 - exponent, 0);
    return minus(`${value.toFixed(decimals)} ± ${error.toFixed(decimals)}${tail}`);
  };
  const percent = (part, all) => (all ? `${short((100 * part) / all, 2)} %` : "0 %");
  // a name written from right to left keeps its numbers to itself
  const isolated = (name) =>
    /[\u0590-\u08ff\ufb1d-\ufefc\u{10800}-\u{10fff}\u{1e800}-\u{1efff}]/u.test(name) ? `\u2068${name}\u2069` : name;
  const place = (i) => {
    if (ny === 1) return `channel ${i}${facts.channels[i] ? ` ${isolated(facts.channels[i])}` : ""}`;
    return `pixel y = ${Math.floor(i / nx)}, x = ${i % nx}`;
  };

  // -- data ----------------------------------------------------------------------------------
  const fromBase64 = (text) => {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return bytes;
  };
  const inflate = async (text) => {
    const stream = new Blob([fromBase64(text.trim())]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };
  const ask = async (what) => {
    const answer = await fetch(what, { cache: "no-store" });
    if (!answer.ok) throw new Error(`${answer.status} ${(await answer.text()).trim()}`);
    return answer.json();
  };

  const sample = { slot: new Map(), exact: new Map(), deciding: [], masses: [], counts: [], origin: null };
  const readSample = async () => {
    const bytes = await inflate(byId("inspector-sample").textContent);
    const view = new DataView(bytes.buffer);
    const size = facts.sample.n;
    let at = 0;
    const column = (read, width, count) => {
      const values = Array.from({ length: count }, (_, i) => view[read](at + width * i, true));
      at += width * count;
      return values;
    };
    column("getUint32", 4, size).forEach((index, i) => sample.slot.set(index, i));
    sample.origin = column("getInt32", 4, size);
    const bins = column("getUint32", 4, size);
    for (const path of facts.sample.exact) sample.exact.set(path, column("getFloat32", 4, size));
    if (facts.sample.deciding) for (let p = 0; p < 4; p++) sample.deciding.push(column("getFloat32", 4, size));
    for (let i = 0; i < facts.sample.masses; i++) {
      sample.masses.push(column("getUint16", 2, bins[i]).map((root) => (root / 65535) ** 2));
    }
    for (const length of bins) {
      const counts = new Array(length);
      for (let b = 0; b < length; b++) {
        let value = 0, power = 1, byte;
        do { byte = bytes[at++]; value += (byte & 127) * power; power *= 128; } while (byte > 127);
        counts[b] = value;
      }
      sample.counts.push(counts);
    }
  };

  const layers = new Map();
  const decode = (fact, bytes, pack) => {
    const codes = new Uint16Array(n);
    for (let i = 0; i < n; i++) codes[i] = bytes[i] | (bytes[n + i] << 8);
    const view = new DataView(bytes.buffer), odd = new Map();
    for (let i = 0; i < pack.nOdd; i++) {
      odd.set(view.getUint32(2 * n + 4 * i, true), view.getFloat32(2 * n + 4 * (pack.nOdd + i), true));
    }
    return { fact, codes, odd, low: pack.low, step: pack.step, log: pack.log, bars: pack.bars };
  };
  const load = async (path) => {
    const fact = factOf.get(path);
    if (fact.sameAs) {
      const other = await layer(fact.sameAs), f = fact.factor;
      const odd = new Map([...other.odd].map(([i, value]) => [i, value * f]));
      const low = other.log ? other.low + Math.log10(f) : other.low * f;
      return { ...other, fact, odd, low, step: other.log ? other.step : other.step * f };
    }
    if (fact.here) {
      const block = byId(`map-${facts.maps.indexOf(fact)}`);
      return decode(fact, await inflate(block.textContent), fact);
    }
    const pack = await ask(`api/map?path=${encodeURIComponent(path)}`);
    return decode(fact, await inflate(pack.data), pack);
  };
  const layer = (path) => {
    if (!layers.has(path)) layers.set(path, load(path));
    return layers.get(path);
  };
  const codeValue = (map, code) => {
    const value = map.low + map.step * (code - FIRST);
    return map.log ? 10 ** value : value;
  };
  const valueAt = (map, i) => {
    const slot = sample.slot.get(i), exact = sample.exact.get(map.fact.path);
    if (slot !== undefined && exact) return exact[slot];
    const code = map.codes[i];
    if (code === NONE) return NaN;
    return code === BELOW || code === ABOVE ? map.odd.get(i) ?? 0 : codeValue(map, code);
  };
  const errorPath = (path) => (factOf.has(`${path}_stderr`) ? `${path}_stderr` : null);
  const wordsOf = (fact, value) => {
    if (fact.kind === "words") return fact.words[value] ?? String(value);
    const found = Object.entries(fact.words).filter(([bit]) => value & Number(bit)).map(([, text]) => text);
    return found.length ? found.join("; ") : "good fit";
  };
  const categorical = (fact) => fact.kind === "bits" || fact.kind === "words";
  const valueText = (fact, value, error) => {
    if (!Number.isFinite(value)) return "no value";
    if (categorical(fact)) return wordsOf(fact, value);
    const counted = Number.isInteger(value) && Math.abs(value) < 1e9 && !Number.isFinite(error);
    return counted ? minus(whole(value)) + (fact.unit && ` ${fact.unit}`) : measured(value, error, fact.unit);
  };

  // -- state ---------------------------------------------------------------------------------
  const state = { map: null, error: null, colours: "p1", selection: null, selectionLink: "", pixel: -1, hover: -1, corner: null };
  const canvas = byId("inspector-canvas"), context = canvas.getContext("2d");
  const image = document.createElement("canvas");
  image.width = nx;
  image.height = ny;
  const imageContext = image.getContext("2d");
  const pixels = imageContext.createImageData(nx, ny);
  const words32 = new Uint32Array(pixels.data.buffer);
  // a line of channels is drawn with tall cells
  const tall = ny * 8 < nx ? nx / (8 * ny) : 1;
  const view = { scale: 1, x: 0, y: 0, fit: 1, width: 1, height: 1, ratio: 1 };

  // -- statistics on codes -------------------------------------------------------------------
  const countCodes = (map, selection) => {
    const counts = new Uint32Array(65536), codes = map.codes;
    if (selection) for (let i = 0; i < n; i++) counts[codes[i]] += selection[i];
    else for (let i = 0; i < n; i++) counts[codes[i]]++;
    return counts;
  };
  const total = (counts) => counts.reduce((sum, count) => sum + count, 0) - counts[NONE];
  const oddEnds = (map) => {
    let low = Infinity, high = -Infinity;
    for (const value of map.odd.values()) { low = Math.min(low, value); high = Math.max(high, value); }
    return [low, high];
  };
  const valueOfCode = (map, code) => {
    if (code === BELOW) return map.log ? 0 : oddEnds(map)[0];
    return code === ABOVE ? oddEnds(map)[1] : codeValue(map, code);
  };
  const quantile = (map, counts, share) => {
    let left = share * (total(counts) - 1);
    for (let code = 1; code < 65536; code++) {
      left -= counts[code];
      if (left < 0) return valueOfCode(map, code);
    }
    return NaN;
  };
  const RANGES = { p1: [0.01, 0.99], p01: [0.001, 0.999], p5: [0.05, 0.95], all: [0, 1] };

  // -- colours -------------------------------------------------------------------------------
  const little = new Uint8Array(new Uint32Array([1]).buffer)[0] === 1;
  const pack = (r, g, b, a) => (little ? (a << 24) | (b << 16) | (g << 8) | r : (r << 24) | (g << 16) | (b << 8) | a) >>> 0;
  const hex = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
  const ramp = Array.from({ length: 256 }, (_, i) => hex(`#${facts.colours.slice(6 * i, 6 * i + 6)}`));
  const PALETTE = [
    "#0072b2", "#d55e00", "#009e73", "#e69f00", "#56b4e9", "#cc79a7", "#8c6d31", "#7f3c8d", "#a50f15", "#41484f", "#b5cf6b",
  ];
  const categories = (fact) => {
    const keys = Object.keys(fact.words).map(Number);
    if (fact.kind === "bits") return [[0, "good fit"], ...keys.map((key) => [key, fact.words[key]])];
    return keys.map((key) => [key, fact.words[key]]);
  };
  const categoryColour = (fact, order) => (order === 0 ? cssColour("--fine") : PALETTE[(order - 1) % PALETTE.length]);
  const belongs = (fact, key, value) => (fact.kind === "bits" && key !== 0 ? (value & key) !== 0 : value === key);
  const categoryOf = (fact, list, value) => Math.max(list.findIndex(([key]) => belongs(fact, key, value)), 0);
  // ends of the colours on the axis of a map, with what leads there and back
  const colourEnds = (map) => {
    const axis = (value) => (map.log ? Math.log10(Math.max(value, 1e-300)) : value), back = (v) => (map.log ? 10 ** v : v);
    return [axis, back, ...RANGES[state.colours].map((share) => axis(quantile(map, map.counts, share)))];
  };
  const levels = (map, counts) => {
    const level = new Float64Array(65536);
    if (state.colours === "beta") {
      // Beta(2,2) quantile of the rank: the root of 3 q^2 - 2 q^3 = p
      const all = total(counts);
      let below = 0;
      for (let code = 1; code < 65536; code++) {
        const rank = (below + counts[code] / 2) / all;
        level[code] = 0.5 - Math.sin(Math.asin(clamp(1 - 2 * rank, -1, 1)) / 3);
        below += counts[code];
      }
      return level;
    }
    const [axis, , low, high] = colourEnds(map);
    for (let code = FIRST; code < ABOVE; code++) {
      level[code] = high > low ? clamp((axis(codeValue(map, code)) - low) / (high - low), 0, 1) : 0.5;
    }
    level[ABOVE] = 1;
    return level;
  };
  const paint = () => {
    const { map, selection } = state;
    const table = new Uint32Array(65536), faint = new Uint32Array(65536);
    const put = (code, [r, g, b]) => { table[code] = pack(r, g, b, 255); faint[code] = pack(r, g, b, 55); };
    if (categorical(map.fact)) {
      const list = categories(map.fact);
      const colours = list.map((_, order) => hex(categoryColour(map.fact, order)));
      for (let code = FIRST; code < ABOVE; code++) {
        put(code, colours[categoryOf(map.fact, list, Math.round(codeValue(map, code)))]);
      }
    } else {
      const level = levels(map, map.counts);
      for (let code = 1; code < 65536; code++) put(code, ramp[Math.round(255 * level[code])]);
    }
    put(NONE, hex(cssColour("--none")));
    const codes = map.codes;
    if (selection) for (let i = 0; i < n; i++) words32[i] = selection[i] ? table[codes[i]] : faint[codes[i]];
    else for (let i = 0; i < n; i++) words32[i] = table[codes[i]];
    imageContext.putImageData(pixels, 0, 0);
  };

  // -- the map -------------------------------------------------------------------------------
  let waiting = false;
  const redraw = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  };
  const drawAxis = (id, from, scale, length, vertical) => {
    const axis = byId(id), last = (vertical ? ny : nx) - 1, marks = [];
    for (const t of ticks(Math.max(from, 0), Math.min(from + length / scale - 1, last), Math.max(Math.floor(length / 70), 1))) {
      if (!Number.isInteger(t)) continue;
      const mark = el("span", {}, String(t));
      mark.style[vertical ? "top" : "left"] = `${(t + 0.5 - from) * scale}px`;
      marks.push(mark);
    }
    axis.replaceChildren(...marks);
  };
  const drawMapAxes = () => {
    drawAxis("inspector-axis-x", view.x, view.scale, view.width, false);
    byId("inspector-axis-y").hidden = ny === 1;
    if (ny > 1) drawAxis("inspector-axis-y", view.y, view.scale * tall, view.height, true);
  };
  const draw = () => {
    const { scale, x, y, ratio } = view;
    drawMapAxes();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, view.width, view.height);
    const x0 = clamp(Math.floor(x), 0, nx), y0 = clamp(Math.floor(y), 0, ny);
    const x1 = clamp(Math.ceil(x + view.width / scale), 0, nx);
    const y1 = clamp(Math.ceil(y + view.height / (scale * tall)), 0, ny);
    context.imageSmoothingEnabled = scale * ratio < 1;
    context.drawImage(image, x0, y0, x1 - x0, y1 - y0,
      (x0 - x) * scale, (y0 - y) * scale * tall, (x1 - x0) * scale, (y1 - y0) * scale * tall);
    if (state.pixel >= 0) box(state.pixel % nx, Math.floor(state.pixel / nx), 1, 1, true);
    if (state.corner) {
      const [a, b] = [state.corner.from, state.corner.to];
      box(Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.abs(a[0] - b[0]) + 1, Math.abs(a[1] - b[1]) + 1, false);
    }
  };
  const box = (px, py, wide, high, single) => {
    const { scale, x, y } = view;
    let [left, top, w, h] = [(px - x) * scale, (py - y) * scale * tall, wide * scale, high * scale * tall];
    if (single && w < 9) [left, w] = [left + w / 2 - 4.5, 9];
    if (single && h < 9) [top, h] = [top + h / 2 - 4.5, 9];
    context.setLineDash(single ? [] : [5, 4]);
    context.lineWidth = 4;
    context.strokeStyle = "#ffffff";
    context.strokeRect(left, top, w, h);
    context.lineWidth = 2;
    context.strokeStyle = "#d0006f";
    context.strokeRect(left, top, w, h);
    context.setLineDash([]);
  };
  const keepInside = () => {
    const wide = view.width / view.scale, high = view.height / (view.scale * tall);
    view.x = wide >= nx ? (nx - wide) / 2 : clamp(view.x, 0, nx - wide);
    view.y = high >= ny ? (ny - high) / 2 : clamp(view.y, 0, ny - high);
    canvas.style.touchAction = view.scale > view.fit * 1.001 ? "none" : "pan-y";
  };
  const zoom = (factor, atX = view.width / 2, atY = view.height / 2) => {
    const scale = clamp(view.scale * factor, view.fit, Math.max(64 / Math.sqrt(tall), view.fit));
    view.x += atX / view.scale - atX / scale;
    view.y += atY / (view.scale * tall) - atY / (scale * tall);
    view.scale = scale;
    keepInside();
    redraw();
    clearTimeout(later);
    later = setTimeout(keepAddress, 250);
  };
  let later = 0;
  const layout = () => {
    if (!state.map) return;
    const wasWhole = view.scale <= view.fit * 1.001;
    const frame = canvas.parentElement;
    view.width = Math.max(frame.clientWidth, 80);
    const most = Math.min(Math.max(window.innerHeight * 0.75, 300), view.width * 1.2);
    view.height = Math.round(clamp((view.width * ny * tall) / nx, 40, most));
    view.ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.style.height = `${view.height}px`;
    canvas.width = Math.round(view.width * view.ratio);
    canvas.height = Math.round(view.height * view.ratio);
    view.fit = Math.min(view.width / nx, view.height / (ny * tall));
    if (wasWhole || view.scale < view.fit) view.scale = view.fit;
    keepInside();
    draw();
  };
  const pixelAt = (event) => {
    const bounds = canvas.getBoundingClientRect();
    const px = Math.floor(view.x + (event.clientX - bounds.left) / view.scale);
    const py = Math.floor(view.y + (event.clientY - bounds.top) / (view.scale * tall));
    return px >= 0 && py >= 0 && px < nx && py < ny ? [px, py] : null;
  };
  const reveal = (i) => {
    const px = i % nx, py = Math.floor(i / nx);
    const wide = view.width / view.scale, high = view.height / (view.scale * tall);
    if (px < view.x || px + 1 > view.x + wide) view.x = px - wide / 2;
    if (py < view.y || py + 1 > view.y + high) view.y = py - high / 2;
    keepInside();
  };
  const describe = (i) => {
    const { map, error } = state;
    const text = valueText(map.fact, valueAt(map, i), error ? valueAt(error, i) : NaN);
    const status = state.status && map !== state.status ? wordsOf(state.status.fact, valueAt(state.status, i)) : "";
    return `${place(i)}: ${map.fact.label} ${text}${status && ` · ${status}`}`;
  };
  const tip = byId("inspector-tip");
  const hover = (event) => {
    const where = event && pixelAt(event);
    tip.hidden = !where || !state.map;
    if (tip.hidden) return;
    tip.textContent = describe(where[1] * nx + where[0]);
    const bounds = canvas.getBoundingClientRect();
    const left = event.clientX - bounds.left, top = event.clientY - bounds.top;
    tip.style.left = `${clamp(left + 14, 0, Math.max(view.width - tip.offsetWidth, 0))}px`;
    const fits = top + 18 + tip.offsetHeight <= view.height;
    tip.style.top = `${fits ? top + 18 : Math.max(top - tip.offsetHeight - 10, 0)}px`;
  };

  const pointers = new Map();
  let drag = null;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    const where = pixelAt(event);
    const rectangle = (event.shiftKey || byId("inspector-rectangle").checked) && where;
    if (rectangle) state.corner = { from: where, to: where };
    drag = { x: event.clientX, y: event.clientY, far: 0, rectangle };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) { hover(event); return; }
    const before = pointers.get(event.pointerId);
    if (pointers.size === 2) {
      const other = [...pointers.values()].find((each) => each.pointerId !== event.pointerId);
      const gap = (a) => Math.hypot(a.clientX - other.clientX, a.clientY - other.clientY);
      const bounds = canvas.getBoundingClientRect();
      drag.far = 99;
      const [atX, atY] = [(event.clientX + other.clientX) / 2 - bounds.left, (event.clientY + other.clientY) / 2 - bounds.top];
      zoom(gap(event) / Math.max(gap(before), 1), atX, atY);
    } else if (drag.rectangle) {
      const where = pixelAt(event);
      if (where) state.corner.to = where;
      redraw();
    } else {
      view.x -= (event.clientX - before.clientX) / view.scale;
      view.y -= (event.clientY - before.clientY) / (view.scale * tall);
      keepInside();
      redraw();
    }
    drag.far = Math.max(drag.far, Math.hypot(event.clientX - drag.x, event.clientY - drag.y));
    if (drag.far > 4) hover(null);
    pointers.set(event.pointerId, event);
  });
  canvas.addEventListener("pointerup", (event) => {
    pointers.delete(event.pointerId);
    if (!drag || pointers.size) return;
    const where = pixelAt(event);
    if (drag.rectangle && drag.far > 4) finishRectangle();
    else if (drag.far <= 4 && where) choose(where[1] * nx + where[0]).then(() => bringIntoView());
    else keepAddress();
    if (drag.far <= 4) state.corner = null;
    drag = null;
  });
  canvas.addEventListener("pointercancel", (event) => {
    pointers.delete(event.pointerId);
    drag = null;
    state.corner = null;
  });
  canvas.addEventListener("pointerleave", () => hover(null));
  canvas.addEventListener("wheel", (event) => {
    // scrolling the page must not get stuck on the map
    if (!event.ctrlKey && document.activeElement !== canvas) return;
    event.preventDefault();
    const bounds = canvas.getBoundingClientRect();
    zoom(Math.exp(-event.deltaY * 0.0022), event.clientX - bounds.left, event.clientY - bounds.top);
  }, { passive: false });
  canvas.addEventListener("dblclick", (event) => {
    const bounds = canvas.getBoundingClientRect();
    zoom(2, event.clientX - bounds.left, event.clientY - bounds.top);
  });
  const finishRectangle = () => {
    const { from: a, to: b } = state.corner;
    state.corner = null;
    selectBox(a, b);
  };
  const selectBox = (a, b) => {
    const [x0, x1, y0, y1] = [Math.min(a[0], b[0]), Math.max(a[0], b[0]), Math.min(a[1], b[1]), Math.max(a[1], b[1])];
    const selection = new Uint8Array(n);
    for (let y = y0; y <= y1; y++) selection.fill(1, y * nx + x0, y * nx + x1 + 1);
    select(selection, ny === 1 ? `channels ${x0} to ${x1}` : `y ${y0} to ${y1}, x ${x0} to ${x1}`, `box,${x0},${y0},${x1},${y1}`);
  };
  canvas.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 10 : 1;
    const moves = {
      ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step], Home: [-nx, 0], End: [nx, 0],
    };
    const at = state.pixel >= 0 ? [state.pixel % nx, Math.floor(state.pixel / nx)] : null;
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    hover(null);
    if (moves[event.key]) {
      const [dx, dy] = moves[event.key];
      const halves = [view.width / view.scale / 2, view.height / (view.scale * tall) / 2];
      const centre = [Math.floor(view.x + halves[0]), Math.floor(view.y + halves[1])];
      const [px, py] = at ? [at[0] + dx, at[1] + dy] : centre;
      const to = [clamp(px, 0, nx - 1), clamp(py, 0, ny - 1)];
      if (state.corner) state.corner.to = to;
      choose(to[1] * nx + to[0]);
    } else if (event.key === "+" || event.key === "=") zoom(1.5);
    else if (event.key === "-") zoom(1 / 1.5);
    else if (event.key === "0") zoom(1e-9);
    else if (event.key === "[" || event.key === "]") neighbour(event.key === "]" ? 1 : -1);
    else if (event.key === "s" && at) {
      if (state.corner) finishRectangle();
      else {
        state.corner = { from: at, to: at };
        say("First corner set; move to the opposite corner and press s again.");
        redraw();
      }
    } else if (event.key === "Escape") { state.corner = null; select(null); }
    else return;
    event.preventDefault();
  });

  // -- colour bar, histogram of the map, selection ---------------------------------------------
  const say = (text) => { byId("inspector-selection").textContent = text; };
  const showScale = () => {
    const { map } = state, bar = byId("inspector-scale");
    bar.replaceChildren();
    if (categorical(map.fact)) {
      const list = categories(map.fact), count = new Array(list.length).fill(0);
      for (let code = FIRST; code < ABOVE; code++) {
        if (!map.counts[code]) continue;
        const value = Math.round(codeValue(map, code));
        list.forEach(([key], order) => { if (belongs(map.fact, key, value)) count[order] += map.counts[code]; });
      }
      const legend = el("ul", { class: "legend" });
      list.forEach(([key, text], order) => {
        if (!count[order]) return;
        const button = el("button", { type: "button", title: "Select these on the map" });
        const mark = el("span", { class: "mark", "aria-hidden": "true" });
        mark.style.background = categoryColour(map.fact, order);
        button.append(mark, `${text}: ${plural(count[order], facts.noun)}`);
        button.addEventListener("click", () => selectCategory(map, key, text));
        legend.append(el("li", {}, button));
      });
      bar.append(legend);
      return;
    }
    const shares = state.colours === "beta" ? [0, 0.15625, 0.5, 0.84375, 1] : null;
    let labels;
    if (shares) labels = shares.map((share) => short(quantile(map, map.counts, share)));
    else {
      const [, back, low, high] = colourEnds(map);
      for (let digits = 3; digits < 7; digits++) {
        labels = [0, 0.25, 0.5, 0.75, 1].map((level) => short(back(low + level * (high - low)), digits));
        if (new Set(labels).size === 5) break;
      }
      if (state.colours !== "all") labels = [`≤ ${labels[0]}`, ...labels.slice(1, 4), `≥ ${labels[4]}`];
    }
    const strip = el("div", { class: "strip" });
    const stops = ramp.filter((_, i) => i % 15 === 0).map((colour) => `rgb(${colour})`);
    strip.style.background = `linear-gradient(to right, ${stops.join(",")})`;
    bar.append(strip, el("div", { class: "ticks" }, ...labels.map((text) => el("span", {}, text))));
    const missing = map.counts[NONE];
    const unit = map.fact.unit ? `in ${map.fact.unit}` : "";
    const words = [unit, missing ? `gray: ${plural(missing, facts.noun)} without a value` : ""].filter(Boolean).join("; ");
    bar.append(el("p", { class: "small" }, words));
  };

  const plot = byId("inspector-histogram");
  const axisOf = (map) => {
    const f = map.log ? Math.log10 : (v) => v, back = map.log ? (v) => 10 ** v : (v) => v;
    const least = map.log ? codeValue(map, FIRST) : -Infinity;
    const [start, a, b, end] = [0, 0.01, 0.99, 1].map((share) => f(Math.max(quantile(map, map.counts, share), least)));
    const ends = [start, end];
    let low = Math.max(a - 0.3 * (b - a), ends[0]), high = Math.min(b + 0.3 * (b - a), ends[1]);
    if (!(high > low)) { const pad = Math.abs(low) * 0.05 || 1e-9; [low, high] = [low - pad, high + pad]; }
    return { f, back, low, high };
  };
  const ticks = (low, high, most) => {
    const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough);
    const found = [];
    for (let t = Math.ceil(low / step) * step; t <= high + 1e-9 * step; t += step) {
      found.push(Math.abs(t) < step * 1e-9 ? 0 : t);
    }
    return found;
  };
  const tickText = (value) => {
    const plain = value === 0 || (Math.abs(value) < 1e5 && Math.abs(value) >= 1e-4);
    return plain ? minus(String(Number(value.toPrecision(6)))) : short(value, 2);
  };
  const stairs = (heights, at, level, floor) => {
    let path = `M${at(0)} ${floor}`;
    heights.forEach((height, i) => { path += `V${level(height).toFixed(1)}H${at(i + 1).toFixed(1)}`; });
    return `${path}V${floor}Z`;
  };
  let brush = null;
  const showHistogram = () => {
    const { map, selection } = state;
    if (!map) return;
    const there = !categorical(map.fact) && total(map.counts) > 0;
    byId("inspector-brush").hidden = !there;
    if (!there) return;
    // bins are whole numbers of codes, or whole parts of one, so that they do not beat with the quantisation
    const axis = axisOf(map), wanted = clamp(Math.round(2 * Math.cbrt(total(map.counts))), 8, 96), known = map.bars;
    const each = known ? 1 / known.parts : Math.max(1, Math.round((axis.high - axis.low) / map.step / wanted));
    const firstCode = known ? known.first : Math.floor((axis.low - map.low) / map.step + FIRST + 0.5);
    const start = map.low + (firstCode - FIRST - 0.5) * map.step;
    const bins = known ? known.counts.length : Math.max(1, Math.ceil((axis.high - start) / (each * map.step)));
    axis.low = start;
    axis.high = axis.low + bins * each * map.step;
    const some = selection ? countCodes(map, selection) : null;
    const bin = (counts) => {
      const heights = new Array(bins).fill(0), parts = known ? known.parts : 1;
      let outside = counts[BELOW] + counts[ABOVE];
      for (let code = FIRST; code < ABOVE; code++) {
        if (!counts[code]) continue;
        const b = Math.floor((code - firstCode) / each + 1e-6);
        if (b < 0 || b >= bins) outside += counts[code];
        else for (let i = b; i < b + parts; i++) heights[i] += counts[code] / parts; // where in its code is not known
      }
      return [heights, outside];
    };
    const width = Math.max(plot.clientWidth || 480, 200), height = 150, floor = height - 22, left = 8, right = width - 8;
    const [coarse, outside] = bin(map.counts), all = known ? known.counts : coarse;
    const logarithmic = byId("inspector-log-counts").checked;
    const top = Math.max(...all, 1);
    const level = (h) => floor - (floor - 8) * (logarithmic ? Math.log1p(h) / Math.log1p(top) : h / top);
    const at = (i) => left + ((right - left) * i) / bins;
    plot.replaceChildren();
    plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
    plot.append(svgEl("path", { d: stairs(all, at, level, floor), class: "bars" }));
    if (some) plot.append(svgEl("path", { d: stairs(bin(some)[0], at, level, floor), class: "bars chosen" }));
    const xOf = (v) => left + ((right - left) * (axis.f(v) - axis.low)) / (axis.high - axis.low);
    plot.append(svgEl("line", { x1: left, x2: right, y1: floor, y2: floor, class: "axis" }));
    for (const t of ticks(axis.low, axis.high, Math.floor(width / 90))) {
      const x = left + ((right - left) * (t - axis.low)) / (axis.high - axis.low);
      const anchor = x < left + 14 ? "start" : x > right - 14 ? "end" : "middle";
      plot.append(svgEl("line", { x1: x, x2: x, y1: floor, y2: floor + 4, class: "axis" }));
      const shown = map.log ? Number((10 ** t).toPrecision(2)) : t;
      plot.append(svgEl("text", { x, y: height - 6, "text-anchor": anchor }, tickText(shown)));
    }
    if (state.pixel >= 0) {
      const x = clamp(xOf(valueAt(map, state.pixel)), left, right);
      if (Number.isFinite(x)) plot.append(svgEl("line", { x1: x, x2: x, y1: 4, y2: floor, class: "here" }));
    }
    brush = { axis, left, right, width, floor };
    const median = quantile(map, map.counts, 0.5);
    const [p5, p95] = [0.05, 0.95].map((share) => short(quantile(map, map.counts, share)));
    const words = `${map.fact.label}: median ${short(median)} ${map.fact.unit}`;
    const beyond = outside ? `; ${whole(outside)} outside the axis` : "";
    plot.setAttribute("aria-label", `Histogram of ${words}, 5 to 95 % from ${p5} to ${p95}${beyond}`);
    byId("inspector-histogram-words").textContent = words + beyond;
  };
  const brushValue = (event) => {
    const bounds = plot.getBoundingClientRect();
    const x = ((event.clientX - bounds.left) / bounds.width) * brush.width;
    const { axis, left, right } = brush;
    return axis.back(axis.low + (axis.high - axis.low) * clamp((x - left) / (right - left), 0, 1));
  };
  let brushing = null, pendingBrush = false;
  plot.addEventListener("pointerdown", (event) => {
    if (!brush) return;
    plot.setPointerCapture(event.pointerId);
    brushing = [brushValue(event), brushValue(event), event.clientX];
  });
  plot.addEventListener("pointermove", (event) => {
    if (!brushing) return;
    brushing[1] = brushValue(event);
    if (pendingBrush) return;
    pendingBrush = true;
    requestAnimationFrame(() => {
      pendingBrush = false;
      if (brushing) selectRange(Math.min(brushing[0], brushing[1]), Math.max(brushing[0], brushing[1]));
    });
  });
  plot.addEventListener("pointerup", (event) => {
    if (!brushing) return;
    const [from, , start] = brushing, to = brushValue(event);
    brushing = null;
    if (Math.abs(event.clientX - start) < 3) select(null);
    else selectRange(Math.min(from, to), Math.max(from, to));
  });
  plot.addEventListener("pointercancel", () => { brushing = null; });
  const selectRange = (from, to) => {
    const { map } = state, selection = new Uint8Array(n), inside = new Uint8Array(65536), { axis } = brush;
    // a brush that reaches the end of the axis takes what lies beyond
    const open = [axis.f(from) <= axis.low, axis.f(to) >= axis.high];
    for (let code = FIRST; code < ABOVE; code++) {
      const value = codeValue(map, code);
      inside[code] = (open[0] || value >= from) && (open[1] || value <= to) ? 1 : 0;
    }
    inside[BELOW] = open[0] ? 1 : 0;
    inside[ABOVE] = open[1] ? 1 : 0;
    for (let i = 0; i < n; i++) selection[i] = inside[map.codes[i]];
    byId("inspector-from").value = open[0] ? "" : Number(from.toPrecision(5));
    byId("inspector-to").value = open[1] ? "" : Number(to.toPrecision(5));
    const ends = [open[0] ? "" : `from ${short(from)}`, open[1] ? "" : `to ${short(to)}`].filter(Boolean).join(" ");
    const link = `range,${map.fact.path},${open[0] ? "" : Number(from.toPrecision(7))},${open[1] ? "" : Number(to.toPrecision(7))}`;
    select(selection, `${map.fact.label} ${ends} ${map.fact.unit}`, link, true);
  };
  const selectCategory = (map, key, text) => {
    const selection = new Uint8Array(n);
    for (let i = 0; i < n; i++) {
      if (map.codes[i] !== NONE && belongs(map.fact, key, Math.round(codeValue(map, map.codes[i])))) selection[i] = 1;
    }
    select(selection, text, `is,${map.fact.path},${key}`);
  };
  const select = (selection, words = "", link = "", keepFields = false) => {
    state.selection = selection;
    state.selectionLink = link;
    keepAddress();
    state.selectionWords = words.trim();
    if (!keepFields) { byId("inspector-from").value = ""; byId("inspector-to").value = ""; }
    paint();
    redraw();
    showHistogram();
    saySelection();
  };
  const saySelection = () => {
    const { map, selection } = state;
    for (const id of ["inspector-clear", "inspector-csv", "inspector-mask"]) byId(id).disabled = !selection;
    if (!selection) { say("Nothing selected. Drag over the histogram, or Shift-drag a rectangle on the map."); return; }
    const count = selection.reduce((sum, each) => sum + each, 0);
    let text = `${plural(count, facts.noun)} selected (${percent(count, n)}): ${state.selectionWords}.`;
    const counts = countCodes(map, selection);
    if (!categorical(map.fact) && total(counts)) {
      const [some, all] = [counts, map.counts].map((each) => short(quantile(map, each, 0.5)));
      text += ` Median ${map.fact.label} ${some} ${map.fact.unit}, of all ${all}.`;
    }
    say(text);
  };

  // page.js keeps what is saved
  const save = (content, type, name) => document.dispatchEvent(new CustomEvent("pchem-save", { detail: [content, type, name] }));
  const saveCsv = () => {
    const { map, error, selection } = state, heading = `${map.fact.label}${map.fact.unit && ` (${map.fact.unit})`}`;
    const quoted = (text) => `"${text.replaceAll('"', '""')}"`;
    const lines = [["y", "x", quoted(heading), ...(error ? ["standard error"] : [])].join(",")];
    const cell = (from, i) => { const v = valueAt(from, i); return Number.isFinite(v) ? Number(v.toPrecision(7)) : ""; };
    for (let i = 0; i < n; i++) {
      if (!selection[i]) continue;
      lines.push([Math.floor(i / nx), i % nx, cell(map, i), ...(error ? [cell(error, i)] : [])].join(","));
    }
    save(`${lines.join("\n")}\n`, "text/csv", "selection.csv");
  };
  const saveMask = () => {
    // numpy's format 1.0: magic, length of the header, header padded to 64 bytes, values of one byte
    const text = `{'descr': '|b1', 'fortran_order': False, 'shape': (${ny}, ${nx}), }`;
    const length = Math.ceil((10 + text.length + 1) / 64) * 64 - 10;
    const head = new Uint8Array(10 + length).fill(32);
    head.set([0x93, 78, 85, 77, 80, 89, 1, 0, length & 255, length >> 8]);
    head.set(new TextEncoder().encode(text), 10);
    head[head.length - 1] = 10;
    save(new Blob([head, state.selection]), "application/octet-stream", "selection.npy");
  };

  // -- one pixel -----------------------------------------------------------------------------
  let turn = 0;
  const choose = async (i, { quiet = false } = {}) => {
    state.pixel = i;
    byId("inspector-trouble").hidden = true;
    reveal(i);
    redraw();
    showHistogram();
    byId("inspector-y").value = Math.floor(i / nx);
    byId("inspector-x").value = i % nx;
    if (!quiet) keepAddress();
    const mine = ++turn;
    const pixel = await pixelData(i);
    if (mine === turn) showPixel(pixel);
  };
  // on a phone a pixel is shown below the map that was tapped
  const bringIntoView = () => {
    const top = byId("inspector-title").getBoundingClientRect().top;
    if (top < 0 || top > window.innerHeight - 120) byId("inspector-pixel").scrollIntoView({ block: "start" });
  };
  // the pixel in full that is least far by some measure; -1 where none is
  const closest = (distance) => {
    let best = -1, least = Infinity;
    for (const i of inFull()) {
      const away = distance(i);
      if (away < least) [best, least] = [i, away];
    }
    return best;
  };
  const medianPixel = () => {
    const { map, status } = state, middle = quantile(map, map.counts, 0.5);
    return closest((i) => Math.abs(valueAt(map, i) - middle) + (status && valueAt(status, i) !== 0 ? 1e300 : 0));
  };
  const pixelData = async (i) => {
    const found = { index: i, values: new Map(), counts: null, origin: 0, deciding: null, mass: null };
    Object.assign(found, { trouble: "", exact: false });
    const slot = sample.slot.get(i);
    for (const fact of facts.maps) {
      if (fact.here) found.values.set(fact.path, valueAt(await layer(fact.path), i));
    }
    if (slot !== undefined) {
      found.exact = true;
      found.counts = sample.counts[slot];
      found.origin = sample.origin[slot];
      found.deciding = sample.deciding.length ? sample.deciding.map((column) => column[slot]) : null;
      found.mass = sample.masses[slot] ?? null;
    }
    if (served) {
      try {
        const answer = await ask(`api/pixel?y=${Math.floor(i / nx)}&x=${i % nx}`);
        for (const [path, value] of Object.entries(answer.values)) found.values.set(path, value ?? NaN);
        const { counts, origin, deciding, mass } = answer;
        Object.assign(found, { counts, origin, deciding, mass, exact: true });
      } catch (error) {
        found.trouble = `The server does not answer (${error.message}). Is ${facts.command} still running?`;
      }
    }
    return found;
  };
  const parametersOf = (pixel) => {
    const paths = ["maps/quanta_exposure", "maps/conversion_gain", "maps/bias"];
    const [h, g, mu] = paths.map((path) => pixel.values.get(path) ?? NaN);
    let sigma = pixel.values.get("maps/read_noise_dn") ?? NaN;
    if (!Number.isFinite(sigma)) sigma = (pixel.values.get("maps/read_noise_e") ?? NaN) / g;
    return [h, g, mu, sigma].every(Number.isFinite) && g > 0 && sigma > 0 && h >= 0 ? [h, g, mu, sigma] : null;
  };
  // components of the PCD that matter at x: [k, weight * normal density]
  const components = (x, [h, g, mu, sigma]) => {
    const first = Math.max(Math.ceil((x - mu - 9 * sigma) * g), 0), last = Math.floor((x - mu + 9 * sigma) * g);
    const found = [];
    for (let k = first; k <= last; k++) {
      const z = (x - mu - k / g) / sigma;
      found.push([k, Math.exp(logPoisson(k, h) - z * z / 2) / (sigma * Math.sqrt(2 * Math.PI))]);
    }
    return found;
  };
  const logFactorials = [0];
  const logPoisson = (k, h) => {
    while (logFactorials.length <= k) logFactorials.push(logFactorials.at(-1) + Math.log(logFactorials.length));
    return h > 0 ? k * Math.log(h) - h - logFactorials[k] : k === 0 ? 0 : -Infinity;
  };
  const density = (x, theta) => components(x, theta).reduce((sum, [, part]) => sum + part, 0);
  // edges between electron numbers k and k + 1
  const edge = (k, [h, g, mu, sigma]) => mu + (k + 0.5) / g + g * sigma * sigma * Math.log((k + 1) / h);

  const shownRange = (pixel, theta) => {
    if (!pixel.counts?.length) {
      const last = Math.ceil(theta[0] + 3 * Math.sqrt(Math.max(theta[0], 0.3))) + 1;
      return [Math.floor(theta[2] - 4 * theta[3]), Math.ceil(theta[2] + last / theta[1] + 4 * theta[3])];
    }
    const all = pixel.counts.reduce((sum, count) => sum + count, 0);
    let below = 0, first = -1, last = 0;
    pixel.counts.forEach((count, i) => {
      below += count;
      if (first < 0 && below / all >= 2e-4) first = i;
      if (below / all < 1 - 2e-4) last = i + 1;
    });
    const margin = Math.max(2, Math.floor((last - first) / 10));
    const [from, to] = [Math.max(first - margin, -2), Math.min(last + margin, pixel.counts.length + 1)];
    return [pixel.origin + from, pixel.origin + to];
  };
  // Everything that the drawing of a pixel needs: the shown DN, and functions of them.
  const sketch = (pixel) => {
    const theta = parametersOf(pixel), counts = pixel.counts;
    const all = counts ? counts.reduce((sum, count) => sum + count, 0) : 0;
    if (!theta && !all) return null;
    const [low, high] = shownRange(pixel, theta), scale = all || 1;
    const bins = Array.from({ length: high - low + 1 }, (_, i) => low + i);
    const countAt = (dn) => counts?.[dn - pixel.origin] ?? 0;
    const expectedAt = (dn) => {
      if (!theta) return NaN;
      if (facts.model) return pixel.mass ? scale * (pixel.mass[dn - pixel.origin] ?? 0) : NaN;
      return scale * density(dn, theta);
    };
    let curve = [];
    if (theta && facts.model) curve = pixel.mass ? bins.map((dn) => [dn, expectedAt(dn)]) : [];
    else if (theta) {
      const fine = Array.from({ length: 601 }, (_, i) => low - 0.5 + ((high - low + 1) * i) / 600);
      curve = fine.map((dn) => [dn, scale * density(dn, theta)]);
    }
    const peak = Math.max(...bins.map(countAt), ...curve.map(([, v]) => v), 1e-12);
    const logarithmic = byId("inspector-log-pixel").checked && all > 0 && peak > 1;
    const limits = limitsOf(pixel, theta, low, high), residuals = residualsOf(bins, countAt, expectedAt, all);
    return { pixel, theta, all, scale, low, high, bins, countAt, expectedAt, curve, peak, logarithmic, limits, residuals };
  };
  const limitsOf = (pixel, theta, low, high) => {
    const deciding = pixel.deciding?.every(Number.isFinite) ? pixel.deciding : facts.model ? null : theta;
    if (!deciding || !(deciding[0] > 0)) return [];
    const found = [];
    for (let k = 0; k < 400 && edge(k, deciding) < high + 0.5; k++) {
      if (edge(k, deciding) > low - 0.5) found.push([k, edge(k, deciding)]);
    }
    return found;
  };
  const residualsOf = (bins, countAt, expectedAt, all) => {
    const expected = all ? bins.map((dn) => [dn, expectedAt(dn)]).filter(([, e]) => e >= 1) : [];
    return expected.map(([dn, e]) => [dn, (countAt(dn) - e) / Math.sqrt(e)]);
  };
  const largestOf = (s) => Math.max(...s.residuals.map(([, r]) => Math.abs(r)));
  // marks of charts.js from [x, y] of each point
  const mark = (kind, points, colour, more = {}) => ({ kind, x: points.map(([x]) => x), y: points.map(([, y]) => y), colour, ...more });
  const componentMarks = (s) => {
    const parts = new Map();
    for (const [dn] of s.theta && !facts.model ? s.curve : []) {
      for (const [k, part] of components(dn, s.theta)) {
        if (s.scale * part < s.peak * 2e-4) continue;
        if (!parts.has(k)) parts.set(k, []);
        parts.get(k).push([dn, s.scale * part]);
      }
    }
    if (parts.size > 60) return [];
    return [...parts].map(([k, points]) => mark("line", points, k % 2 ? "green" : "vermilion", { width: 0.8 }));
  };
  const densityPanel = (s) => {
    const ends = s.logarithmic ? [0.5, 8 * s.peak] : [0, 1.25 * s.peak], marks = [];
    const dashed = s.logarithmic ? 0.5 * (ends[1] / 0.5) ** 0.88 : 0.88 * ends[1];
    const edges = [...s.bins, s.high + 1].map((dn) => [dn - 0.5, s.countAt(dn)]);
    if (s.all) marks.push({ ...mark("steps", edges, "bars", { filled: true, label: facts.samples }), y: s.bins.map(s.countAt) });
    marks.push(...componentMarks(s));
    if (s.curve.length) marks.push(mark("line", s.curve, "ink", { width: 1.2, label: "fit" }));
    marks.push(mark("sticks", s.limits.map(([, dn]) => [dn, dashed]), "blue", { dash: "--", width: 0.9 }));
    const every = Math.max(1, Math.ceil(s.limits.length / 18));
    s.limits.forEach(([k, dn], i) => {
      const from = i ? s.limits[i - 1][1] : s.low - 0.5;
      if (k % every === 0) marks.push({ kind: "words", x: (from + dn) / 2, up: 0.9, text: String(k), align: "center", colour: "blue" });
    });
    return { height: 3, y: { label: s.all ? `${facts.samples} per DN` : "density", ends, log: s.logarithmic }, marks };
  };
  const residualPanel = (s) => {
    const limit = s.residuals.length ? clamp(1.15 * largestOf(s), 3.5, 12) : 3.5, far = s.residuals.filter(([, r]) => Math.abs(r) > limit);
    const marks = [
      { kind: "span", axis: "y", low: -2, high: 2, colour: "band" },
      { kind: "level", axis: "y", at: 0, colour: "ink", width: 0.6 },
      mark("sticks", s.residuals.map(([dn, r]) => [dn, clamp(r, -limit, limit)]), "blue", { label: "residual" }),
      mark("points", far.map(([dn, r]) => [dn, 0.93 * Math.sign(r) * limit]), "vermilion", { mark: "x", size: 3 }),
    ];
    return { height: 1, y: { label: "residual\n(σ)", ends: [-limit, limit] }, marks, note: s.theta ? "" : "no fit, no residuals" };
  };
  const describePlot = (s) => {
    const frames = `${whole(s.all)} ${facts.samples}`, off = s.residuals.length ? short(largestOf(s), 2) : "";
    const first = s.limits.slice(0, 4).map(([, dn]) => short(dn, 4)).join(", ");
    const parts = [s.all ? `Histogram of ${frames}` : "Fitted density without a histogram", `${s.low} to ${s.high} DN`];
    if (s.theta) parts.push("fitted density");
    if (first) parts.push(`first limits between electron numbers at ${first} DN`);
    if (off) parts.push(`largest residual ${off} sigma`);
    const line = facts.model
      ? `probability under the model ${facts.model}`
      : "fitted density; thin: its components, one per electron number";
    const below = "Below: (observed − expected) / √expected, 2 sigma shaded; largest";
    const words = [s.all ? `Gray: ${frames}.` : ""];
    if (s.curve.length) words.push(`Line: ${line}.`);
    if (first) words.push("Dashed: limits between the electron numbers k.");
    if (off) words.push(`${below} ${off}.`);
    byId("inspector-caption").textContent = words.filter(Boolean).join(" ");
    return `${parts.join("; ")}.`;
  };
  let clearPlot = () => {};
  const drawPixel = (pixel) => {
    const s = sketch(pixel);
    clearPlot();
    clearPlot = () => {};
    byId("inspector-caption").textContent = "";
    byId("inspector-counts").hidden = !s || !s.all;
    if (!s?.all && !s?.curve.length) return; // of a model with effects the curve is stored with the histogram
    const panels = [densityPanel(s), ...(s.all ? [residualPanel(s)] : [])];
    const stack = { height: 76, x: { label: "signal (DN)", ends: [s.low - 0.5, s.high + 0.5], whole: true }, panels };
    clearPlot = window.pchemChart(byId("inspector-plot"), { widths: [1], stacks: [stack] }, describePlot(s));
    fillCounts(s);
  };
  const fillCounts = (s) => {
    const details = byId("inspector-counts"), body = details.querySelector("tbody");
    const row = (dn) => {
      const e = s.expectedAt(dn), cells = [whole(s.countAt(dn)), Number.isFinite(e) ? short(e) : ""];
      cells.push(e >= 1 ? short((s.countAt(dn) - e) / Math.sqrt(e), 2) : "");
      return el("tr", {}, el("th", { scope: "row" }, String(dn)), ...cells.map((text) => el("td", {}, text)));
    };
    const fill = () => body.replaceChildren(...s.bins.map(row));
    details.ontoggle = () => { if (details.open) fill(); };
    if (details.open) fill();
  };
  let current = null;
  const showPixel = (pixel) => {
    current = pixel;
    const { index: i, values } = pixel, name = place(i);
    byId("inspector-title").textContent = name[0].toUpperCase() + name.slice(1);
    const status = values.get("fit/fit_status"), statusFact = factOf.get("fit/fit_status");
    const bad = Number.isFinite(status) && (status & facts.failedMask) !== 0;
    const verdict = byId("inspector-status");
    verdict.className = status === 0 ? "good" : bad ? "serious" : "caution";
    const sign = status === 0 ? "✓" : bad ? "✕" : "▲";
    const p = values.get("fit/goodness_p");
    const fitText = statusFact ? wordsOf(statusFact, status) : "";
    verdict.textContent = `${sign} ${fitText}${Number.isFinite(p) ? `; goodness of fit p = ${short(p, 2)}` : ""}`;
    const rows = [], others = [];
    for (const fact of facts.maps) {
      if (fact.kind === "stderr" || fact.path === "fit/fit_status" || !values.has(fact.path)) continue;
      const error = values.get(`${fact.path}_stderr`) ?? NaN;
      const text = valueText(fact, values.get(fact.path), error);
      const truth = values.get(fact.path.replace("maps/", "truth/"));
      const panel = facts.panel.indexOf(fact.path);
      const row = el("tr", {}, el("th", { scope: "row", title: fact.sentence }, fact.label), el("td", {}, text));
      row.dataset.path = fact.path;
      if (panel < 0) others.push(row);
      else {
        if (hasTruth) row.append(el("td", {}, Number.isFinite(truth) ? short(truth, 4) : ""));
        rows[panel] = row;
      }
    }
    byId("inspector-values").replaceChildren(...rows.filter(Boolean));
    byId("inspector-others").hidden = others.length === 0;
    byId("inspector-others").querySelector("tbody").replaceChildren(...others);
    const notes = [];
    if (pixel.trouble) notes.push(pixel.trouble);
    if (!pixel.exact) {
      notes.push(`Values to ${facts.keptTo}; this ${facts.noun}'s histogram is not in the file, which`);
      notes.push(`holds ${whole(facts.sample.n)} of ${whole(n)}. To see all: ${facts.command}`);
    } else if (facts.model && !pixel.mass && parametersOf(pixel)) {
      notes.push(`To see the fitted curve of this ${facts.noun} (model ${facts.model}): ${facts.command}`);
    }
    byId("inspector-note").textContent = notes.join(" ");
    byId("inspector-nearest").hidden = pixel.counts !== null;
    byId("inspector-pixel").hidden = false;
    byId("inspector-empty").hidden = true;
    byId("inspector-spoken").textContent = `${describe(i)}.`;
    drawPixel(pixel);
    app.dataset.pixel = String(i);
  };
  const truths = facts.panel.map((path) => factOf.get(path.replace("maps/", "truth/"))).filter(Boolean);
  const hasTruth = truths.some((fact) => fact.here || served);
  const inFull = () => [...sample.slot.keys()].sort((a, b) => a - b);
  const neighbour = (direction) => {
    const list = inFull();
    if (!list.length) return;
    const at = list.findIndex((i) => i >= state.pixel), here = list[at] === state.pixel;
    const next = direction > 0 ? (at < 0 ? 0 : at + (here ? 1 : 0)) : (at < 0 ? list.length : at) - 1;
    choose(list[(next + list.length) % list.length]);
  };
  const nearest = () => {
    const y = Math.floor(state.pixel / nx), x = state.pixel % nx;
    const best = closest((i) => (Math.floor(i / nx) - y) ** 2 + ((i % nx) - x) ** 2);
    if (best >= 0) choose(best);
  };

  // -- address -------------------------------------------------------------------------------
  const address = () => {
    const parts = [`pixel=${Math.floor(state.pixel / nx)},${state.pixel % nx}`, `map=${state.map.fact.path}`];
    if (state.colours !== "p1") parts.push(`colours=${state.colours}`);
    if (view.scale > view.fit * 1.001) {
      const middle = [view.x + view.width / view.scale / 2, view.y + view.height / (view.scale * tall) / 2];
      parts.push(`zoom=${(view.scale / view.fit).toFixed(2)},${middle.map((each) => each.toFixed(1)).join(",")}`);
    }
    if (state.selectionLink) parts.push(`select=${state.selectionLink}`);
    return `#${parts.join("&")}`;
  };
  let ready = false;
  const keepAddress = () => {
    if (state.pixel < 0 || !state.map || !ready) return;
    byId("inspector-link").setAttribute("href", address());
    try { history.replaceState(null, "", address()); } catch { /* some browsers forbid it for files, and many in a second */ }
  };
  const finite = (texts) => texts.map(Number).every(Number.isFinite);
  const goTo = ([factor, x, y]) => {
    view.scale = clamp(view.fit * factor, view.fit, Math.max(64 / Math.sqrt(tall), view.fit));
    view.x = x - view.width / view.scale / 2;
    view.y = y - view.height / (view.scale * tall) / 2;
    keepInside();
    redraw();
  };
  const selectAsked = async ([kind, ...rest], shown) => {
    if (kind === "box" && rest.length === 4 && finite(rest)) {
      const [x0, y0, x1, y1] = rest.map((each, i) => clamp(Math.round(Number(each)), 0, (i % 2 ? ny : nx) - 1));
      selectBox([x0, y0], [x1, y1]);
      return true;
    }
    const [path, ...ends] = rest;
    if (!factOf.has(path) || !usable(factOf.get(path)) || !finite(ends)) return false;
    if (kind !== "range" && kind !== "is") return false;
    if (state.map.fact.path !== path) await showMap(path);
    if (kind === "is") selectCategory(state.map, Number(ends[0]), wordsOf(state.map.fact, Number(ends[0])));
    else if (brush) selectRange(ends[0] === "" ? brush.axis.back(brush.axis.low) : Number(ends[0]), ends[1] === "" ? brush.axis.back(brush.axis.high) : Number(ends[1]));
    if (state.map.fact.path !== shown) await showMap(shown);
    return true;
  };
  const fromAddress = () => {
    const asked = new URLSearchParams(location.hash.slice(1));
    const position = /^(\d+),(\d+)$/.exec(asked.get("pixel") ?? "");
    const [y, x] = position ? [Number(position[1]), Number(position[2])] : [NaN, NaN];
    const colours = asked.get("colours"), path = asked.get("map"), trouble = [];
    const known = { pixel: y < ny && x < nx, colours: Object.hasOwn(RANGES, colours ?? "") || colours === "beta", map: factOf.has(path) };
    for (const [name, good] of Object.entries(known)) if (asked.has(name) && !good) trouble.push(`${name} ${asked.get(name)}`);
    const zoomed = (asked.get("zoom") ?? "").split(",");
    return {
      pixel: known.pixel ? y * nx + x : -1,
      colours: known.colours ? colours : null,
      path: known.map ? path : null,
      zoom: zoomed.length === 3 && finite(zoomed) ? zoomed.map(Number) : null,
      select: asked.has("select") ? asked.get("select").split(",") : null,
      trouble,
    };
  };

  // -- controls ------------------------------------------------------------------------------
  const usable = (fact) => fact.here || served;
  const showMap = async (path) => {
    const fact = factOf.get(path);
    byId("inspector-map").value = path;
    byId("inspector-sentence").textContent = fact.sentence;
    app.dataset.busy = "yes";
    try {
      const map = await layer(path), wanted = errorPath(path);
      state.error = wanted && usable(factOf.get(wanted)) ? await layer(wanted) : null;
      map.counts ??= countCodes(map, null);
      // the ends of a selection are values of the map that it was made on
      if (state.map && state.map !== map) for (const id of ["inspector-from", "inspector-to"]) byId(id).value = "";
      state.map = map;
    } catch (error) {
      layers.delete(path);
      if (state.map) byId("inspector-map").value = state.map.fact.path;
      say(`${fact.label} cannot be shown: ${error.message}`);
      return;
    } finally { delete app.dataset.busy; }
    byId("inspector-colours").disabled = categorical(fact);
    canvas.setAttribute("aria-label", `Map of ${fact.label}`);
    paint();
    layout();
    showScale();
    showHistogram();
    saySelection();
    app.dataset.map = path;
    keepAddress();
  };
  const fillControls = () => {
    const list = byId("inspector-map"), groups = new Map();
    for (const fact of facts.maps) {
      if (!groups.has(fact.group)) groups.set(fact.group, el("optgroup", { label: fact.group }));
      const text = fact.label + (fact.unit ? ` (${fact.unit})` : "");
      const option = el("option", { value: fact.path }, usable(fact) ? text : `${text}: pchem view only`);
      option.disabled = !usable(fact);
      groups.get(fact.group).append(option);
    }
    list.append(...groups.values());
    byId("inspector-y").max = ny - 1;
    byId("inspector-x").max = nx - 1;
    byId("inspector-y-label").hidden = ny === 1;
    byId("inspector-truth").hidden = !hasTruth;
  };
  // pixels that stand out, with why: sorted by a click on a heading
  const notable = { rows: [], key: "", up: true };
  const fillNotable = async () => {
    for (const { words, pixels: where, path } of facts.notable) {
      const shown = factOf.has(path) && usable(factOf.get(path)) ? path : "maps/read_noise_e";
      const map = factOf.has(shown) && usable(factOf.get(shown)) ? await layer(shown) : state.map;
      for (const i of where) {
        const value = valueAt(map, i);
        notable.rows.push({ reason: words, place: i, value, text: `${map.fact.label} ${valueText(map.fact, value, NaN)}` });
      }
    }
    sortNotable("");
  };
  const sortNotable = (key) => {
    const { rows } = notable;
    notable.up = key === notable.key ? !notable.up : true;
    notable.key = key;
    const rank = (a, b) => (Number.isNaN(a) ? 1 : 0) - (Number.isNaN(b) ? 1 : 0) || (a > b ? 1 : a < b ? -1 : 0);
    const shown = key ? [...rows].sort((a, b) => rank(a[key], b[key]) * (notable.up ? 1 : -1)) : rows;
    byId("inspector-notable").replaceChildren(...shown.map((row) => {
      const button = el("button", { type: "button", "data-pixel": row.place }, ny === 1 ? place(row.place) : `y ${Math.floor(row.place / nx)}, x ${row.place % nx}`);
      button.addEventListener("click", () => choose(row.place).then(bringIntoView));
      return el("tr", {}, el("th", { scope: "row" }, row.reason), el("td", {}, button), el("td", {}, row.text));
    }));
    for (const head of document.querySelectorAll("#inspector-notables th[scope=col]")) {
      const own = head.firstElementChild.dataset.key === key;
      head.setAttribute("aria-sort", own ? (notable.up ? "ascending" : "descending") : "none");
    }
  };
  // words for the eye and for the ear
  const tell = (text, where) => {
    byId("inspector-spoken").textContent = text;
    byId(where).textContent = text;
    byId(where).hidden = false;
  };
  const listen = () => {
    byId("inspector-map").addEventListener("change", (event) => showMap(event.target.value));
    byId("inspector-colours").addEventListener("change", (event) => {
      state.colours = event.target.value;
      paint();
      redraw();
      showScale();
      keepAddress();
    });
    byId("inspector-in").addEventListener("click", () => zoom(1.6));
    byId("inspector-out").addEventListener("click", () => zoom(1 / 1.6));
    byId("inspector-whole").addEventListener("click", () => zoom(1e-9));
    byId("inspector-log-counts").addEventListener("change", showHistogram);
    byId("inspector-log-pixel").addEventListener("change", () => current && drawPixel(current));
    const go = () => {
      const y = ny === 1 ? 0 : Number(byId("inspector-y").value), x = Number(byId("inspector-x").value);
      if (Number.isInteger(y) && Number.isInteger(x) && y >= 0 && x >= 0 && y < ny && x < nx) choose(y * nx + x);
      else {
        const ends = `y is 0 to ${ny - 1}, x is 0 to ${nx - 1}`;
        tell(`There is no such ${facts.noun}: ${ends}.`, "inspector-trouble");
      }
    };
    byId("inspector-go").addEventListener("click", go);
    for (const id of ["inspector-y", "inspector-x"]) {
      byId(id).addEventListener("keydown", (event) => { if (event.key === "Enter") go(); });
    }
    for (const head of document.querySelectorAll("#inspector-notables th[scope=col] button")) {
      head.addEventListener("click", () => sortNotable(head.dataset.key));
    }
    byId("inspector-csv").addEventListener("click", saveCsv);
    byId("inspector-mask").addEventListener("click", saveMask);
    for (const id of ["inspector-from", "inspector-to"]) byId(id).addEventListener("change", () => {
      const [from, to] = ["inspector-from", "inspector-to"].map((each) => byId(each).value);
      if (from === "" && to === "") select(null);
      else if (brush) {
        const { back, low, high } = brush.axis;
        selectRange(from === "" ? back(low) : Number(from), to === "" ? back(high) : Number(to));
      }
    });
    byId("inspector-clear").addEventListener("click", () => select(null));
    byId("inspector-previous").addEventListener("click", () => neighbour(-1));
    byId("inspector-next").addEventListener("click", () => neighbour(1));
    byId("inspector-nearest").addEventListener("click", nearest);
    byId("inspector-copy").addEventListener("click", async () => {
      const link = new URL(address(), location.href).href;
      try { await navigator.clipboard.writeText(link); tell("Link copied.", "inspector-note"); }
      catch { tell(`Copy this link: ${link}`, "inspector-note"); }
    });
    byId("inspector-link").addEventListener("click", (event) => event.preventDefault());
    window.addEventListener("hashchange", async () => {
      const asked = fromAddress();
      tellTrouble(asked);
      if (asked.colours && asked.colours !== state.colours) {
        byId("inspector-colours").value = asked.colours;
        byId("inspector-colours").dispatchEvent(new Event("change"));
      }
      if (asked.path && asked.path !== state.map.fact.path) await showMap(asked.path);
      if (asked.zoom) goTo(asked.zoom);
      if (asked.select) await selectAsked(asked.select, state.map.fact.path);
      if (asked.pixel >= 0 && asked.pixel !== state.pixel) choose(asked.pixel, { quiet: true });
    });
    new ResizeObserver(() => { layout(); showHistogram(); }).observe(app);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { paint(); redraw(); showScale(); });
  };
  const tellTrouble = ({ trouble }) => {
    if (!trouble.length) return;
    tell(`Not in this run: ${trouble.join("; ")}. The link may be from another run.`, "inspector-trouble");
  };
  const start = async () => {
    if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old");
    fillControls();
    app.hidden = false;
    const asked = fromAddress();
    if (asked.colours) { state.colours = asked.colours; byId("inspector-colours").value = asked.colours; }
    const first = facts.maps.filter(usable).map((fact) => fact.path);
    if (!first.length) throw new Error("this run has no map");
    await readSample();
    if (factOf.has("fit/fit_status")) state.status = await layer("fit/fit_status");
    let path = asked.path ?? (first.includes("maps/read_noise_e") ? "maps/read_noise_e" : first[0]);
    if (!first.includes(path)) path = first[0];
    await showMap(path);
    if (!state.map && path !== "fit/fit_status" && state.status) await showMap("fit/fit_status");
    if (!state.map) throw new Error("no map can be read");
    if (state.map && !asked.path && total(state.map.counts) === 0 && state.status) await showMap("fit/fit_status");
    listen();
    if (asked.select && !(await selectAsked(asked.select, state.map.fact.path))) asked.trouble.push(`select ${asked.select}`);
    await fillNotable();
    const chosen = asked.pixel >= 0 ? asked.pixel : medianPixel();
    if (chosen >= 0) await choose(chosen, { quiet: true });
    if (asked.zoom) goTo(asked.zoom);
    tellTrouble(asked);
    if (asked.pixel >= 0 || asked.trouble.length) byId("inspector").scrollIntoView();
    ready = true;
    byId("inspector-link").setAttribute("href", address());
    app.dataset.ready = "yes";
  };
  start().catch((error) => {
    app.hidden = true;
    byId("inspector-trouble").hidden = false;
    byId("inspector-trouble").textContent = `The inspector cannot start: ${error.message}.`;
  });
})();
