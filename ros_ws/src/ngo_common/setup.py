"""Installs the settings and the ROS side that nodes share."""

from setuptools import find_packages, setup

NAME = "ngo_common"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "nodes/*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["numpy", "pillow", "pyyaml"],
    zip_safe=False,
    maintainer="NGO maintainers",
    maintainer_email="maintainers@ngo.invalid",
    description="Settings, parameters, quality of service and processes of the nodes.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
)
