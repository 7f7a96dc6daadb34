// What a page does beside being read: files of its figures, explanations of words, folded parts that open for links and
// for print. Without it figures are saved by the browser's own menu, words lead to the glossary, parts open by a click.
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const bytesOf = (base64) => Uint8Array.from(atob(base64), (sign) => sign.charCodeAt(0));
  const save = (content, type, name) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([content], { type }));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };

  document.addEventListener("pchem-save", (event) => save(...event.detail));

  // -- figures as files ------------------------------------------------------------------------
  const SVG = "data:image/svg+xml,";
  // files are for paper: without the rules of a dark screen
  const svgOf = (image) => decodeURIComponent(image.src.slice(SVG.length)).replace(/@media screen[^]*?(?=<\/style>)/, "");
  const savePng = async (shown, name) => {
    const image = new Image();
    image.src = SVG + encodeURIComponent(svgOf(shown));
    await image.decode();
    const scale = 2400 / image.naturalWidth, canvas = document.createElement("canvas");
    canvas.width = 2400;
    canvas.height = Math.round(image.naturalHeight * scale);
    const context = canvas.getContext("2d");
    context.fillStyle = "#ffffff";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(image, 0, 0, canvas.width, canvas.height);
    canvas.toBlob((blob) => save(blob, "image/png", name), "image/png");
  };
  const saveCsv = async (content, name) => {
    const stream = new Blob([bytesOf(content)]).stream().pipeThrough(new DecompressionStream("gzip"));
    save(await new Response(stream).text(), "text/csv", name);
  };
  const tables = JSON.parse(byId("figure-tables")?.textContent ?? "{}");
  for (const figure of document.querySelectorAll("figure[id^=figure-]")) {
    const name = figure.id.slice("figure-".length), image = figure.querySelector("img");
    const row = document.createElement("p");
    row.className = "downloads";
    const button = (text, what, act) => {
      const made = document.createElement("button");
      made.type = "button";
      made.textContent = text;
      made.setAttribute("aria-label", `Save ${what}`);
      made.addEventListener("click", act);
      row.append(made);
    };
    button("SVG", `${name} as SVG`, () => save(svgOf(image), "image/svg+xml", `${name}.svg`));
    button("PNG", `${name} as PNG`, () => savePng(image, `${name}.png`));
    for (const [part, content] of tables[name] ?? []) {
      const file = `${name}${part ? `_${part}` : ""}.csv`;
      button(part ? `CSV: ${part.replaceAll("_", " ")}` : "CSV", `the numbers, ${file}`, () => saveCsv(content, file));
    }
    figure.append(row);
  }

  // -- words explained -------------------------------------------------------------------------
  const tip = document.createElement("div");
  tip.className = "term-tip";
  tip.id = "term-tip";
  tip.setAttribute("role", "tooltip");
  tip.hidden = true;
  document.body.append(tip);
  let shown = null;
  const hide = () => {
    shown?.removeAttribute("aria-describedby");
    shown = null;
    tip.hidden = true;
  };
  const explain = (link) => {
    const entry = byId(link.hash.slice(1));
    if (!entry) return;
    hide();
    shown = link;
    tip.textContent = entry.nextElementSibling.textContent;
    tip.hidden = false;
    link.setAttribute("aria-describedby", tip.id);
    const at = link.getBoundingClientRect(), room = document.documentElement.clientWidth - tip.offsetWidth - 8;
    tip.style.left = `${Math.max(8, Math.min(at.left, room))}px`;
    const above = at.top - tip.offsetHeight - 6;
    tip.style.top = `${above > 4 ? above : at.bottom + 6}px`;
  };
  for (const link of document.querySelectorAll("a.term")) {
    link.addEventListener("pointerenter", (event) => { if (event.pointerType === "mouse") explain(link); });
    link.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") hide(); });
    link.addEventListener("focus", () => explain(link));
    link.addEventListener("blur", hide);
    // a tap explains; a second one, or a click, leads to the list
    let explainedBefore = false;
    link.addEventListener("pointerdown", (event) => { explainedBefore = event.pointerType === "mouse" || shown === link; });
    link.addEventListener("click", (event) => {
      if (event.detail && !explainedBefore) { event.preventDefault(); explain(link); }
    });
  }
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") hide(); });
  document.addEventListener("scroll", hide, { passive: true });

  // -- folded parts ----------------------------------------------------------------------------
  const openTarget = () => {
    let target = null;
    try { target = byId(decodeURIComponent(location.hash.slice(1))); } catch { /* no place in this page */ }
    if (!target) return;
    const inside = target.querySelector(":scope > details.folded");
    if (inside) inside.open = true;
    for (let node = target.closest("details"); node; node = node.parentElement.closest("details")) node.open = true;
    target.scrollIntoView();
  };
  addEventListener("hashchange", openTarget);
  openTarget();
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")].filter((each) => !each.closest("#inspector"));
    for (const each of opened) each.open = true;
  });
  addEventListener("afterprint", () => { for (const each of opened) each.open = false; });
})();
