"""What the packages import is what they declare, and their cores install and run without ROS."""

import ast
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
import setuptools

from scripts.link_same_files import LEAST_BYTES, link_same_files
from tests.unit.test_layers import imported_names

ROOT = Path(__file__).parents[2]
WORKSPACE = ROOT / "ros_ws"
SOURCES = {path.parent.name: path.parent for path in sorted(WORKSPACE.glob("*/*/package.xml"))}
PYTHON = [name for name, folder in SOURCES.items() if (folder / "setup.py").exists()]
# Programs of the repository, which are not installed: requirements/ has what they import.
PROGRAMS = ("training", "benchmarks", "demo", "tests", "tools", "scripts")
# Modules whose distribution has another name.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "yaml": "pyyaml",
    "mcap_ros2": "mcap-ros2-support",
    "rerun": "rerun-sdk",
    "cv2": "opencv-python-headless",
}
# Keys of rosdep for libraries that Debian and Ubuntu have: with these alone the nodes of a robot with a lidar run.
DEBIAN = {name: f"python3-{name.lower()}" for name in ("PIL", "matplotlib", "numba", "numpy", "scipy", "yaml")}
# What is installed by hand: the other renderer of a camera's table.
BY_HAND = {"pybullet", "pybullet-data"}
OWN = {*PYTHON, *PROGRAMS, "ros2_stand_in"}
ROS = ("rclpy", "ament_index_python", "launch", "launch_ros")
VERSION = "0.1.0"


def is_of_ros(module: str) -> bool:
    """Whether a module comes with ROS: in package.xml, not in requirements/."""
    return module in ROS or module.endswith(("_msgs", "_srvs", "_interfaces"))


def imports_below(folder: Path) -> set[str]:
    """The names of all modules from elsewhere that files below a folder import, without those of Python itself."""
    names: set[str] = set()
    for path in folder.rglob("*.py"):
        if path.name != "setup.py":
            names |= {name.partition(".")[0] for name in imported_names(path.read_text(), "a.b") if name}
    return names - set(sys.stdlib_module_names) - {"a", "__future__", folder.name}


def ros_packages_in_launch_files(folder: Path) -> set[str]:
    """Packages that launch files name: those whose nodes they start, and whose folders they look into."""
    named: set[str] = set()
    for path in [*folder.glob("launch/*.py"), *folder.glob("ngo_bringup/*.py")]:
        named |= {
            node.value
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in SOURCES
        }
    return named


def declared_for_ros(folder: Path) -> set[str]:
    root = ElementTree.parse(folder / "package.xml").getroot()
    return {element.text or "" for tag in ("depend", "exec_depend") for element in root.iter(tag)}


def setup_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The arguments that a setup.py gives to setuptools."""
    given: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", given.update)
    monkeypatch.chdir(folder)
    exec(compile((folder / "setup.py").read_text(), "setup.py", "exec"), {"__name__": "setup"})
    return given


def distribution(module: str) -> str:
    return DISTRIBUTIONS.get(module, module.replace("_", "-"))


def required(*files: str) -> set[str]:
    lines = [line for name in files for line in (ROOT / "requirements" / name).read_text().splitlines()]
    return {re.split(r"[=\[<>; ]", line, maxsplit=1)[0] for line in lines if line and line[0] not in "#-"}


@pytest.mark.parametrize("name", PYTHON)
def test_a_package_declares_what_it_imports_and_no_more(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = SOURCES[name]
    imported = imports_below(folder)
    of_ros = {module for module in imported if is_of_ros(module) or module in SOURCES}
    forwarded = {"ngo_bringup"} if name != "ngo_bringup" else set()  # which depends on those that forward to it
    of_debian = {DEBIAN[module] for module in imported & set(DEBIAN)}
    assert declared_for_ros(folder) == of_ros | of_debian | ros_packages_in_launch_files(folder) - forwarded - {name}
    of_pip = {module if module in SOURCES else distribution(module) for module in imported if not is_of_ros(module)}
    declared = setup_of(folder, monkeypatch)
    extras = declared["extras_require"]
    view = set(extras.get("view", []))
    networks = {*extras.get("networks", []), *extras.get("camera", [])}  # which a robot with a lidar does not need
    assert set(declared.get("install_requires", [])) == of_pip - view - networks
    assert view <= of_pip & required("view.txt") - required("lidar.txt", "runtime.txt", "test.txt")
    assert networks <= of_pip & required("runtime.txt")
    needed, files = of_pip - view - networks - set(SOURCES), ["lidar.txt"]
    if name == "ngo_sim":  # which a robot does not need
        files.append("runtime.txt")
    assert needed <= required(*files), f"{files} have all that is imported"


def imported_at_once(module: str, seen: set[str]) -> set[str]:
    """Modules from elsewhere that importing one of the packages' modules imports, without those of Python itself."""
    folder, _, rest = module.partition(".")
    path = SOURCES[folder] / folder / rest.replace(".", "/")
    path = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
    if module in seen or not path.exists():
        return set()
    seen.add(module)
    tree = ast.parse(path.read_text())
    tree.body = [each for each in tree.body if isinstance(each, ast.Import | ast.ImportFrom)]
    names = imported_names(ast.unparse(tree), module)
    own = {name for name in names if name.partition(".")[0] in PYTHON}
    found = {name.partition(".")[0] for name in names - own} - set(sys.stdlib_module_names) - {"__future__"}
    return found.union(*(imported_at_once(name, seen) for name in own))


