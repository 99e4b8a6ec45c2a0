"""The benchmark of the corrector's time."""

import pytest

from benchmarks import wrong_loops


def test_a_graph_says_how_much_of_its_goal_it_took(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wrong_loops, "_CASES", [("random", 30, 200, True)])
    monkeypatch.setattr(wrong_loops, "_GOAL_S", {200: 1e-3})
    (found,) = wrong_loops.measure(0)
    assert found["graph"] == "random_30" and found["solved"]
    assert float(found["of_goal"]) == pytest.approx(1000.0 * float(found["seconds"]), abs=5.1)
