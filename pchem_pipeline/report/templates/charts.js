// Charts of curves, bars and points: uPlot has the axes, the cursor and the zoom, the marks are drawn here.
// Without this script, and on paper, the page has a plain picture of each.
"use strict";
(() => {
  const source = document.getElementById("charts");
  if (!source) return;
  const { colours, charts } = JSON.parse(source.textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let palette = colours[dark.matches ? "dark" : "light"];
  const colourOf = (name = "blue") => palette[name] ?? name;

  const PX_MM = 4.6, LOWEST = 72, TICKS = 26, NAME = 18, BELOW = TICKS + NAME, ABOVE = 8, LEFT = 66, RIGHT = 14, POINT = 4 / 3, SIDE_BY_SIDE = 560;
  const DASHES = { "--": [5, 3], ":": [1.5, 2.5], "-.": [6, 3, 1.5, 3], "-...": [7, 2, 1.5, 2, 1.5, 2], "..": [1.5, 1.5] };
  const FONT = '12px system-ui, -apple-system, "Segoe UI", "DejaVu Sans", Arial, sans-serif';
  const SOLID = new Set(["bars", "band", "span"]);
  const solid = (mark) => SOLID.has(mark.kind) || mark.filled;

  const made = (tag, name, text) => {
    const element = document.createElement(tag);
    if (name) element.className = name;
    if (text) element.textContent = text;
    return element;
  };

  // -- numbers ---------------------------------------------------------------------------------
  const raised = (n) => String(n).replace(/[-0-9]/g, (sign) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(sign)]);
  const written = (value, digits = 5) => {
    if (value === null || value === undefined || !Number.isFinite(value)) return "–";
    const [mantissa, power] = Number(value.toPrecision(digits)).toString().split("e");
    return (power ? `${mantissa}×10${raised(Number(power))}` : mantissa).replace("-", "−");
  };
  const decimalsOf = (step) => {
    let decimals = 0;
    while (decimals < 12 && Math.abs(step * 10 ** decimals - Math.round(step * 10 ** decimals)) > 1e-6) decimals++;
    return decimals;
  };
  const linear = (step) => (value) => {
    if (step < 1e-5 || Math.abs(value) >= 1e7) return written(value, 4);
    return value.toLocaleString("en-US", { minimumFractionDigits: decimalsOf(step), maximumFractionDigits: decimalsOf(step) }).replace("-", "−");
  };
  // powers of ten between two values, some of their multiples where there is room for them
  const powers = (low, high, most) => {
    const exponents = [];
    for (let p = Math.floor(Math.log10(low)); p <= Math.log10(high); p++) exponents.push(p);
    const inside = (digits, every) => exponents.filter((p) => p % every === 0).flatMap((p) => digits.map((digit) => Number(`${digit}e${p}`))).filter((each) => each >= low && each <= high);
    for (const digits of [[1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9], [1, 2, 5]]) {
      const found = inside(digits, 1);
      if (found.length <= most) return found;
    }
    return inside([1], Math.max(1, Math.ceil(exponents.length / most)));
  };
  const power = (value) => {
    const exponent = Math.round(Math.log10(value));
    return Math.abs(exponent) > 2 && Math.abs(value / 10 ** exponent - 1) < 1e-9 ? `10${raised(exponent)}` : written(value, 2);
  };

  // places along x: written out, or evenly spaced
  const places = (x) => (Array.isArray(x) ? x : Array.from({ length: x.n }, (_, i) => x.from + i * x.step));
  const nearest = (x, value) => {
    let low = 0, high = x.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (x[middle] < value) low = middle; else high = middle;
    }
    return high >= 0 && value - x[low] > x[high] - value ? high : low;
  };
  const valueAt = (mark, x) => {
    if (mark.y === undefined || !mark.x.length) return undefined;
    if (mark.kind === "steps") {
      const i = nearest(mark.x, x), bin = mark.x[i] > x ? i - 1 : i;
      return mark.y[bin];
    }
    const i = nearest(mark.x, x);
    return mark.kind === "band" ? [mark.low[i], mark.y[i]] : mark.y[i];
  };

  // -- marks -----------------------------------------------------------------------------------
  // each is given where values lie (canvas pixels), the corners of the panel, and the pixels of a screen's dot
  const curve = (context, X, Y, x, y) => {
    let open = false;
    for (let i = 0; i < x.length; i++) {
      if (y[i] === null) { open = false; continue; }
      if (open) context.lineTo(X(x[i]), Y(y[i])); else context.moveTo(X(x[i]), Y(y[i]));
      open = true;
    }
  };
  const held = (x, y) => {
    const across = [], up = [];
    for (let i = 0; i < x.length; i++) {
      across.push(i ? (x[i - 1] + x[i]) / 2 : x[i], i < x.length - 1 ? (x[i] + x[i + 1]) / 2 : x[i]);
      up.push(y[i], y[i]);
    }
    return [across, up];
  };
  const dots = (context, X, Y, x, y, radius) => {
    context.beginPath();
    for (let i = 0; i < x.length; i++) {
      if (y[i] === null) continue;
      context.moveTo(X(x[i]) + radius, Y(y[i]));
      context.arc(X(x[i]), Y(y[i]), radius, 0, 7);
    }
    context.fill();
  };
  const paint = {
    line(mark, context, X, Y, box, ratio) {
      curve(context, X, Y, ...(mark.step ? held(mark.x, mark.y) : [mark.x, mark.y]));
      context.stroke();
      if (mark.dots) dots(context, X, Y, mark.x, mark.y, (mark.dots * POINT * ratio) / 2);
    },
    steps(mark, context, X, Y, box) {
      const across = mark.x.flatMap((each) => [each, each]).slice(1, -1), up = mark.y.flatMap((each) => [each, each]);
      if (!mark.filled) {
        curve(context, X, Y, across, up);
        context.stroke();
        return;
      }
      const floor = Math.min(Y(0), box.bottom);
      for (let i = 0; i < across.length; i += 2) {
        if (up[i] !== null) context.rect(X(across[i]), Y(up[i]), X(across[i + 1]) - X(across[i]) + 0.5, floor - Y(up[i]));
      }
      context.fill();
    },
    bars(mark, context, X, Y) {
      for (let i = 0; i < mark.x.length; i++) {
        const left = X(mark.x[i] - mark.broad / 2), right = X(mark.x[i] + mark.broad / 2);
        context.rect(left, Y(mark.y[i]), right - left, Y(mark.low[i]) - Y(mark.y[i]));
      }
      context.fill();
    },
    sticks(mark, context, X, Y) {
      for (let i = 0; i < mark.x.length; i++) {
        if (mark.y[i] === null) continue;
        context.moveTo(X(mark.x[i]), Y(0));
        context.lineTo(X(mark.x[i]), Y(mark.y[i]));
      }
      context.stroke();
    },
    points(mark, context, X, Y, box, ratio) {
      const half = ratio * Math.max((mark.size * POINT) / 2, 1);
      context.lineWidth = ratio * 1.2;
      for (let i = 0; mark.error && i < mark.x.length; i++) {
        if (mark.y[i] === null) continue;
        context.moveTo(X(mark.x[i]), Y(mark.y[i] - mark.error[0][i]));
        context.lineTo(X(mark.x[i]), Y(mark.y[i] + mark.error[1][i]));
      }
      if (mark.mark === "o") {
        context.stroke();
        dots(context, X, Y, mark.x, mark.y, half);
        return;
      }
      for (let i = 0; i < mark.x.length; i++) {
        if (mark.y[i] === null) continue;
        const x = X(mark.x[i]), y = Y(mark.y[i]);
        if (mark.mark === "s") context.fillRect(x - half, y - half, 2 * half, 2 * half);
        else {
          context.moveTo(x - half, y - half); context.lineTo(x + half, y + half);
          context.moveTo(x - half, y + half); context.lineTo(x + half, y - half);
        }
      }
      context.stroke();
    },
    band(mark, context, X, Y) {
      const [x, high] = mark.step ? held(mark.x, mark.y) : [mark.x, mark.y];
      const low = mark.step ? held(mark.x, mark.low)[1] : mark.low;
      for (let i = 0; i < x.length; i++) if (high[i] !== null) context.lineTo(X(x[i]), Y(high[i]));
      for (let i = x.length - 1; i >= 0; i--) if (low[i] !== null) context.lineTo(X(x[i]), Y(low[i]));
      context.closePath();
      context.fill();
    },
    level(mark, context, X, Y, box) {
      if (mark.axis === "x") { context.moveTo(X(mark.at), box.top); context.lineTo(X(mark.at), box.bottom); }
      else { context.moveTo(box.left, Y(mark.at)); context.lineTo(box.right, Y(mark.at)); }
      context.stroke();
    },
    span(mark, context, X, Y, box) {
      if (mark.axis === "x") context.fillRect(X(mark.low), box.top, X(mark.high) - X(mark.low), box.bottom - box.top);
      else context.fillRect(box.left, Y(mark.high), box.right - box.left, Y(mark.low) - Y(mark.high));
    },
    words(mark, context, X, Y, box, ratio) {
      context.textAlign = mark.align;
      context.textBaseline = "bottom";
      const y = box.bottom - mark.up * (box.bottom - box.top);
      context.fillText(mark.text, X(mark.x), Math.max(y, box.top + 14 * ratio)); // not cut at the top of a low panel
    },
  };

  // -- a panel ---------------------------------------------------------------------------------
  const draw = (panel, u) => {
    const { ctx: context, bbox } = u, ratio = uPlot.pxRatio;
    const box = { left: bbox.left, top: bbox.top, right: bbox.left + bbox.width, bottom: bbox.top + bbox.height };
    const place = (axis, scale) => {
      const least = axis.log ? u.scales[scale].min * 1e-3 : -Infinity;
      return (value) => u.valToPos(Math.max(value, least), scale, true);
    };
    const X = place(panel.stack.x, "x"), Y = place(panel.y, "y");
    context.save();
    context.font = FONT.replace("12px", `${12 * ratio}px`);
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, bbox.width, bbox.height);
    context.clip();
    for (const mark of panel.marks) {
      if (mark.label && panel.stack.row.off.has(mark.label)) continue;
      context.save();
      context.strokeStyle = context.fillStyle = colourOf(mark.colour);
      context.globalAlpha = mark.alpha ?? 1;
      context.lineWidth = (mark.width ?? 1.1) * POINT * ratio;
      context.lineJoin = "round";
      context.setLineDash((DASHES[mark.dash] ?? []).map((each) => each * ratio));
      context.beginPath();
      if (mark.colour !== "none") paint[mark.kind](mark, context, X, Y, box, ratio);
      context.restore();
    }
    context.restore();
    const lines = panel.note?.split("\n") ?? [], [upright, side] = (panel.corner ?? "upper right").split(" ");
    context.fillStyle = colourOf("faint");
    context.textAlign = side;
    context.textBaseline = "top";
    const start = upright === "upper" ? box.top + 4 * ratio : box.bottom - (4 + 15 * lines.length) * ratio;
    lines.forEach((line, i) => context.fillText(line, side === "right" ? box.right - 4 * ratio : box.left + 6 * ratio, start + i * 15 * ratio));
    // what is upright has up to two lines
    context.fillStyle = colourOf("ink");
    context.translate(box.left - (LEFT - 4) * ratio, (box.top + box.bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    panel.y.label.split("\n").forEach((line, i) => context.fillText(line, 0, 14 * ratio * i));
    context.restore();
  };

  const axisOf = (axis, scale, shown) => {
    const found = {
      scale,
      stroke: () => colourOf("ink"),
      font: FONT,
      size: scale === "x" ? (shown ? TICKS : 0) : axis.label ? LEFT : LEFT - NAME,
      grid: { stroke: () => colourOf("grid"), width: 1 },
      ticks: { stroke: () => colourOf("edge"), width: 1, size: 5, show: shown },
      border: { show: true, stroke: () => colourOf("edge"), width: 1 },
      gap: 3,
      space: scale === "x" ? 64 : 28,
      values: (u, splits, _, space, step) => splits.map(axis.log ? power : linear(step)),
    };
    if (scale === "x" && shown) Object.assign(found, { label: axis.label, labelFont: FONT, labelSize: NAME, labelGap: 0 });
    if (axis.log) {
      const room = (u) => (scale === "x" ? u.bbox.width / 46 : u.bbox.height / 26) / uPlot.pxRatio;
      found.splits = (u, _, low, high) => powers(low, high, Math.max(2, room(u)));
      found.filter = (u, splits) => splits;
    }
    if (axis.linear) {
      const both = (low, high) => [0, ...[0.5 * axis.linear, 10, 100, 1e3, 1e4, 1e5].flatMap((each) => [-each, each])].filter((each) => each >= low && each <= high).sort((a, b) => a - b);
      found.splits = (u, _, low, high) => both(low, high);
      found.filter = (u, splits) => splits;
      found.values = (u, splits) => splits.map((each) => written(each));
    }
    if (axis.whole) found.incrs = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
    if (axis.ticks) {
      const known = new Map(axis.ticks), splits = found.splits;
      const inside = (low, high) => [...known.keys()].filter((each) => each >= low && each <= high);
      found.splits = (u, i, low, high, step, space) => {
        const given = inside(low, high);
        return given.length > 1 || !splits ? given : splits(u, i, low, high, step, space);
      };
      found.filter = (u, splits_) => splits_;
      found.values = (u, splits_) => splits_.map((each) => known.get(each) ?? written(each, 3));
    }
    // panels over another have ticks without texts
    if (!shown) found.values = (u, splits) => splits.map(() => null);
    return found;
  };
  const scaleOf = (axis, ends) => ({
    time: false,
    distr: axis.log ? 3 : axis.linear ? 4 : 1,
    asinh: axis.linear ?? 1,
    range: () => ends(),
  });

  const plot = (panel, element, width, last) => {
    const { stack } = panel, [left, right] = stack.view, [low, high] = panel.view;
    const options = {
      width,
      height: panel.pixels + ABOVE + (last ? BELOW : ABOVE),
      padding: [ABOVE, RIGHT, last ? 0 : ABOVE, 0],
      legend: { show: false },
      scales: { x: scaleOf(stack.x, () => stack.view), y: scaleOf(panel.y, () => panel.view) },
      series: [{}, { scale: "y", paths: () => null, points: { show: false } }],
      axes: [axisOf(stack.x, "x", last), axisOf(panel.y, "y", true)],
      cursor: {
        points: { show: false },
        drag: { x: true, y: true, uni: 24, setScale: false },
        bind: { dblclick: () => () => { reset(stack); return null; } },
      },
      hooks: { draw: [(u) => draw(panel, u)], setCursor: [(u) => point(panel, u)], setSelect: [(u) => zoom(panel, u)] },
    };
    return new uPlot(options, [[left, right], [low, high]], element);
  };

  // -- zoom and values -------------------------------------------------------------------------
  const show = (stack) => {
    for (const panel of stack.panels) {
      panel.plot.batch(() => {
        panel.plot.setScale("x", { min: stack.view[0], max: stack.view[1] });
        panel.plot.setScale("y", { min: panel.view[0], max: panel.view[1] });
      });
    }
  };
  const reset = (stack) => {
    stack.view = stack.x.ends;
    for (const panel of stack.panels) panel.view = panel.y.ends;
    show(stack);
  };
  const zoom = (panel, u) => {
    const { left, top, width, height } = u.select, { stack } = panel;
    if (width < 6 && height < 6) return;
    const whole = { x: u.over.clientWidth, y: u.over.clientHeight };
    if (width > 5 && width < whole.x - 1) stack.view = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
    if (height > 5 && height < whole.y - 1) panel.view = [u.posToVal(top + height, "y"), u.posToVal(top, "y")];
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    show(stack);
  };
  let pointing = false;
  const point = (panel, u) => {
    if (pointing) return;
    const { stack } = panel, { left, top } = u.cursor;
    pointing = true;
    for (const other of stack.panels) if (other !== panel) other.plot?.setCursor({ left, top: -10 }, false);
    pointing = false;
    const x = left >= 0 && top >= 0 ? u.posToVal(left, "x") : null;
    stack.row.place.textContent = x === null ? "" : `${stack.x.label}: ${written(x)}`;
    for (const [label, { value }] of stack.row.keys) {
      const mark = x === null ? null : panel.marks.find((each) => each.label === label && each.x);
      const found = mark && valueAt(mark, x);
      value.textContent = found === undefined || found === null ? "" : Array.isArray(found) ? `${written(found[0])} … ${written(found[1])}` : written(found);
    }
  };
  const told = (row) => [row.place.textContent, ...[...row.keys].filter(([, { value }]) => value.textContent).map(([label, { value }]) => `${label} ${value.textContent}`)].join("; ");
  const keyed = (panel, event) => {
    const { stack, plot: u } = panel, wide = u.over.clientWidth, middle = u.over.clientHeight / 2;
    const at = u.cursor.left >= 0 ? u.cursor.left : wide / 2, step = event.shiftKey ? wide / 10 : wide / 100;
    const closer = (factor) => {
      const places_ = [at - (at * factor), at + ((wide - at) * factor)].map((each) => u.posToVal(each, "x"));
      const [low, high] = stack.x.ends;
      stack.view = [Math.max(places_[0], low), Math.min(places_[1], high)];
      show(stack);
    };
    const act = {
      ArrowLeft: () => u.setCursor({ left: Math.max(0, at - step), top: middle }),
      ArrowRight: () => u.setCursor({ left: Math.min(wide, at + step), top: middle }),
      "+": () => closer(0.5),
      "-": () => closer(2),
      0: () => reset(stack),
      Escape: () => reset(stack),
    }[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    stack.row.spoken.textContent = told(stack.row);
  };

  // -- a chart ---------------------------------------------------------------------------------
  const swatch = (mark) => {
    const make = (name) => document.createElementNS("http://www.w3.org/2000/svg", name);
    const svg = make("svg"), shape = make("path"), disk = mark.kind === "points" && mark.mark !== "x";
    svg.setAttribute("viewBox", "0 0 18 10");
    svg.setAttribute("aria-hidden", "true");
    svg.append(shape);
    const outline = solid(mark) ? "M1 1h16v8H1z" : "M0 5h18";
    shape.setAttribute("d", disk ? "M6 5a3 3 0 0 0 6 0a3 3 0 0 0-6 0" : mark.kind === "points" ? "M6 2l6 6m0-6l-6 6" : outline);
    const tint = () => {
      const filled = disk || solid(mark), dashes = (DASHES[mark.dash] ?? []).join(" ");
      const style = filled ? { fill: colourOf(mark.colour), "fill-opacity": mark.alpha ?? 1 } : { fill: "none", stroke: colourOf(mark.colour), "stroke-width": 2, "stroke-dasharray": dashes };
      for (const [name, value] of Object.entries(style)) shape.setAttribute(name, value);
    };
    tint();
    return { svg, tint };
  };
  // stacks side by side have one legend
  const legend = (row) => {
    const list = made("ul", "keys");
    for (const mark of row.stacks.flatMap((stack) => stack.panels).flatMap((panel) => panel.marks)) {
      if (!mark.label || row.keys.has(mark.label)) continue;
      const item = made("li"), value = made("span", "value");
      if (mark.colour === "none") {
        item.append(made("span", "", mark.label));
      } else {
        const button = made("button"), { svg, tint } = swatch(mark);
        button.type = "button";
        button.setAttribute("aria-pressed", "true");
        button.append(svg, made("span", "", mark.label));
        button.addEventListener("click", () => {
          const hidden = !row.off.delete(mark.label);
          if (hidden) row.off.add(mark.label);
          button.setAttribute("aria-pressed", String(!hidden));
          for (const panel of row.stacks.flatMap((stack) => stack.panels)) panel.plot.redraw(false);
        });
        row.tints.push(tint);
        item.append(button);
      }
      item.append(value);
      row.keys.set(mark.label, { value });
      list.append(item);
    }
    list.append(row.place);
    return list;
  };

  const drawn = new Set();
  const buildStack = (stack, row) => {
    const whole = made("div", "stack"), room = stack.height * PX_MM - BELOW - 2 * ABOVE * stack.panels.length;
    const shares = stack.panels.reduce((sum, each) => sum + each.height, 0);
    Object.assign(stack, { row, view: stack.x.ends, element: whole });
    if (stack.title) whole.append(made("p", "chart-title", stack.title));
    row.element.append(whole);
    stack.panels.forEach((panel, i) => {
      Object.assign(panel, { stack, view: panel.y.ends, pixels: Math.max(LOWEST, (room * panel.height) / shares) });
      for (const mark of panel.marks) if (mark.kind !== "words" && mark.x !== undefined) mark.x = places(mark.x);
      const frame = made("div", "panel");
      frame.tabIndex = 0;
      frame.setAttribute("role", "application");
      frame.setAttribute("aria-roledescription", "chart");
      frame.setAttribute("aria-label", `${panel.y.label.replace("\n", " ")} against ${stack.x.label}; arrows read values, plus and minus zoom, 0 shows all`);
      whole.append(frame);
      panel.plot = plot(panel, frame, whole.clientWidth, i === stack.panels.length - 1);
      frame.addEventListener("keydown", (event) => keyed(panel, event));
    });
  };
  // draws a chart into a box of the page and returns what takes it away
  const build = (box, chart, alt) => {
    const element = made("div", "chart"), rows = [];
    element.setAttribute("role", "group");
    element.setAttribute("aria-label", alt);
    box.append(element);
    for (let i = 0; i < chart.stacks.length; i += chart.widths.length) {
      const row = { stacks: chart.stacks.slice(i, i + chart.widths.length), off: new Set(), keys: new Map(), tints: [] };
      Object.assign(row, { element: made("div", "row"), place: made("li", "place"), spoken: made("p", "spoken") });
      row.spoken.setAttribute("aria-live", "polite");
      element.append(row.element);
      rows.push(row);
    }
    const shares = chart.widths.map((each) => `minmax(0, ${each}fr)`).join(" ");
    const columns = () => {
      const side = chart.widths.length > 1 && box.clientWidth >= SIDE_BY_SIDE;
      for (const row of rows) row.element.style.gridTemplateColumns = side ? shares : "minmax(0, 1fr)";
    };
    columns();
    for (const row of rows) {
      for (const stack of row.stacks) buildStack(stack, row);
      row.element.after(legend(row), row.spoken);
    }
    let width = box.clientWidth;
    const resized = new ResizeObserver(() => {
      if (!box.clientWidth || box.clientWidth === width) return;
      width = box.clientWidth;
      columns();
      for (const stack of chart.stacks) for (const panel of stack.panels) panel.plot.setSize({ width: stack.element.clientWidth, height: panel.plot.height });
    });
    resized.observe(box);
    for (const row of rows) drawn.add(row);
    return () => {
      resized.disconnect();
      for (const row of rows) drawn.delete(row);
      for (const stack of chart.stacks) for (const panel of stack.panels) panel.plot.destroy();
      element.remove();
    };
  };
  window.pchemChart = build; // for the inspector

  dark.addEventListener("change", () => {
    palette = colours[dark.matches ? "dark" : "light"];
    for (const row of drawn) {
      for (const tint of row.tints) tint();
      for (const panel of row.stacks.flatMap((stack) => stack.panels)) panel.plot.redraw();
    }
  });

  // a chart is drawn when it comes near the window; those in folded parts when these are opened
  const watch = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      watch.unobserve(target);
      target.classList.add("drawn");
      build(target.querySelector(".picture"), charts[target.id.slice("figure-".length)], target.querySelector("img").alt);
    }
  }, { rootMargin: "600px" });
  for (const name of Object.keys(charts)) {
    const figure = document.getElementById(`figure-${name}`);
    if (figure) watch.observe(figure);
  }
})();
