"""A warm-up that takes long is told, and a short one is not."""

import threading

import pytest

from ngo_estimator.offline import compiling


def test_what_takes_long_is_said_while_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "_SILENT_S", 0.01)
    said = threading.Event()
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        said.set()

    with compiling.compiling(say):
        assert said.wait(30.0)
    assert len(lines) == 1 and lines[0].startswith("compiles, once after an installation")


def test_what_is_short_or_fails_is_not_said(monkeypatch: pytest.MonkeyPatch) -> None:
    timers: list[threading.Timer] = []

    class Kept(threading.Timer):
        def start(self) -> None:
            timers.append(self)
            super().start()

    monkeypatch.setattr(threading, "Timer", Kept)
    lines: list[str] = []
    with compiling.compiling(lines.append):
        pass
    with pytest.raises(ValueError, match="weights"), compiling.compiling(lines.append):
        raise ValueError("weights")
    for timer in timers:
        timer.join(30.0)
    assert len(timers) == 2 and lines == []
