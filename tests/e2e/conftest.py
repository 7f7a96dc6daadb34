"""The command with real files in another folder."""

import os
import shutil

import pytest
from helpers.commands import RUN, Shell
from helpers.without_pictures import undrawn

CAMERA = """
run: {store: truth.zarr, tile: 8}
simulate:
  shape: [20, 28]
  n_frames: 1200
  seed: 11
  output: frames
  frames_per_file: 300
  integration_time: 4.87
"""


@pytest.fixture
def shell(tmp_path):
    """Commands in an empty folder whose name has a space and a letter beyond ASCII."""
    folder = tmp_path / "mein Labor µ"
    folder.mkdir()
    return Shell(folder)


@pytest.fixture(scope="session")
def camera(make_once):
    """A folder with ``frames/*.tif``, four files of 300 frames of 20 x 28 pixels, and ``truth.zarr``."""

    def simulate(folder):
        (folder / "camera.yaml").write_text(CAMERA)
        Shell(folder).ok("simulate", "camera.yaml")

    return make_once("camera", simulate)


@pytest.fixture
def frames(shell, camera):
    """The camera's TIFF files in the folder of the shell, as ``frames/``."""
    shutil.copytree(camera / "frames", shell.folder / "frames")
    return shell.folder / "frames"


@pytest.fixture(scope="session")
def finished(make_once, camera):
    """An uninterrupted run of the camera's frames, tiles of 8 pixels, without pictures; do not change it."""

    def run(folder):
        shutil.copytree(camera / "frames", folder / "frames")
        (folder / "run.yaml").write_text(RUN)
        with undrawn():
            Shell(folder).ok("run", "run.yaml")

    return make_once("finished", run) / "run.zarr"


@pytest.fixture(scope="module")
def browser():
    """Debian's Chromium, headless, driven by Playwright; tests of it are skipped where either is missing.

    Not longer than a module: while Playwright is open an event loop runs in this thread.
    """
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="no Playwright; install it with: pip install playwright"
    )
    named = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
    path = os.environ.get("PCHEM_CHROMIUM") or next(filter(None, named), None)
    if path is None:
        pytest.skip("no Chromium; install it with: apt-get install chromium, or set PCHEM_CHROMIUM")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def open_page(browser):
    """Open pages that must say nothing and ask nobody but their own place; checked at the end of a test."""
    said, asked, contexts = [], [], []

    def open_(url, width=1200, **options):
        contexts.append(browser.new_context(viewport={"width": width, "height": 900}, **options))
        page, place = contexts[-1].new_page(), url.partition("#")[0].rpartition("/")[0]
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append((place, request.url)))
        page.goto(url)
        return page

    open_.asked = asked
    yield open_
    assert said == []
    assert [url for place, url in asked if not url.startswith((place, "data:"))] == []
    for context in contexts:
        context.close()