def test_nodes_of_a_lidar_start_with_what_debian_has() -> None:
    """A library that only files need, or only pictures, is imported where it is used."""
    nodes = ("local_node", "lidar_input", "ngo_node", "ngo_map", "map_layer")
    starts = [*(f"ngo_estimator.nodes.{node}" for node in nodes), "ngo_explorer.nodes.explore_node"]
    starts += [
        "ngo_estimator.slam.scan_trajectory",
        "ngo_estimator.slam.session",
        "ngo_estimator.offline.warm_up_scans",
    ]
    found = set().union(*(imported_at_once(module, set()) for module in starts))
    assert {module for module in found if not is_of_ros(module)} == set(DEBIAN) - {"matplotlib"}


def test_programs_import_what_the_requirements_have() -> None:
    imported = set().union(*(imports_below(ROOT / folder) for folder in PROGRAMS))
    # What a test finds beside itself, and examples of bad imports.
    local = {path.stem for path in (ROOT / "tests").rglob("*.py")} | OWN
    modules = {module for module in imported - local if not is_of_ros(module)}
    names = {distribution(module) for module in modules}
    assert names - BY_HAND <= required("lidar.txt", "runtime.txt", "test.txt", "build.txt")


def pins(*files: str) -> set[tuple[str, str, str]]:
    """Name, version and marker of each pinned requirement; of the marker only what it says about Python 3.11."""
    found = set()
    for name in files:
        text = (ROOT / "requirements" / f"{name}.txt").read_text().replace('"', "'")
        for package, version, marker in re.findall(r"^([\w.-]+)(?:\[[\w,]+\])?==([^\s;]+) *;?(.*)", text, re.MULTILINE):
            side = re.search(r"(<|>=) '3\.11'", marker)
            found.add((package, version, side.group(1) if side else ""))
    return found


def test_every_pin_is_locked_with_hashes_and_nothing_else_is() -> None:
    """`make venv` installs the locked files alone, each of whose packages needs the hashes of its files."""
    locked = pins("locked", "locked_lidar", "locked_ros", "locked_gpu")
    given = pins("constraints", "lidar", "runtime", "test", "build", "ros")
    assert given - locked == set() and pins("ros_kilted") <= pins("locked_ros_kilted"), "run scripts/lock.sh"
    windows = {"coloredlogs", "humanfriendly", "pyreadline3", "pywin32"}
    libraries = {package for package, *_ in pins("locked_gpu")}  # of PyTorch's build for GPUs
    assert {package for package, *_ in locked - given} <= windows | libraries, (
        "run scripts/lock.sh, and add them to constraints.txt"
    )
    for name in ("locked", "locked_lidar", "locked_ros", "locked_ros_kilted", "locked_gpu", "locked_cpu"):
        entries = re.split(r"(?m)^(?=\w)", (ROOT / "requirements" / f"{name}.txt").read_text())[1:]
        assert entries and all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries), name


def test_same_files_are_linked_and_no_others(tmp_path: Path) -> None:
    contents = {"a/one": b"x" * LEAST_BYTES, "b/two": b"x" * LEAST_BYTES, "b/other": b"y" * LEAST_BYTES, "small": b"x"}
    for name, content in contents.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    (tmp_path / "link").symlink_to("a/one")
    assert link_same_files(tmp_path) == LEAST_BYTES and link_same_files(tmp_path) == 0
    assert {name: (tmp_path / name).read_bytes() for name in contents} == contents
    assert (tmp_path / "a/one").samefile(tmp_path / "b/two") and (tmp_path / "link").is_symlink()


