"""Installs the simulators and their nodes."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "ngo_sim"


def files_below(folder: str) -> list[tuple[str, list[str]]]:
    """Pairs of install folder and files for every file below `folder`, if there are any."""
    by_parent: dict[Path, list[str]] = {}
    for path in sorted(Path(folder).rglob("*")):
        hidden = any(part.startswith((".", "__pycache__")) for part in path.parts)
        if path.is_file() and not hidden:
            by_parent.setdefault(path.parent, []).append(str(path))
    return [(str(Path("share") / NAME / parent), paths) for parent, paths in by_parent.items()]


setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "weights/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *files_below("launch"),
        *files_below("config"),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="NGO maintainers",
    maintainer_email="maintainers@ngo.invalid",
    description="Simulators of mazes and buildings with exact ground truth, and the nodes that publish them.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "building2d = ngo_sim.nodes.building2d_node:main",
            "maze2d = ngo_sim.nodes.maze2d_node:main",
            "maze3d = ngo_sim.nodes.maze3d_node:main",
        ],
    },
)
