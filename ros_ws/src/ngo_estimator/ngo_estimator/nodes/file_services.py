"""The services that write and read files: the trajectory, and all that a trajectory goes on with."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from ngo_msgs.srv import LoadState, SaveGraph, SaveState, SaveTrajectory
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from ngo_estimator.trajectory.files import ENDINGS, tum_lines, write_lines, write_trajectory
from ngo_estimator.trajectory.g2o import GRAPH_ENDING, g2o_lines, write_g2o
from ngo_estimator.trajectory.save_path import folder_inside, path_inside

if TYPE_CHECKING:
    from ngo_estimator.nodes.settings import NgoNodeSettings
    from ngo_estimator.slam.joining import Joining
    from ngo_estimator.slam.map_localisation import MapLocalisation
    from ngo_estimator.slam.session import Session
    from ngo_estimator.slam.trajectory_update import Trajectory
    from ngo_estimator.trajectory.g2o import PlanarGraph

    Loaded = tuple[Session, MapLocalisation | Joining | None]

Result = TypeVar("Result")


class FileServices:
    """Answers ``~/save_trajectory``, ``~/save_graph``, ``~/save_state`` and ``~/load_state``.

    Files are written and read in a thread, while relative poses go on.
    """

    def __init__(
        self,
        node: Node,
        settings: "NgoNodeSettings",
        trajectory: "Callable[[], Trajectory | None]",
        graph: "Callable[[], PlanarGraph | None]",
        session: "Callable[[], Session]",
        take: "Callable[[Loaded], None]",
    ) -> None:
        """Save ``trajectory()``, ``graph()`` and ``session()``, and hand a loaded session to ``take``.

        Paths lie in the folder of the ``settings``. With a session comes the search for the robot in its map: if they
        say localization, or the session goes on from another start.
        """
        self._node, self._settings, self._folder = node, settings, Path(settings.save_directory)
        self._trajectory, self._graph, self._session, self._take = trajectory, graph, session, take
        self._newest = self._folder  # the state that was loaded or saved last

    def open(self, qos: QoSProfile, built: ExitStack) -> None:
        """Offer the services, until ``built`` is closed."""
        self._thread = built.enter_context(ThreadPoolExecutor(1))
        for kind, name, callback in (
            (SaveTrajectory, "~/save_trajectory", self._on_save_trajectory),
            (SaveGraph, "~/save_graph", self._on_save_graph),
            (SaveState, "~/save_state", self._on_save_state),
            (LoadState, "~/load_state", self._on_load_state),
        ):
            # A group of its own: while a file is written, the others go on.
            group = MutuallyExclusiveCallbackGroup()
            service = self._node.create_service(kind, name, callback, qos_profile=qos, callback_group=group)
            built.callback(self._node.destroy_service, service)

    def load_at_start(self, path: str, relocalise: bool) -> None:
        """Load the state in a folder that the parameters name; raises ``ValueError``, of one line."""
        self._newest = self._folder.expanduser() / Path(path).expanduser()
        self._take(self._loaded(self._session(), self._newest, relocalise))

    def load_again(self) -> None:
        """Load the state that was loaded or saved last, and look for the robot in it; raises ``ValueError``."""
        self._take(self._loaded(self._session(), self._newest, relocalise=True))

    def _loaded(self, present: "Session", folder: Path, relocalise: bool) -> "Loaded":
        session = present.loaded(folder)
        if self._settings.keeps_map:
            return session, session.localisation()
        return session, session.joining() if relocalise or self._settings.mode == "localization" else None

    async def _on_save_trajectory(
        self, request: SaveTrajectory.Request, response: SaveTrajectory.Response
    ) -> SaveTrajectory.Response:
        trajectory, folder = self._trajectory(), self._folder
        graph = self._graph() if request.path.endswith(GRAPH_ENDING) else None
        write = partial(_write, trajectory=trajectory, graph=graph)
        response.success, response.message = await self._aside(lambda: _written(request.path, folder, write))
        return response

    async def _on_save_graph(self, request: SaveGraph.Request, response: SaveGraph.Response) -> SaveGraph.Response:
        write = partial(_write_graph, trajectory=self._trajectory(), graph=self._graph())
        response.success, response.message = await self._aside(lambda: _written(request.path, self._folder, write))
        return response

    async def _on_save_state(self, request: SaveState.Request, response: SaveState.Response) -> SaveState.Response:
        """Save what the trajectory is at this moment."""
        try:
            session = self._session()
            arrays, frames = session.state(), session.core.newest().frames
            path = folder_inside(self._folder, request.path)
            await self._aside(lambda: session.write(path, arrays))
            self._newest = path
            response.success, response.message = True, f"wrote {frames} poses to {path}"
        except ValueError as error:
            response.message = str(error)
        return response

    async def _on_load_state(self, request: LoadState.Request, response: LoadState.Response) -> LoadState.Response:
        """Load a state; the present trajectory goes on until it is whole."""
        try:
            relocalise = _relocalises(request.mode)
            path, present = folder_inside(self._folder, request.path), self._session()
            loaded = await self._aside(lambda: self._loaded(present, path, relocalise))
            self._take(loaded)
            self._newest = path
            response.success, response.message = True, f"loaded {loaded[0].core.newest().frames} poses from {path}"
        except ValueError as error:
            response.message = str(error)
        return response

    async def _aside(self, work: Callable[[], Result]) -> Result:
        """The result of work that is done in a thread, or its error."""
        done, executor = Future(), self._node.executor

        def run() -> None:
            try:
                done.set_result(work())
            except Exception as error:
                done.set_exception(error)
            executor.wake()

        self._thread.submit(run)
        result: Result = await done
        return result


def _relocalises(mode: int) -> bool:
    """Whether a mode asks for the robot to be found in the map; raises ``ValueError`` for one that there is not."""
    modes = LoadState.Request
    if mode not in (modes.CONTINUE, modes.RELOCALISE):
        raise ValueError(f"mode is {mode}; expected {modes.CONTINUE} (CONTINUE) or {modes.RELOCALISE} (RELOCALISE)")
    return bool(mode == modes.RELOCALISE)


def _written(name: str, folder: Path, write: Callable[[Path], str]) -> tuple[bool, str]:
    """Write a file in the folder; returns whether it succeeded, and a message for the user."""
    try:
        return True, write(path_inside(folder, name))
    except Exception as error:  # the caller of the service gets an answer in any case
        return False, " ".join(str(error).split()) or repr(error)


def _write(path: Path, trajectory: "Trajectory | None", graph: "PlanarGraph | None") -> str:
    """Write the trajectory, or where the ending says so its graph; returns what was written."""
    if trajectory is None:
        raise ValueError("the trajectory is empty; nothing was written")
    if path.suffix not in (*ENDINGS, GRAPH_ENDING):
        raise ValueError(f"file is '{path}'; allowed: a name that ends in {', '.join(ENDINGS)} or {GRAPH_ENDING}")
    if graph is not None:
        write_g2o(path, graph)
        return f"wrote {len(graph.ids)} poses to {path}"
    write_trajectory(path, trajectory.stamps_ns, trajectory.poses_xyyaw)
    return f"wrote {len(trajectory.stamps_ns)} poses to {path}"


def _write_graph(path: Path, trajectory: "Trajectory | None", graph: "PlanarGraph | None") -> str:
    """Write the graph, and the trajectory beside it; returns what was written."""
    if trajectory is None or graph is None:
        raise ValueError("the trajectory is empty; nothing was written")
    if path.suffix != GRAPH_ENDING:
        raise ValueError(f"path is '{path}'; expected a name that ends in {GRAPH_ENDING}")
    beside = path.with_suffix(".tum")
    write_lines({path: g2o_lines(graph), beside: tum_lines(trajectory.stamps_ns, trajectory.poses_xyyaw)})
    loops, poses = int(graph.is_loop.sum()), len(trajectory.stamps_ns)
    return f"wrote {len(graph.ids)} vertices and {loops} loops to {path}, and {poses} poses to {beside}"
