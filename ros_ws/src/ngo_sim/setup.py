"""Installs the simulators and their nodes."""

from glob import glob

from setuptools import find_packages, setup

NAME = "ngo_sim"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "weights/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((f"share/{NAME}/{folder}", sorted(glob(f"{folder}/*.*"))) for folder in ("config", "launch")),
    ],
    install_requires=[
        "gymnasium",
        "matplotlib",
        "networkx",
        "ngo_common",
        "ngo_recordings",
        "numba",
        "numpy",
        "pymunk",
        "safetensors",
        "scipy",
        "vizdoom",
    ],
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
