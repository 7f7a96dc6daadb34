"""The demonstration with a hidden effect: what is hidden, and what is refused before anything is written."""

from pathlib import Path

import pytest

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.commands.demo import hidden_effect, run_demo
from pchem_pipeline.effects.framework.region import Region, When


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("rownoise@columns=2:5", r"'rownoise': no such effect; choose one of: adc_dnl, .*row_noise"),
        ("row_noise@colums=2:5", "columns=A:B"),
        ("row_noise@columns=2:9000", "the sensor has"),
        ("clipping", "has no typical strength"),
    ],
)
def test_what_cannot_be_hidden_is_refused(tmp_path: Path, asked: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        run_demo(tmp_path / "x", hidden=asked, size=8, n_frames=60, seed=1)
    assert not (tmp_path / "x").exists()


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ConfigError, match="is not empty; choose another folder"):
        run_demo(tmp_path, hidden="row_noise", size=8, n_frames=60, seed=1)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_effect_can_be_hidden_in_a_place() -> None:
    effect = hidden_effect("row_noise@columns=2:5,frames=10:20", 12, 60)
    everywhere = hidden_effect("row_noise", 12, 60).model_dump()["row_noise_dn"]
    assert effect.model_dump()["row_noise_dn"] == pytest.approx(everywhere * (4 * 6) ** 0.5)
    assert effect.region == Region(columns=((2, 5),))
    assert effect.when == When(range=((10, 20),))
