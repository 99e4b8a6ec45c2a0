"""The live view that rerun serves to browsers. The only module that imports rerun, which is an extra."""

import socket
from urllib.parse import quote

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ngo_estimator.view.shapes import Window

TRUTH, ODOMETRY, CORRECTED = (31, 111, 214), (44, 160, 44), (255, 127, 14)  # Colours of the demo's picture.
COLORS = {"truth": TRUTH, "odometry": ODOMETRY, "corrected": CORRECTED}
_SCAN, _ROBOT, _PLAN = (214, 39, 40), (0, 0, 0), (148, 80, 200)
_EYE_HEIGHT = 1.95  # times half of the window: the default field of view sees it whole
_TIMELINE = "time"


class ViewError(Exception):
    """The view cannot be served; the message is one line."""


class RerunView:
    """A map from above, the current picture and the errors, at ``url`` of this machine.

    Args:
        web_port, grpc_port: of the page and of its data. memory_mb: what is kept for pages that open later.

    Raises:
        ViewError: a port is in use.
    """

    def __init__(self, web_port: int, grpc_port: int, memory_mb: int, open_browser: bool) -> None:
        for port in (web_port, grpc_port):
            _check_free(port)
        self._stream = rr.RecordingStream("ngo")
        # A page that opens late shows the present at once.
        self._stream.serve_grpc(
            grpc_port=grpc_port,
            default_blueprint=_blueprint(None),
            server_memory_limit=f"{memory_mb}MB",
            newest_first=True,
        )
        data = f"rerun+http://127.0.0.1:{grpc_port}/proxy"
        rr.serve_web_viewer(web_port=web_port, open_browser=open_browser, connect_to=data)
        self.url = f"http://127.0.0.1:{web_port}/?url={quote(data, safe='')}"
        self._style_errors()

    def at(self, seconds: float) -> None:
        """All that follows belongs to this time."""
        self._stream.set_time(_TIMELINE, duration=seconds)

    def look_at(self, window: Window) -> None:
        """Show a window of the map from above."""
        self._stream.send_blueprint(_blueprint(window), make_active=True, make_default=True)

    def path(self, name: str, xy: np.ndarray) -> None:
        """A trajectory ``(n, 2)`` on the map: one of ``COLORS``."""
        height = 0.02 * (1 + list(COLORS).index(name))
        radius = rr.Radius.ui_points(2.0 if name == "corrected" else 1.3)
        self._stream.log(f"map/{name}", rr.LineStrips3D([_raised(xy, height)], colors=[COLORS[name]], radii=radius))

    def loops(self, lines: np.ndarray, colors: np.ndarray) -> None:
        """Lines ``(n, 2, 2)`` between places that are the same, with colors ``(n, 4)``; see ``LiveView.show_loops``."""
        # rerun draws lines opaque: a faint one is a pale one, and lies lower than the stronger ones.
        share = np.clip(colors[:, 3:], 0.0, 1.0)
        colors = np.round(255.0 * (1.0 - share * (1.0 - colors[:, :3]))).astype(np.uint8)
        raised = np.concatenate([lines, np.tile(0.01 * share[:, None], (1, 2, 1))], axis=2)
        self._stream.log("map/loops", rr.LineStrips3D(raised, colors=colors, radii=rr.Radius.ui_points(0.7)))

    def frontiers(self, xy: np.ndarray, colors: np.ndarray) -> None:
        """Points ``(n, 2)`` at the edge of the unknown, with colors ``(n, 3)``; see ``LiveView.show_frontiers``."""
        shades = np.round(255.0 * colors).astype(np.uint8)
        self._stream.log("map/frontiers", rr.Points3D(_raised(xy, 0.1), colors=shades, radii=rr.Radius.ui_points(2.0)))

    def plan(self, xy: np.ndarray) -> None:
        """The path ``(n, 2)`` that the robot means to drive, and its end."""
        line = rr.LineStrips3D([_raised(xy, 0.11)], colors=[_PLAN], radii=rr.Radius.ui_points(1.5))
        self._stream.log("map/plan", line)
        self._stream.log("map/goal", rr.Points3D(_raised(xy[-1:], 0.13), colors=_PLAN, radii=rr.Radius.ui_points(5.0)))

    def robot(self, pose_xyyaw: np.ndarray, outline: np.ndarray, size_m: float) -> None:
        """The robot as an arrow of ``size_m``, and the outline ``(n, 2)`` of its uncertainty."""
        x, y, yaw = pose_xyyaw.tolist()
        arrow = rr.Arrows3D(
            origins=[[x, y, 0.15]],
            vectors=[[size_m * np.cos(yaw), size_m * np.sin(yaw), 0.0]],
            colors=[_ROBOT],
            radii=0.12 * size_m,
        )
        self._stream.log("map/robot", arrow)
        radius = rr.Radius.ui_points(1.5)
        self._stream.log("map/covariance", rr.LineStrips3D([_raised(outline, 0.12)], colors=[CORRECTED], radii=radius))

    def scan(self, xy: np.ndarray) -> None:
        """Hits ``(n, 2)`` of the newest scan."""
        self._stream.log("map/scan", rr.Points3D(_raised(xy, 0.09), colors=_SCAN, radii=rr.Radius.ui_points(1.5)))

    def grid(self, cells: np.ndarray, resolution_m: float, origin_xyyaw: np.ndarray) -> None:
        """An occupancy grid ``(height, width)``: -1 unknown, 0 free to 100 occupied, the first row at the origin."""
        height, width = cells.shape
        x, y, yaw = origin_xyyaw.tolist()
        picture = np.ascontiguousarray(cells[::-1].astype(np.int8))  # the first row of a picture is the upper one
        self._stream.log(
            "map/grid",
            rr.GridMap(
                data=picture.tobytes(),
                format=rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="U8"),
                cell_size=resolution_m,
                translation=[x, y, 0.0],
                rotation_axis_angle=rr.RotationAxisAngle([0.0, 0.0, 1.0], radians=yaw),
                colormap=rr.components.Colormap.RvizMap,
            ),
        )

    def picture(self, image: np.ndarray) -> None:
        """The newest picture, ``(height, width, 1 or 3)`` of bytes."""
        self._stream.log("picture", rr.Image(image.squeeze(2) if image.shape[2] == 1 else image))

    def error(self, name: str, position_rmse_m: float) -> None:
        """Another value of the error of ``odometry`` or ``corrected``."""
        self._stream.log(f"errors/{name}", rr.Scalars(position_rmse_m))

    def text(self, markdown: str) -> None:
        """Numbers in words."""
        self._stream.log("state", rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def close(self) -> None:
        """Send what is left."""
        self._stream.flush()

    def _style_errors(self) -> None:
        for name in ("odometry", "corrected"):
            lines = rr.SeriesLines(colors=[COLORS[name]], names=[name], widths=[2.0])
            self._stream.log(f"errors/{name}", lines, static=True)


def _raised(xy: np.ndarray, height_m: float) -> np.ndarray:
    """Points ``(n, 2)`` above the grid, so that it does not hide them."""
    return np.column_stack([xy, np.full(len(xy), height_m)]).astype(np.float32)


def _blueprint(window: Window | None) -> rrb.Blueprint:
    eye = None
    if window is not None:
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=[window.x, window.y, _EYE_HEIGHT * window.half_m],
            look_target=[window.x, window.y, 0.0],
            eye_up=[0.0, 1.0, 0.0],
        )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(name="Map", origin="map", line_grid=False, background=[255, 255, 255], eye_controls=eye),
            rrb.Vertical(
                rrb.Spatial2DView(name="Picture", origin="picture"),
                rrb.TimeSeriesView(name="Position RMSE (m)", origin="errors"),
                rrb.TextDocumentView(name="State", origin="state"),
            ),
            column_shares=[2, 1],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=_TIMELINE),
    )


def _check_free(port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            raise ViewError(f"port {port} is in use, perhaps by another live view: choose another one") from None
