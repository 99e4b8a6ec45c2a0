"""The settings of a lidar's estimators: what is wrong with a file is one clear line."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from ngo_estimator.data.lidar_file import LIDAR_FILE, LidarFileError, is_lidar, read_lidar_file, require_opencv
from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig, read_mixture_config
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.slam.scan_trajectory import ScanTrajectory

WHOLE = {"format": 1, "estimator": "lidar", "world": "scan", "odometry": {}, "graph": {}}
SHIPPED = Path(__file__).parents[4] / "ros_ws" / "src" / "ngo_estimator" / "weights" / "scan"


def folder(tmp_path: Path, values: Any) -> Path:
    text = values if isinstance(values, bytes) else json.dumps(values).encode()
    (tmp_path / LIDAR_FILE).write_bytes(text)
    return tmp_path


def test_what_is_not_there_has_its_default(tmp_path: Path) -> None:
    given = folder(tmp_path, {**WHOLE, "graph": {"keys_between": 3, "kernel": 2, "loops": {"every": 4}}})
    assert is_lidar(given)
    config = read_lidar_file(given, "graph", ScanGraphConfig)
    assert (config.keys_between, config.kernel, config.loops.every) == (3, 2.0, 4)
    assert isinstance(config.kernel, float)
    assert config.most_scans == ScanGraphConfig().most_scans and config.loops.search == ScanGraphConfig().loops.search
    assert read_mixture_config(given, "scan") == MixtureConfig()


def test_the_shipped_file_is_read() -> None:
    assert is_lidar(SHIPPED)
    read_mixture_config(SHIPPED, "scan")
    ScanTrajectory.load(SHIPPED, "scan")


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({**WHOLE, "graph": {"kernels": 3.0}}, "unknown keys"),
        ({**WHOLE, "graph": {"loops": {"search": {"depht": 3}}}}, "depht"),
        ({**WHOLE, "graph": {"kernel": -1.0}}, "positive"),
        ({**WHOLE, "graph": {"kernel": "3"}}, "float"),
        ({**WHOLE, "graph": {"kernel": True}}, "float"),
        ({**WHOLE, "graph": {"kernel": 10**400}}, "finite"),
        ({**WHOLE, "graph": {"keys_between": 2.5}}, "int"),
        ({**WHOLE, "graph": {"keys_between": None}}, "int"),
        ({**WHOLE, "graph": []}, "object"),
        ({**WHOLE, "graph": {"loops": 3}}, "object"),
        ({**WHOLE, "more": 1}, "keys"),
        ({k: v for k, v in WHOLE.items() if k != "odometry"}, "keys"),
        ({**WHOLE, "format": 2}, "format 1"),
        ([], "format 1"),
        (b'{"format": 1,', "is not JSON"),
        (b'{"format": NaN}', "format 1"),
        (b"\xff\xfe\x00", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"", "is not JSON"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, values: Any, told: str) -> None:
    given = folder(tmp_path, values)
    with pytest.raises(LidarFileError, match=told) as error:
        ScanTrajectory.load(given, "scan")
    assert "\n" not in str(error.value) and str(given / LIDAR_FILE) in str(error.value)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"key_m": 0.0}, "key_m is 0.0"),
        ({"keys_m": 0.3}, "unknown keys"),
        ({"first_weights": [0.5, 0.2, 0.2, 0.07, 0.03]}, "6 hypotheses"),
    ],
)
def test_a_bad_setting_of_the_front_end_is_one_line(tmp_path: Path, values: dict[str, Any], told: str) -> None:
    given = folder(tmp_path, {**WHOLE, "odometry": values})
    with pytest.raises(LidarFileError, match=told) as error:
        read_mixture_config(given)
    assert "\n" not in str(error.value) and str(given / LIDAR_FILE) in str(error.value)


def test_another_world_is_told(tmp_path: Path) -> None:
    with pytest.raises(LidarFileError, match="for the world 'scan'; expected 'maze2d'"):
        read_mixture_config(folder(tmp_path, WHOLE), "maze2d")


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    assert not is_lidar(tmp_path)
    with pytest.raises(LidarFileError, match="cannot be read"):
        read_mixture_config(tmp_path)


def test_opencv_that_does_not_load_is_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cv2.py").write_text('raise ImportError("libGL.so.1: cannot open shared object file")')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    with pytest.raises(ValueError, match=r"needs OpenCV, which cannot be imported \(libGL.so.1: cannot open"):
        require_opencv()
