"""The picture of a recording: its path, sample images, the times of its messages and its motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.recordings.recording_report import SAMPLES, Report


def save_picture(report: Report, path: Path) -> None:
    """Draw a report and save it as PNG."""
    has_truth = bool(np.isfinite(report.poses_xyyaw).any())
    ratios = (1.0, 2.6, 1.2) if has_truth else (1.0, 1.2)
    figure = Figure(figsize=(12, 2.1 * sum(ratios)), layout="constrained")
    rows = np.atleast_1d(np.asarray(figure.subfigures(len(ratios), 1, height_ratios=ratios)))
    for axes, image in zip(rows[0].subplots(1, SAMPLES), report.samples, strict=False):
        _show_image(axes, image)
    if has_truth:
        path_axes, step_axes = rows[1].subplots(1, 2)
        _show_path(path_axes, report)
        _show_steps(step_axes, report)
    _show_intervals(rows[-1].subplots(), report)
    names = ", ".join(Path(name).name for name in report.files)
    figure.suptitle(f"{names}: {report.frames} frames, {report.image}")
    figure.savefig(path, dpi=110)


def _show_image(axes: Axes, image: np.ndarray) -> None:
    """A picture, or of one row of depth its curve."""
    if image.shape[0] == 1 and image.dtype != np.uint8:
        axes.plot(np.where(np.isfinite(image[0, :, -1]), image[0, :, -1], np.nan), linewidth=0.8)
        axes.set(xlabel="column", ylabel="depth [m]")
        return
    if image.dtype != np.uint8 and image.shape[2] == 1:
        axes.imshow(np.where(np.isfinite(image[..., 0]), image[..., 0], np.nan), cmap="viridis")
    else:
        axes.imshow(image[..., :3] if image.shape[2] > 1 else image[..., 0], cmap="gray")
    axes.set_axis_off()


def _show_path(axes: Axes, report: Report) -> None:
    poses = report.poses_xyyaw
    axes.plot(poses[:, 0], poses[:, 1], color="0.8", linewidth=0.8, zorder=0)
    since_s = report.stamps_s - report.stamps_s[0]
    points = axes.scatter(poses[:, 0], poses[:, 1], c=since_s, s=3, cmap="viridis")
    axes.figure.colorbar(points, ax=axes, label="time [s]")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="ground truth")


def _show_steps(axes: Axes, report: Report) -> None:
    steps = np.diff(report.poses_xyyaw, axis=0)
    steps = steps[np.isfinite(steps[:, 0])]
    turns = (steps[:, 2] + np.pi) % (2 * np.pi) - np.pi
    axes.plot(np.hypot(steps[:, 0], steps[:, 1]), np.degrees(turns), ".", markersize=2, alpha=0.4)
    axes.set(xlabel="moved in a step [m]", ylabel="turned in a step [deg]", title="motion from frame to frame")


def _show_intervals(axes: Axes, report: Report) -> None:
    if len(report.stamps_s) > 1:
        axes.plot(report.stamps_s[1:] - report.stamps_s[0], 1e3 * np.diff(report.stamps_s), linewidth=0.8)
    missing = ~np.isfinite(report.poses_xyyaw[:, 0])
    if missing.any() and not missing.all():
        since_s = report.stamps_s[missing] - report.stamps_s[0]
        axes.plot(since_s, np.zeros(len(since_s)), "|", color="tab:red", label="no true pose")
        axes.legend(loc="upper right")
    axes.set(xlabel="time [s]", ylabel="between frames [ms]", title="gaps")
    axes.set_ylim(0.0, 1.2 * axes.get_ylim()[1])
