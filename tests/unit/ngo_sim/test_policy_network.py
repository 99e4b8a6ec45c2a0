import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from ngo_sim.drivers import Action
from ngo_sim.learned_driver import LearnedDriver
from ngo_sim.policy_network import PolicyConfig, PolicyNetwork, PolicyView, grey_picture, load_policy

SMALL = PolicyConfig(height=6, width=8, pictures=2, channels=(3,), kernels=(3,), strides=(2,), hidden=5)


def weights(config: PolicyConfig, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: rng.normal(0.0, 0.3, shape).astype(np.float32) for name, shape in config.tensor_shapes().items()}


def pictures(count: int, config: PolicyConfig = SMALL, seed: int = 1) -> np.ndarray:
    shape = (count, 2 * config.height, 2 * config.width, 3)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def view_of(
    frames: np.ndarray, poses: list[tuple[float, float, float]], actions: list[int], mirrored: bool
) -> PolicyView:
    """What is seen on a drive, or on its mirror image at the axis x."""
    view = PolicyView(SMALL)
    for frame, (x, y, yaw), action in zip(frames, poses, [*actions, None], strict=True):
        sign = -1.0 if mirrored else 1.0
        view.see(frame[:, ::-1] if mirrored else frame, np.array((x, sign * y, sign * yaw)))
        if action is not None:
            view.did((0, 2, 1)[action] if mirrored else action)
    return view


def test_a_grey_picture_is_the_mean_of_blocks_and_colours() -> None:
    picture = pictures(1)[0]
    expected = picture.reshape(6, 2, 8, 2, 3).astype(float).mean(axis=(1, 3, 4))
    np.testing.assert_array_equal(grey_picture(picture, 6, 8), np.floor(expected + 1e-9))


def test_a_view_holds_the_newest_pictures_and_the_motion_between_decisions() -> None:
    frames, view = pictures(3), PolicyView(SMALL)
    grey = [grey_picture(frame, 6, 8) for frame in frames]
    view.see(frames[0], np.array((1.0, 2.0, math.pi / 2)))
    np.testing.assert_array_equal(view.pictures, [grey[0], grey[0]])
    assert view.senses.tolist() == [0.0] * 8
    view.did(Action.TURN_LEFT)
    view.see(frames[1], np.array((0.75, 2.5, -math.pi + 0.25)))
    np.testing.assert_array_equal(view.pictures, [grey[1], grey[0]])
    np.testing.assert_allclose(view.senses, [0, 1, 0, 0.5, 0.25, math.pi / 2 + 0.25, 0.0, 0.0], atol=1e-6)
    view.did(Action.FORWARD)
    view.see(frames[2], np.array((0.75, 2.5, -math.pi + 0.25)))
    np.testing.assert_array_equal(view.pictures, [grey[2], grey[1]])
    assert view.senses.tolist() == [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_a_view_knows_the_way_since_the_last_bend_and_the_one_before() -> None:
    view, frame = PolicyView(SMALL), pictures(1)[0]
    drive = (
        [(x, 0.0, 0.1 * (-1) ** x) for x in range(6)]  # 5 m, hardly straight
        + [(5.0, 0.5, math.radians(60)), (5.0, 1.0, math.radians(110))]  # two bends, too little way between them
        + [(5.0, 1.0 + y, math.pi / 2) for y in (1.0, 2.0, 3.0)]
    )
    seen = []
    for pose in drive:
        view.see(frame, np.array(pose))
        seen.append(view.senses[-2:].tolist())
    np.testing.assert_allclose(seen[5], [0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(seen[6], [0.0, 0.55], atol=1e-6)
    np.testing.assert_allclose(seen[7], [0.0, 0.55], atol=1e-6)
    np.testing.assert_allclose(seen[-1], [0.3, 0.55], atol=1e-6)


def test_in_a_mirror_it_does_the_mirror_image() -> None:
    network = PolicyNetwork(SMALL, weights(SMALL))
    drive = (pictures(3), [(0, 0, 0.1), (0.4, 0.1, 0.2), (0.7, 0.3, 0.0)], [1, 2])
    own, mirrored = (network.logits(view_of(*drive, mirrored=mirrored)) for mirrored in (False, True))
    np.testing.assert_allclose(mirrored, own[[0, 2, 1]], rtol=1e-4, atol=1e-5)
    assert abs(own[1] - own[2]) > 1e-3


def test_a_decision_is_drawn_from_the_odds_and_held() -> None:
    tensors = {name: np.zeros_like(tensor) for name, tensor in weights(SMALL).items()}
    tensors["common.bias"][:] = math.log(4.0), 0.0  # forward in 4 of 6 cases
    driver = LearnedDriver(np.random.default_rng(0), PolicyNetwork(SMALL, tensors))
    frame = pictures(1)[0]
    actions = np.array([driver.action(np.zeros(3), frame) for _ in range(6000)]).reshape(-1, SMALL.hold_frames)
    assert SMALL.hold_frames == 3 and (actions == actions[:, :1]).all()
    np.testing.assert_allclose(np.bincount(actions[:, 0], minlength=3) / len(actions), (4 / 6, 1 / 6, 1 / 6), atol=0.03)
    with pytest.raises(ValueError, match="observation is None; the learned driver has to see"):
        driver.action(np.zeros(3))


def write(path: Path, tensors: dict[str, np.ndarray], **changes: Any) -> None:
    content = save(tensors)
    path.write_bytes(content)
    description = {
        "format": 1,
        "network": "driver",
        "sha256": hashlib.sha256(content).hexdigest(),
        "config": dataclasses.asdict(SMALL),
    }
    path.with_suffix(".json").write_text(json.dumps({**description, **changes}))


def test_weights_come_back_from_their_file(tmp_path: Path) -> None:
    path, tensors = tmp_path / "driver.safetensors", weights(SMALL)
    write(path, tensors)
    view = view_of(pictures(2), [(0, 0, 0), (0.4, 0.1, 0.2)], [2], mirrored=False)
    network = load_policy(path)
    assert network.config == SMALL
    np.testing.assert_array_equal(network.logits(view), PolicyNetwork(SMALL, tensors).logits(view))
