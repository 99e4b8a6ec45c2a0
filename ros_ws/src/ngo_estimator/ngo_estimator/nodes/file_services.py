"""The services that write and read files: the trajectory, and all that a trajectory goes on with."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from ngo_msgs.srv import LoadState, SaveState, SaveTrajectory
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from ngo_estimator.trajectory.files import edges_of, write_trajectory
from ngo_estimator.trajectory.save_path import folder_inside, path_inside

if TYPE_CHECKING:
    from ngo_estimator.slam.joining import Joining
    from ngo_estimator.slam.map_localisation import MapLocalisation
    from ngo_estimator.slam.session import Session
    from ngo_estimator.slam.trajectory_update import Trajectory

    Loaded = tuple[Session, MapLocalisation | Joining | None]

Result = TypeVar("Result")


class FileServices:
    """Answers ``~/save_trajectory``, ``~/save_state`` and ``~/load_state``.

    Files are written and read in a thread, while relative poses go on.
    """

    def __init__(
        self,
        node: Node,
        folder: str,
        localises: bool,
        trajectory: "Callable[[], Trajectory | None]",
        session: "Callable[[], Session]",
        take: "Callable[[Loaded], None]",
    ) -> None:
        """Save ``trajectory()`` and ``session()``, and hand a loaded session to ``take``; paths lie in ``folder``.

        With a session comes the search for the robot in its map: if the node ``localises``, or the session goes on from
        another start.
        """
        self._node, self._folder, self._localises = node, Path(folder), localises
        self._trajectory, self._session, self._take = trajectory, session, take

    def open(self, qos: QoSProfile, built: ExitStack) -> None:
        """Offer the services, until ``built`` is closed."""
        self._thread = built.enter_context(ThreadPoolExecutor(1))
        for kind, name, callback in (
            (SaveTrajectory, "~/save_trajectory", self._on_save_trajectory),
            (SaveState, "~/save_state", self._on_save_state),
            (LoadState, "~/load_state", self._on_load_state),
        ):
            # A group of its own: while a file is written, the others go on.
            group = MutuallyExclusiveCallbackGroup()
            service = self._node.create_service(kind, name, callback, qos_profile=qos, callback_group=group)
            built.callback(self._node.destroy_service, service)

    def load_at_start(self, path: str, relocalise: bool) -> None:
        """Load the state in a folder that the parameters name; raises ``ValueError``, of one line."""
        folder = self._folder.expanduser() / Path(path).expanduser()
        self._take(self._loaded(self._session(), folder, relocalise))

    def _loaded(self, present: "Session", folder: Path, relocalise: bool) -> "Loaded":
        session = present.loaded(folder)
        if self._localises:
            return session, session.localisation()
        return session, session.joining() if relocalise else None

    async def _on_save_trajectory(
        self, request: SaveTrajectory.Request, response: SaveTrajectory.Response
    ) -> SaveTrajectory.Response:
        trajectory, folder = self._trajectory(), self._folder
        response.success, response.message = await self._aside(lambda: _written(request.path, folder, trajectory))
        return response

    async def _on_save_state(self, request: SaveState.Request, response: SaveState.Response) -> SaveState.Response:
        """Save what the trajectory is at this moment."""
        try:
            session = self._session()
            arrays, frames = session.state(), session.core.newest().frames
            path = folder_inside(self._folder, request.path)
            await self._aside(lambda: session.write(path, arrays))
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


def _written(name: str, folder: Path, trajectory: "Trajectory | None") -> tuple[bool, str]:
    """Write a file in the folder; returns whether it succeeded, and a message for the user."""
    try:
        path = path_inside(folder, name)
        if trajectory is None:
            raise ValueError("the trajectory is empty; nothing was written")
        edges = edges_of(trajectory) if path.suffix == ".g2o" else ()
        write_trajectory(path, trajectory.stamps_ns, trajectory.poses_xyyaw, edges)
    except Exception as error:  # the caller of the service gets an answer in any case
        return False, " ".join(str(error).split()) or repr(error)
    return True, f"wrote {len(trajectory.stamps_ns)} poses to {path}"
