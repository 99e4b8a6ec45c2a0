"""Installs the writer and the reader of recordings."""

from setuptools import find_packages, setup

NAME = "ngo_recordings"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["apsw", "lz4", "mcap", "numpy", "pillow", "pyyaml", "rosbags", "scipy", "zstandard"],
    zip_safe=False,
    maintainer="NGO maintainers",
    maintainer_email="maintainers@ngo.invalid",
    description="Writes recordings (MCAP) and reads them and rosbag2 folders as frames with motion and ground truth.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
)