def test_the_container_is_made_as_the_documents_say() -> None:
    container, contributing = ((ROOT / name).read_text() for name in ("Dockerfile", "CONTRIBUTING.md"))
    needed = {"python3", "python3-venv", "python3-dev", "g++", "cmake", "git", "make"}
    for text in (container, contributing, (ROOT / ".ci/run").read_text()):
        assert needed <= set(re.findall(r"[\w+-]+", text))
    assert "RUN make build FOR=$FOR" in container and 'CMD ["make", "demo"]' in container


def test_licences_of_all_requirements_are_listed_and_the_gpl_stays_in_the_tests() -> None:
    page = (ROOT / "docs" / "reference" / "licences.md").read_text()
    listed = set(re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE))
    assert required("lidar.txt", "runtime.txt", "test.txt", "build.txt") <= listed
    outside = [*SOURCES.values(), *(ROOT / folder for folder in PROGRAMS if folder != "tests")]
    assert not [folder for folder in outside if "evo" in imports_below(folder)]
    assert "evo" in imports_below(ROOT / "tests"), "otherwise this test says nothing"


@pytest.mark.parametrize("name", SOURCES)
def test_all_packages_have_one_version(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    root = ElementTree.parse(SOURCES[name] / "package.xml").getroot()
    facts = {key: root.findtext(key) for key in ("name", "version", "license")}
    assert facts == {"name": name, "version": VERSION, "license": "Apache-2.0"}
    if name in PYTHON:
        given = setup_of(SOURCES[name], monkeypatch)
        assert {key: given[key] for key in facts} == facts
        assert given["description"] == root.findtext("description")
    assert f"## [{VERSION}]" in (ROOT / "CHANGELOG.md").read_text()


CORE = '''
import importlib, pkgutil, sys
from pathlib import Path

class NoRos:
    """An interpreter without ROS."""
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in ("rclpy", "ament_index_python") or top.endswith(("_msgs", "_srvs", "_interfaces")):
            raise ModuleNotFoundError(f"{name} is of ROS")

sys.meta_path.insert(0, NoRos())
here = Path(sys.argv[1])
for package in ("ngo_common", "ngo_recordings", "ngo_estimator"):
    module = importlib.import_module(package)
    assert Path(module.__file__).is_relative_to(here), module.__file__
    for found in pkgutil.walk_packages(module.__path__, package + "."):
        if ".nodes" not in found.name and found.name != "ngo_estimator.view.rerun_view":  # rerun is an extra
            importlib.import_module(found.name)

import torch
torch.set_num_threads(1)
from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.offline.recording_run import RecordingRun
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_recordings.frames import Frame
import numpy as np

weights = here / "weights"
weights.mkdir()
write_untrained(weights, "maze2d")
rng = np.random.default_rng(0)
frames = [
    Frame(10**9 + k * 10**8, rng.random((1, 241, 4), dtype=np.float32), action=(k - 1) % 3 if k else None)
    for k in range(5)
]
run = RecordingRun(LocalOdometry.load(weights, "maze2d"), OnlineTrajectory.load(weights, 64, "maze2d"))
events = list(run.run(frames))
print(type(events[-1]).__name__, len(events[-1].trajectory.stamps_ns))
assert (here / "share/ngo_estimator/weights/maze2d/neural_graph_optimizer.safetensors").exists()
'''


def test_the_core_installs_with_pip_and_runs_without_ros(tmp_path: Path) -> None:
    """From copies, because pip builds within the sources; without an index, so that nothing is downloaded."""
    packages = [tmp_path / name for name in ("ngo_common", "ngo_recordings", "ngo_estimator")]
    for copy in packages:
        shutil.copytree(SOURCES[copy.name], copy, ignore=shutil.ignore_patterns("__pycache__", "maze3d", "scan"))
    target = tmp_path / "installed"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", "-q"]
    options = ["--no-deps", "--no-index", "--no-build-isolation", "--no-compile", "--target", str(target)]
    subprocess.run([*pip, "install", *options, *map(str, packages)], check=True, cwd=tmp_path, timeout=120)
    program = tmp_path / "core.py"
    program.write_text(CORE)
    result = subprocess.run(
        [sys.executable, str(program), str(target)],
        env={**os.environ, "PYTHONPATH": str(target), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["RecordedRun", "5"]
