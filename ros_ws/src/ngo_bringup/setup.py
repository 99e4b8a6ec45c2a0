"""Installs the launch files, the parameters and the views of the whole graph."""

from glob import glob

from setuptools import setup

NAME = "ngo_bringup"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *(
            (f"share/{NAME}/{folder}", sorted(glob(f"{folder}/*.*")))
            for folder in ("config", "foxglove", "launch", "rviz")
        ),
    ],
    zip_safe=False,
    maintainer="NGO maintainers",
    maintainer_email="maintainers@ngo.invalid",
    description="Launch files and parameters of the whole graph.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
)
