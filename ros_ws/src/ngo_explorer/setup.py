"""Installs the explorer and its node."""

from glob import glob

from setuptools import find_packages, setup

NAME = "ngo_explorer"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", sorted(glob("config/*.*"))),
    ],
    install_requires=["ngo_common", "ngo_recordings", "numba", "numpy"],
    zip_safe=False,
    maintainer="NGO maintainers",
    maintainer_email="maintainers@ngo.invalid",
    description="Explores a place: chooses frontiers of the map, drives to them, or has Nav2 drive.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={"console_scripts": ["explore = ngo_explorer.nodes.explore_node:main"]},
)
