from pathlib import Path

from demo.session import SessionConfig


def test_the_map_may_be_written_where_the_results_go(tmp_path: Path) -> None:
    nodes = {spec.executable: spec.parameters for spec in SessionConfig("maze2d", 2000, 30).estimators(tmp_path)}
    assert nodes["ngo_map"]["save_directory"] == str(tmp_path), "the working directory may be another one"
