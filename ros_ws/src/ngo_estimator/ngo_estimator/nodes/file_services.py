"""The services that write and read files: the trajectory, and all that a trajectory goes on with."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from ngo_msgs.srv import LoadState, SaveGraph, SaveState, SaveTrajectory
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from ngo_estimator.trajectory.files import ENDINGS, trajectory_lines, write_lines
from ngo_estimator.trajectory.g2o import GRAPH_ENDING, g2o_lines
from ngo_estimator.trajectory.save_path import folder_inside, path_inside

if TYPE_CHECKING:
    from ngo_estimator.nodes.settings import NgoNodeSettings
    from ngo_estimator.slam.joining import Joining
    from ngo_estimator.slam.map_localisation import MapLocalisation
    from ngo_estimator.slam.session import Session
    from ngo_estimator.slam.trajectory_update import Trajectory
    from ngo_estimator.trajectory.g2o import PlanarGraph

    Loaded = tuple[Session, MapLocalisation | Joining | None]
    Trajectories = Mapping[str, Trajectory]

Result = TypeVar("Result")
Written = tuple[np.ndarray, np.ndarray | None]
Service = tuple[Any, str, Callable[..., Any]]
_QOS = QoSProfile(depth=1000)  # every call is answered, many at once as well


class FileServices:
    """Answers ``~/save_trajectory`` and ``~/save_graph``.

    Files are written in a thread, while relative poses go on. ``written`` is what the ids of the graph that was written
    last name: the stamps of its poses, and the ranks of their drives where there are several.
    """

    written: "Written | None" = None

    def __init__(
        self,
        node: Node,
        settings: "NgoNodeSettings",
        trajectories: "Callable[[], Trajectories]",
        graph: "Callable[[], PlanarGraph | None]",
    ) -> None:
        """Save ``trajectories()`` and ``graph()``; paths lie in the folder of the ``settings``.

        Names of trajectories stand before the ending of the file's name; that of a single one is empty.
        """
        self._node, self._settings, self._folder = node, settings, Path(settings.save_directory)
        self._trajectories, self._graph = trajectories, graph

    def open(self, built: ExitStack, *others: Service) -> None:
        """Offer the services and others, until ``built`` is closed."""
        self._thread = built.enter_context(ThreadPoolExecutor(1))
        # Each in a group of its own: while a file is written, the others go on.
        own = [(MutuallyExclusiveCallbackGroup(), service) for service in self._services()]
        for group, (kind, name, callback) in (*own, *((None, service) for service in others)):
            service = self._node.create_service(kind, name, callback, qos_profile=_QOS, callback_group=group)
            built.callback(self._node.destroy_service, service)

    def _services(self) -> Iterator[Service]:
        yield SaveTrajectory, "~/save_trajectory", self._on_save_trajectory
        yield SaveGraph, "~/save_graph", self._on_save_graph

    async def _on_save_trajectory(
        self, request: SaveTrajectory.Request, response: SaveTrajectory.Response
    ) -> SaveTrajectory.Response:
        graph = self._graph() if request.path.endswith(GRAPH_ENDING) else None
        response.success, response.message = await self._save(request.path, _write, graph)
        return response

    async def _on_save_graph(self, request: SaveGraph.Request, response: SaveGraph.Response) -> SaveGraph.Response:
        response.success, response.message = await self._save(request.path, _write_graph, self._graph())
        return response

    async def _save(self, path: str, write: Callable[..., str], graph: "PlanarGraph | None") -> tuple[bool, str]:
        """Whether a file was written, and a message; its graph, where it has one, names poses from then on."""
        whole = partial(write, trajectories=self._trajectories(), graph=graph)
        success, message = await self._aside(lambda: _written(path, self._folder, whole))
        if success and graph is not None:
            self.written = graph.stamps_ns, graph.ranks
        return success, message

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


class StateServices(FileServices):
    """Answers ``~/save_state`` and ``~/load_state`` as well."""

    def __init__(
        self,
        node: Node,
        settings: "NgoNodeSettings",
        trajectories: "Callable[[], Trajectories]",
        graph: "Callable[[], PlanarGraph | None]",
        session: "Callable[[], Session]",
        take: "Callable[[Loaded], None]",
    ) -> None:
        """Save ``session()`` as well, and hand a loaded session to ``take``.

        With a session comes the search for the robot in its map: if the ``settings`` say localization, or the session
        goes on from another start.
        """
        super().__init__(node, settings, trajectories, graph)
        self._session, self._take = session, take
        self._newest = self._folder  # the state that was loaded or saved last

    def _services(self) -> Iterator[Service]:
        yield from super()._services()
        yield SaveState, "~/save_state", self._on_save_state
        yield LoadState, "~/load_state", self._on_load_state

    def load_at_start(self, path: str, relocalise: bool) -> None:
        """Load the state in a folder that the parameters name; raises ``ValueError``, of one line."""
        self._newest = self._folder.expanduser() / Path(path).expanduser()
        self._take(self._loaded(self._session(), self._newest, relocalise))

    def reload(self) -> None:
        """Load the state that was loaded or saved last, and look for the robot in it; raises ``ValueError``."""
        self._take(self._loaded(self._session(), self._newest, relocalise=True))

    def _loaded(self, present: "Session", folder: Path, relocalise: bool) -> "Loaded":
        session = present.loaded(folder)
        if self._settings.keeps_map:
            return session, session.localisation()
        return session, session.joining() if relocalise or self._settings.mode == "localization" else None

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


def _write(path: Path, trajectories: "Trajectories", graph: "PlanarGraph | None") -> str:
    """Write the trajectories, or where the ending says so their graph; returns what was written."""
    if not trajectories:
        raise ValueError("the trajectory is empty; nothing was written")
    if path.suffix not in (*ENDINGS, GRAPH_ENDING):
        raise ValueError(f"file is '{path}'; allowed: a name that ends in {', '.join(ENDINGS)} or {GRAPH_ENDING}")
    if graph is not None:
        write_lines({path: g2o_lines(graph)})
        return f"wrote {len(graph.ids)} poses to {path}"
    lines, said = _lines_of(path, trajectories)
    write_lines(lines)
    return f"wrote {said}"


def _write_graph(path: Path, trajectories: "Trajectories", graph: "PlanarGraph | None") -> str:
    """Write the graph, and the trajectories beside it; returns what was written."""
    if not trajectories or graph is None:
        raise ValueError("the trajectory is empty; nothing was written")
    if path.suffix != GRAPH_ENDING:
        raise ValueError(f"path is '{path}'; expected a name that ends in {GRAPH_ENDING}")
    lines, said = _lines_of(path.with_suffix(".tum"), trajectories)
    write_lines({path: g2o_lines(graph), **lines})
    return f"wrote {len(graph.ids)} vertices and {int(graph.is_loop.sum())} loops to {path}, and {said}"


def _lines_of(path: Path, trajectories: "Trajectories") -> tuple[dict[Path, Iterator[str]], str]:
    """The lines of the files of all trajectories, and what they hold in words."""
    lines: dict[Path, Iterator[str]] = {}
    said = []
    for name, trajectory in trajectories.items():
        own = path.with_stem(f"{path.stem}_{name}") if name else path
        lines |= trajectory_lines(own, trajectory.stamps_ns, trajectory.poses_xyyaw)
        said.append(f"{len(trajectory.stamps_ns)} poses to {own}")
    return lines, ", ".join(said)
