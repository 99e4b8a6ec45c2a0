"""The learned driver's network: what it looks at, and its forward pass in numpy: a simulator needs no torch."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors
from safetensors.numpy import load

from ngo_common.files import read_file

FORMAT = 1
NETWORK = "driver"
SHIPPED = Path(__file__).with_name("weights") / "driver.safetensors"
ACTIONS = 3
SENSES = ACTIONS + 5
MIRRORED_SENSES = (0, 2, 1, 3, 4, 5, 6, 7)
"""Where each of the senses is found for a robot in a mirror: left and right actions exchanged."""
MIRRORED_SIGNS = (1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0)
"""What they are multiplied by then: motion to the left and turning have the other sign."""

_BEND_RAD = math.radians(45.0)
_SHORTEST_RUN_M = 2.0
_RUN_UNIT_M = 10.0


@dataclass(frozen=True)
class PolicyConfig:
    """What the learned driver sees and how its network is built; the pictures are grey."""

    height: int = 30  # of a picture, pixels
    width: int = 40  # of a picture, pixels
    pictures: int = 3  # of the newest decisions, the present one among them
    hold_frames: int = 3  # for which an action is held: a decision is taken in every so many frames
    channels: tuple[int, ...] = (16, 32, 32)  # of the convolutions
    kernels: tuple[int, ...] = (5, 3, 3)  # sides of their kernels, pixels
    strides: tuple[int, ...] = (2, 2, 2)  # of their kernels, pixels
    hidden: int = 128  # units of the layer behind them

    def __post_init__(self) -> None:
        for name in ("height", "width", "pictures", "hold_frames", "hidden"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} is {value!r}; it must be an integer of at least 1")
        for name in ("channels", "kernels", "strides"):
            value = getattr(self, name)
            if not value or len(value) != len(self.channels) or any(type(one) is not int or one < 1 for one in value):
                raise ValueError(f"{name} is {value!r}; it must have {len(self.channels)} integers of at least 1")
        if min(self.feature_shape) < 1:
            raise ValueError(f"pictures of {self.width} x {self.height} leave the kernels {self.kernels} nothing")

    @property
    def feature_shape(self) -> tuple[int, int, int]:
        """Channels, height and width behind the convolutions."""
        height, width = self.height, self.width
        for kernel, stride in zip(self.kernels, self.strides, strict=True):
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        return self.channels[-1], height, width

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights."""
        shapes: dict[str, tuple[int, ...]] = {}
        before = self.pictures
        for index, (channels, kernel) in enumerate(zip(self.channels, self.kernels, strict=True)):
            shapes[f"convolution_{index}.weight"] = (channels, before, kernel, kernel)
            shapes[f"convolution_{index}.bias"] = (channels,)
            before = channels
        shapes["hidden.weight"] = (self.hidden, int(np.prod(self.feature_shape)) + SENSES)
        shapes["hidden.bias"] = (self.hidden,)
        shapes["common.weight"], shapes["common.bias"] = (2, self.hidden), (2,)
        shapes["turn.weight"] = (1, self.hidden)
        return shapes


class PolicyView:
    """What the network looks at: the pictures of the newest decisions, how it moved since the last one, and how far.

    pictures: uint8 (pictures, height, width), the newest first. senses: float32 (8,), 1 for the last of the three
    actions; the motion since it was decided on: m forward, m to the left, rad counter-clockwise; and in units of 10 m
    the way since the last bend and the way before that bend, because at the end of a corridor its length is not to be
    seen. A bend is where the heading has left that of the last bend by over 45 degrees; runs of less than 2 m belong to
    it. At the first decision all senses are 0.
    """

    def __init__(self, config: PolicyConfig) -> None:
        self.config = config
        self.pictures = np.zeros((config.pictures, config.height, config.width), dtype=np.uint8)
        self.senses = np.zeros(SENSES, dtype=np.float32)
        self._last_pose: tuple[float, float, float] | None = None
        self._bend_yaw, self._run_m, self._earlier_run_m = 0.0, 0.0, 0.0

    def see(self, observation: npt.NDArray[np.uint8], pose_xyyaw: npt.NDArray[np.float64]) -> None:
        """Take in what is seen at a decision, and where; the first picture counts as having been seen all the time."""
        picture = grey_picture(observation, self.config.height, self.config.width)
        x, y, yaw = pose_xyyaw.tolist()
        if self._last_pose is None:
            self.pictures[:] = picture
            self._bend_yaw = yaw
        else:
            last_x, last_y, last_yaw = self._last_pose
            dx, dy, cos, sin = x - last_x, y - last_y, math.cos(last_yaw), math.sin(last_yaw)
            turned = math.remainder(yaw - last_yaw, math.tau)
            self._run_m += math.hypot(dx, dy)
            if abs(math.remainder(yaw - self._bend_yaw, math.tau)) > _BEND_RAD:
                if self._run_m >= _SHORTEST_RUN_M:
                    self._earlier_run_m = self._run_m
                self._bend_yaw, self._run_m = yaw, 0.0
            runs = self._run_m / _RUN_UNIT_M, self._earlier_run_m / _RUN_UNIT_M
            self.senses[ACTIONS:] = cos * dx + sin * dy, cos * dy - sin * dx, turned, *runs
        self._last_pose = x, y, yaw
        self.pictures[1:] = self.pictures[:-1].copy()
        self.pictures[0] = picture

    def did(self, action: int) -> None:
        """Remember the action that was decided on."""
        self.senses[:ACTIONS] = 0.0
        self.senses[action] = 1.0


