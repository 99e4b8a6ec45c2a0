"""The services that save and load all that a trajectory goes on with."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ngo_msgs.srv import LoadState, SaveState

from ngo_estimator.trajectory.save_path import folder_inside

if TYPE_CHECKING:
    from ngo_estimator.online.session import Session

Aside = Callable[[Callable[[], Any]], Awaitable[Any]]


class StateServices:
    """Answers ``~/save_state`` and ``~/load_state``; files are written and read aside, while relative poses go on."""

    def __init__(
        self, folder: str, aside: Aside, session: Callable[[], "Session"], take: Callable[["Session"], None]
    ) -> None:
        """Save ``session()`` and hand a loaded one to ``take``; paths lie in ``folder``.

        ``aside`` runs a function in a thread, and awaits its result.
        """
        self._folder, self._aside, self._session, self._take = Path(folder), aside, session, take

    def load_at_start(self, path: str) -> None:
        """Load the state in a folder that the parameters name; raises ``ValueError``, of one line."""
        self._take(self._session().loaded(self._folder.expanduser() / Path(path).expanduser()))

    async def on_save(self, request: SaveState.Request, response: SaveState.Response) -> SaveState.Response:
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

    async def on_load(self, request: LoadState.Request, response: LoadState.Response) -> LoadState.Response:
        """Load a state; the present trajectory goes on until it is whole."""
        try:
            _check_mode(request.mode)
            path, session = folder_inside(self._folder, request.path), self._session()
            loaded = await self._aside(lambda: session.loaded(path))
            self._take(loaded)
            response.success, response.message = True, f"loaded {loaded.core.newest().frames} poses from {path}"
        except ValueError as error:
            response.message = str(error)
        return response


def _check_mode(mode: int) -> None:
    modes = LoadState.Request
    if mode == modes.RELOCALISE:
        raise ValueError("mode is RELOCALISE, which this version does not have; expected CONTINUE")
    if mode != modes.CONTINUE:
        raise ValueError(f"mode is {mode}; expected {modes.CONTINUE} (CONTINUE) or {modes.RELOCALISE} (RELOCALISE)")
