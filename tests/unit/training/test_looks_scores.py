"""The numbers of the ablation of looks: what is better in which direction, and what the page says about it."""

import numpy as np
import pytest

from training.ablate_looks import Arguments
from training.looks_scores import METRICS, Scores, table_json


def scores(plain: float, varied: float, precision: tuple[float, float]) -> dict[str, Scores]:
    noise = np.linspace(0.9, 1.1, 20)
    found = {name: {key: (value * noise).tolist() for key in METRICS} for name, value in
             (("plain", plain), ("varied", varied))}  # fmt: skip
    for name, value in zip(found, precision, strict=True):
        found[name]["precision_at_1"] = (value * noise).tolist()
    return found


def test_networks_are_compared_on_the_same_mazes() -> None:
    table = table_json(scores(2.0, 1.0, (0.5, 0.75)))
    assert list(table) == list(METRICS)
    for key, entry in table.items():
        low, high = entry["plain"]["ci95"]
        assert low < entry["plain"]["mean"] < high
        if METRICS[key].is_error:
            assert entry["varied_vs_plain"]["difference"]["mean"] == pytest.approx(-1.0)
            assert entry["varied_vs_plain"]["relative_percent"]["mean"] == pytest.approx(-50.0)
            # Noise that both share does not widen the interval of their ratio.
            np.testing.assert_allclose(entry["varied_vs_plain"]["relative_percent"]["ci95"], -50.0)
    assert table["precision_at_1"]["varied_vs_plain"]["difference"]["mean"] == pytest.approx(0.25)


def test_no_right_partner_at_all_can_be_compared() -> None:
    assert table_json(scores(2.0, 1.0, (0.0, 0.0)))["precision_at_1"]["varied_vs_plain"]["difference"]["mean"] == 0.0


@pytest.mark.parametrize(
    ("field", "value", "allowed"), [("mazes", 1, "2 to 200"), ("place_groups", 26, "2 to 25"), ("frames", 2, "3 to")]
)
def test_a_bad_setting_is_named_with_what_is_allowed(field: str, value: int, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"{field} is {value}; expected {allowed}"):
        Arguments(**{field: value})  # type: ignore[arg-type]
