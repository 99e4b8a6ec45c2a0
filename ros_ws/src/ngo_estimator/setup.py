"""Installs the estimators, their nodes and their trained weights."""

from glob import glob

from setuptools import find_packages, setup

NAME = "ngo_estimator"
FOLDERS = ("config", "launch", *sorted(glob("weights/*")))

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((f"share/{NAME}/{folder}", sorted(glob(f"{folder}/*.*"))) for folder in FOLDERS),
    ],
    install_requires=[
        "matplotlib",
        "ngo_common",
        "ngo_recordings",
        "numba",
        "numpy",
        "pillow",
        "pyyaml",
        "rich",
        "rosbags",
        "safetensors",
        "scipy",
        "tyro",
    ],
    zip_safe=False,
    maintainer="NGO maintainers",
    maintainer_email="maintainers@ngo.invalid",
    description="Local odometry and the Neural Graph Optimizer, and the nodes that run them.",
    license="Apache-2.0",
    # A lidar needs no networks and no pictures.
    extras_require={
        "networks": ["torch"],
        "camera": ["opencv-python-headless"],
        "test": ["pytest"],
        "view": ["rerun-sdk"],
    },
    entry_points={
        "console_scripts": [
            "join_sessions = ngo_estimator.nodes.join_sessions:main",
            "local_node = ngo_estimator.nodes.local_node:main",
            "ngo_map = ngo_estimator.nodes.ngo_map:main",
            "ngo_node = ngo_estimator.nodes.ngo_node:main",
            "optimize_graph = ngo_estimator.nodes.optimize_graph:main",
            "run_recording = ngo_estimator.nodes.run_recording:main",
            "view_node = ngo_estimator.nodes.view_node:main",
        ],
    },
)
