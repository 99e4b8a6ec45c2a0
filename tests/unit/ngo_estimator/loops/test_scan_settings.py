"""Settings outside of their ranges are refused, by name."""

import math
import re

import pytest

from ngo_estimator.loops.scan_settings import ScanGraphConfig, ScanLoopConfig, WindowConfig


@pytest.mark.parametrize(
    ("settings", "name", "value"),
    [
        (ScanLoopConfig, "every", 0),
        (ScanLoopConfig, "least_agreeing", -1),
        (ScanLoopConfig, "least_response", 1.5),
        (ScanLoopConfig, "range_m", math.inf),
        (ScanLoopConfig, "search_factor", 0.5),
        (ScanLoopConfig, "most_disagreement", math.nan),
        (ScanLoopConfig, "source_keys", 16),
        (WindowConfig, "least_m", 9.0),
        (WindowConfig, "least_deg", 0.0),
        (WindowConfig, "most_m", math.inf),
        (WindowConfig, "most_deg", 200.0),
        (WindowConfig, "share", -0.1),
        (WindowConfig, "deviations", 0.0),
        (ScanGraphConfig, "keys_between", 0),
        (ScanGraphConfig, "most_scans", 99),
        (ScanGraphConfig, "agreeing_beyond", -1),
        (ScanGraphConfig, "kernel", math.nan),
    ],
)
def test_a_value_out_of_range_is_refused_by_name(settings: type, name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"^{name} is {re.escape(str(value))}; expected "):
        settings(**{name: value})


def test_no_limit_of_disagreement_and_windows_of_one_width_are_allowed() -> None:
    assert ScanLoopConfig(most_disagreement=math.inf).most_disagreement == math.inf
    assert WindowConfig(least_m=2.0, most_m=2.0).least_m == 2.0
