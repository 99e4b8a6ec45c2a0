"""What diagnostics say about the localisation in a saved map."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ngo_estimator.online.map_localisation import LocalisedStep


def localisation_details(step: "LocalisedStep | None") -> dict[str, str]:
    """Values for diagnostics; ``step`` is the newest one, None before the first."""
    return {"localisation": "localised" if _known(step) else "not localised", "hypotheses": _hypotheses(step)}


def localisation_problems(step: "LocalisedStep | None") -> list[str]:
    """That the pose is not known, with where the robot may be; nothing where it is known."""
    return [] if _known(step) else [f"not localised: {_hypotheses(step) or 'no hypothesis yet'}"]


def _known(step: "LocalisedStep | None") -> bool:
    return step is not None and step.found.pose_xyyaw is not None


def _hypotheses(step: "LocalisedStep | None") -> str:
    """Where the robot may be, the best supported first."""
    modes = () if step is None else step.found.hypotheses
    poses = [(*mode.pose_xyyaw.tolist(), mode.support) for mode in modes]
    return "; ".join(f"x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad, support {n:.1f}" for x, y, yaw, n in poses)
