"""Packages of others, left as pip leaves them."""

import shutil
import tomllib
from pathlib import Path


def install(project: Path, site: Path) -> None:
    """Copy the modules of a project into a folder, with what its pyproject.toml announces."""
    about = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    info = site / f"{about['name'].replace('-', '_')}-{about['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {about['name']}\nVersion: {about['version']}\n"
    )
    points = about["entry-points"].items()
    (info / "entry_points.txt").write_text(
        "".join(f"[{group}]\n" + "".join(f"{a} = {b}\n" for a, b in rows.items()) for group, rows in points)
    )
    for path in project.rglob("*.py"):
        place = site / path.relative_to(project)
        place.parent.mkdir(exist_ok=True)
        shutil.copy(path, place)
