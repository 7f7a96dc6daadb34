"""Shares in words."""

import pytest

from pchem_pipeline.base.units import per_cent


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.0123, "1.2 %"), (0.68, "68 %"), (0.9949, "99 %"), (0.997, "100 %"), (3.4, "340 %")],
)
def test_a_share_is_never_told_as_a_power_of_ten(share: float, words: str) -> None:
    assert per_cent(share) == words