def grey_picture(observation: npt.NDArray[np.uint8], height: int, width: int) -> npt.NDArray[np.uint8]:
    """uint8 (height, width): the mean of colours and of whole blocks of pixels, rounded down.

    Raises ValueError where observation is not uint8 (a height, b width, 3) with whole a and b.
    """
    if observation.ndim != 3 or observation.dtype != np.uint8 or observation.shape[2] != 3:
        raise ValueError(
            f"the learned driver is given {observation.dtype} {observation.shape}; it needs colour pictures, uint8 "
            "(height, width, 3)"
        )
    rows, cols = observation.shape[0] // height, observation.shape[1] // width
    if observation.shape[:2] != (rows * height, cols * width) or not rows or not cols:
        raise ValueError(
            f"the learned driver is given pictures of {observation.shape[1]} x {observation.shape[0]}; it needs "
            f"multiples of {width} x {height}"
        )
    total = observation.reshape(height, rows, width, cols * 3).sum(axis=(1, 3), dtype=np.uint32)
    return (total // (rows * cols * 3)).astype(np.uint8)


class PolicyNetwork:
    """Convolutions and a hidden layer, all with ReLU, of a view and of its mirror image, to the odds of the actions.

    The sum of the two hidden layers gives the odds of going forward and of turning at all, their difference those of
    left against right: what the network does in a mirror is the mirror image of what it does, whatever its weights.

    tensors: float arrays of the names and shapes of config.tensor_shapes(). Raises ValueError for others.
    """

    def __init__(self, config: PolicyConfig, tensors: dict[str, npt.NDArray[Any]]) -> None:
        expected = config.tensor_shapes()
        if tensors.keys() != expected.keys():
            raise ValueError(f"the weights are {sorted(tensors)}; expected {sorted(expected)}")
        for name, shape in expected.items():
            if tensors[name].shape != shape or not np.isfinite(tensors[name]).all():
                raise ValueError(f"{name} has shape {tensors[name].shape}; expected {shape}, all finite")
        self.config = config
        weights = {name: tensor.astype(np.float32) for name, tensor in tensors.items()}
        self._convolutions = [
            (weights[f"convolution_{index}.weight"].reshape(channels, -1), weights[f"convolution_{index}.bias"])
            for index, channels in enumerate(config.channels)
        ]
        self._hidden = weights["hidden.weight"], weights["hidden.bias"]
        self._common = weights["common.weight"], weights["common.bias"]
        self._turn = weights["turn.weight"]

    def logits(self, view: PolicyView) -> npt.NDArray[np.float32]:
        """float32 (3,) of a view: the logarithms of the odds of the three actions, but for a common summand."""
        pictures = view.pictures.astype(np.float32) / 255.0
        seen = self._hidden_layer(pictures, view.senses)
        signs = np.array(MIRRORED_SIGNS, dtype=np.float32)
        mirrored = self._hidden_layer(pictures[:, :, ::-1], view.senses[list(MIRRORED_SENSES)] * signs)
        weight, bias = self._common
        forward, turn = weight @ (seen + mirrored) + bias
        (left,) = self._turn @ (seen - mirrored)
        return np.array((forward, turn + left, turn - left), dtype=np.float32)

    def _hidden_layer(
        self, values: npt.NDArray[np.float32], senses: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        for (weight, bias), kernel, stride in zip(
            self._convolutions, self.config.kernels, self.config.strides, strict=True
        ):
            windows = np.lib.stride_tricks.sliding_window_view(values, (kernel, kernel), axis=(1, 2))
            windows = windows[:, ::stride, ::stride]
            height, width = windows.shape[1:3]
            columns = windows.transpose(0, 3, 4, 1, 2).reshape(weight.shape[1], height * width)
            values = np.maximum(weight @ columns + bias[:, None], 0.0).reshape(-1, height, width)
        weight, bias = self._hidden
        hidden: npt.NDArray[np.float32] = np.maximum(weight @ np.concatenate((values.ravel(), senses)) + bias, 0.0)
        return hidden


def load_policy(path: Path = SHIPPED) -> PolicyNetwork:
    """The network in a safetensors file that the JSON beside it describes.

    Raises ValueError naming the file, what is wrong with it and what was expected.
    """
    beside = path.with_suffix(".json")
    try:
        description, content = json.loads(read_file(beside)), read_file(path)
        tensors = load(content)
    except OSError as error:
        raise ValueError(
            f"{error.filename}: cannot be read ({error.strerror}); expected a driver's weights, or the JSON beside them"
        ) from error
    except (ValueError, RecursionError, safetensors.SafetensorError) as error:
        raise ValueError(f"{path}: it or the JSON beside it is damaged ({error})") from error
    if not isinstance(description, dict) or (description.get("format"), description.get("network")) != (
        FORMAT,
        NETWORK,
    ):
        raise ValueError(f"{beside}: is not the description of a {NETWORK} of format {FORMAT}")
    if hashlib.sha256(content).hexdigest() != description.get("sha256"):
        raise ValueError(f"{path}: is not the file that {beside.name} describes (sha256 differs)")
    try:
        return PolicyNetwork(policy_config(description.get("config")), tensors)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def policy_config(values: Any) -> PolicyConfig:
    """The config of JSON values; unknown and missing keys raise ValueError."""
    expected = asdict(PolicyConfig())
    if not isinstance(values, dict) or values.keys() != expected.keys():
        raise ValueError(f"config is {values!r}; expected an object with {', '.join(expected)}")
    arguments: dict[str, Any] = {key: tuple(one) if isinstance(one, list) else one for key, one in values.items()}
    return PolicyConfig(**arguments)
