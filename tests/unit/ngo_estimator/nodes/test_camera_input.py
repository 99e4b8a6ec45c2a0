"""What the node of a camera refuses before it starts."""

from typing import Any

import pytest

from ngo_common.nodes.process import StartError
from ngo_estimator.nodes.camera_input import CameraInput
from ngo_estimator.nodes.settings import LocalNodeSettings, MapNodeSettings
from ngo_estimator.nodes.weights import weights_folder


def test_a_camera_needs_odometry_and_has_no_map() -> None:
    node: Any = None
    with pytest.raises(StartError, match="'robot_odometry' is 'none'; expected 'topic' or 'tf'"):
        CameraInput(node, LocalNodeSettings(world="camera"), lambda step: None)
    with pytest.raises(StartError, match="camera has no weights, and no map"):
        weights_folder(MapNodeSettings(world="camera"))
