"""Size and speed of the report's inspector in Chromium: first paint, until usable, and frames while panning.

Usage: python scripts/bench/bench_inspector.py [SIZE ...]    (default: 512 2048)

Needs Playwright and Chromium (PCHEM_CHROMIUM names another one). The maps are those of a simulated sensor,
drawn from distributions; the figures are left out, so that the times are the inspector's.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()

from pchem_pipeline.report.data import ReportData  # noqa: E402
from pchem_pipeline.report.inspector import InspectorData, MapEntry, PixelSample, choose_scale, pack_map  # noqa: E402
from pchem_pipeline.report.pages.page import Drawn  # noqa: E402
from pchem_pipeline.report.pages.report import render_report  # noqa: E402

#: Median, spread between pixels and standard error of one pixel: as of the paper's sensor.
MAPS = {
    "quanta_exposure": ("e-", 2.0, 0.7, 0.012),
    "conversion_gain": ("e-/DN", 0.091, 0.0075, 0.00026),
    "bias": ("DN", 100.0, 4.2, 0.07),
    "read_noise_e": ("e-", 0.305, 0.043, 0.0026),
}
DOT = "data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA="
PAN = """
async () => {
  const canvas = document.getElementById("inspector-canvas"), box = canvas.getBoundingClientRect();
  const send = (type, x, y) => canvas.dispatchEvent(new PointerEvent(type, {
    pointerId: 1, clientX: box.left + x, clientY: box.top + y, bubbles: true }));
  canvas.setPointerCapture = () => {};
  const frame = () => new Promise((done) => requestAnimationFrame(done));
  send("pointerdown", box.width / 2, box.height / 2);
  const times = [];
  let last = await frame();
  for (let i = 0; i < 90; i++) {
    const a = i / 7;
    send("pointermove", box.width / 2 + 90 * Math.sin(a), box.height / 2 + 60 * Math.cos(a));
    const now = await frame();
    times.push(now - last);
    last = now;
  }
  send("pointerup", 0, 0);
  return times.slice(5);
}
"""


def make_page(size: int) -> str:
    """Return the page of a sensor of ``size`` by ``size`` pixels."""
    rng = np.random.default_rng(1)
    coarse = 4.0 if size * size > 1_000_000 else 1.0
    index = np.sort(rng.choice(size * size, 2400, replace=False))
    entries, exact, maps = [], {}, {}
    for name, (unit, median, spread, error) in MAPS.items():
        values = median + spread * rng.standard_normal((size, size))
        errors = error * np.exp(0.15 * rng.standard_normal((size, size)))
        for suffix, array, step in (("", values, error / 8), ("_stderr", errors, 0.02 * error)):
            path = f"maps/{name}{suffix}"
            packed = pack_map(array, choose_scale(array, step=step, coarse=coarse))
            kind = "stderr" if suffix else "value"
            entries.append(
                MapEntry(path, f"{name}{suffix}".replace("_", " "), unit, name, kind, packed=packed)
            )
            exact[path] = array.ravel()[index]
        maps[name] = values[:8, :8]
    counts = [rng.poisson(100, 120) for _ in index]
    sample = PixelSample(index, exact, np.full(index.size, 90), counts)
    data = ReportData(
        "bench",
        (size, size),
        maps=maps,
        inspector=lambda: InspectorData(tuple(entries), sample, "a quarter", "pchem view"),
    )
    dot = Drawn(DOT, 9, 9)
    return render_report(data, lambda figures: {each.name: dot for each in figures})["report.html"]


def measure(page: Page, path: Path) -> dict[str, float]:
    """Open the page and return times in ms."""
    start = time.perf_counter()
    page.goto(path.as_uri(), wait_until="commit")
    page.wait_for_selector("#inspector-app[data-ready]", timeout=120_000)
    ready = 1e3 * (time.perf_counter() - start)
    paints: list[dict[str, Any]] = page.evaluate(
        "performance.getEntriesByType('paint').map((e) => e.toJSON())"
    )
    first = max(entry["startTime"] for entry in paints)
    page.locator("#inspector-canvas").scroll_into_view_if_needed()
    found = {"first paint": first, "usable": ready}
    for words, clicks in (("whole map", 0), ("zoomed", 4)):
        for _ in range(clicks):
            page.click("#inspector-in")
        times = np.array(page.evaluate(PAN))
        found |= {f"pan, {words}, median": np.median(times), f"pan, {words}, 95 %": np.quantile(times, 0.95)}
    start = time.perf_counter()
    page.select_option("#inspector-map", "maps/bias")
    page.wait_for_selector('#inspector-app[data-map="maps/bias"]')
    found["another map"] = 1e3 * (time.perf_counter() - start)
    start = time.perf_counter()
    page.fill("#inspector-from", "99")
    page.keyboard.press("Enter")
    page.wait_for_function("document.getElementById('inspector-selection').textContent.includes('selected')")
    found["a selection"] = 1e3 * (time.perf_counter() - start)
    return found


def main(sizes: list[int]) -> None:
    chromium = os.environ.get("PCHEM_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        print(f"Chromium {browser.version}, no graphics card, {os.cpu_count()} cores")
        for size in sizes:
            path = Path(folder) / f"{size}.html"
            path.write_text(make_page(size), encoding="utf-8")
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            print(f"\n{size} x {size} pixels, {path.stat().st_size / 1e6:.1f} MB")
            for words, milliseconds in measure(page, path).items():
                print(f"  {words:<24}{milliseconds:8.0f} ms")
            page.close()
        browser.close()


if __name__ == "__main__":
    main([int(size) for size in sys.argv[1:]] or [512, 2048])
